"""The nearest known word to a mistyped one."""

from collections.abc import Iterable
from difflib import get_close_matches

#: Up to this many edits a word counts as mistyped rather than as another word.
TYPO_EDITS = 2


def edits(a: str, b: str) -> int:
    """Insertions, deletions, replacements and swaps of neighbours from `a` to `b` (optimal string alignment)."""
    before: list[int] = []
    above = list(range(len(b) + 1))
    for i, x in enumerate(a, 1):
        row = [i]
        for j, y in enumerate(b, 1):
            cost = min(above[j] + 1, row[j - 1] + 1, above[j - 1] + (x != y))
            if i > 1 and j > 1 and x == b[j - 2] and a[i - 2] == y:
                cost = min(cost, before[j - 2] + 1)
            row.append(cost)
        before, above = above, row
    return above[-1]


def is_typo(word: str, known: str) -> bool:
    """Whether `word` is `known` mistyped: few edits, and fewer than half of its letters."""
    if abs(len(word) - len(known)) > TYPO_EDITS:
        return False
    count = edits(word.lower(), known.lower())
    return count <= TYPO_EDITS and 2 * count < len(known)


def nearest(word: str, known: Iterable[str]) -> str:
    """The known word most like `word`, "" if none is like it. Of equally near ones the first is taken.

    Letters in the wrong place count as typos; failing that, the parts of a key may stand in any order.
    """
    words = list(known)
    typos = [candidate for candidate in words if is_typo(word, candidate)]
    if typos:
        return min(typos, key=lambda candidate: edits(word.lower(), candidate.lower()))
    in_order = {_parts_in_order(candidate): candidate for candidate in reversed(words)}
    like = get_close_matches(_parts_in_order(word[:64]), in_order, n=1, cutoff=0.5)
    return in_order[like[0]] if like else ""


def _parts_in_order(key: str) -> str:
    return "_".join(sorted(key.lower().split("_")))

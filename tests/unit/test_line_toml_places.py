"""The locator against an oracle that knows nothing of TOML: unique numbers, found again "
"by searching the text."""

import re
import tomllib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.toml_places import Path, line_of, places


def leaves(value: Any, path: Path = ()) -> dict[Path, Any]:
    """Every scalar of a parsed document by path."""
    if isinstance(value, dict):
        return {k: v for key, below in value.items() for k, v in leaves(below, (*path, key)).items()}
    if isinstance(value, list):
        return {k: v for i, below in enumerate(value) for k, v in leaves(below, (*path, i)).items()}
    return {path: value}


def check_by_search(text: str) -> int:
    """Each leaf of the form 7xxxx must be located on the line in which its digits stand. Returns how many."""
    where, count = places(text), 0
    for path, value in leaves(tomllib.loads(text)).items():
        assert path in where
        if isinstance(value, int) and value >= 70_000:
            expected = next(i for i, line in enumerate(text.split("\n"), 1) if re.search(rf"\b{value}\b", line))
            assert where[path] == expected, path
            count += 1
    return count


DOCUMENT = '''\
# [no] header = 70001
top = 70010
"quoted # key" = 70011
'literal ] key' . b = 70012
dotted.deep . "er\\"" = 70013
text = """
[fake]
key = 1 \\""" still """
after = 70014
raw = \'\'\'
x = 1 \\
'quoted' \'\'\'\'
then = 70015   # comment = 3
empty = ""
empties = ["", '', """""", \'\'\'\'\'\']
list = [ 70016, # one ]
  70017,

  [70018, "]", 70019], { a = 70020, b.c = [
  70021 ] },
]
date = 1979-05-27 07:32:00
inline = { x = 70022, "y z" = { w = "}" , v = 70023 } }
nothing = {}
none = []

[table]  # [other]
a = 70030
[table.sub."quo.ted"]
a = 70031
[ spaced . out ]
a = 70032

[[array]]
a = 70033
[array.sub]
b = 70034
[[array.sub.list]]
c = 70035
[[array]]
[[array.list]]
d = 70036
[[array.list]]
d = 70037'''


def test_every_construct_is_located() -> None:
    assert check_by_search(DOCUMENT) == 22
    where = places(DOCUMENT)
    assert DOCUMENT.split("\n")[where[("table", "sub", "quo.ted")] - 1] == '[table.sub."quo.ted"]'
    second = [i for i, line in enumerate(DOCUMENT.split("\n"), 1) if line == "[[array]]"][1]
    assert where[("array", 1)] == second
    assert where[("array", 1, "list", 0)] == second + 1


def test_a_missing_key_is_at_the_header_of_its_table() -> None:
    where = places("a = 1\n\n[[t]]\nx = 1\n[[t]]\ny = 2\n")
    assert line_of(where, ("t", 1, "x")) == 5
    assert line_of(where, ("t", 0, "deep", "er")) == 3
    assert line_of(where, ("nowhere",)) == 1
    assert line_of({}, ()) == 1


_bare = st.text("abcxyz_-019", min_size=1, max_size=5)
_any_key = st.one_of(_bare, st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=5))
_decoy = st.sampled_from(["", " ", "# x = 1", "# [t]", '# """', "# ]}", "\n", "# '"])
_text_value = st.sampled_from(
    ['"#"', "'[x]'", '"""\na = 1\n[[b]]\n"""', "'''\n}\n'''", '"\\"]"', "1.5e3", "true", "1979-05-27 07:32:00", "inf"]
)


def spelled(key: str) -> st.SearchStrategy[str]:
    if re.fullmatch(r"[A-Za-z0-9_-]+", key):
        return st.sampled_from([key, f'"{key}"', f"'{key}'", f" {key} "])
    escaped = "".join(f"\\U{ord(c):08x}" if c in '"\\' else c for c in key)
    return st.just(f'"{escaped}"')


@st.composite
def documents(draw: st.DrawFn) -> str:
    """A document in random spelling; its numbers are all different."""
    number = iter(range(70_000, 80_000))

    def value(depth: int, over_lines: bool) -> str:
        kind = draw(st.sampled_from(["number", "number", "other", "array", "table"] if depth else ["number"]))
        if kind == "other":
            other = draw(_text_value)
            return other if over_lines or "\n" not in other else "0"
        if kind == "array":
            gap = st.sampled_from(["", " ", "\n", " # , ]\n  "]) if over_lines else st.just(" ")
            parts = [f"{draw(gap)}{value(depth - 1, over_lines)}{draw(gap)}" for _ in range(draw(st.integers(0, 3)))]
            return "[" + ",".join(parts) + draw(st.sampled_from(["", ","] if parts else [""])) + draw(gap) + "]"
        if kind == "table":
            names = draw(st.lists(_any_key, max_size=3, unique=True))
            return "{" + ", ".join(f"{draw(spelled(k))} = {value(depth - 1, False)}" for k in names) + "}"
        return str(next(number))

    def pairs() -> str:
        names = draw(st.lists(_any_key, max_size=4, unique=True))
        return "".join(
            f"{draw(_decoy)}\n{draw(spelled(name))}{draw(st.sampled_from(['', '.k', ' . k.l']))} = "
            f"{value(2, True)}"
            f" {draw(st.sampled_from(['', '# end = 1']))}\n"
            for name in names
        )

    text = pairs()
    for table in draw(st.lists(st.integers(0, 5), max_size=6)):
        # Header names that no top-level key can have, so that a document never says a thing twice.
        if table < 3:
            text += f"[[ A{table} ]]\n{pairs()}" + draw(st.sampled_from(["", f"[A{table}.S-S]\nn = {next(number)}\n"]))
        else:
            text += f"[T{next(number)}.'S.']\n{pairs()}"
    return text


@given(documents())
def test_random_documents_are_located(text: str) -> None:
    check_by_search(text)


@pytest.mark.parametrize("text", ["", "\n\n", "# only a comment", "a = 70001", "[t]", "a = [\n]"])
def test_small_documents(text: str) -> None:
    check_by_search(text)

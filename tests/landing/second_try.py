"""Chance or fault: what failed is tried twice more, alone, each time in a process of its own, when the machine is calm.

A stall of the machine, a port that was taken and a neighbour's leak do not come back there; a fault does, or it is one
that comes and goes: then it is listed, and `tests.landing.known` does not let it stand for long.
"""

from collections.abc import Callable
from itertools import groupby

TRIES = 2
MOST_TRIED = 12  #: more, and it is no chance
NEVER_AGAIN = ("SyntaxError", "ImportError", "ModuleNotFoundError", "IndentationError")

Crashes = dict[str, str]  #: by test, or by file where it is not one test that failed: what it says

#: Runs these tests, or whole files, alone; the number tells their tries apart. Whether every one of them passed.
Try = Callable[[list[str], int], bool]


def tried_again(failed: Crashes, passes: Try) -> tuple[Crashes, Crashes]:
    """Of what failed: what passes in each try (intermittent), and what does not. A file's tests are tried together."""
    if len(failed) > MOST_TRIED:
        return {}, failed
    intermittent: Crashes = {}
    for file, group in groupby(sorted(failed), _file_of):
        tests = list(group)
        if any(failed[test].startswith(NEVER_AGAIN) for test in tests):
            continue
        asked = [file] if file in tests else tests
        if all(passes(asked, number) for number in range(1, TRIES + 1)):
            intermittent |= {test: failed[test] for test in tests}
    return intermittent, {test: crash for test, crash in failed.items() if test not in intermittent}


def _file_of(test: str) -> str:
    return test.partition("::")[0]

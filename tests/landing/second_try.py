"""Chance or fault: what failed is tried twice more, alone, each time in a process of its own, when the machine is calm.

A stall of the machine, a port that was taken and a neighbour's leak do not come back there; a fault does, or it is one
that comes and goes: then it is listed, and `tests.landing.known` does not let it stand for long.
"""

from collections.abc import Callable, Collection
from itertools import groupby

TRIES = 2
MOST_TRIED = 5  #: more, and it is no chance
#: How what a crash says begins where one more try says nothing: a stall is exactly when such faults show.
NEVER_AGAIN = ("SyntaxError", "ImportError", "ModuleNotFoundError", "IndentationError", "tests.support.recorder.")

Crashes = dict[str, str]  #: by test, or by file where it could not be collected: what it says

#: Runs the first alone, tests or a whole file; the number tells their tries apart. Whether all of the second passed.
Try = Callable[[list[str], list[str], int], bool]


def tried_again(failed: Crashes, whole: Collection[str], passes: Try) -> tuple[Crashes, Crashes]:
    """Of what failed: what passes in each try (intermittent), and what does not.

    A file's tests are tried together; all of the file is where one of them is in `whole`, and counts once then.
    """
    files = {_file_of(test) for test in whole}
    if len(files) + sum(_file_of(test) not in files for test in failed) > MOST_TRIED:
        return {}, failed
    intermittent: Crashes = {}
    for file, group in groupby(sorted(failed), _file_of):
        tests = list(group)
        if any(failed[test].startswith(NEVER_AGAIN) for test in tests):
            continue
        asked = [file] if file in files else tests
        if all(passes(asked, tests, number) for number in range(1, TRIES + 1)):
            intermittent |= {test: failed[test] for test in tests}
    return intermittent, {test: crash for test, crash in failed.items() if test not in intermittent}


def _file_of(test: str) -> str:
    return test.partition("::")[0]

"""One thing that `doctor` has looked at, and what came of it."""

from collections.abc import Iterable
from typing import Literal, NamedTuple

#: FAIL: repair or correct it before the line is armed. warning: it works, or somebody has set it so; look again.
Verdict = Literal["OK", "warning", "FAIL", "skipped"]
VERDICTS: tuple[Verdict, ...] = ("OK", "warning", "FAIL", "skipped")


class Check(NamedTuple):
    """`measured` is what was found, with its number; `wanted` what it is held against; `todo` what a person can do."""

    group: str
    subject: str  #: what was looked at: a device, a folder, a clock
    name: str  #: what of it; empty where the subject says all
    verdict: Verdict
    measured: str
    wanted: str = ""
    todo: str = ""


def counted(checks: Iterable[Check]) -> dict[Verdict, int]:
    """How many there are of each verdict."""
    verdicts = [check.verdict for check in checks]
    return {verdict: verdicts.count(verdict) for verdict in VERDICTS}

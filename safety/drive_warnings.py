"""What drives say of themselves that stops nothing, and that somebody should hear of: warnings, limits. Pure.

A warning comes with an error code (an emergency message, an error register) or as a bit of the statusword only: the bit
is given some time for its code. Each is told once, when it comes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import CountArray, DriveCondition, Inputs
from safety.actions import Action, Finding, found

LASTING_S = 0.5  #: a limit acts, or a warning has no code, until that is told
AGAIN_S = 10.0  #: the same warning of the same drive is not told again before
_LIMITED, _WARNS = int(DriveCondition.LIMITED), int(DriveCondition.WARNS)
_ONLY_THE_BIT = -1


@dataclass(frozen=True, slots=True)
class WarningLimits:
    names: Sequence[str]  #: of the drives, roller 1 first
    lasting: int  #: periods
    again: int


def warning_limits(line: Line) -> WarningLimits:
    period_s = line.control.period_s
    names = [drive.name for drive in sorted(line.drives, key=lambda drive: drive.roller)]
    return WarningLimits(names, max(1, round(LASTING_S / period_s)), max(1, round(AGAIN_S / period_s)))


@dataclass(slots=True)
class WarningState:
    """Of the drives of a line with `n` rollers; arrays (n,)."""

    n: int
    period: int = 0
    quiet: bool = True  #: nothing is said, and nothing was
    limited: CountArray = field(init=False)  #: periods in a row
    coded: CountArray = field(init=False)  #: the warning of the period before, as in `Inputs.drive_warning`
    uncoded: CountArray = field(init=False)  #: periods in a row with the bit and no code
    told: dict[tuple[int, int], int] = field(default_factory=dict[tuple[int, int], int])  #: drive and code: period

    def __post_init__(self) -> None:
        self.limited, self.coded, self.uncoded = np.zeros((3, self.n), np.int64)

    def begin_anew(self) -> None:
        """A person arms: what lasts is told again."""
        self.quiet = False
        self.limited, self.coded, self.uncoded = np.zeros((3, self.n), np.int64)
        self.told.clear()


def find_warnings(limits: WarningLimits, state: WarningState, inputs: Inputs) -> list[Finding]:
    """What is to be told of this period; none of it stops anything."""
    state.period += 1
    spoken = any(inputs.drive_condition.tobytes()) or any(inputs.drive_warning.tobytes())
    if state.quiet and not spoken:
        return []
    warns, limited = (inputs.drive_condition & bit != 0 for bit in (_WARNS, _LIMITED))
    coded = inputs.drive_warning.copy()
    state.limited = np.where(limited, state.limited + 1, 0)
    state.uncoded = np.where(warns & (coded == 0), state.uncoded + 1, 0)
    findings: list[Finding] = []
    for i in np.flatnonzero(state.limited == limits.lasting).tolist():
        findings.append(found("drive-limits", Action.NONE, drive=limits.names[i]))
    for i in np.flatnonzero((coded != state.coded) & (coded != 0)).tolist():
        if _is_due(limits, state, i, int(coded[i])):
            findings.append(_warning(limits.names[i], int(coded[i])))
    for i in np.flatnonzero(state.uncoded == limits.lasting).tolist():
        if _is_due(limits, state, i, _ONLY_THE_BIT):
            findings.append(found("drive-warns-without-code", Action.NONE, drive=limits.names[i]))
    state.coded, state.quiet = coded, not spoken
    return findings


def _is_due(limits: WarningLimits, state: WarningState, i: int, code: int) -> bool:
    """Whether this has not been told lately. What is told is remembered."""
    last = state.told.get((i, code))
    if last is not None and state.period - last < limits.again:
        return False
    for key in [key for key, period in state.told.items() if state.period - period >= limits.again]:
        del state.told[key]  # bounded: a drive that warns of something else every time is not remembered for ever
    state.told[i, code] = state.period
    return True


def _warning(name: str, warning: int) -> Finding:
    error_code, register = warning & 0xFFFF, warning >> 16
    return found("drive-warns", Action.NONE, drive=name, error_code=error_code, register=register)

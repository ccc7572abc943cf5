"""The runtime monitor: what speaks for the fallback while a configuration controls the line. Pure; time in periods.

Torques that chatter, torques that are cut again and again, and whether the fallback would still recover the line
(`recoverability`).

Chatter is what the gate and a probation measure, by the same limit (gate.chatter_max_nm): the root mean square of a
torque's change from period to period. They look where nothing moves; here changes that go on the same way are left
out, so that a step is none, and of a slower swing only its turns count. What is beyond the limit adds up, what is below
takes off (a cumulative sum, Page 1954): a torque that jumps there and back every period or two is found within tenths
of a second, one that is a tenth beyond the limit within seconds, and one that the gate has let through, under more
noise than the line has, never.
"""

from dataclasses import dataclass, field
from math import ceil, sqrt

import numpy as np

from gateway.control.deviation import Measured
from gateway.core.line import Line
from gateway.core.line_limits import chatter_limit_nm
from gateway.core.line_scales import line_scales
from gateway.core.signals import BoolArray, FloatArray
from safety.actions import Action, Finding, found
from safety.recoverability import Recovery

WINDOW_MOMENTS = 25.0
CHATTERED = 2.0  #: windows that a torque may have chattered by sqrt(2) of the limit, or half of one by sqrt(5) of it
MOST = 3.0  #: times the limit that a change counts for: where rates are high, a step and its way back are no chatter
CUT = 0.5  #: share of the window's periods in which a torque is cut
UNRECOVERABLE = {"span": "unrecoverable-tension", "roller": "unrecoverable-speed"}


@dataclass(frozen=True, slots=True)
class MonitorLimits:
    n: int
    chatter_nm: float  #: root mean square
    window: int  #: periods
    cuts: int

    @property
    def beyond_nm2(self) -> float:
        """What squared changes of one torque may add up to beyond the limit."""
        return CHATTERED * self.window * self.chatter_nm**2


def monitor_limits(line: Line) -> MonitorLimits:
    window = max(10, line_scales(line).periods(WINDOW_MOMENTS))
    return MonitorLimits(line.n, chatter_limit_nm(line), window, ceil(CUT * window))


def _none() -> FloatArray:
    return np.zeros(0)


@dataclass(slots=True)
class MonitorState:
    """Since a configuration took over."""

    before_nm: FloatArray | None = None  #: (n,)
    last_nm: FloatArray = field(default_factory=_none)  #: (n,), the last change of each torque that was none of 0
    counted: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))  #: whether that was chatter already
    beyond_nm2: FloatArray = field(default_factory=_none)  #: (n,), what chatter adds up to beyond the limit, squared
    periods: FloatArray = field(default_factory=_none)  #: (n,), since which it does
    cut: list[bool] = field(default_factory=list[bool])
    cuts: int = 0


def look(limits: MonitorLimits, state: MonitorState, torque_nm: FloatArray, cut: bool) -> list[Finding]:
    """A period's torque (n,) that is about to be sent, and whether a limit cut it: what speaks against the law."""
    if state.before_nm is None:
        state.before_nm = torque_nm
        state.last_nm, state.beyond_nm2, state.periods = np.zeros((3, limits.n))
        state.counted = np.zeros(limits.n, dtype=np.bool_)
        return []
    _chatter(limits.chatter_nm, state, torque_nm - state.before_nm)
    state.before_nm = torque_nm
    state.cut.append(cut)
    state.cuts += cut
    if len(state.cut) > limits.window:
        state.cuts -= state.cut.pop(0)
    findings: list[Finding] = []
    if not state.beyond_nm2.max() < limits.beyond_nm2:  # what is no number is beyond
        i = int(state.beyond_nm2.argmax())
        periods = max(int(state.periods[i]), 1)
        chatter_nm = sqrt(limits.chatter_nm**2 + float(state.beyond_nm2[i]) / periods)
        told = {"chatter_nm": chatter_nm, "periods": periods, "allowed_nm": limits.chatter_nm}
        findings.append(found("chattering", Action.NONE, roller=i + 1, **told))
    if state.cuts >= limits.cuts:
        counts = {"cuts": state.cuts, "periods": len(state.cut), "allowed": limits.cuts - 1}
        findings.append(found("torque-cut", Action.NONE, **counts))
    return findings


def recoverable(
    recovery: Recovery | None,
    measured: Measured,
    setpoint_n: FloatArray,
    in_flight_nm: FloatArray,
    torque_nm: FloatArray,
    remembered: FloatArray | None,
) -> list[Finding]:
    """Whether the fallback would still keep every tension, after `torque_nm`; nothing is said without a model."""
    if recovery is None:
        return []
    short = recovery.shortfall(measured, setpoint_n, in_flight_nm[: recovery.depth], torque_nm, remembered)
    return [] if short is None else [found(UNRECOVERABLE[short.what], Action.STOP, **short.parameters)]


def _chatter(limit_nm: float, state: MonitorState, change_nm: FloatArray) -> None:
    """A period's changes (n,) of the torques: where one turns round, it and the one that it turns round count.

    What is no number turns round.
    """
    change_nm = np.clip(change_nm, -MOST * limit_nm, MOST * limit_nm)
    turned = ~(change_nm * state.last_nm >= 0.0)
    square: FloatArray = change_nm**2 + np.where(state.counted, 0.0, state.last_nm**2)
    state.beyond_nm2 = np.maximum(state.beyond_nm2 + np.where(turned, square, 0.0) - limit_nm**2, 0.0)
    state.periods = np.where(state.beyond_nm2 > 0.0, state.periods + 1.0, 0.0)
    moved = change_nm != 0.0
    state.counted = np.where(moved, turned, state.counted)
    state.last_nm = np.where(moved, change_nm, state.last_nm)

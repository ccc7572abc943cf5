"""The runtime monitor: what speaks for the fallback while a configuration controls the line. Pure; time in periods.

It asks nothing of statistics: torques that turn round again and again, torques that are cut again and again, and
whether the fallback would still recover the line (`recoverability`).
"""

from dataclasses import dataclass, field
from math import ceil

import numpy as np

from gateway.control.deviation import Measured
from gateway.core.line import Line
from gateway.core.line_scales import line_scales
from gateway.core.signals import BoolArray, FloatArray
from safety.actions import Action, Finding, found
from safety.recoverability import Recovery

WINDOW_MOMENTS = 25.0
REVERSAL_SHARE_OF_STEP = 0.5  #: of the most that a torque may change by in a period: moves of more count
REVERSALS = 0.3  #: share of the window's periods in which a drive turns round: it chatters
CUT = 0.5  #: share of the window's periods in which a torque is cut
UNRECOVERABLE = {"span": "unrecoverable-tension", "roller": "unrecoverable-speed"}


@dataclass(frozen=True, slots=True)
class MonitorLimits:
    n: int
    reversal_nm: float
    window: int  #: periods
    reversals: int  #: of one drive within the window
    cuts: int


def monitor_limits(line: Line) -> MonitorLimits:
    period_s = line.control.period_s
    window = max(10, line_scales(line).periods(WINDOW_MOMENTS))
    reversal_nm = REVERSAL_SHARE_OF_STEP * line.limits.torque_rate_nm_per_s * period_s
    return MonitorLimits(line.n, reversal_nm, window, ceil(REVERSALS * window), ceil(CUT * window))


@dataclass(slots=True)
class MonitorState:
    """Since a configuration took over."""

    before_nm: FloatArray | None = None  #: (n,)
    way: FloatArray = field(default_factory=lambda: np.zeros(0))  #: -1 or 1: of each drive's last move that counts
    turned: list[BoolArray] = field(default_factory=list[BoolArray])  #: of the window's periods, (n,) each
    counts: FloatArray = field(default_factory=lambda: np.zeros(0))  #: (n,), turns in the window
    cut: list[bool] = field(default_factory=list[bool])
    cuts: int = 0


def look(limits: MonitorLimits, state: MonitorState, torque_nm: FloatArray, cut: bool) -> list[Finding]:
    """A period's torque (n,) that is about to be sent, and whether a limit cut it: what speaks against the law."""
    if state.before_nm is None:
        state.before_nm = torque_nm
        state.way, state.counts = np.zeros(limits.n), np.zeros(limits.n)
        return []
    state.way, turned = _turns(state.way, torque_nm - state.before_nm, limits.reversal_nm)
    state.before_nm = torque_nm
    state.turned.append(turned)
    state.counts += turned
    state.cut.append(cut)
    state.cuts += cut
    if len(state.cut) > limits.window:
        state.counts -= state.turned.pop(0)
        state.cuts -= state.cut.pop(0)
    findings: list[Finding] = []
    if state.counts.max() >= limits.reversals:
        i = int(state.counts.argmax())
        counts = {"reversals": int(state.counts[i]), "periods": len(state.cut), "allowed": limits.reversals - 1}
        findings.append(found("chattering", Action.NONE, roller=i + 1, reversal_nm=limits.reversal_nm, **counts))
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


def _turns(way: FloatArray, move_nm: FloatArray, reversal_nm: float) -> tuple[FloatArray, BoolArray]:
    """Which torques turn round by a period's `move_nm`, and the sign of the last move of each that counts; (n,)."""
    now = np.where(np.abs(move_nm) > reversal_nm, np.sign(move_nm), way)
    return now, now * way < 0.0

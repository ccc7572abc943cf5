"""What a run was worth, from sampled trajectories: the paper's metrics as written, and beside them the corrected ones.

Tensions and set-points (k, n) in N, torques (k, n) in Nm, evenly sampled at `time_s` (k,). y_inf, which the paper
leaves open, is the set-point at the end. As written, settling time counts from the start of the run and overshoot takes
the greatest tension against the level of all; corrected, both are per span, from the change, overshoot in the direction
of the set-point's step and relative to its size (to the set-point itself where it does not step).
"""

from dataclasses import dataclass
from math import inf

import numpy as np

from gateway.core.line import Priorities
from gateway.core.signals import FloatArray

BAND = 0.02  #: of y_inf, within which a tension has settled


def rmse_n(tension_n: FloatArray, setpoint_n: FloatArray) -> float:
    """Root of the time mean of the squared 2-norm over all spans (eq. rmse), in N. Arrays (k, n), evenly sampled."""
    error: FloatArray = tension_n - setpoint_n
    return float(np.sqrt(np.sum(error**2) / len(error)))


def rmse_per_span_n(tension_n: FloatArray, setpoint_n: FloatArray) -> FloatArray:
    """Root mean square error of each span, (n,) in N. Their root sum of squares is `rmse_n`."""
    return np.sqrt(np.mean((tension_n - setpoint_n) ** 2, axis=0, dtype=np.float64))


def settling_time_paper_s(time_s: FloatArray, tension_n: FloatArray, setpoint_n: FloatArray) -> float:
    """Eq. settling_time: from the start of the run until ||y - y_inf|| stays within 2 % of ||y_inf||; inf: never."""
    final = setpoint_n[-1]
    outside = ~(np.linalg.norm(tension_n - final, axis=1) <= BAND * np.linalg.norm(final))  # what is no number, too
    return _since(time_s, outside) + float(time_s[0])


def settling_time_s(time_s: FloatArray, tension_n: FloatArray, setpoint_n: FloatArray, changed_s: float) -> FloatArray:
    """Per span (n,), from the change at `changed_s` until it stays within 2 % of its set-point; inf: never.

    What is no number is outside, and where there is no sample after the change nothing has settled.
    """
    after = time_s >= changed_s
    final = setpoint_n[-1]
    if not after.any():
        return np.full(len(final), inf)
    outside = ~(np.abs(tension_n[after] - final) <= BAND * final)
    return np.array([_since(time_s[after], column) for column in outside.T])


def overshoot_paper_pct(tension_n: FloatArray, setpoint_n: FloatArray) -> float:
    """Eq. overshoot: the greatest tension of each span against y_inf, in norms."""
    final = setpoint_n[-1]
    return float(100.0 * np.linalg.norm(tension_n.max(axis=0) - final) / np.linalg.norm(final))


def overshoot_pct(time_s: FloatArray, tension_n: FloatArray, setpoint_n: FloatArray, changed_s: float) -> FloatArray:
    """Per span (n,), of the step's size, in its direction; of the set-point, either way, where it does not step."""
    step: FloatArray = setpoint_n[-1] - setpoint_n[0]
    error: FloatArray = tension_n[time_s >= changed_s] - setpoint_n[-1]
    beyond = np.where(step == 0.0, np.abs(error), np.sign(step) * error).max(axis=0)
    return 100.0 * np.maximum(beyond, 0.0) / np.where(step == 0.0, setpoint_n[-1], np.abs(step))


def effort_n2m2s(time_s: FloatArray, torque_nm: FloatArray) -> float:
    """Eq. control_effort: the integral of u'u over the run, torques held from sample to sample."""
    return float(np.sum(torque_nm[:-1] ** 2 * np.diff(time_s)[:, None]))


@dataclass(frozen=True)
class RunMetrics:
    """All metrics of a run, as written (`paper`) and corrected; (n,) per span."""

    rmse_n: float
    rmse_per_span_n: FloatArray
    settling_s: FloatArray  #: inf: never
    settling_paper_s: float
    overshoot_pct: FloatArray
    overshoot_paper_pct: float
    effort_n2m2s: float


def run_metrics(
    time_s: FloatArray, tension_n: FloatArray, setpoint_n: FloatArray, torque_nm: FloatArray, changed_s: float
) -> RunMetrics:
    """Metrics of sampled trajectories, with the change at `changed_s`."""
    return RunMetrics(
        rmse_n=rmse_n(tension_n, setpoint_n),
        rmse_per_span_n=rmse_per_span_n(tension_n, setpoint_n),
        settling_s=settling_time_s(time_s, tension_n, setpoint_n, changed_s),
        settling_paper_s=settling_time_paper_s(time_s, tension_n, setpoint_n),
        overshoot_pct=overshoot_pct(time_s, tension_n, setpoint_n, changed_s),
        overshoot_paper_pct=overshoot_paper_pct(tension_n, setpoint_n),
        effort_n2m2s=effort_n2m2s(time_s, torque_nm),
    )


@dataclass(frozen=True)
class Performance:
    """P = [RMSE, OS, t_s] of a run (as corrected, of the worst span), and what else S weighs."""

    rmse_n: float
    overshoot_pct: float
    settling_s: float
    effort_n2m2s: float
    robustness_n: float  #: R
    compute_s: float  #: C_comp, per step

    def vector(self) -> FloatArray:
        """[e_RMSE, t_s, OS, U_total, R, C_comp], the order of eq. performance_score."""
        return np.array(
            [self.rmse_n, self.settling_s, self.overshoot_pct, self.effort_n2m2s, self.robustness_n, self.compute_s]
        )


def score(found: Performance, priorities: Priorities) -> float:
    """S = w . [six metrics] (eq. performance_score); inf where one of them is."""
    return float(weights(priorities) @ found.vector()) if np.isfinite(found.vector()).all() else inf


def weights(priorities: Priorities) -> FloatArray:
    """w, in the order of `Performance.vector`."""
    p = priorities
    return np.array(
        [p.rmse_per_n, p.settling_per_s, p.overshoot_per_pct, p.effort_per_n2m2s, p.robustness_per_n, p.compute_per_s]
    )


def _since(time_s: FloatArray, outside: FloatArray) -> float:
    """Seconds from the first sample to the one behind the last that is `outside` (k,)."""
    found = np.flatnonzero(outside)
    if not len(found):
        return 0.0
    return float(time_s[found[-1] + 1] - time_s[0]) if found[-1] + 1 < len(time_s) else inf

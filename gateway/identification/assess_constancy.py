"""Whether one line made the data: parameters before and after any instant must be the same."""

from collections.abc import Sequence
from math import exp, log

import numpy as np

from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.identification.findings import Finding, Severity
from gateway.identification.regressions import EquationFit, Stretch, fit_roller, fit_span, stretches_of

#: Coefficient, name, and the log of its ratio before and after up to which it may be wear, heat or a reel.
DRIFTS = {"span": ((0, "EA/L", 0.04),), "roller": ((0, "R/J", 0.04), (1, "f/J", 0.1))}
DRIFT_SIGMAS = 5.0
JOINTS = (0.15, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85)  #: where the data are divided


def assess_constancy(recording: Recording, line: Line, fits: Sequence[EquationFit]) -> list[Finding]:
    """Parameters before and after some instants: two lines' files in one contradict each other."""
    stretches = stretches_of(recording, line)
    times = np.concatenate([s.data.time_s[s.k] for s in stretches]) if stretches else np.zeros(0)
    worst: tuple[float, float, float, str] | None = None
    for part in JOINTS if len(times) else ():
        at_s = float(np.quantile(times, part))
        early, late = _cut(stretches, at_s, False), _cut(stretches, at_s, True)
        for fit in fits if early and late else ():
            first, second = _again(early, line, fit), _again(late, line, fit)
            for k, name, drift in DRIFTS[fit.kind]:
                moved, deviation = _moved(first, second, k)
                sigmas = (abs(moved) - drift) / deviation
                if sigmas > DRIFT_SIGMAS and (worst is None or sigmas > worst[0]):
                    worst = (sigmas, at_s, moved, f"{name} of {fit.kind} {fit.index + 1}")
    if worst is None:
        return []
    _, at_s, moved, name = worst
    what = f"{name} is {exp(moved):.3g} times as large after {at_s:.6g} s as before"
    mend = "the file holds two lines, two products or two scales: give each by itself"
    return [Finding("mixed", Severity.REFUSAL, what, f"about {at_s:.6g} s", exp(abs(moved)), 1.0, mend)]


def _moved(first: EquationFit, second: EquationFit, k: int) -> tuple[float, float]:
    """Log of the ratio of a coefficient after and before, and its standard deviation."""
    a, b = (max(float(fit.coefficients[k]), 1e-300) for fit in (first, second))
    a_off, b_off = (float(np.sqrt(fit.covariance[k, k])) for fit in (first, second))
    return log(b / a), float(np.hypot(a_off / a, b_off / b))


def _cut(stretches: list[Stretch], at_s: float, late: bool) -> list[Stretch]:
    parts = [Stretch(s.data, s.k[(s.data.time_s[s.k] >= at_s) == late]) for s in stretches]
    return [part for part in parts if len(part.k) > 40]


def _again(stretches: list[Stretch], line: Line, fit: EquationFit) -> EquationFit:
    if fit.kind == "roller":
        return fit_roller(stretches, line, fit.index, float(fit.shift_s[0]), fit.colour)
    return fit_span(stretches, line, fit.index, fit.shift_s, fit.colour)

"""Whether the data move the line enough for the intervals wanted, and over enough speed to tell frictions apart."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.unnamed_terms import widest
from gateway.identification.findings import EXCITATION, Finding, Severity
from gateway.identification.regressions import MOVING, WINDOW_S, EquationFit, moving

AMPLITUDE_N, DURATION_S = 2.0, 5.0  #: of the experiment that is recommended where nothing better is known
SPEED_SPREAD = 0.5  #: of the mean: with less there is one speed
LONGEST_S = 60.0  #: a recommendation asks for more amplitude rather than for longer


@dataclass(frozen=True)
class Wanted:
    """Relative half-widths (95 %) of what all rollers or spans share, and of the Coulomb friction (Nm)."""

    stiffness_per_length: float = 0.02
    radius_per_inertia: float = 0.02
    friction_per_inertia: float = 0.03
    coulomb_nm: float = 0.5
    apart: float = 0.05  #: of EA, L, R, J and f, each by itself


def predicted_intervals(fits: Sequence[EquationFit], line: Line) -> dict[str, float]:
    """By the names of `Estimate.intervals`: relative half-widths of 95 %; coulomb_nm in Nm. Of what all share."""
    rollers = [fit for fit in fits if fit.kind == "roller"]
    spans = [fit for fit in fits if fit.kind == "span"]
    found: dict[str, float] = {}
    if spans:
        found["stiffness_per_length"] = _pooled([_relative(fit, [1.0, 0.0]) for fit in spans])
        apart = _pooled([_relative(fit, [0.0, 1.0]) for fit in spans])
        found["length_m"] = min(apart, widest([span.length_m for span in line.spans]))
        found["stiffness_n"] = float(np.hypot(found["length_m"], found["stiffness_per_length"]))
    if rollers:
        found["radius_per_inertia"] = _pooled([_relative(fit, [1.0, 0.0, 0.0, 0.0]) for fit in rollers])
        found["friction_per_inertia"] = _pooled([_relative(fit, [0.0, 1.0, 0.0, 0.0]) for fit in rollers])
        found["radius2_per_inertia"] = _pooled([_relative(fit, [0.0, 0.0, 1.0, 0.0]) for fit in rollers])
        radius = _pooled([_relative(fit, [-1.0, 0.0, 1.0, 0.0]) for fit in rollers])
        inertia = _pooled([_relative(fit, [-2.0, 0.0, 1.0, 0.0]) for fit in rollers])
        friction = _pooled([_relative(fit, [-2.0, 1.0, 1.0, 0.0]) for fit in rollers])
        found["radius_m"] = min(radius, widest([one.radius_m for one in line.rollers]))
        found["inertia_kg_m2"] = min(inertia, widest([one.inertia_kg_m2 for one in line.rollers]))
        found["friction_nms_per_rad"] = min(friction, widest([one.friction_nms_per_rad for one in line.rollers]))
        found["coulomb_nm"] = float(np.median([_coulomb(fit) for fit in rollers]))
    return found


def assess_excitation(
    recording: Recording, line: Line, fits: Sequence[EquationFit], predicted: dict[str, float], wanted: Wanted
) -> list[Finding]:
    found: list[Finding] = []
    lacking = 1.0
    strong = (
        ("EA/L", "stiffness_per_length", wanted.stiffness_per_length),
        ("R/J", "radius_per_inertia", wanted.radius_per_inertia),
        ("f/J", "friction_per_inertia", wanted.friction_per_inertia),
    )
    for title, name, limit in strong:
        if name in predicted and predicted[name] > limit:
            lacking = max(lacking, predicted[name] / limit)
            what = f"these data tell it to +-{predicted[name]:.1%}, wanted is +-{limit:.1%}"
            found.append(Finding(EXCITATION, Severity.REFUSAL, what, title, predicted[name], limit))
    for kind, title, unit in (("roller", "speed", "m/s"), ("span", "tension", "N")):
        quiet = [fit for fit in fits if fit.kind == kind and not moving(fit)]
        if quiet:
            names = f"{kind} {', '.join(str(fit.index + 1) for fit in quiet)}"
            worst = min(fit.change for fit in quiet)
            what = f"{title} moves hardly more than by noise (least {worst:.2g} {unit} in {WINDOW_S:g} s)"
            found.append(Finding(EXCITATION, Severity.REFUSAL, what, names, worst, MOVING))
    text = _experiment(recording, lacking if found else 1.0)
    found = [Finding(f.kind, f.severity, f.what, f.where, f.value, f.limit, f.mend, text) for f in found]
    return found + _friction(recording, predicted, wanted) + _apart(predicted, wanted)


def _friction(recording: Recording, predicted: dict[str, float], wanted: Wanted) -> list[Finding]:
    """Coulomb friction is told from viscous friction by different speeds."""
    found: list[Finding] = []
    speeds = np.nanmean(recording.speed_m_per_s[recording.controlled], axis=1)
    low, high = np.quantile(speeds, (0.05, 0.95)).tolist()
    spread = (high - low) / max(abs(float(np.mean(speeds))), 1e-9)
    text = f"the same at a second speed, {0.5 * high:.3g} or {2.0 * high:.3g} m/s as the line permits"
    coulomb = predicted.get("coulomb_nm", 0.0)
    if coulomb > wanted.coulomb_nm:
        what = f"Coulomb friction is told from viscous to +-{coulomb:.2g} Nm, wanted is +-{wanted.coulomb_nm:g} Nm"
        found.append(Finding("one speed", Severity.WARNING, what, "friction", coulomb, wanted.coulomb_nm, "", text))
    elif spread < SPEED_SPREAD:
        what = f"there is one speed, {low:.3g} to {high:.3g} m/s: friction elsewhere is taken from there"
        found.append(Finding("one speed", Severity.NOTE, what, "friction", spread, SPEED_SPREAD, "", text))
    return found


def _apart(predicted: dict[str, float], wanted: Wanted) -> list[Finding]:
    """What only weak terms of the equations tell."""
    found: list[Finding] = []
    for title, name, mend in (
        ("EA and L", "length_m", "measure the length of the spans, and give it a small tolerance"),
        ("R, J and f", "radius_m", "measure the radius of the rollers, and give it a small tolerance"),
    ):
        if predicted.get(name, 0.0) > wanted.apart:
            what = f"each by itself is told to +-{predicted[name]:.0%} by simple regressions: their ratios are strong"
            found.append(Finding("weak", Severity.NOTE, what, title, predicted[name], wanted.apart, mend))
    return found


def _experiment(recording: Recording, lacking: float) -> str:
    """From what moved the line here: intervals go with 1 / (amplitude sqrt(duration))."""
    setpoint = recording.tension_setpoint_n[recording.controlled]
    moved = float(np.nanmax(np.nanstd(setpoint, axis=0))) if np.isfinite(setpoint).any() else 0.0
    there_s = recording.period_s * float(np.sum(recording.controlled))
    duration_s = there_s * lacking**2
    if moved >= 0.5 * AMPLITUDE_N and duration_s <= LONGEST_S:
        amplitude_n = moved
    else:
        amplitude_n, duration_s = AMPLITUDE_N, DURATION_S
    return (
        f"every tension set-point moved at random by +-{amplitude_n:.2g} N, each 0.1 s, for {ceil(duration_s)} s,"
        " under control"
    )


def _relative(fit: EquationFit, powers: list[float]) -> float:
    """Standard deviation of the log of a product of powers of the coefficients."""
    value = np.where(np.abs(fit.coefficients) > 1e-300, fit.coefficients, 1e-300)
    weight: FloatArray = np.array(powers) / value
    return float(np.sqrt(max(weight @ fit.covariance @ weight, 0.0)))


def _pooled(deviations: list[float]) -> float:
    """Half-width of 95 % of what several measure."""
    return 1.96 / float(np.sqrt(np.sum(1.0 / np.maximum(deviations, 1e-12) ** 2)))


def _coulomb(fit: EquationFit) -> float:
    """Half-width in Nm: R c/J over R/J."""
    return 1.96 * float(np.sqrt(fit.covariance[3, 3])) / max(abs(float(fit.coefficients[0])), 1e-300)

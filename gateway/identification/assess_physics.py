"""Whether channels belong together as the two equations say: swapped, frozen, of wrong unit, sign or line.

Each equation must explain most of what its channel does, with parameters that the line's file allows. Where one does
not, exchanges of two channels are tried: the one that mends all equations that it touches is named.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import exp, log

import numpy as np

from gateway.core.line import Line, Parameter
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.identification.assess_channels import Unit, force_units, likely_units, speed_units, torque_units
from gateway.identification.assess_constancy import assess_constancy
from gateway.identification.findings import Finding, Severity
from gateway.identification.regressions import (
    WINDOW_S,
    EquationFit,
    Stretch,
    fit_roller,
    fit_span,
    has_cell,
    moving,
    should_move,
    stretches_of,
)

EXPLAINED = 0.7  #: share of changes that an equation must explain
SURE = 0.95  #: an equation that explains so much is judged, however little moves
RANGE_MARGIN = 1.1  #: ratio beyond the corners of the tolerances, beside the interval
PEERS = 1.5  #: ratio to the median of the other rollers or spans, each over its own nominal value
_MOST_SWAPS = 3
_COLOUR = {"roller": 0.2, "span": 0.9}  #: of quick fits


@dataclass(frozen=True)
class _Equation:
    kind: str
    index: int

    def channels(self) -> set[str]:
        """Without those that hardly matter."""
        i = self.index
        if self.kind == "roller":
            return {f"speed_{i + 1}_m_per_s", f"torque_{i + 1}_nm"}
        before = f"speed_{i}_m_per_s" if i else "unwind_speed_m_per_s"
        return {f"tension_{i + 1}_n", f"speed_{i + 1}_m_per_s", before}

    def __str__(self) -> str:
        return f"{self.kind} {self.index + 1}"


def assess_physics(recording: Recording, line: Line, fits: Sequence[EquationFit], suspects: set[str]) -> list[Finding]:
    """`suspects`: channels of which something grave was found already; nothing more is said of their equations."""
    free = [fit for fit in fits if not _of(fit).channels() & suspects]
    still = [fit for fit in free if not moving(fit) and should_move(fit) and fit.explained < EXPLAINED]
    judged = [fit for fit in free if moving(fit) or fit.explained > SURE]
    bad = {_of(fit) for fit in judged if not fit.explained >= EXPLAINED or _backwards(fit)}  # NaN explains nothing
    swaps, left = _swaps(recording, line, bad | {_of(fit) for fit in still})
    found = [*swaps, *(_still(fit) for fit in still if _of(fit) in left)]
    frozen = {finding.where for finding in found}
    found += _unexplained([fit for fit in judged if _of(fit) in left and not _of(fit).channels() & frozen], line)
    named = {channel for swap in swaps for channel in swap.where.split(" and ")}
    clear = [fit for fit in judged if _of(fit) not in bad and not _of(fit).channels() & (named | frozen)]
    found += _ranges(clear, line)
    return found or assess_constancy(recording, line, clear)


def _still(fit: EquationFit) -> Finding:
    """A sensor that shows noise around one value while what drives it moves."""
    name, unit, by = f"tension_{fit.index + 1}_n", "N", "speeds"
    if fit.kind == "roller":
        name, unit, by = f"speed_{fit.index + 1}_m_per_s", "m/s", "torque"
    what = f"it moves by {fit.change:.2g} {unit} in {WINDOW_S:g} s, {by} should move it by {fit.driven:.2g}"
    mend = "the sensor is frozen, or its wire is off"
    return Finding("frozen", Severity.REFUSAL, what, name, fit.change, fit.driven, mend)


def log_ratio(fit: EquationFit, line: Line) -> tuple[float, float, float, float]:
    """Of EA/L of a span or R/J of a roller to the nominal value: log, its deviation, least and most by the file."""
    top, bottom = _parameters(fit, line)
    value, deviation = float(fit.coefficients[0]), float(np.sqrt(fit.covariance[0, 0]))
    least = log((1.0 - top.tolerance) / (1.0 + bottom.tolerance))
    most = log((1.0 + top.tolerance) / (1.0 - bottom.tolerance))
    return log(max(value, 1e-300) * bottom.value / top.value), deviation / max(abs(value), 1e-300), least, most


def _parameters(fit: EquationFit, line: Line) -> tuple[Parameter, Parameter]:
    if fit.kind == "span":
        return line.web.stiffness_n, line.spans[fit.index].length_m
    return line.rollers[fit.index].radius_m, line.rollers[fit.index].inertia_kg_m2


def _of(fit: EquationFit) -> _Equation:
    return _Equation(fit.kind, fit.index)


def _backwards(fit: EquationFit) -> bool:
    return float(fit.coefficients[0]) < -5.0 * float(np.sqrt(fit.covariance[0, 0]))


def _swaps(recording: Recording, line: Line, bad: set[_Equation]) -> tuple[list[Finding], set[_Equation]]:
    """Exchanges that mend equations, the best first, and the equations that none mends."""
    found: list[Finding] = []
    while bad and len(found) < _MOST_SWAPS:
        tried = [_trial(recording, line, pair, bad) for pair in _pairs(line.n, bad)]
        good = [trial for trial in tried if trial is not None]
        if not good:
            break
        explained, (a, b), recording, mended = max(good, key=lambda trial: (len(trial[3]), trial[0]))
        what = f"exchanged, they explain {explained:.0%} of what the equations say; as recorded, below {EXPLAINED:.0%}"
        mend = "exchange the two channels in the file's columns, or the two wires"
        found.append(Finding("swapped", Severity.REFUSAL, what, f"{a} and {b}", explained, EXPLAINED, mend))
        bad = bad - mended
    return found, bad


def _pairs(n: int, bad: set[_Equation]) -> Iterable[tuple[str, str]]:
    """Pairs of one kind, each of a bad equation."""
    touched = {channel for equation in bad for channel in equation.channels()}
    speeds = ["unwind_speed_m_per_s", *(f"speed_{i + 1}_m_per_s" for i in range(n))]
    for names in (
        speeds,
        [f"tension_{i + 1}_n" for i in range(n)],
        [f"torque_{i + 1}_nm" for i in range(n)],
    ):
        yield from combinations([name for name in names if name in touched], 2)


def _trial(
    recording: Recording, line: Line, pair: tuple[str, str], bad: set[_Equation]
) -> tuple[float, tuple[str, str], Recording, set[_Equation]] | None:
    """The exchange of a pair, if all equations that it touches are good after it and one was bad before."""
    swapped = exchanged(recording, pair)
    stretches = stretches_of(swapped, line)
    rollers = {_Equation("roller", i) for i in range(line.n)}
    spans = {_Equation("span", i) for i in range(line.n) if has_cell(recording, i)}
    touched = {equation for equation in rollers | spans if equation.channels() & set(pair)}
    if not stretches or not touched & bad:
        return None
    worst = 1.0
    for equation in touched:
        fit = _quick(stretches, line, equation)
        value, deviation, least, most = log_ratio(fit, line)
        margin = 1.96 * deviation + log(RANGE_MARGIN)
        worst = min(worst, fit.explained)
        if not fit.explained >= EXPLAINED or not least - margin < value < most + margin:
            return None
    return worst, pair, swapped, touched & bad


def exchanged(recording: Recording, pair: tuple[str, str]) -> Recording:
    values = {name: _channel(recording, name) for name in pair}
    arrays: dict[str, FloatArray] = {}
    for name, other in (pair, pair[::-1]):
        array, column = _where(name)
        target = arrays.setdefault(array, np.array(getattr(recording, array)))
        target[(slice(None), column) if column is not None else slice(None)] = values[other]
    return replace(recording, **arrays)


def _channel(recording: Recording, name: str) -> FloatArray:
    array, column = _where(name)
    values = np.array(getattr(recording, array))
    return values if column is None else values[:, column]


def _where(name: str) -> tuple[str, int | None]:
    if name == "unwind_speed_m_per_s":
        return name, None
    kind, number, unit = name.split("_", 2)
    return f"{kind}_{unit}", int(number) - 1


def _quick(stretches: list[Stretch], line: Line, equation: _Equation) -> EquationFit:
    colour = _COLOUR[equation.kind]
    if equation.kind == "roller":
        return fit_roller(stretches, line, equation.index, 0.0, colour)
    return fit_span(stretches, line, equation.index, np.zeros(2), colour)


def _unexplained(bad: Sequence[EquationFit], line: Line) -> list[Finding]:
    """What no exchange mends: a sign, a sensor that does not move, columns of two lines, or something else."""
    found: list[Finding] = []
    rest: list[EquationFit] = []
    for fit in bad:
        own = f"torque_{fit.index + 1}_nm" if fit.kind == "roller" else f"tension_{fit.index + 1}_n"
        if _backwards(fit) and fit.explained > EXPLAINED:
            what = f"{'speed' if fit.kind == 'roller' else 'tension'} moves against what it should: the sign is wrong"
            value = float(fit.coefficients[0])
            found.append(Finding("sign", Severity.REFUSAL, what, own, value, 0.0, "change its sign"))
        else:
            rest.append(fit)
    for kind, title in (("roller", "torques and speeds"), ("span", "tensions and speeds")):
        count = line.n if kind == "roller" else sum(span.control == "tension" for span in line.spans)
        mine = [fit for fit in rest if fit.kind == kind]
        if count > 1 and len(mine) > 0.6 * count:
            explained = float(np.median([fit.explained for fit in mine]))
            what = f"{title} do not belong together on {len(mine)} of {count} {kind}s ({explained:.0%} explained)"
            mend = "take all columns from one line's recording of one time"
            found.append(Finding("mixed", Severity.REFUSAL, what, title, explained, EXPLAINED, mend))
            rest = [fit for fit in rest if fit.kind != kind]
    return found + [_left(fit) for fit in rest]


def _left(fit: EquationFit) -> Finding:
    channels = ", ".join(sorted(_of(fit).channels()))
    what = f"{max(fit.explained, 0.0):.0%} of its changes are explained by {channels}"
    mend = "one of these channels is frozen, noisy, of another line, or wired to another place"
    return Finding("unexplained", Severity.REFUSAL, what, str(_of(fit)), fit.explained, EXPLAINED, mend)


def _ranges(fits: Sequence[EquationFit], line: Line) -> list[Finding]:
    """Parameters against the file's tolerances and against each other: units, and files of other lines."""
    found: list[Finding] = []
    common: dict[str, float] = {}
    for kind in ("span", "roller"):
        mine = [fit for fit in fits if fit.kind == kind]
        if mine:
            alone, common[kind] = _alone(mine, line)
            found += alone
    stiff, driven = common.get("span"), common.get("roller")
    if stiff is not None and driven is not None and abs(stiff) > log(PEERS) and abs(stiff + driven) < log(2.0):
        factor = 0.5 * (driven - stiff)
        speeds = _together("speeds", factor, speed_units(line, 0), "m/s", stiff, fits, line, "span")
        found, common = found + speeds, {} if speeds else common
    for kind, title, units, unit, sign in (
        ("span", "tensions", force_units(), "N", 1.0),
        ("roller", "torques", torque_units(line, 0), "Nm", -1.0),
    ):
        if kind in common:
            found += _together(title, sign * common[kind], units, unit, common[kind], fits, line, kind)
    return found


def _alone(fits: Sequence[EquationFit], line: Line) -> tuple[list[Finding], float]:
    """Those that differ from the others, and the median of the logs of ratios to nominal values."""
    logs = [log_ratio(fit, line)[0] for fit in fits]
    median = float(np.median(logs))
    if len(fits) < 3:
        return [], median
    found: list[Finding] = []
    for fit, value in zip(fits, logs, strict=True):
        off = value - median
        _, deviation, least, most = log_ratio(fit, line)
        if abs(off) - 1.96 * deviation < log(PEERS):
            continue
        span = fit.kind == "span"
        units = force_units() if span else torque_units(line, fit.index)
        unit = likely_units(exp(off if span else -off), units, 1.3)
        outside = not least - log(RANGE_MARGIN) < value < most + log(RANGE_MARGIN)
        severity = Severity.REFUSAL if unit or outside else Severity.WARNING
        name = f"tension_{fit.index + 1}_n" if span else f"torque_{fit.index + 1}_nm"
        what = f"{_parameter(fit)} is {exp(value):.3g} of the file's value, on the other {fit.kind}s {exp(median):.3g}"
        mend = f"this may be in {unit}: give it in {'N' if span else 'Nm'}" if unit else _other(fit)
        found.append(Finding("unit" if unit else "spread", severity, what, name, exp(off), PEERS, mend))
    return found, median


def _together(
    title: str, factor: float, units: Sequence[Unit], si: str, value: float, fits: Sequence[EquationFit], line: Line,
    kind: str,
) -> list[Finding]:  # fmt: skip
    """All of a kind outside the tolerances: a common unit, or another line's file. `factor` is a log."""
    mine = [fit for fit in fits if fit.kind == kind]
    _, deviation, least, most = log_ratio(mine[0], line)
    margin = log(RANGE_MARGIN) + 1.96 * deviation
    if least - margin < value < most + margin:
        return []
    unit = likely_units(exp(factor), units, exp(most))
    allowed = f"{exp(least):.2g} to {exp(most):.2g}"
    what = f"{_parameter(mine[0])} is {exp(value):.3g} of the file's value, allowed are {allowed}"
    mend = (
        f"these may be in {unit}: give them in {si}"
        if unit
        else "this is another line than the file says, or a parameter there is wrong"
    )
    return [Finding("unit" if unit else "range", Severity.REFUSAL, what, f"all {title}", exp(value), exp(most), mend)]


def _parameter(fit: EquationFit) -> str:
    return "EA/L" if fit.kind == "span" else "R/J"


def _other(fit: EquationFit) -> str:
    return (
        f"check scale and {'length' if fit.kind == 'span' else 'radius and inertia'} of {_of(fit)} in the line's file"
    )

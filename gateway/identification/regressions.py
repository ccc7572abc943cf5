"""Simple regressions of the two equations, one roller or span at a time: what data can say before anything is fitted.

Between two samples, h apart, and divided by h:

    dv_i = R/J <u_i(t - latency - delay)> - f/J <v_i> + R^2/J <T_{i+1} - T_i> - R/J c                     (roller i)
    dT_i = EA/L (<v_i(t + lead_1)> - <v_{i-1}(t + lead_0)>) + 1/L <T_{i-1} v_{i-1} - T_i v_i> + constant  (span i)

<> is the mean over the interval: exact for a held torque, by trapezoids for what is measured. The mean of two samples
is not correlated with their difference by white noise of the sensor, so the slopes are not drawn to zero as those of
differences on samples are. Noise of sensor and process make the differences' errors a moving average of the first
order, e_k - c e_{k-1}: rows are divided by 1 - c q^-1. R^2/J and 1/L, about which a few seconds say little, have a
prior, the line's file; all else is the data's own.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise
from gateway.core.web_model import nominal_model
from gateway.identification.coloured_regression import VAGUE_S, Solved, coloured

LEAST_SAMPLES = 60  #: of a stretch that is used
MOST_STRETCHES = 20  #: the longest ones: each brings an unknown of its own
LEAST_REACH_S, REACH_PERIODS = 0.03, 5  #: shifts are looked for so far either way, the larger of both
WINDOW_S = 0.1  #: over which changes are compared with what the equation says of them
MOVING_SHARE = 0.2  #: of these windows: those with most movement, so that quiet hours hide nothing
MOVING = 5.0  #: times what noise makes of such changes
_FINE = 200  #: steps per period of the profile likelihood
_GAUSS_NEWTON_STEPS = 12


@dataclass(frozen=True)
class EquationFit:
    """Of roller or span `index` (from 0). Coefficients: R/J, f/J, R^2/J, R c/J of a roller; EA/L, 1/L of a span."""

    kind: str  #: "roller" or "span"
    index: int
    coefficients: FloatArray
    covariance: FloatArray  #: of the coefficients, with the shifts unknown too
    shift_s: FloatArray  #: a roller's (delay,) beyond the line's latency; a span's leads (of v_i, of v_{i-1})
    shift_information: FloatArray  #: inverse of their covariance, with the coefficients unknown too, 1/s^2
    colour: float  #: c
    explained: float  #: share of the changes over `WINDOW_S`, squared, that the equation explains; below 0: none
    change: float  #: root mean square of these changes, m/s or N; of both the fifth with most movement
    driven: float  #: the same of what its torque, or its two speeds, should move it by, as the line's file says
    noise: float  #: standard deviation of a sample of the sensor (speed of a roller, tension of a span)
    shaking: float  #: the same from third differences, which hold little else of a tension, whatever the equation
    disturbance: float  #: intensity of the white noise in the rate (m/s^1.5 of a roller)
    rows: int


@dataclass(frozen=True)
class Stretch:
    """Samples in a row. Interval k lies between samples k and k + 1; some are left out at the ends, for shifts."""

    data: Recording
    k: NDArray[np.intp]

    def mean(self, x: FloatArray) -> FloatArray:
        return 0.5 * (x[self.k] + x[self.k + 1])

    def rate(self, x: FloatArray) -> FloatArray:
        t = self.data.time_s
        return (x[self.k + 1] - x[self.k]) / (t[self.k + 1] - t[self.k])

    def held(self, u: FloatArray, delay_s: float) -> FloatArray:
        """Mean of what is held from each sample to the next, `delay_s` later."""
        t = self.data.time_s
        total = np.concatenate(([0.0], np.cumsum(u[:-1] * np.diff(t))))
        return self.rate(np.interp(t - delay_s, t, total))

    def shifted(self, x: FloatArray, lead_s: float) -> tuple[FloatArray, FloatArray]:
        """Mean of x(t + lead), straight between samples, and its derivative by the lead."""
        t = self.data.time_s
        slope = np.diff(x) / np.diff(t)
        total = np.concatenate(([0.0], np.cumsum(0.5 * (x[1:] + x[:-1]) * np.diff(t))))
        j = np.clip(np.searchsorted(t, t + lead_s, side="right") - 1, 0, len(t) - 2)
        since = t + lead_s - t[j]
        value = x[j] + slope[j] * since
        return self.rate(total[j] + 0.5 * (x[j] + value) * since), self.rate(value)


def reach_s(period_s: float) -> float:
    """Shifts are looked for up to this."""
    return max(LEAST_REACH_S, REACH_PERIODS * period_s)


def stretches_of(recording: Recording, line: Line) -> list[Stretch]:
    """The longest stretches under control, of all that are long enough."""
    beyond = int(np.ceil((reach_s(recording.period_s) + line.control.latency_s) / recording.period_s)) + 2
    window = round(WINDOW_S / recording.period_s)  # at short periods a window is many samples, and two are to fit
    parts = recording.stretches(max(LEAST_SAMPLES, 3 * beyond, 2 * (beyond + window)))
    longest = sorted(parts, key=lambda part: -part.samples)[:MOST_STRETCHES]
    return [Stretch(part, np.arange(beyond, part.samples - 1 - beyond)) for part in longest]


def has_cell(recording: Recording, i: int) -> bool:
    return not bool(np.isnan(recording.tension_n[:, i]).all())


def equation_fits(recording: Recording, line: Line) -> list[EquationFit]:
    """Of all rollers, then of all spans that have a load cell; none where no stretch is long enough."""
    stretches = stretches_of(recording, line)
    if not stretches:
        return []
    rollers = [fit_roller(stretches, line, i) for i in range(line.n)]
    return rollers + [fit_span(stretches, line, i) for i in range(line.n) if has_cell(recording, i)]


def moving(fit: EquationFit) -> bool:
    """Whether changes are large against what noise makes of them: else nothing is told of the equation."""
    return fit.change > MOVING * _by_noise(fit)


def should_move(fit: EquationFit) -> bool:
    """Whether they should be, by the line's file."""
    return fit.driven > 2.0 * MOVING * _by_noise(fit)


def _by_noise(fit: EquationFit) -> float:
    """Changes that noise makes: the load cell's own, or what is usual on rollers, where torque moves so quickly."""
    if fit.kind == "span":
        return float(np.sqrt(2.0) * fit.shaking)
    usual = Noise()
    return float(np.sqrt(usual.acceleration_m_per_s1_5**2 * WINDOW_S + 2.0 * usual.speed_m_per_s**2))


def fit_roller(
    stretches: list[Stretch], line: Line, i: int, delay_s: float | None = None, colour: float | None = None
) -> EquationFit:
    """`delay_s` beyond the line's latency and `colour` are looked for unless they are given."""
    model, roller = nominal_model(line), line.rollers[i]
    inverse = float(model.radius_m[i] ** 2 / model.inertia_kg_m2[i])
    weak = (2, inverse, inverse * (2.0 * roller.radius_m.tolerance + roller.inertia_kg_m2.tolerance))
    y = [s.rate(s.data.speed_m_per_s[:, i]) for s in stretches]
    others = [
        np.column_stack((-s.mean(s.data.speed_m_per_s[:, i]), s.mean(_pull(s.data, line, i)), -np.ones(len(s.k))))
        for s in stretches
    ]

    def table(delay: float) -> list[FloatArray]:
        torque = [s.held(s.data.torque_nm[:, i], line.control.latency_s + delay) for s in stretches]
        return [np.column_stack(columns) for columns in zip(torque, others, strict=True)]

    sought = delay_s is None
    delay, information = delay_s or 0.0, 0.0
    found = Solved(y, table(delay), weak, colour)
    if sought:
        for _ in range(2):  # the delay is found for a colour, and the colour for a delay
            delay, information = _best_delay(y, table, found.colour, line.control.latency_s, stretches[0].data.period_s)
            found = Solved(y, table(delay), weak, colour)
    nominal = float(model.radius_m[i] / model.inertia_kg_m2[i])
    shift, known = np.array([delay]), np.array([[information]])
    return _fit_of("roller", i, found, nominal, found.covariance, shift, known, stretches)


def fit_span(
    stretches: list[Stretch], line: Line, i: int, lead_s: FloatArray | None = None, colour: float | None = None
) -> EquationFit:
    """Leads (of v_i, of v_{i-1}) and `colour` are looked for unless they are given."""
    span = line.spans[i].length_m
    weak = (1, 1.0 / span.value, span.tolerance / span.value)
    y = [s.rate(s.data.tension_n[:, i]) for s in stretches]
    after = [s.data.speed_m_per_s[:, i] for s in stretches]
    before = [s.data.speed_m_per_s[:, i - 1] if i else s.data.unwind_speed_m_per_s for s in stretches]

    def table(lead: FloatArray) -> tuple[list[FloatArray], list[FloatArray]]:
        """And the derivatives of its first column by the leads."""
        tables, slopes = [], []
        for s, v, w in zip(stretches, after, before, strict=True):
            (v_mean, v_slope), (w_mean, w_slope) = s.shifted(v, float(lead[0])), s.shifted(w, float(lead[1]))
            transport = s.mean(_upstream(s.data, line, i)) * w_mean - s.mean(_tension(s.data, i)) * v_mean
            tables.append(np.column_stack((v_mean - w_mean, transport, np.ones(len(s.k)))))
            slopes.append(np.column_stack((v_slope, -w_slope)))
        return tables, slopes

    sought = lead_s is None
    lead = np.zeros(2) if lead_s is None else lead_s
    reach = reach_s(stretches[0].data.period_s)
    if sought:  # first both together, which is a shift of the tension, coarsely
        step = 0.5 * stretches[0].data.period_s
        shifts = step * np.arange(-np.floor(reach / step), np.floor(reach / step) + 1)
        tried = ((Solved(y, table(np.full(2, d))[0], weak, 0.9).cost, abs(d), d) for d in shifts)
        lead = min(tried)[2] * np.ones(2)  # `Solved` has no cost that is no number
    found = Solved(y, table(lead)[0], weak, colour)
    prior = np.eye(2) / VAGUE_S**2
    for _ in range(2 if sought else 0):  # the leads are found for a colour, and the colour for leads
        for _ in range(_GAUSS_NEWTON_STEPS):
            gradient, information, _ = found.along(table(lead)[1])
            step = np.linalg.solve(information + prior, gradient - prior @ lead)
            lead = np.clip(lead + step, -reach, reach)
            found = Solved(y, table(lead)[0], weak, found.colour)
            if np.abs(step).max() < 1e-6:
                break
        found = Solved(y, table(lead)[0], weak, colour)
    _, information, covariance = found.along(table(lead)[1])
    nominal = line.web.stiffness_n.value / span.value
    spread = covariance if sought else found.covariance
    return _fit_of("span", i, found, nominal, spread, lead, information, stretches)


def _best_delay(
    y: list[FloatArray], table: Callable[[float], list[FloatArray]], colour: float, latency_s: float, period_s: float
) -> tuple[float, float]:
    """Delay beyond the latency at the top of the profile likelihood, and its information from the interval of 95 %.

    The mean of a held torque is straight in the delay from one multiple of the period to the next, so the sum of
    squares there needs the torque at both ends only.
    """
    reach = round(reach_s(period_s) / period_s)
    nearest = round(latency_s / period_s)
    tables = [coloured(table(m * period_s - latency_s), colour) for m in range(nearest - reach, nearest + reach + 1)]
    target = coloured([part[:, None] for part in y], colour)[:, 0]
    Q, _ = np.linalg.qr(tables[0][:, 1:])
    target = target - Q @ (Q.T @ target)
    torque = [x[:, 0] - Q @ (Q.T @ x[:, 0]) for x in tables]
    part = np.arange(_FINE + 1) / _FINE
    delays, costs = [], []
    for j in range(2 * reach):
        a, b = torque[j], torque[j + 1]
        along = (1.0 - part) * (target @ a) + part * (target @ b)
        power = (1.0 - part) ** 2 * (a @ a) + 2.0 * part * (1.0 - part) * (a @ b) + part**2 * (b @ b)
        delays.append((nearest - reach + j + part) * period_s - latency_s)
        costs.append(target @ target - along**2 / np.maximum(power, 1e-300))
    delay, cost = np.concatenate(delays), np.maximum(np.concatenate(costs), 1e-300)
    cost = np.where(np.isnan(cost), np.inf, cost)  # `argmin` would choose what is no number
    likely = -0.5 * len(target) * np.log(cost / cost.min())
    inside = delay[likely > -0.5 * 1.96**2]
    deviation = max(float(inside.max() - inside.min()), period_s / _FINE) / (2.0 * 1.96)
    return float(delay[np.argmin(cost)]), 1.0 / deviation**2


def _fit_of(
    kind: str, i: int, found: Solved, nominal: float, covariance: FloatArray, shift_s: FloatArray,
    information: FloatArray, stretches: list[Stretch],
) -> EquationFit:  # fmt: skip
    period_s = stretches[0].data.period_s
    window = max(1, round(WINDOW_S / period_s))

    def changes(parts: list[FloatArray]) -> FloatArray:
        return np.concatenate([_sums(part, window) for part in parts]) * period_s

    change, missed = changes(found.y), changes(found.residuals())
    driven = nominal * changes([table[:, 0] - table[:, 0].mean() for table in found.table])
    most = np.argsort(-np.maximum(np.abs(change), np.abs(change - missed)))
    most = most[: max(1, round(MOVING_SHARE * len(most)))]
    power = float(np.mean(change[most] ** 2))
    third = np.concatenate([np.diff(part, 2) for part in found.y]) * period_s
    innovation = np.sqrt(found.variance)
    keep = 4 if kind == "roller" else 2
    return EquationFit(
        kind=kind,
        index=i,
        coefficients=found.coefficients[:keep],
        covariance=covariance[:keep, :keep],
        shift_s=shift_s,
        shift_information=information,
        colour=found.colour,
        explained=1.0 - float(np.mean(missed[most] ** 2)) / max(power, 1e-300),
        change=float(np.sqrt(power)),
        driven=float(np.std(driven)),
        noise=float(period_s * innovation * np.sqrt(found.colour)),
        shaking=float(np.sqrt(np.mean(third**2) / 20.0)),
        disturbance=float(np.sqrt(period_s) * innovation * (1.0 - found.colour)),
        rows=len(change),
    )


def _sums(x: FloatArray, window: int) -> FloatArray:
    total = np.concatenate(([0.0], np.cumsum(x)))
    return total[window:] - total[:-window]


def _pull(data: Recording, line: Line, i: int) -> FloatArray:
    """T_{i+1} - T_i. Where there is no load cell the set-point stands in, or nothing: the prior of R^2/J is small."""
    after = _tension(data, i + 1) if i + 1 < data.n else np.full(data.samples, line.web.tension_after_n)
    return after - _tension(data, i)


def _upstream(data: Recording, line: Line, i: int) -> FloatArray:
    """T_{i-1}."""
    return _tension(data, i - 1) if i else np.full(data.samples, line.web.tension_before_n)


def _tension(data: Recording, i: int) -> FloatArray:
    if has_cell(data, i):
        return data.tension_n[:, i]
    return np.nan_to_num(data.tension_setpoint_n[:, i])

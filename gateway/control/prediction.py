"""What the model says the next sample will be, and how far off it is: the Kalman predictor along a recording.

The state [T; v] follows the paper's nonlinear equations with Coulomb friction between two samples; torque lag and dead
time move known torques, and are no states. Gains come from the Riccati recursion of the linearised sampled model. There
are no disturbance states: a model that is off shows in the innovations, which are then neither white nor of the size
that the noise gives them. Normalised innovation squared, 1 for a true model, is what validity is judged by.

Rollers out of round (`eccentricity`) are the exception: their angles are known from the data but for where they begin,
and what they began with is learned along the stretch.

What is taken, and what it costs: between samples the unwinder's speed is a straight line (or held); the process noise
is white, with the speed's own measuring error at the unwinder beside it; RK4 takes steps of at most 0.35 over the
fastest pole, whose decay is then right to 1.3e-4 of itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, inf, log, pi
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from gateway.control import prediction_kernel
from gateway.control.eccentricity import SWING_STEP, Swung, learned, radii_of, swings_beside, travel
from gateway.core.recording import Recording
from gateway.core.signals import CountArray, FloatArray
from gateway.core.theta import Noise, Theta
from gateway.core.web_model import linearise

Unwinder = Literal["linear", "held"]  #: how its speed goes from one sample to the next

WARM_UP_S = 0.05  #: torques of this time are needed before the first prediction
SIGN_WIDTH_M_PER_S = 1e-3  #: the friction's sign at standstill is tanh(v / width)
UNMEASURED_N = 10.0  #: standard deviation of a tension without a load cell when a stretch begins
_REACH = 0.35  #: of a step of the integration, over the fastest pole
_RESTS = 1e-5  #: relative change of a variance in a period
_SAME_SPEED = 0.4  #: operating points closer than this share, or _SAME_M_PER_S, are one
_SAME_M_PER_S = 2e-3
_POINT_S = 0.5  #: over which operating points are means


class Unpredictable(Exception):
    """A stretch that cannot be predicted, or a theta that no line can have; the text says why."""


@dataclass(frozen=True)
class Stretch:
    """A recording without a gap, as the predictor reads it."""

    recording: Recording
    outputs: CountArray  #: (m,), which entries of [T; v] are measured: all but tensions without a load cell
    measured: FloatArray  #: (k, m)
    torque_nm: FloatArray  #: (k, n)
    unwinder: Unwinder
    unwind_m_per_s: FloatArray  #: (k, 2), at begin and end of the period from each sample on
    first: int  #: the sample with which predicting begins
    start: FloatArray  #: (2n,), state at `first`
    points: FloatArray  #: (p, 2n + 1), operating points: tensions, speeds, the unwinder's speed
    point: CountArray  #: (k,), which of them
    travelled_m: FloatArray  #: (k, n), by each roller's surface since the stretch began
    swing: FloatArray  #: (n, 2), of each roller here, where it is known (see `eccentricity`); 0: round

    @property
    def n(self) -> int:
        return self.torque_nm.shape[1]

    @property
    def predictions(self) -> int:
        return len(self.measured) - self.first - 1

    @property
    def names(self) -> list[str]:
        """Of the outputs, counted from 1."""
        return [f"tension {j + 1}" if j < self.n else f"speed {j - self.n + 1}" for j in self.outputs.tolist()]


@dataclass(frozen=True)
class Gains:
    """The Kalman filter along a stretch. Row 0 of `which` is of the first predicted sample."""

    gain: FloatArray  #: (g, 2n, m)
    factor: FloatArray  #: (g, m, m), lower Cholesky factor of S
    root: FloatArray  #: (g, m, m), its inverse
    which: CountArray  #: (k,)

    @property
    def log_determinant(self) -> FloatArray:
        """Of S at each prediction, (k,)."""
        found: FloatArray = 2.0 * np.log(np.diagonal(self.factor, axis1=1, axis2=2)).sum(axis=1)
        return found[self.which]

    @property
    def covariance(self) -> FloatArray:
        """S of each prediction, (k, m, m)."""
        return (self.factor @ self.factor.transpose(0, 2, 1))[self.which]


@dataclass(frozen=True)
class Predicted:
    """One-step predictions of one stretch."""

    stretch: Stretch
    gains: Gains
    state: FloatArray  #: (k, 2n), before each sample was seen
    innovation: FloatArray  #: (k, m), measured less predicted; N and m/s
    whitened: FloatArray  #: (k, m), of unit covariance where the model is true
    swung: Swung | None = None  #: what was learned of eccentric rollers

    @property
    def log_likelihood(self) -> FloatArray:
        """Of each sample, (k,), natural logarithm."""
        m = self.innovation.shape[1]
        determinant = self.gains.log_determinant + (0.0 if self.swung is None else self.swung.log_determinant)
        return -0.5 * (np.square(self.whitened).sum(axis=1) + determinant + m * log(2.0 * pi))

    @property
    def covariance(self) -> FloatArray:
        """Of each innovation, (k, m, m)."""
        covariance = self.gains.covariance
        if self.swung is None:
            return covariance
        factor = self.gains.factor[self.gains.which]
        return covariance + factor @ self.swung.spread @ factor.transpose(0, 2, 1)

    @property
    def normalised_squared(self) -> FloatArray:
        """Per output (m,): mean square of the innovation over its variance; 1 for a true model."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2)
        return np.mean(np.square(self.innovation) / variance, axis=0)

    @property
    def normalised(self) -> float:
        """Mean over all outputs of e' S^-1 e / m; 1 for a true model."""
        return float(np.mean(np.square(self.whitened)))


def stretch_of(recording: Recording, unwinder: Unwinder = "linear") -> Stretch:
    """A recording without a gap; tension columns that are NaN throughout have no load cell.

    Raises Unpredictable when something else is unknown, or too little is there.
    """
    n = recording.n
    cells = ~np.isnan(recording.tension_n).all(axis=0)
    signals = np.hstack((recording.tension_n, recording.speed_m_per_s))
    outputs = np.flatnonzero(np.concatenate((cells, np.ones(n, dtype=np.bool_))))
    measured = np.ascontiguousarray(signals[:, outputs])
    v0 = recording.unwind_speed_m_per_s
    first = ceil(WARM_UP_S / recording.period_s - 1e-9)
    if recording.samples < first + 3:
        raise Unpredictable(f"{recording.source}: {recording.samples} samples, at least {first + 3} are needed")
    for name, values in (("measurements", measured), ("torques", recording.torque_nm), ("unwinder's speed", v0)):
        if not np.isfinite(values).all():
            raise Unpredictable(f"{recording.source}: {name} are not all known; take its stretches")
    if (np.diff(recording.time_s) > 1.5 * recording.period_s).any():
        raise Unpredictable(f"{recording.source}: samples are missing; take its stretches")
    filled = _filled(signals, recording)
    points, point = _operating_points(np.column_stack((filled, v0)), recording.period_s)
    following = np.append(v0[1:], v0[-1]) if unwinder == "linear" else v0
    return Stretch(
        recording, outputs, measured, np.ascontiguousarray(recording.torque_nm), unwinder,
        np.column_stack((v0, following)), first, filled[first].copy(), points, point,
        travel(recording.speed_m_per_s, recording.period_s), np.zeros((n, 2)),
    )  # fmt: skip


def _filled(signals: FloatArray, recording: Recording) -> FloatArray:
    """With a guess where there is no load cell: the set-point, or the mean of what is measured."""
    guess = recording.tension_setpoint_n
    filled = signals.copy()
    unknown = np.isnan(filled)
    known = ~unknown[:, : recording.n]
    mean = float(filled[:, : recording.n][known].mean()) if known.any() else 0.0
    filled[:, : recording.n][~known] = np.where(np.isfinite(guess), guess, mean)[~known]
    return filled


def _operating_points(signals: FloatArray, period_s: float) -> tuple[FloatArray, CountArray]:
    """Means (p, 2n + 1) over blocks of `_POINT_S`, a new one only where a speed has changed, and which holds (k,)."""
    samples, n = len(signals), signals.shape[1] // 2
    length = max(round(_POINT_S / period_s), 1)
    points: list[FloatArray] = []
    point = np.empty(samples, dtype=np.int64)
    for begin in range(0, samples, length):
        mean = signals[begin : begin + length].mean(axis=0)
        if not points or _moved(points[-1][n:], mean[n:]):
            points.append(mean)
        point[begin : begin + length] = len(points) - 1
    return np.array(points), point


def _moved(before_m_per_s: FloatArray, now_m_per_s: FloatArray) -> bool:
    near = np.maximum(_SAME_SPEED * np.abs(before_m_per_s), _SAME_M_PER_S)
    return bool((np.abs(now_m_per_s - before_m_per_s) > near).any())


def coefficients_of(thetas: Sequence[Theta], stretch: Stretch) -> tuple[FloatArray, FloatArray]:
    """What the kernel takes of b thetas: (b, 6, n) and times (b, 5). The first decides the step of the integration.

    Raises Unpredictable for a theta that no line can have, and for a latency that needs torques from before.
    """
    tables = np.array([_table(theta) for theta in thetas])
    delays = np.array([[theta.torque_lag_s, theta.latency_s] for theta in thetas])
    period_s = stretch.recording.period_s
    if not (np.isfinite(tables).all() and (tables[:, :3] > 0.0).all() and (tables[:, 3:] >= 0.0).all()):
        raise Unpredictable("parameters must be finite, radius, inertia, length and stiffness above 0")
    if not ((delays >= 0.0) & (delays < inf)).all() or delays[:, 1].max() > (stretch.first - 1) * period_s + 1e-9:
        raise Unpredictable(
            f"latency and lag must be 0 or more, the latency at most {(stretch.first - 1) * period_s} s"
        )
    times = np.empty((len(thetas), 5))
    times[:, :2], times[:, 2] = delays, period_s
    times[:, 3], times[:, 4] = SIGN_WIDTH_M_PER_S, _step_s(tables[0], stretch)
    return tables, times


def _table(theta: Theta) -> FloatArray:
    """Rows as the kernel has them, (6, n)."""
    web = theta.web
    per_inertia = web.radius_m / web.inertia_kg_m2
    return np.array(
        (
            np.full(theta.n, web.stiffness_n), 1.0 / web.length_m, web.radius_m * per_inertia,
            web.friction_nms_per_rad / web.inertia_kg_m2, per_inertia, theta.coulomb_nm * per_inertia,
        )
    )  # fmt: skip


def _step_s(table: FloatArray, stretch: Stretch) -> float:
    """Steps no longer than `_REACH` over the fastest pole: bearings, web against rollers, friction at standstill."""
    swing = 2.0 * np.sqrt(np.max(table[0] * table[1]) * np.max(table[2]))
    fastest = max(float(np.max(table[3])), float(swing))
    slowest = np.abs(stretch.recording.speed_m_per_s).min()
    if slowest < 5.0 * SIGN_WIDTH_M_PER_S:
        fastest = max(fastest, float(np.max(table[3] + table[5] / SIGN_WIDTH_M_PER_S)))
    return _REACH / max(fastest, 1e-9)


def sampled_model(theta: Theta, noise: Noise, period_s: float, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """F and Q (2n, 2n) of a period around the operating point (2n + 1,): tensions, speeds, the unwinder's speed.

    Q is the exact integral of the white noise on the accelerations (Van Loan), with the error of the measured speed of
    the unwinder, which span 1 is told as the truth.
    """
    n, web = theta.n, theta.web
    A, _ = linearise(web, at[:n], at[n : 2 * n], float(at[2 * n]))
    slope = theta.coulomb_nm * web.radius_m / web.inertia_kg_m2 / SIGN_WIDTH_M_PER_S
    speeds = np.arange(n, 2 * n)
    A[speeds, speeds] -= slope / np.square(np.cosh(np.minimum(np.abs(at[n : 2 * n]) / SIGN_WIDTH_M_PER_S, 300.0)))
    W = np.zeros((2 * n, 2 * n))
    W[speeds, speeds] = noise.acceleration_m_per_s1_5**2
    W[0, 0] = ((web.stiffness_n - web.tension_before_n) / web.length_m[0] * noise.speed_m_per_s) ** 2 * period_s
    block = np.zeros((4 * n, 4 * n))
    block[: 2 * n, : 2 * n], block[: 2 * n, 2 * n :], block[2 * n :, 2 * n :] = -A, W, A.T
    both: FloatArray = expm(block * period_s)
    F = np.ascontiguousarray(both[2 * n :, 2 * n :].T)
    Q = F @ both[: 2 * n, 2 * n :]
    return F, 0.5 * (Q + Q.T)


def gains_of(theta: Theta, noise: Noise, stretch: Stretch) -> Gains:
    """The Kalman filter of this model along the stretch. Raises Unpredictable when it has none."""
    models = [sampled_model(theta, noise, stretch.recording.period_s, at) for at in stretch.points]
    transitions, intensities = (np.ascontiguousarray(part) for part in zip(*models, strict=True))
    n, outputs, samples = stretch.n, stretch.outputs, len(stretch.measured)
    deviations = np.where(outputs < n, noise.tension_n, noise.speed_m_per_s)
    variances: FloatArray = np.square(deviations)
    begin = np.full(2 * n, UNMEASURED_N**2)
    begin[outputs] = variances
    m = len(outputs)
    gain, factor, root = (np.empty((samples, rows, m)) for rows in (2 * n, m, m))
    which: CountArray = np.zeros(samples, dtype=np.int64)
    found: int = prediction_kernel.kalman(
        transitions, intensities, stretch.point, variances, outputs, np.diag(begin), stretch.first, _RESTS, gain,
        factor, root, which,
    )  # fmt: skip
    if found < 0:
        raise Unpredictable("the predictor has no gain: the noise is not above 0, or parameters are extreme")
    return Gains(gain[:found].copy(), factor[:found].copy(), root[:found].copy(), which[stretch.first + 1 :])


def predict(theta: Theta, noise: Noise, stretch: Stretch) -> Predicted:
    """Innovations of a model on a stretch. Raises Unpredictable.

    Of a model with eccentric rollers each prediction knows of the swings what the samples before it have shown, and
    before the first one no more than their amplitudes. Else the rollers swing as the stretch says.
    """
    gains = gains_of(theta, noise, stretch)
    if theta.eccentricity.any():
        return _learning(theta, gains, stretch)
    innovation, state = innovations([theta], stretch, gains, states=True)
    return Predicted(stretch, gains, state[0], innovation[0], whitened(innovation, gains)[0])


def _learning(theta: Theta, gains: Gains, stretch: Stretch) -> Predicted:
    """The separate-bias form of the predictor that has the swings as states."""
    at = np.flatnonzero(theta.eccentricity)
    swings = swings_beside(np.zeros_like(stretch.swing), at)
    innovation, state = innovations([theta] * len(swings), stretch, gains, swings, states=True)
    found = learned(theta, stretch, at, whitened(innovation, gains))
    if found is None:
        raise Unpredictable("the predictor has no gain: the eccentricity is extreme")
    known = found.before[:, at].reshape(len(found.before), -1) / SWING_STEP

    def swung(of: FloatArray) -> FloatArray:
        """`of` (1 + q, k, x), round and with a step of each swing, as linear as it is."""
        moved: FloatArray = of[0] + np.einsum("qkx,kq->kx", of[1:] - of[0], known)
        return moved

    return Predicted(stretch, gains, swung(state), swung(innovation), found.whitened, found)


def innovations(
    thetas: Sequence[Theta],
    stretch: Stretch,
    gains: Gains,
    swings: FloatArray | None = None,
    *,
    states: bool = False,
) -> tuple[FloatArray, FloatArray]:
    """Of b thetas under the same gains: (b, k, m), and the predicted states (b, k, 2n) where they are wanted.

    Each with its own `swings` (b, n, 2), or all with those of the stretch.
    """
    tables, times = coefficients_of(thetas, stretch)
    swings = np.broadcast_to(stretch.swing, (len(thetas), *stretch.swing.shape)) if swings is None else swings
    radii = radii_of([theta.web.radius_m for theta in thetas], stretch.travelled_m, swings)
    found = np.empty((len(thetas), stretch.predictions, len(stretch.outputs)))
    predicted = np.empty((len(thetas), stretch.predictions, 2 * stretch.n) if states else (0, 0, 0))
    prediction_kernel.follow(
        tables, _boundary(thetas[0]), times, radii, stretch.torque_nm, stretch.unwind_m_per_s, stretch.first,
        stretch.start, stretch.outputs, stretch.measured, gains.gain, _padded(gains, stretch), found, predicted,
    )  # fmt: skip
    return found, predicted


def whitened(innovation: FloatArray, gains: Gains) -> FloatArray:
    """Innovations (b, k, m) in units in which they have unit covariance."""
    found = np.empty_like(innovation)
    prediction_kernel.whiten(innovation, gains.root, gains.which, found)
    return found


def imagined(theta: Theta, stretch: Stretch, gains: Gains, innovation: FloatArray) -> Stretch:
    """The stretch as the model would have it with these innovations (k, m) and the same torques."""
    tables, times = coefficients_of([theta], stretch)
    outputs = np.empty_like(innovation)
    radii = radii_of([theta.web.radius_m], stretch.travelled_m, stretch.swing[None])
    prediction_kernel.imagine(
        tables[0], _boundary(theta), times[0], radii[0], stretch.torque_nm, stretch.unwind_m_per_s, stretch.first,
        stretch.start, stretch.outputs, gains.gain, _padded(gains, stretch), innovation, outputs,
    )  # fmt: skip
    return replace(stretch, measured=np.vstack((stretch.measured[: stretch.first + 1], outputs)))


def free_run(theta: Theta, predicted: Predicted, begin: int, length: int) -> FloatArray:
    """Errors (length, m) of the model left to itself, from what was known after prediction `begin` on.

    Measurements do not correct it, torques and the unwinder's speed are those of the stretch.
    """
    stretch, gains = predicted.stretch, predicted.gains
    state = predicted.state[begin] + gains.gain[gains.which[begin]] @ predicted.innovation[begin]
    first = stretch.first + 1 + begin
    end = first + length + 1
    part = replace(
        stretch, measured=stretch.measured[:end], torque_nm=stretch.torque_nm[:end], first=first, start=state,
        unwind_m_per_s=stretch.unwind_m_per_s[:end], travelled_m=stretch.travelled_m[:end],
        swing=stretch.swing if predicted.swung is None else predicted.swung.before[begin],
    )  # fmt: skip
    blind = np.zeros((1, 2 * stretch.n, len(stretch.outputs)))
    nothing = Gains(blind, gains.factor[:1], gains.root[:1], np.zeros(length, dtype=np.int64))
    return innovations([theta], part, nothing)[0][0]


def _boundary(theta: Theta) -> FloatArray:
    return np.array([theta.web.tension_before_n, theta.web.tension_after_n])


def _padded(gains: Gains, stretch: Stretch) -> NDArray[np.int64]:
    """`which` with a row for every sample of the stretch."""
    return np.concatenate((np.zeros(stretch.first + 1, dtype=np.int64), gains.which))

"""Recursive least squares for the line's parameters from its running data: what they are, and how they drift.

Between two samples, with the torque that acts standing,

    v_i,k+1 = v_i,k + h k(b) (-b v_i,k + g m_i + a (T_{i+1} - T_i) - c g sign v_i)     b = f/J, g = R/J, a = R^2/J
    T_i,k+1 = T_i,k + h (EA/L (v_i - v_{i-1}) + 1/L (T_{i-1} v_{i-1} - T_i v_i))       k(b) = (1 - exp(-bh)) / (bh)

with means over the period in place of T and v on the right (eqs. roller_velocity_dynamics, web_tension_dynamics; exact
for the torque, and k(b) is undone by `combinations`). Both are regressions, but a difference of two noisy samples has
an error that is not white, and least squares on it is biased. So both sides pass the filter that makes it white, which
is that of a Kalman predictor for the noise (Ljung 1999, System Identification, section 7.5: what is linear in the
parameters stays so). With excitation the ratio of the noises need not be known. On a quiet line all that moves is noise
and the loop's answer to it: there R/J and f/J are biased by 2 % when the disturbance is twice as strong as believed,
and by less when it is weaker; EA/L would be by 7 %, so that spans learn only while their tension moves.

What was learnt is kept as normal equations, to which the line's file is a prior when they are solved. They fade with
`forgetting_s`: without excitation to nothing, and the estimate to the prior with the prior's width (stabilised
forgetting, Milek and Kraus 1995), so that no covariance winds up. What wears is forgotten in its own direction:
friction of bearings and stiffness of the web walk at random, as in a Kalman filter for the parameters. With a
forgetting factor alone, a step of friction on a quiet line is taken for one of all parameters of the roller. Rollers'
equations add up to those of a shared parameter.

Latency and torque lag must be known: a lag of 5 ms left out costs 10 % of R/J. A torque that does not change with the
samples bends the speeds between them, which biases EA/L by up to 0.5 %.
"""

from dataclasses import dataclass, field, replace
from math import exp, floor, inf, sqrt

import numpy as np

from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise
from gateway.core.web_model import WebModel, nominal_model
from gateway.identification.combinations import ROLLER, SPAN, Evidence, fit, log_slope
from gateway.identification.estimate import Estimate, Structure
from gateway.identification.recursive_kernel import age, take_in

METHOD = "recursive least squares"
AS_IN_THE_PAPER = Structure()
ASSUMED = Noise()
_GAP = 1.5  #: periods between two samples, from which on they are not neighbours
_LEAST_SPREAD = 0.01  #: of the variance that `Noise` says: what stands still looks free of noise
_FEWEST = 50.0  #: samples of a row of equations (as far as remembered) before its residuals are believed to be noise


@dataclass(frozen=True)
class Sample:
    """What was measured at a time, NaN where it was not, and the torque sent then."""

    time_s: float
    tension_n: FloatArray  #: (n,)
    speed_m_per_s: FloatArray  #: (n,)
    torque_nm: FloatArray  #: (n,)
    unwind_speed_m_per_s: float


@dataclass(frozen=True)
class Settings:
    """What is believed, and how fast it may change. As they stand here, a whole recording weighs alike."""

    line: Line
    noise: Noise = ASSUMED
    latency_s: float | None = None  #: from a sample to its torque; None: as in the line's file
    torque_lag_s: float = 0.0  #: known from elsewhere: these regressions do not tell it
    forgetting_s: float = inf  #: after which time something counts 1/e
    friction_drift_per_sqrt_s: float = 0.0  #: standard deviation of the relative change of f in a second; 0: none
    stiffness_drift_per_sqrt_s: float = 0.0  #: of E A

    def __post_init__(self) -> None:
        if not self.forgetting_s > 0.0:
            raise ValueError(f"forgetting_s: is {self.forgetting_s}, should be greater than 0")
        for name, value in (("latency_s", self.latency_s or 0.0), ("torque_lag_s", self.torque_lag_s)):
            if not value >= 0.0:
                raise ValueError(f"{name}: is {value}, should be 0 or greater")
        if not min(self.noise.tension_n, self.noise.speed_m_per_s) > 0.0:
            raise ValueError(f"noise: is {self.noise}, that of tensions and speeds should be greater than 0")


def live(line: Line, noise: Noise = ASSUMED, latency_s: float | None = None, torque_lag_s: float = 0.0) -> Settings:
    """For drift: 20 % more friction of a roller is seen within a second, which costs 0.3 % of noise."""
    return Settings(line, noise, latency_s, torque_lag_s, 300.0, 0.01, 0.003)


@dataclass
class State:
    """What is remembered; rows are rollers, then spans (`recursive_kernel`). Make one with `begin`."""

    speed_m_per_s: FloatArray  #: (2, n+1), v_0 .. v_n of the sample before and of the last
    tension_n: FloatArray  #: (2, n+2), T_0 .. T_{n+1}
    sent_nm: FloatArray  #: (d, n), newest first, of the last sample and those before; the oldest two act now
    filters: FloatArray  #: (2n, 8)
    information: FloatArray  #: (2n, 4, 4)
    moment: FloatArray  #: (2n, 4)
    sums: FloatArray  #: (2n, 2): squared innovations by their variance, and how many
    noise: FloatArray  #: (2, 2), as the kernel wants it
    drift: FloatArray  #: (2, 4), how combinations of rollers and of spans walk in a second
    given_nm: FloatArray  #: (n,), what the drives give behind their lag
    late: float  #: by how much the older of two torques that act in a period counts
    withheld: float  #: what of a change the lag takes off its first period
    samples: int = 0
    time_s: float = field(default=-inf)


def begin(settings: Settings) -> State:
    """Nothing learnt."""
    line, noise = settings.line, settings.noise
    n, period_s, model = line.n, line.control.period_s, nominal_model(line)
    tension = np.full((2, n + 2), np.nan)
    tension[:, 0], tension[:, -1] = model.tension_before_n, model.tension_after_n
    stiffness_per_length = model.stiffness_n / float(np.mean(model.length_m))
    delay = (line.control.latency_s if settings.latency_s is None else settings.latency_s) / period_s
    rate = float(np.mean(model.friction_nms_per_rad / model.inertia_kg_m2))
    decay = exp(-rate * period_s)  # of a speed, in a period
    part = delay - floor(delay)  # of a period, at its beginning: what it does has decayed when the period ends
    # Noise of the speeds moves the tension that is computed from them, as a random walk.
    moves = (
        noise.acceleration_m_per_s1_5**2 * period_s,
        2.0 * (stiffness_per_length * period_s * noise.speed_m_per_s) ** 2,
    )
    return State(
        speed_m_per_s=np.full((2, n + 1), np.nan),
        tension_n=tension,
        sent_nm=np.full((floor(delay) + 2, n), np.nan),
        filters=np.zeros((2 * n, ROLLER + 4)),
        information=np.zeros((2 * n, ROLLER, ROLLER)),
        moment=np.zeros((2 * n, ROLLER)),
        sums=np.zeros((2 * n, 2)),
        drift=_drift(settings, model),
        given_nm=np.full(n, np.nan),
        late=(decay ** (1.0 - part) - decay) / (1.0 - decay),
        withheld=_withheld(settings.torque_lag_s, rate, period_s),
        noise=np.array([[moves[0], noise.speed_m_per_s**2], [moves[1], noise.tension_n**2]]),
    )


def _withheld(lag_s: float, rate_per_s: float, period_s: float) -> float:
    """Mean of exp(-t / lag) over a period, weighted with what is left at its end of a speed gained at t."""
    if lag_s == 0.0:
        return 0.0
    t = (np.arange(100) + 0.5) / 100.0 * period_s
    weight = np.exp(-rate_per_s * (period_s - t))
    return float(np.sum(weight * np.exp(-t / lag_s)) / np.sum(weight))


def _drift(settings: Settings, model: WebModel) -> FloatArray:
    """(2, 4). More friction is a greater f/J, and a little less of all others in the sampled equation."""
    radius, inertia = float(np.mean(model.radius_m)), float(np.mean(model.inertia_kg_m2))
    rate, torque = float(np.mean(model.friction_nms_per_rad)) / inertia, radius / inertia
    b_h = rate * settings.line.control.period_s
    shrinks = float(log_slope(np.array([b_h]))[0])
    friction = settings.friction_drift_per_sqrt_s * np.array(
        [rate * (1.0 + shrinks), torque * shrinks, radius * torque * shrinks, 0.0]
    )
    stiffness = settings.stiffness_drift_per_sqrt_s * model.stiffness_n / float(np.mean(model.length_m))
    return np.stack((friction, [stiffness, 0.0, 0.0, 0.0]))


def update(settings: Settings, state: State, sample: Sample) -> None:
    """Take in the next sample. After a gap the filters start again; a sample from before the last is left out."""
    line = settings.line
    period_s = line.control.period_s
    passed = (sample.time_s - state.time_s) / period_s
    if passed < 0.5:
        return
    if passed > _GAP:
        state.speed_m_per_s[1] = np.nan
        state.sent_nm[:] = np.nan
        state.given_nm[:] = np.nan
    if state.samples and (settings.forgetting_s < inf or state.drift.any()):
        passed_s = passed * period_s
        keep = exp(-passed_s / settings.forgetting_s)
        age(keep, sqrt(passed_s) * state.drift, state.information, state.moment, state.sums)
    speed, tension, sent = state.speed_m_per_s, state.tension_n, state.sent_nm
    speed[0], tension[0] = speed[1], tension[1]
    speed[1, 0], speed[1, 1:] = sample.unwind_speed_m_per_s, sample.speed_m_per_s
    tension[1, 1:-1] = sample.tension_n
    take_in(
        speed, tension, _acting(settings, state), period_s, state.noise,
        state.filters, state.information, state.moment, state.sums,
    )  # fmt: skip
    sent[1:] = sent[:-1]
    sent[0] = sample.torque_nm
    state.samples += 1
    state.time_s = sample.time_s


def _acting(settings: Settings, state: State) -> FloatArray:
    """The torque (n,) that stands for what acted in the last period."""
    newer, older = state.sent_nm[-2:]
    target = newer if state.late == 0.0 else (1.0 - state.late) * newer + state.late * older
    if settings.torque_lag_s == 0.0:
        return target
    given = np.where(np.isnan(state.given_nm), target, state.given_nm)
    left = exp(-settings.line.control.period_s / settings.torque_lag_s)
    state.given_nm = target + left * (given - target)
    return target + state.withheld * (given - target)


def estimate(settings: Settings, state: State, structure: Structure = AS_IN_THE_PAPER) -> Estimate:
    """What is believed now. Raises ValueError for a structure with a torque lag.

    Intervals are those of parameters that stand still; with forgetting they are wider than need be for those, by up to
    the square root of 2.
    """
    n = settings.line.n
    spread = np.concatenate((_spread(state, slice(0, n), ROLLER), _spread(state, slice(n, None), SPAN)))
    information = state.information / spread[:, None, None]
    moment = state.moment / spread[:, None]
    if not structure.coulomb:
        information[:n, ROLLER - 1], information[:n, :, ROLLER - 1], moment[:n, ROLLER - 1] = 0.0, 0.0, 0.0
    evidence = Evidence(
        information[:n], moment[:n], information[n:, :SPAN, :SPAN], moment[n:, :SPAN], settings.line.control.period_s
    )
    found = fit(settings.line, structure, evidence)
    latency_s = found.theta.latency_s if settings.latency_s is None else settings.latency_s
    theta = replace(found.theta, latency_s=latency_s, torque_lag_s=settings.torque_lag_s)
    return Estimate(METHOD, structure, theta, None, found.intervals, state.samples)


def estimated_recursively(settings: Settings, recording: Recording, structure: Structure = AS_IN_THE_PAPER) -> Estimate:
    """Of a whole recording: its parts under control, in which everything is known.

    Raises ValueError for a recording of another line or period.
    """
    line = settings.line
    if (recording.n, recording.period_s) != (line.n, line.control.period_s):
        raise ValueError(
            f"{recording.source}: has {recording.n} spans at a period of {recording.period_s:g} s; "
            f"the line has {line.n} at {line.control.period_s:g} s"
        )
    state = begin(settings)
    for part in recording.stretches(2):
        for sample in samples_of(part):
            update(settings, state, sample)
    return estimate(settings, state, structure)


def samples_of(recording: Recording) -> list[Sample]:
    """One by one, as a running line gives them."""
    columns = (
        recording.time_s.tolist(), recording.tension_n, recording.speed_m_per_s, recording.torque_nm,
        recording.unwind_speed_m_per_s.tolist(),
    )  # fmt: skip
    return [Sample(*row) for row in zip(*columns, strict=True)]


def _spread(state: State, rows: slice, columns: int) -> FloatArray:
    """(n,), how much more the innovations of rollers or of spans vary than `Noise` says; one number for all."""
    squared, count = 0.0, 0.0
    for information, moment, sums in zip(state.information[rows], state.moment[rows], state.sums[rows], strict=True):
        explained = (
            moment[:columns] @ np.linalg.pinv(information[:columns, :columns], 1e-12, hermitian=True) @ moment[:columns]
        )
        if sums[1] > _FEWEST:
            squared += max(float(sums[0] - explained), 0.0)
            count += float(sums[1]) - columns
    return np.full(len(state.sums[rows]), max(squared / count, _LEAST_SPREAD) if count > 0.0 else 1.0)

"""The weights that a design takes when it is given none: rules in what it knows of time, limits and the line.

The defaults of the classes are those of S_sim at 10 ms period, 10 ms latency and 1000 Nm/s. They were chosen on random
plants around it (EA, J, L +-20 %, R +-15 %, f +-50 %), designed both on the plant itself and on S_sim, in both cases of
the benchmark: the smallest sum of RMSEs whose peaks stay below 52 N. The rules lead from there to other conditions and
to lines of every size. With

    D = latency + half a period + 4 ms       the dead time that the loop must stand, `stood_s`; D0 = 19 ms
    b = R EA / (J L) of the quickest roller  tension acceleration per torque, N/s^2/Nm
    T = the greatest tension
    r = b (torque rate) / T                  as a multiple of S_sim's at 1000 Nm/s and 60 N
    m = J / R^2 of the heaviest roller, s    its mass at the web, and the noise of its encoder

the natural frequency of the loop is w = (b^2 / torque weight)^(1/4), and a weight is the greatest of three:

 - what delay allows: w at a fixed share of 1 / D, so that 4 ms beyond the latency are stood;
 - what the torque rate allows: linear feedback that asks for torque quicker than the drives may change it swings
   between the limits. A step of a given size needs a rate as the third power of w, hence r^(-4/3); with the torque's
   own limit in between, r^(-3/2) is what was found from 1000 to 1e5 Nm/s;
 - what encoders allow: their noise times the gain on a roller's speed stays a share of what drives may change torque
   by in a period. Only where a law feeds speeds back as they are measured.

Integrals, and the speeds of draw spans, are as much slower than S_sim's as the loop is.

`docs/decisions/0020-weights-follow-the-dead-time.md` and `0049-weights-follow-the-size-of-the-line.md` have the
figures.
"""

from dataclasses import dataclass, replace
from math import inf, isfinite

import numpy as np

from gateway.control.design.task import DesignTask
from gateway.core.theta import NOISE_SHARE

STOOD_BEYOND_S = 0.004  #: beyond the latency, `margins.LEAST_DELAY_MARGIN_S`
REFERENCE_STOOD_S = 0.019  #: D at 10 ms period and latency
REFERENCE_RATE_NM_PER_S = 1000.0
RATE_POWER = -1.5
REFERENCE_QUICKNESS = 0.04 / 0.95 * 2400.0  #: b of S_sim, N/s^2/Nm
REFERENCE_TENSION_N = 60.0  #: T of S_sim
REFERENCE_STIFFNESS_N_PER_M = 2400.0  #: EA / L of S_sim
LQI_SHARE, LQG_SHARE = 0.5, 0.58  #: natural frequency times D
LQI_INTEGRAL = 1.56  #: of the integrals, over the loop's frequency: sqrt(1000) / 20.3 1/s
LET_GO_S = 0.009  #: least time of back-calculation
MPC_RATE_SHARE = 0.4  #: of its torque weight at 1000 Nm/s, the rate's part
FOLLOWING_ROLLER_NOISE, FOLLOWING_WEB_NOISE_N_PER_SQRT_S = 20.0, 1.0


@dataclass(frozen=True)
class LqWeights:
    """Weights per squared deviation."""

    tension_per_n2: float = 1.0
    speed_per_m2_s2: float = 0.0
    draw_speed_per_m2_s2: float = 4.0e4  #: of a draw span, in place of the tension's weight
    torque_per_nm2: float = 0.03


@dataclass(frozen=True)
class LqrWeights(LqWeights):
    """As `LqWeights`, and how much cheaper torque is that all rollers give alike."""

    common_torque: float = 1.0  #: times `torque_per_nm2`


@dataclass(frozen=True)
class LqiWeights(LqWeights):
    """Feedback as in `LqWeights`, and the integrals."""

    torque_per_nm2: float = 0.06
    integral_per_n2s2: float = 1000.0
    draw_integral_per_m2: float = 4.0e6
    antiwindup: float = 0.4  #: share of the missing torque that is taken back in a period


@dataclass(frozen=True)
class LqgWeights(LqWeights):
    """Feedback as in `LqWeights`, and what moves the line as far as its observer believes."""

    torque_per_nm2: float = 0.03
    disturbance_nm_per_sqrt_s: float = 2.0  #: how fast torque disturbances wander
    roller_noise: float = 1.0  #: times `Noise.acceleration_m_per_s1_5`; more: a faster observer
    web_noise_n_per_sqrt_s: float = 0.0  #: of the tensions' own equations; 0: they are believed


@dataclass(frozen=True)
class MpcWeights(LqgWeights):
    """As `LqgWeights`, and the weight of tension beyond its limits."""

    torque_per_nm2: float = 1.0e-3
    disturbance_nm_per_sqrt_s: float = 1.0
    tension_limit_per_n2: float = 100.0


def stood_s(task: DesignTask) -> float:
    """D: latency, half a period of hold, and the delay that must be stood beyond."""
    return task.latency_s + 0.5 * task.period_s + STOOD_BEYOND_S


def rate_share(task: DesignTask) -> float:
    """r: how quickly drives can make the greatest tension's jerk, as a multiple of the reference's.

    A rate that is not given is taken for the reference's: whatever the drives can do, it is not everything. A greatest
    tension that is not given is twice the greatest set-point.
    """
    rate, most_n = task.limits.torque_rate_nm_per_s, task.limits.tension_max_n
    tension_n = most_n if isfinite(most_n) else 2.0 * float(np.max(task.tension_n))
    if not isfinite(rate) or tension_n <= 0.0:
        return 1.0
    return rate / REFERENCE_RATE_NM_PER_S * _size(task) * REFERENCE_TENSION_N / tension_n


def encoder_bandwidth(task: DesignTask) -> float:
    """The gain on the speed of the heaviest roller over its inertia (rad/s) that encoders allow; inf: any.

    At it the noise of a roller's speed, fed back as it is measured, makes of its torque `NOISE_SHARE` of what drives
    may change in a period.
    """
    rate = task.limits.torque_rate_nm_per_s
    if task.encoder_noise_m_per_s <= 0.0 or not isfinite(rate):
        return inf
    lever = float(np.max(task.model.inertia_kg_m2 / task.model.radius_m))  # m R
    return NOISE_SHARE * rate * task.period_s / (lever * task.encoder_noise_m_per_s)


def lqr_weights(task: DesignTask) -> LqrWeights:
    """Those of `design_lqr`.

    Without integral action a torque that the model has wrong leaves an offset of that torque over the feedback's gain.
    Friction and radii that are all wrong alike are what costs most, so that torque which all rollers give alike is made
    cheaper, down to a quarter, as far as delay and encoders leave room. It costs nothing in steps of single spans.
    """
    torque = max(_feedback_torque_weight(task), _by_encoders(task))
    least = max(_torque_weight_at(task, LQG_SHARE / stood_s(task)), _by_encoders(task))
    return LqrWeights(
        torque_per_nm2=torque,
        draw_speed_per_m2_s2=_draw_weight(task, LqrWeights(), torque),
        common_torque=max(0.25, (least / torque) ** 2),
    )


def lqi_weights(task: DesignTask) -> LqiWeights:
    """Those of `design_lqi`.

    With integrals, peaks grow with the dead time: the torque rate's part of the weight does so too, as D^1.5. The
    integrals are no faster than the loop.
    """
    first = LqiWeights()
    by_delay = _torque_weight_at(task, LQI_SHARE / stood_s(task))
    by_rate = first.torque_per_nm2 * rate_share(task) ** RATE_POWER * _slower(task) ** 1.5 * _size(task) ** 2
    torque = max(by_delay, by_rate, _by_encoders(task, LQI_INTEGRAL))
    integral = min(1.0, _squared_frequency(task, first, torque))
    draw = _draw_weight(task, first, torque)
    return LqiWeights(
        torque_per_nm2=torque,
        draw_speed_per_m2_s2=draw,
        integral_per_n2s2=first.integral_per_n2s2 * integral,
        draw_integral_per_m2=first.draw_integral_per_m2 * (draw / first.draw_speed_per_m2_s2) * integral,
        antiwindup=_taken_back(first.antiwindup, task),
    )


def lqg_weights(task: DesignTask) -> LqgWeights:
    """Those of `design_lqg`.

    Its observer quickens as the square of the feedback's frequency: a slower one would eat the delay margin, and in a
    quick loop it is errors of the model that move the rollers.
    """
    first, torque = LqgWeights(), _feedback_torque_weight(task)
    return LqgWeights(
        torque_per_nm2=torque,
        draw_speed_per_m2_s2=_draw_weight(task, first, torque),
        disturbance_nm_per_sqrt_s=first.disturbance_nm_per_sqrt_s * _slower(task) ** -0.5,
        roller_noise=max(1.0, _squared_frequency(task, first, torque)),
    )


def mpc_weights(task: DesignTask) -> MpcWeights:
    """Those of `design_mpc`, which knows the limits and may be quicker.

    Its frequency goes as the root of 1 / D where the loop is quicker than at the reference, as 1 / D where it is
    slower; the rate's part is less than half of the weight at the reference. The observer quickens as in `lqg_weights`,
    with the fourth power of the frequency: it starts from a feedback that is quicker than it.
    """
    first, slower = MpcWeights(), _slower(task)
    by_delay = max(slower**2, slower**4)
    by_rate = MPC_RATE_SHARE * rate_share(task) ** RATE_POWER
    times = max(by_delay, by_rate)
    torque = first.torque_per_nm2 * times * _size(task) ** 2
    return MpcWeights(
        torque_per_nm2=torque,
        draw_speed_per_m2_s2=_draw_weight(task, first, torque),
        disturbance_nm_per_sqrt_s=first.disturbance_nm_per_sqrt_s * slower**-0.5,
        roller_noise=max(1.0, 1.0 / times),
    )


def without_disturbances(weights: MpcWeights) -> MpcWeights:
    """`weights` of a law that estimates no torque disturbance, and so corrects no offset.

    Its observer follows the measurements: one that believes the tensions' equations makes of every error of the model a
    steady error of the estimate, which no feedback sees.
    """
    return replace(
        weights,
        disturbance_nm_per_sqrt_s=0.0,
        roller_noise=max(weights.roller_noise, FOLLOWING_ROLLER_NOISE),
        web_noise_n_per_sqrt_s=FOLLOWING_WEB_NOISE_N_PER_SQRT_S,
    )


def _taken_back(share: float, task: DesignTask) -> float:
    """The share that back-calculation takes back in a period.

    Within D, or within 9 ms where D is shorter, it is as much as `share` a period within D at the reference. Integrals
    that let go sooner are missing when the torque leaves its limit.
    """
    periods = task.period_s / 0.010 * REFERENCE_STOOD_S / max(stood_s(task), LET_GO_S)
    return 1.0 - (1.0 - share) ** periods


def _feedback_torque_weight(task: DesignTask) -> float:
    by_rate = LqWeights().torque_per_nm2 * rate_share(task) ** RATE_POWER * _size(task) ** 2
    return max(_torque_weight_at(task, LQG_SHARE / stood_s(task)), by_rate)


def _by_encoders(task: DesignTask, integral: float = 0.0) -> float:
    """The torque weight at which encoders' noise makes its share of the torque; 0: no noise is known.

    A span that swings at o on its roller, under the cost T^2 + q (integral of T)^2 + torque^2 b^2 / w^4, is brought to
    s^3 + e s^2 + (o^2 + e^2/2) s + sqrt(q) w^2, e the gain on its roller's speed over the roller's inertia, where

        w^4 + 2 e c w^3 = e^2 o^2 + e^4 / 4        c = sqrt(q) / w, `integral`

    by its symmetric root locus. For e as encoders allow it the left side grows with w: there is one root above 0.
    """
    e = encoder_bandwidth(task)
    if not isfinite(e):
        return 0.0
    swing = _quickness(task) * float(np.max(task.model.radius_m))  # o^2, 1/s^2
    roots = np.roots([1.0, 2.0 * e * integral, 0.0, 0.0, -(e**2 * swing + 0.25 * e**4)])
    return _torque_weight_at(task, float(roots.real[np.abs(roots.imag) <= 1e-9 * np.abs(roots)].max()))


def _squared_frequency(task: DesignTask, first: LqWeights, torque_per_nm2: float) -> float:
    """w^2 as a multiple of that of `first` on S_sim."""
    return _size(task) * (first.torque_per_nm2 / torque_per_nm2) ** 0.5


def _draw_weight(task: DesignTask, first: LqWeights, torque_per_nm2: float) -> float:
    """The weight of a draw span's speed: its loop is as much slower than S_sim's as the tensions' is.

    The bandwidth of a speed under the cost q v^2 + torque weight u^2 is sqrt(q / torque weight) R/J. It goes with w
    where q goes with (EA / (L w))^2.
    """
    return first.draw_speed_per_m2_s2 * _stiffness(task) ** 2 / _squared_frequency(task, first, torque_per_nm2)


def _slower(task: DesignTask) -> float:
    """D as a multiple of the reference's."""
    return stood_s(task) / REFERENCE_STOOD_S


def _size(task: DesignTask) -> float:
    """b as a multiple of the reference's."""
    return _quickness(task) / REFERENCE_QUICKNESS


def _quickness(task: DesignTask) -> float:
    """b, N/s^2/Nm: how fast a torque bends the tension at the quickest roller."""
    model = task.model
    return float(np.max(model.radius_m / model.inertia_kg_m2 * model.stiffness_n / model.length_m))


def _stiffness(task: DesignTask) -> float:
    """EA / L of the stiffest span, as a multiple of the reference's: what a draw makes of tension in a time."""
    return float(np.max(task.model.stiffness_n / task.model.length_m)) / REFERENCE_STIFFNESS_N_PER_M


def _torque_weight_at(task: DesignTask, frequency_per_s: float) -> float:
    """The torque weight (per N^2 of tension) at which the loop's natural frequency is `frequency_per_s`."""
    return (_quickness(task) / frequency_per_s**2) ** 2

"""Proving the wiring: how far one drive may pull at standstill, and what that says of a load cell. Pure.

Symbols as in the paper. Drive i pulls its roller while every other roller is free. What its torque does is told by the
roller's own balance, whatever the rest of the web does meanwhile; over a window of time, from sample to sample,

    int u dt = a int T_i dt - r int T_{i+1} dt + f_i/R_i x_i + J_i/R_i dv_i + F dt

x is the way of the roller's surface, F its dry friction and a = R_i/g, g being what the load cell shows of a newton
(and the drive gives of a newton metre), r is R_i as far as the load cell behind is right. They, f/R, J/R and F are
estimated from the windows of a pull, around what the line's file says of them within its tolerances (F: around none,
by a share of the torque): linear, with a normal posterior.

Torque stays below a share of the tension that the line's file allows (`TENSION_SHARE`), by the roller's smallest
radius; what a roller's momentum adds when slack ends is bounded by its speed, which stays below w.
"""

from dataclasses import dataclass, replace
from math import inf, pi

import numpy as np

from gateway.core.line import Line
from gateway.core.line_limits import tension_bands_n, torque_limits_nm
from gateway.core.signals import BoolArray, FloatArray
from safety.tensioning import delay_s, lag_s, tensioning_speed_m_per_s

TENSION_SHARE = 0.2  #: of tension_max_n, that a proof may come to
TORQUE_SHARE = 0.6  #: of the torque that holds so much: momentum and an undamped web have the rest
CATCH_SHARE = 0.1  #: of tension_max_n, that slack may add when it ends at speed w
ZERO_SHARE = 0.05  #: of a span's tension band, that its load cell may show of a slack web, either way
ANSWERS = 0.2  #: of the tension that the torque explains: from where on a load cell answers
DRY_SHARE = 0.15  #: of the torque: spread of what dry friction may take of it
FACTOR_ROOM = 1.15  #: beside the radius's tolerance, that a load cell may be off by
MODEL_ERROR = 0.03  #: of the torque: what the balance leaves out
NEAR_STRETCHES, NEAR_M = 4.0, 0.005  #: the first way either direction is tried for
HOLD_LAGS = 1.5  #: of a span's own time constant under friction
SHORTEST_RAMP_S = 0.5
ZERO_S = 1.0  #: for which zeros and noise are taken, before anything pulls
RAMP_SWINGS = 1.5  #: of the slowest swing of a web without friction: a cosine of that length leaves none of it


@dataclass(frozen=True, slots=True)
class ProvingLimits:
    """Arrays (n,). SI."""

    period_s: float
    measured: BoolArray  #: a load cell measures the span
    torque_nm: FloatArray  #: U, the most that a drive pulls with
    tension_n: FloatArray  #: that it explains at the nominal radius
    tension_max_n: FloatArray  #: per span, that a proof may come to as shown
    zero_n: FloatArray  #: that a slack web may show, either way
    speed_m_per_s: float  #: w
    speed_gain: FloatArray  #: of the limit of the speed, Nm per m/s
    damping: FloatArray  #: that keeps a web without friction from swinging, Nm per m/s
    lag_s: float  #: of the drives, by which gain and reset are set
    reset_share: float
    ramp_s: FloatArray  #: of a pull, from none to U
    hold_s: FloatArray
    near_m: FloatArray  #: way of a roller to which both directions are tried first
    far_m: FloatArray  #: and at most: with all the slack that may be there
    compliance_m_per_n: FloatArray  #: L/EA of each span
    prior: FloatArray  #: (n, 5), means of a, f/R, J/R, F and r
    spread: FloatArray  #: (n, 5), their standard deviations
    factor: FloatArray  #: the greatest that a healthy load cell shows of a newton; its inverse is the least


def zero_allowed_n(line: Line) -> FloatArray:
    """What each span's load cell may show of a slack web, either way, (n,)."""
    low, high = tension_bands_n(line)
    allowed: FloatArray = ZERO_SHARE * (high - low)
    return allowed


def spans_with_cells(line: Line) -> BoolArray:
    """Which spans a load cell sees, (n,): also one that only shows is proved, for its span is held against its band."""
    seen: BoolArray = np.isin(np.arange(1, line.n + 1), [cell.span for cell in line.load_cells])
    return seen


def proving_limits(line: Line) -> ProvingLimits:
    """The limits of `line` while its wiring is proved."""
    rollers, n = line.rollers, line.n
    radius = np.array([roller.radius_m.value for roller in rollers])
    wide = np.array([roller.radius_m.tolerance for roller in rollers])
    inertia = np.array([roller.inertia_kg_m2.value for roller in rollers])
    heavy = np.array([roller.inertia_kg_m2.tolerance for roller in rollers])
    friction = np.array([roller.friction_nms_per_rad.value for roller in rollers])
    rough = np.array([roller.friction_nms_per_rad.tolerance for roller in rollers])
    length = np.array([span.length_m.value for span in line.spans])
    slack = np.array([span.slack_max_m for span in line.spans])
    mass, stiffness, drag = inertia / radius**2, line.web.stiffness_n.value / length, friction / radius**2
    most_n = np.minimum.accumulate(tension_bands_n(line)[1])  # a pull comes to all spans before
    torque = np.minimum(TORQUE_SHARE * TENSION_SHARE * most_n * radius, torque_limits_nm(line))
    impedance = np.sqrt(mass * stiffness)
    catch = CATCH_SHARE * most_n / (np.minimum(impedance, mass * stiffness / drag) + stiffness * delay_s(line))
    slowest = pi * np.sqrt(stiffness / mass) / (2.0 * np.arange(1, n + 1) + 1.0)  # of i spans, held at one end
    ramp = np.maximum(SHORTEST_RAMP_S, RAMP_SWINGS * 2.0 * pi / slowest / (1.0 + (0.5 * drag / impedance) ** 2))
    stretch = np.cumsum(torque / radius / stiffness)
    lag = lag_s(line)
    ones = np.ones(n)
    return ProvingLimits(
        period_s=line.control.period_s,
        measured=spans_with_cells(line),
        torque_nm=torque,
        tension_n=torque / radius,
        tension_max_n=TENSION_SHARE * tension_bands_n(line)[1],
        zero_n=zero_allowed_n(line),
        speed_m_per_s=min(tensioning_speed_m_per_s(line), float(catch.min())),
        speed_gain=inertia / (radius * lag),
        damping=radius * np.minimum(np.maximum(impedance - drag, 0.0), mass / lag),
        lag_s=lag,
        reset_share=min(1.0, line.control.period_s / (4.0 * lag)),
        ramp_s=ramp,
        hold_s=np.maximum(ramp, HOLD_LAGS * drag / stiffness),
        near_m=NEAR_STRETCHES * stretch + np.minimum(NEAR_M, np.cumsum(slack)),
        far_m=np.cumsum(slack) + NEAR_STRETCHES * stretch,
        compliance_m_per_n=1.0 / stiffness,
        prior=np.stack([radius, friction / radius, inertia / radius, 0.0 * ones, radius], axis=1),
        spread=np.stack(
            [
                2.0 * radius,
                (rough + wide) * friction / radius,
                (heavy + wide) * inertia / radius,
                DRY_SHARE * torque,
                2.0 * wide * radius,
            ],  # fmt: skip
            axis=1,
        ),
        factor=FACTOR_ROOM / (1.0 - wide),
    )


def slack_of_one_span(line: Line, limits: ProvingLimits) -> ProvingLimits:
    """`limits` of a proof of few devices: a roller takes up no more than the greatest slack of one span before it."""
    slack = np.array([span.slack_max_m for span in line.spans])
    return replace(limits, far_m=limits.far_m - np.cumsum(slack) + np.maximum.accumulate(slack))


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of samples, as they were at rest. Arrays (n,)."""

    tension_n: FloatArray
    speed_m_per_s: FloatArray
    way_m: FloatArray  #: not one: the greatest way of a roller, as its drive shows it, in `ZERO_S` at rest


@dataclass(frozen=True, slots=True)
class Pull:
    """What a drive's torque has done. Tensions (n,) are as shown, less the zeros."""

    drive: int  #: from 0
    direction: int  #: of the torque command, to which the web has answered; 0: to neither
    speed_sign: int  #: of the speed shown, for a torque command above 0; 0: it did not move enough to tell
    moved: bool
    held: bool  #: something has held it that no load cell shows
    torque_nm: float
    way_m: float
    start_n: FloatArray
    end_n: FloatArray
    #: (windows, 5 + n): integral of the torque in `direction`, time, way and change of speed as shown, time moving
    #: (with its sign, as shown), integrals of the tensions
    windows: FloatArray


@dataclass(frozen=True, slots=True)
class Factor:
    """What a load cell shows of a newton."""

    value: float
    spread: float  #: of its logarithm; infinite where nothing can be said

    def is_surely_off(self, most: float) -> bool:
        """Whether it lies beyond `most` or its inverse, whatever is left open."""
        open_ = np.exp(2.0 * self.spread)
        return bool(self.value / open_ > most or self.value * open_ < 1.0 / most)

    def is_told(self) -> bool:
        """Whether it is known well enough to tell 1 from a half or from two."""
        return self.spread <= ENOUGH


SPEED_NOISE_LEFT = 0.54  #: of an encoder's noise, in the difference of two filtered speeds
ENOUGH = 0.15  #: spread of a factor's logarithm, with which a half and two are told from one
NOTHING_SAID = Factor(1.0, inf)
FEWEST = 3  #: windows of which anything is said
CLEARLY = 3.0  #: deviations, by which friction is above or below 0
WAY_SHARE = 0.25  #: of the way that tensions tell of, or its inverse: what an encoder shows is no noise of its own
WAY_GOES_WITH = 0.8  #: correlation of the two
WAY_NOISE = 1.5  #: times the greatest way at rest, which holds a roller's own shaking, too: tensions tell of more
OPEN = 3.0  #: of what the line's file says, that friction and inertia may be either way while signs are looked for


def factor_of(
    limits: ProvingLimits, noise: Noise, pull: Pull, cell: int, sign: int, behind: tuple[int, int] | None
) -> Factor:
    """What load cell `cell` (from 0) shows of a newton in the span that `pull` has tensioned; `sign` is its own.

    `behind`: the load cell of the span behind its roller, and that one's sign; None: there is none.
    """
    if len(pull.windows) < FEWEST:
        return NOTHING_SAID
    prior, spread = limits.prior[pull.drive], limits.spread[pull.drive]
    found, deviation = _fit(
        limits, noise, pull, cell, sign, behind, pull.speed_sign * pull.direction or 1, prior, spread
    )
    a, by = float(found[0]), float(deviation[0])
    return NOTHING_SAID if a <= by else Factor(float(prior[0]) / a, by / a)


def way_sign_of(limits: ProvingLimits, noise: Noise, pull: Pull, cells: list[tuple[int, int]]) -> int:
    """The sign of the speed that is shown for a torque above 0, by what load cells say of the roller's way; 0: none.

    The unwinder stands. So roller i has gone as far as the spans before it have become longer,

        x_i = sum over j = 1..i of L_j/(EA) T_j

    whatever moved it; an encoder's sign is told by whether it shows as much, or as much the other way. Slack that is
    taken up adds to the way alone, in the same direction. `cells`: load cell and sign of spans 1 to i, in order.
    """
    rows = pull.windows
    if len(rows) < FEWEST or len(cells) != pull.drive + 1:
        return 0
    time_s, ways_m = rows[:, 1], rows[:, 2]
    shown_m = np.cumsum(ways_m) - 0.5 * ways_m
    told_m = np.zeros(len(rows))
    for span, (cell, sign) in enumerate(cells):
        told_m += limits.compliance_m_per_n[span] * sign * rows[:, 5 + cell] / time_s
    shown_m, told_m = shown_m - shown_m.mean(), told_m - told_m.mean()
    by_noise_m = WAY_NOISE * float(noise.way_m[pull.drive]) * max(1.0, float(time_s.sum()) / ZERO_S) ** 0.5
    if np.ptp(told_m) <= by_noise_m:
        return 0
    both, told, shown = float(shown_m @ told_m), float(told_m @ told_m), float(shown_m @ shown_m)
    share, goes_with = abs(both) / told, abs(both) / (told * shown) ** 0.5 if shown > 0.0 else 0.0
    if not WAY_SHARE <= share <= 1.0 / WAY_SHARE or goes_with < WAY_GOES_WITH:
        return 0
    return pull.direction if both > 0.0 else -pull.direction


def speed_sign_of(
    limits: ProvingLimits, noise: Noise, pull: Pull, cell: int, sign: int, behind: tuple[int, int] | None
) -> int:
    """The sign of the speed that is shown for a torque above 0, where the way alone was too short to tell it; 0: none.

    Friction takes power, whatever turns: f is above 0, and comes out below where the sign is wrong.
    """
    if len(pull.windows) < FEWEST:
        return 0
    prior, spread = limits.prior[pull.drive].copy(), limits.spread[pull.drive].copy()
    spread[1:3] = OPEN * prior[1:3]
    prior[1:3] = 0.0
    found, deviation = _fit(limits, noise, pull, cell, sign, behind, 1, prior, spread)
    if abs(found[1]) < CLEARLY * deviation[1]:
        return 0
    return pull.direction if found[1] > 0.0 else -pull.direction


def _fit(
    limits: ProvingLimits, noise: Noise, pull: Pull, cell: int, sign: int, behind: tuple[int, int] | None, shown: int,
    prior: FloatArray, spread: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """What is estimated (5,) and how sure it is (5,), as a standard deviation; `shown`: the sign of the speed's."""
    i, rows = pull.drive, pull.windows
    pull_behind = np.zeros(len(rows)) if behind is None else behind[1] * rows[:, 5 + behind[0]]
    matrix = np.column_stack((sign * rows[:, 5 + cell], shown * rows[:, 2:5], -pull_behind))
    told = _balance_spread(limits, noise, i, cell, rows[:, 1])
    # Scaled, so that no line's size makes the equations ill-conditioned.
    scaled = matrix * spread / told[:, None]
    missing = (rows[:, 0] - matrix @ prior) / told
    covariance = np.linalg.inv(scaled.T @ scaled + np.eye(5))
    found = covariance @ scaled.T @ missing
    left = missing - scaled @ found
    # What the web does beside the balance makes it less sure than the sensors alone do.
    wider = max(1.0, float(left @ left) / len(left))
    return prior + spread * found, spread * np.sqrt(wider * np.diag(covariance))


def _balance_spread(limits: ProvingLimits, noise: Noise, i: int, cell: int, time_s: FloatArray) -> FloatArray:
    """By how much (Nm s) the balance of roller `i` may be off in windows of `time_s`, as standard deviations."""
    prior, speed = limits.prior[i], float(noise.speed_m_per_s[i])
    lasts_s = 2.0 * prior[2] / prior[1]  # so long a time a roller's momentum lasts: what shakes it at rest goes on
    periods = np.maximum(time_s / limits.period_s, 1.0)
    model = (MODEL_ERROR * limits.torque_nm[i] * time_s) ** 2
    momentum = (prior[2] * SPEED_NOISE_LEFT * speed) ** 2
    shaken = (prior[1] * speed * time_s) ** 2 * np.minimum(1.0, lasts_s / time_s)
    spread: FloatArray = np.sqrt(model + momentum + shaken + (prior[0] * noise.tension_n[cell] * time_s) ** 2 / periods)
    return spread

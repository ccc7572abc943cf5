"""The tension of a span without a load cell, from the balance of forces at its rollers. Pure.

By eq. roller_velocity_dynamics, of roller i at the end of span i, and of the one before it:

    T_i = T_{i+1} + N_i,    T_i = T_{i-1} - N_{i-1},    N_i = (u_i - c_i sign v_i)/R_i - f_i v_i/R_i^2 - J_i a_i/R_i^2

with a dry friction c_i of nothing up to what the line's file lets every roller have (`gate.stress_coulomb_nm`).

Each parameter lies anywhere in its tolerance, so N is an interval, and so is T: where both rollers say something, what
both say. Tensions that are measured, and T_{n+1} of the line's file, are where it begins.

Of a change the balance says far more than of a tension: dry friction, zeros and what a tolerance makes of a steady
torque are the same before and after. A web that breaks takes T_i away from roller i and from the one before it: the
one behind is sped up by it or its drive holds it with as much less, whatever the law does meanwhile. So a fall of T_i
is told from changes of torque, speed and acceleration, each with its tolerance.
"""

from dataclasses import dataclass, replace

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import BoolArray, FloatArray
from gateway.core.theta import expected_noise

TORQUE_ERROR = 0.03  #: of a torque: how far what a drive gives may be from what it was asked for
MEAN_PERIODS = 20  #: that torques, speeds and tensions are averaged over, all alike
FALLEN = 0.3  #: of its set-point: what no tension loses within moments while the web is whole and nothing else is asked
FALL_DEVIATIONS = 6.0  #: of the noise of an acceleration, beyond it
CREEPING = 0.02  #: of the greatest speed: below it dry friction may hold a roller either way


@dataclass(frozen=True)
class Balance:
    """Arrays (n,); pairs (2, n) are the least and the most that the tolerances allow."""

    estimated: BoolArray  #: no load cell sees the span
    indicated: BoolArray  #: a load cell sees it that nothing is controlled by: an estimate stands in where it is silent
    per_radius: FloatArray  #: (2, n), 1/R
    friction: FloatArray  #: (2, n), f/R^2
    mass_kg: FloatArray  #: (2, n), J/R^2
    dry_n: FloatArray  #: dry friction, c/R, of which a roller may have anything
    creeping_m_per_s: float  #: slower, it may act either way
    after_n: float  #: T_{n+1}


def balance_of(line: Line) -> Balance:
    """The balance of `line`; the spans that no load cell sees are estimated."""
    rollers, seen = line.rollers, {cell.span for cell in line.load_cells}

    def ends(name: str) -> FloatArray:
        value = np.array([getattr(roller, name).value for roller in rollers])
        tolerance = np.array([getattr(roller, name).tolerance for roller in rollers])
        return np.array([value * (1.0 - tolerance), value * (1.0 + tolerance)])

    per_radius = 1.0 / ends("radius_m")[::-1]
    return Balance(
        estimated=np.array([i + 1 not in seen for i in range(line.n)]),
        indicated=np.array([i + 1 in seen and span.control == "draw" for i, span in enumerate(line.spans)]),
        per_radius=per_radius,
        friction=ends("friction_nms_per_rad") * per_radius**2,
        mass_kg=ends("inertia_kg_m2") * per_radius**2,
        dry_n=line.gate.stress_coulomb_nm * per_radius[1],
        creeping_m_per_s=CREEPING * line.limits.speed_max_m_per_s,
        after_n=line.web.tension_after_n,
    )


def pull_n(
    balance: Balance, torque_nm: FloatArray, speed_m_per_s: FloatArray, acceleration_m_per_s2: FloatArray
) -> FloatArray:
    """N (2, n) in N, least and most, from torques, surface speeds and accelerations, each (n,).

    A roller that turns may have any dry friction up to c against its way, and one that hardly turns either way.
    """
    torque = np.sort(torque_nm * balance.per_radius, axis=0)
    torque += np.abs(torque) * np.array([[-TORQUE_ERROR], [TORQUE_ERROR]])
    friction = np.sort(balance.friction * speed_m_per_s, axis=0)
    inertia = np.sort(balance.mass_kg * acceleration_m_per_s2, axis=0)
    creeping_m_per_s = balance.creeping_m_per_s
    against_n = np.where(speed_m_per_s > -creeping_m_per_s, balance.dry_n, 0.0)
    along_n = np.where(speed_m_per_s < creeping_m_per_s, balance.dry_n, 0.0)
    return torque - friction[::-1] - inertia[::-1] + np.array((-against_n, along_n))


def estimate_n(
    balance: Balance, tension_n: FloatArray, pull: FloatArray, estimated: BoolArray | None = None
) -> FloatArray:
    """Tensions (2, n) in N, least and most; of spans that are measured what is in `tension_n` (n,).

    `estimated` (n,) are the spans that are not measured now; None: those that no load cell sees.
    `pull` (2, n) is of `pull_n`. Where the two rollers of a span contradict each other, everything that either says.
    """
    n = len(tension_n)
    estimated = balance.estimated if estimated is None else estimated
    ahead, behind = np.empty((2, n)), np.empty((2, n))
    known: tuple[float, float] = (-np.inf, np.inf)
    for i in range(n):  # from the unwinder on, whose torque nobody knows
        if estimated[i]:
            known = (known[0] - pull[1, i - 1], known[1] - pull[0, i - 1]) if i else known
        else:
            known = (tension_n[i], tension_n[i])
        ahead[:, i] = known
    known = (balance.after_n, balance.after_n)
    for i in range(n - 1, -1, -1):
        if estimated[i]:
            known = (known[0] + pull[0, i], known[1] + pull[1, i])
        else:
            known = (tension_n[i], tension_n[i])
        behind[:, i] = known
    both = np.array([np.maximum(ahead[0], behind[0]), np.minimum(ahead[1], behind[1])])
    either = np.array([np.minimum(ahead[0], behind[0]), np.maximum(ahead[1], behind[1])])
    return np.where(both[0] <= both[1], both, either)


def changes_of(balance: Balance) -> Balance:
    """The balance of changes: what does not change falls out of it. Rollers must turn on in their direction."""
    return replace(balance, dry_n=np.zeros_like(balance.dry_n), after_n=0.0)


def fall_noise_n(line: Line, balance: Balance) -> FloatArray:
    """What the noise that is expected of encoders may make of a fall (n,), as it is told from each span's end."""
    # Of the slope of a speed that is averaged twice: 1 / (2 tau) sqrt(period / tau) of a sample's, tau = MEAN_PERIODS.
    noise_m_per_s2 = expected_noise(line).speed_m_per_s / (2.0 * MEAN_PERIODS**1.5 * line.control.period_s)
    squares = np.square(balance.mass_kg[1] * noise_m_per_s2)
    for i in range(line.n - 2, -1, -1):  # of spans in a row without a load cell all rollers behind are counted with
        if balance.estimated[i + 1]:
            squares[i] += squares[i + 1]
    noise_n: FloatArray = FALL_DEVIATIONS * np.sqrt(squares)
    return noise_n


def least_fall_n(set_n: FloatArray, low_n: float | FloatArray, noise_n: FloatArray) -> FloatArray:
    """The certain fall (n,) from which on a web has broken, at set-points (n,); `low_n` are the bands' lower ends."""
    least_n: FloatArray = np.maximum(FALLEN * set_n, low_n) + noise_n
    return least_n


def break_seen_n(balance: Balance, i: int, tension_n: float) -> float:
    """What of a break of span `i` (from 0) at `tension_n` is certain, at the worst of the tolerances (N).

    Whether the drives hold their rollers, or the rollers run apart.
    """
    n, changes = len(balance.dry_n), changes_of(balance)
    ends = ((i, 1.0), (i - 1, -1.0)) if i else ((i, 1.0),)
    torque, acceleration = np.zeros((2, n))
    for k, way in ends:
        torque[k] = -way * tension_n / balance.per_radius[1, k]
        acceleration[k] = way * tension_n / balance.mass_kg[1, k]
    none = np.zeros(n)
    held, apart = pull_n(changes, torque, none, none), pull_n(changes, none, none, acceleration)
    return min(-float(estimate_n(changes, none, pull)[1, i]) for pull in (held, apart))

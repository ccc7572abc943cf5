"""What a rollout is of: plants and what theirs do beside the plain equations, courses, the loop; and what it yields."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf

import numpy as np

from gateway.core.signals import BoolArray, CountArray, FloatArray
from gateway.core.theta import Theta
from gateway.core.web_model import WebModel

RUNAWAY_N = 1e3  #: where a line says nothing of its tensions: beyond it, either way, a loop has run away


def _none() -> FloatArray:
    return np.empty(0)


@dataclass(frozen=True)
class Effects:
    """What real plants do beside the two equations of `web_model`. (b, n) each, unless said otherwise.

    Roller i turns by phi_i and has the surface speed w_i = R_i dphi_i/dt, which its encoder measures; the web on it
    runs at v_i, which the tensions follow in `web_model`'s equation. m_i is the torque behind its lag:

        rho_i    = 1 + e_i sin(phi_i + p_i),    v_i = rho_i w_i
        dw_i/dt  = R_i^2/J_i rho_i (T_{i+1} - T_i) - f_i/J_i w_i + R_i/J_i (m_i - c_i F_i)
        tau dm_i/dt = u_i(t - latency) - m_i

    F_i is Coulomb's sign: of w_i; at rest it is what keeps the roller there, as long as |F_i| <= 1 does. It is decided
    once a step of the integration, after Karnopp (1985, ASME J. Dyn. Syst. Meas. Control 107): a roller that would turn
    back within a step is at rest at its end, and nothing but web and drive moves one that rests.
    """

    torque_lag_s: FloatArray  #: tau, (b,); 0: none
    coulomb_nm: FloatArray  #: c, 0 and above
    eccentricity: FloatArray  #: e, share of the radius
    phase_rad: FloatArray  #: p: the angle at the beginning of a course is 0
    latency_s: FloatArray | None = None  #: (b,), rounded up to whole steps of the integration; None: that of the loop


@dataclass(frozen=True)
class Plants:
    """Plants of equal size: (b, n) each, and the constant tensions (b, 2) ahead of and behind the line."""

    stiffness_n: FloatArray
    length_m: FloatArray
    radius_m: FloatArray
    inertia_kg_m2: FloatArray
    friction_nms_per_rad: FloatArray
    boundary_n: FloatArray
    effects: Effects | None = None

    @property
    def count(self) -> int:
        return self.length_m.shape[0]

    @property
    def n(self) -> int:
        return self.length_m.shape[1]

    def model(self, index: int) -> WebModel:
        """The two equations of one plant, without its effects."""
        before, after = self.boundary_n[index].tolist()
        return WebModel(
            float(self.stiffness_n[index, 0]), self.length_m[index], self.radius_m[index], self.inertia_kg_m2[index],
            self.friction_nms_per_rad[index], before, after,
        )  # fmt: skip


def plants_of(models: Sequence[WebModel]) -> Plants:
    """Plants of a list of models."""
    n = models[0].n
    return Plants(
        np.array([np.full(n, model.stiffness_n) for model in models]),
        np.array([model.length_m for model in models]),
        np.array([model.radius_m for model in models]),
        np.array([model.inertia_kg_m2 for model in models]),
        np.array([model.friction_nms_per_rad for model in models]),
        np.array([[model.tension_before_n, model.tension_after_n] for model in models]),
    )


def plants_of_thetas(
    thetas: Sequence[Theta], eccentricity: FloatArray | float = 0.0, phase_rad: FloatArray | float = 0.0
) -> Plants:
    """Plants with the friction, lag and latency that is believed of them; eccentricity and phase (b, n), (n,) or one.

    Raises ValueError for arrays of another shape.
    """
    plain = plants_of([theta.web for theta in thetas])
    shape = (plain.count, plain.n)
    effects = Effects(
        torque_lag_s=np.array([theta.torque_lag_s for theta in thetas]),
        coulomb_nm=np.array([theta.coulomb_nm for theta in thetas]),
        eccentricity=np.array(np.broadcast_to(eccentricity, shape), dtype=np.float64),
        phase_rad=np.array(np.broadcast_to(phase_rad, shape), dtype=np.float64),
        latency_s=np.array([theta.latency_s for theta in thetas]),
    )
    return with_effects(plain, effects)


def with_effects(plants: Plants, effects: Effects | None) -> Plants:
    """The same plants with other effects."""
    return Plants(
        plants.stiffness_n, plants.length_m, plants.radius_m, plants.inertia_kg_m2, plants.friction_nms_per_rad,
        plants.boundary_n, effects,
    )  # fmt: skip


def no_effects(plants: Plants) -> Effects:
    """Effects that do nothing."""
    nothing = np.zeros((plants.count, plants.n))
    return Effects(np.zeros(plants.count), nothing, nothing, nothing)


@dataclass(frozen=True)
class Course:
    """What is asked of the line, period by period: known to law and plant at the sample at which it happens."""

    tension_n: FloatArray  #: set-points (k, n)
    unwind_speed_m_per_s: FloatArray  #: (k,)
    changed: int = 0  #: the period of the (first) change, from which settling time and overshoot count
    later: tuple[int, ...] = ()  #: periods of the changes after it; from each on they count anew, and the worst is told
    tail: int = 0  #: periods at the end in which nothing is asked to move, and nothing should

    @property
    def periods(self) -> int:
        return len(self.unwind_speed_m_per_s)

    @cached_property
    def changes(self) -> CountArray:
        """The period of each change, and the number of periods after the last of them, (c + 1,)."""
        return np.array([self.changed, *self.later, self.periods], dtype=np.int64)

    @property
    def settled_at_n(self) -> FloatArray:
        """The set-points that each change leads to, (c, n)."""
        return self.tension_n[self.changes[1:] - 1]

    @property
    def direction(self) -> FloatArray:
        """-1, 0 or 1 for each change and span (c, n): where its set-point goes."""
        before: FloatArray = self.tension_n[np.maximum(self.changes[:-1] - 1, 0)]
        before[0] = self.tension_n[0]
        return np.sign(self.settled_at_n - before)


def course_through(period_s: float, parts: Sequence[tuple[float, FloatArray, float]], tail_s: float = 0.0) -> Course:
    """Set-points (n,) in N and unwinder's speed in m/s that stand for so many seconds each, one part after another.

    Every part but the first begins with a change. Raises ValueError for no part, and a part of less than a period.
    """
    lasting = [round(duration_s / period_s) for duration_s, _, _ in parts]
    if not lasting or min(lasting) < 1:
        raise ValueError(f"parts of {lasting} periods of {period_s:g} s; allowed: one or more parts of at least 1")
    first, *later = np.cumsum(lasting)[:-1].tolist() or [0]
    return Course(
        np.repeat([tension for _, tension, _ in parts], lasting, axis=0),
        np.repeat([speed for _, _, speed in parts], lasting), first, tuple(later), round(tail_s / period_s),
    )  # fmt: skip


@dataclass(frozen=True)
class Setup:
    """How the loop is closed. Times in s; per drive Nm and Nm/s; noise as standard deviations of a sample."""

    period_s: float
    latency_s: float
    substeps: int = 1  #: RK4 steps a period; the latency is a whole number of them
    torque_nm: float | FloatArray = inf  #: (n,) where drives differ
    torque_rate_nm_per_s: float = inf
    tension_noise_n: float = 0.0
    speed_noise_m_per_s: float = 0.0
    acceleration_m_per_s1_5: float = 0.0  #: intensity of the noise on the rollers
    tension_step_n: float = 0.0  #: of the measurement's quantisation; 0: none
    speed_step_m_per_s: float = 0.0
    seed: int = 0
    runaway_n: float = RUNAWAY_N  #: a tension beyond it, either way, or one that is no number: the loop has run away
    late_share: float = 0.0  #: of the commands, drive by drive, that arrive a period late; until then the last one acts

    @property
    def step_s(self) -> float:
        return self.period_s / self.substeps

    @property
    def delay_steps(self) -> int:
        """Integration steps from a sample to the torque that it causes."""
        return round(self.latency_s / self.step_s)

    def draw(self, periods: int, n: int) -> tuple[FloatArray, FloatArray]:
        """Noise on the samples (k, 2n), and speeds (k substeps, n) that the rollers are moved by in each step."""
        generator = np.random.default_rng(self.seed)
        scale = np.repeat([self.tension_noise_n, self.speed_noise_m_per_s], n)
        samples = generator.standard_normal((periods, 2 * n)) * scale
        moved = generator.standard_normal((periods * self.substeps, n))
        return samples, moved * self.acceleration_m_per_s1_5 * self.step_s**0.5

    def late(self, periods: int, n: int) -> BoolArray:
        """Whether the command of each period and drive (k, n) arrives a period late: the same for all plants.

        One that the next command has overtaken by then is never applied.
        """
        # A stream of its own: commands that are late do not change the noise.
        return np.random.default_rng([self.seed, 1]).random((periods, n)) < self.late_share


@dataclass(frozen=True)
class Rollouts:
    """What became of each plant. Errors and tensions are true; (b, n) unless said otherwise.

    Of a plant that has run away all errors, tensions, speeds and torques are inf, the lowest tension -inf, and what
    was recorded ends with nan.
    """

    squared_error_n2: FloatArray  #: mean over all samples of (T - T_ref)^2
    tension_min_n: FloatArray  #: over all steps of the integration
    tension_max_n: FloatArray
    settled: FloatArray  #: periods from a change to the last sample outside the band; inf where it never came in
    beyond_n: FloatArray  #: greatest overshoot, in the direction of the set-point's step (either, where there is none)
    roller_speed_max_m_per_s: FloatArray  #: greatest surface speed, either way, over all steps of the integration
    torque_max_nm: FloatArray
    torque_step_max_nm: FloatArray  #: from period to period
    effort_n2m2s: FloatArray  #: integral of u^2, per drive
    tension_n: FloatArray = field(default_factory=_none)  #: (b, k, n), at the samples, only where it was recorded
    torque_nm: FloatArray = field(default_factory=_none)  #: (b, k, n), as sent, within its limits
    tail_swing_n: FloatArray = field(default_factory=_none)  #: half of greatest less least tension in the tail
    tail_error_n: FloatArray = field(default_factory=_none)  #: |mean of T - T_ref| over the tail's samples
    chatter_nm: FloatArray = field(default_factory=_none)  #: rms over the tail of u_k - u_{k-1}; empty without a tail

    @property
    def rmse_n(self) -> FloatArray:
        """Eq. rmse of each plant, (b,)."""
        return np.sqrt(self.squared_error_n2.sum(axis=1))

    @property
    def diverged(self) -> BoolArray:
        """Whether a plant has run away: a tension beyond `Setup.runaway_n`, or none that is a number, (b,)."""
        return np.isinf(self.tension_max_n[:, 0])  # or of any other span

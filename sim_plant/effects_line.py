"""The line by the full model, and what wear and faults do to it. Rollers and spans count from 1, as in the paper."""

from math import inf, isfinite, sqrt

import numpy as np

from sim_plant.effects_kernel import integrate_full
from sim_plant.effects_model import NEVER_SLIPS, Model, State, condition_of, model_of
from sim_plant.physics import RATE, TARGET, VALUE, FloatArray, PlainLine
from sim_plant.plant import Plant
from sim_plant.plant_fields import each


class FullLine:
    """As `physics.PlainLine`, for `World`; all effects of the plant's file act."""

    def __init__(self, plant: Plant, inputs: FloatArray) -> None:
        n = plant.spans
        self._plant = plant
        self._model = model_of(plant)
        self._condition = condition_of(plant)
        self._state = State(plant)
        self._inputs = inputs
        self._web = np.zeros(2 * n)
        self.tension_n = self._web[:n]  #: true values now, views (n,)
        self.speed_m_per_s = self._web[n:]  #: of the web
        self.surface_speed_m_per_s = self._state.surface_speed_m_per_s  #: of the rollers, apart from eccentricity
        self.torque_nm = self._state.torque_nm  #: what the drives give, behind their lag
        self._refresh()  # compiles now, not in the first millisecond

    @classmethod
    def after(cls, plant: Plant, plain: PlainLine, inputs: FloatArray) -> "FullLine":
        """The same line in the same state, which the plain equations have brought about."""
        line = cls(plant, inputs)
        line._state.spring_n[:] = plain.tension_n
        line._state.surface_speed_m_per_s[:] = plain.speed_m_per_s
        line._state.torque_nm[:] = plain.torque_nm
        line._refresh()
        return line

    def advance(self, noise: FloatArray, trace: FloatArray) -> None:
        """As many steps as `noise` (m, n) and `trace` (m, 3n+1) have rows; see `integrate_full`."""
        integrate_full(self._model, self._condition, self._state.vector, self._inputs, noise, trace, self._web)

    def set_torque_nm(self, index: int, value: float) -> None:
        """The torque of roller `index` + 1 from now on, without lag: the power stage is off, or on with a jump."""
        self._inputs[:2, index] = value
        self._state.torque_nm[index] = value

    def follow_commands(self) -> None:
        """Without lag a torque is where its command is at once, also for who looks before the next step."""
        model, n = self._model, len(self.torque_nm)
        if model.lag_rate_per_s == 0.0:
            step, demand_nm = model.torque_step_nm, self._inputs[VALUE, :n]
            self.torque_nm[:] = step * np.rint(demand_nm / step) if step > 0.0 else demand_nm

    def start_at_equilibrium(self, tension_n: FloatArray, unwind_speed_m_per_s: float) -> FloatArray:
        """Put the web at its rest point, round rollers supposed. Returns the torques (n,) that hold it."""
        spring, arm, speed = rest(self._model, tension_n, unwind_speed_m_per_s)
        self._state.spring_n[:], self._state.arm_n[:], self._state.surface_speed_m_per_s[:] = spring, arm, speed
        downstream = np.append(tension_n[1:], self._model.boundary_n[1])
        torque = self._friction_nm(speed) - self.radius_m[1:] * (downstream - tension_n)
        self._state.torque_nm[:] = torque
        self._refresh()
        return torque

    @property
    def radius_m(self) -> FloatArray:
        """Mean radii now, shape (n+1,), the unwinder's first."""
        reels = np.sqrt(self._state.reel_area_m2)
        return np.concatenate((reels[:1], self._model.radius_m[:-1], reels[1:]))

    @property
    def slack_m(self) -> FloatArray:
        """Length of web (n,) that each span has too much; 0 under tension. A broken span has none."""
        pull = self._state.spring_n + self._state.arm_n
        slack = np.maximum(0.0, -pull) / (self._model.stiffness_n * self._model.per_length_per_m)
        return slack if self._model.slack else np.zeros_like(slack)

    def break_web(self, span: int) -> None:
        """The web of a span is torn: no tension there at once, until it is spliced. From now on no web pushes."""
        self._clear(span)
        self._condition.broken[span - 1] = True
        self._no_web_pushes()

    def splice_web(self, span: int) -> None:
        """The web of a span is whole again, straight and without tension."""
        self._clear(span)
        self._condition.broken[span - 1] = False
        self._refresh()

    def slacken_web(self, span: int, length_m: float) -> None:
        """A span has this length of web too much, which must be taken up before tension comes back."""
        self._check("span", span)
        if not (isfinite(length_m) and length_m >= 0.0):
            raise ValueError(f"the slack of span {span} must be a length from 0 m on, got {length_m}")
        self._clear(span)
        k = span - 1
        self._state.spring_n[k] = -length_m * self._model.stiffness_n[k] * self._model.per_length_per_m[k]
        self._no_web_pushes()

    def set_friction_factor(self, roller: int, factor: float, rate_per_s: float = inf) -> None:
        """All friction of a roller's bearing times `factor`, beside its wear, reached at this rate (inf: at once)."""
        self._check("roller", roller)
        if not (isfinite(factor) and factor >= 0.0 and rate_per_s > 0.0):
            raise ValueError(f"friction factor of roller {roller} must be 0 or more, and its rate above 0")
        friction = self._condition.friction[:, roller - 1]
        friction[TARGET], friction[RATE] = factor, rate_per_s
        if rate_per_s == inf:
            friction[VALUE], friction[RATE] = factor, 0.0

    def friction_factor(self, roller: int) -> float:
        """c of a roller's bearing now: wear and what a fault has made of it."""
        self._check("roller", roller)
        return float(self._bearing[roller - 1])

    def set_slip(self, roller: int, mu_factor: float) -> None:
        """The friction between web and roller is `mu_factor` of the plant's; below 1 the web may slip there.

        1 is the plant as it is: where slip is off, its web never slips. Raises ValueError for the last roller, which
        holds the web as a nip or a reel.
        """
        self._check("roller", roller)
        n, slip = self._plant.spans, self._plant.effects.slip
        if roller == n:
            raise ValueError(f"roller {roller} is the last one, a nip or a reel: the web cannot slip there")
        if not (isfinite(mu_factor) and mu_factor >= 0.0):
            raise ValueError(f"mu_factor of roller {roller} must be 0 or more, got {mu_factor}")
        mu, wrap = each(slip.friction_coefficient, n)[roller - 1], each(slip.wrap_rad, n)[roller - 1]
        as_it_is = mu_factor == 1.0 and not slip.on
        self._condition.grip[roller - 1] = NEVER_SLIPS if as_it_is else np.exp(mu_factor * mu * wrap)
        self._refresh()

    def _friction_nm(self, surface_speed_m_per_s: FloatArray) -> FloatArray:
        """Torques (n,) of friction at these surface speeds; at rest none, whatever it could hold."""
        model, w = self._model, surface_speed_m_per_s
        viscous = each(self._plant.rollers.friction_nms_per_rad, len(w)) * w / self.radius_m[1:]
        bend = (model.breakaway_nm - model.coulomb_nm) * np.exp(-((w / model.stribeck_speed_m_per_s) ** 2))
        return self._bearing * (viscous + np.sign(w) * (model.coulomb_nm + bend))

    @property
    def _bearing(self) -> FloatArray:
        return self._condition.wear[VALUE] * self._condition.friction[VALUE]

    def _clear(self, span: int) -> None:
        self._check("span", span)
        self._state.spring_n[span - 1] = self._state.arm_n[span - 1] = 0.0

    def _no_web_pushes(self) -> None:
        self._model = self._model._replace(slack=True)
        self._refresh()

    def _check(self, what: str, number: int) -> None:
        if not 1 <= number <= self._plant.spans:
            raise IndexError(f"{what} {number}: this line has {what}s 1 to {self._plant.spans}")

    def _refresh(self) -> None:
        n = self._plant.spans
        self.advance(np.empty((0, n)), np.empty((0, 3 * n + 1)))


def rest(model: Model, tension_n: FloatArray, unwind_speed_m_per_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Spring (N), arm (N) and speed (m/s), each (n,), at which the web runs at rest with tensions (n,) in N.

    The two span equations of `effects_model` set to zero give s and q as functions of v_i; with s + q = T_i that is a
    quadratic in v_i, with one positive root. At standstill the arm has forgotten.
    """
    n = len(tension_n)
    spring, arm, speed = np.array(tension_n, dtype=np.float64), np.zeros(n), np.zeros(n)
    if unwind_speed_m_per_s == 0.0:
        return spring, arm, speed
    spring_up, arm_up, v_up = float(model.boundary_n[0]), 0.0, unwind_speed_m_per_s
    for i in range(n):
        stiff, arm_stiff = float(model.stiffness_n[i]), float(model.arm_stiffness_n[i])
        decay = model.arm_rate_per_s / float(model.per_length_per_m[i])
        # (E A (v - v_up) + s_up v_up) / v + (r E A (v - v_up) + q_up v_up) / (v + L/tau) = T
        a = stiff + arm_stiff - tension_n[i]
        b = stiff * (decay - v_up) + spring_up * v_up + (arm_up - arm_stiff) * v_up - tension_n[i] * decay
        c = decay * v_up * (spring_up - stiff)
        v = (-b + sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
        spring[i] = (stiff * (v - v_up) + spring_up * v_up) / v
        arm[i] = tension_n[i] - spring[i]
        speed[i] = v_up = v
        spring_up, arm_up = float(spring[i]), float(arm[i])
    return spring, arm, speed

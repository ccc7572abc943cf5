"""One plant step by step, in plain numpy: the two equations of `web_model`, and the same with `Effects`."""

from math import ceil, exp

import numpy as np

from gateway.control.rollout_terms import Effects, Plants, Setup
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel


class PlainLine:
    """Without effects: `state` [T; v] (2n,)."""

    def __init__(self, model: WebModel, step_s: float, state: FloatArray) -> None:
        self._model = model
        self._step_s = step_s
        self.state = state

    def step(self, sent_nm: FloatArray, unwind_speed_m_per_s: float, moved_m_per_s: FloatArray) -> None:
        """With the torque that arrives, and the speeds that the rollers are moved by at random, (n,) each."""
        self.state = rk4(self._model, self.state, sent_nm, unwind_speed_m_per_s, self._step_s)
        self.state[self._model.n :] += moved_m_per_s


class RealLine:
    """With effects: `state` [T; w; phi] (3n,)."""

    def __init__(
        self, plants: Plants, effects: Effects, index: int, step_s: float, state: FloatArray, torque_nm: FloatArray
    ) -> None:
        self._model = plants.model(index)
        self._step_s = step_s
        self._lag_s = float(effects.torque_lag_s[index])
        self._gain = self._model.radius_m / self._model.inertia_kg_m2
        self._coulomb = self._gain * effects.coulomb_nm[index]
        self._eccentricity, self._phase_rad = effects.eccentricity[index], effects.phase_rad[index]
        self.state = np.concatenate((state, np.zeros(plants.n)))
        self._torque_nm = torque_nm  #: behind its lag

    def step(self, sent_nm: FloatArray, unwind_speed_m_per_s: float, moved_m_per_s: FloatArray) -> None:
        """With the torque that arrives, and the speeds that the rollers are moved by at random, (n,) each."""
        n, step_s, turning = self._model.n, self._step_s, slice(self._model.n, 2 * self._model.n)
        # The torque's share of the speeds is integrated exactly, however short its lag.
        half, whole = self._given(sent_nm, 0.5 * step_s), self._given(sent_nm, step_s)
        first = self._rate(self.state, unwind_speed_m_per_s)
        speed = self.state[turning]
        pulling = first[turning] + self._gain * (self._torque_nm if self._lag_s > 0.0 else sent_nm)
        resting = (self._coulomb > 0.0) & (speed == 0.0) & (np.abs(pulling) <= self._coulomb)
        direction = np.where(speed == 0.0, np.sign(pulling), np.sign(speed))

        def slope(at: FloatArray, given: FloatArray) -> FloatArray:
            probe = at.copy()
            probe[turning] += np.where(resting, 0.0, given)
            rate = self._rate(probe, unwind_speed_m_per_s)
            rate[turning] = np.where(resting, 0.0, rate[turning] - direction * self._coulomb)
            return rate

        k1 = slope(self.state, np.zeros(n))
        k2 = slope(self.state + 0.5 * step_s * k1, half)
        k3 = slope(self.state + 0.5 * step_s * k2, half)
        k4 = slope(self.state + step_s * k3, whole)
        self.state = self.state + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        self.state[turning] += np.where(resting, 0.0, whole + moved_m_per_s)
        turned_back = (self._coulomb > 0.0) & (direction * self.state[turning] < 0.0)
        self.state[turning][turned_back] = 0.0
        self._torque_nm = sent_nm + (self._torque_nm - sent_nm) * self._fade(step_s)

    def _fade(self, span_s: float) -> float:
        return exp(-span_s / self._lag_s) if self._lag_s > 0.0 else 0.0

    def _given(self, sent_nm: FloatArray, span_s: float) -> FloatArray:
        """R/J times the integral of the torque over `span_s`."""
        lagging = (self._torque_nm - sent_nm) * self._lag_s * (1.0 - self._fade(span_s))
        return self._gain * (sent_nm * span_s + lagging)

    def _rate(self, state: FloatArray, unwind_speed_m_per_s: float) -> FloatArray:
        """d[T; w; phi]/dt (3n,) by web and viscous friction alone."""
        model, n = self._model, self._model.n
        rho: FloatArray = 1.0 + self._eccentricity * np.sin(state[2 * n :] + self._phase_rad)
        surface = state[n : 2 * n]
        tension = np.concatenate(([model.tension_before_n], state[:n], [model.tension_after_n]))
        web = np.concatenate(([unwind_speed_m_per_s], rho * surface))
        stretch = model.stiffness_n * np.diff(web)
        carried = tension[:n] * web[:n] - tension[1 : n + 1] * web[1:]
        turned = rho * model.radius_m**2 * np.diff(tension[1:]) - model.friction_nms_per_rad * surface
        return np.concatenate(
            ((stretch + carried) / model.length_m, turned / model.inertia_kg_m2, surface / model.radius_m)
        )


def rk4(
    model: WebModel, state: FloatArray, torque_nm: FloatArray, unwind_speed_m_per_s: float, step_s: float
) -> FloatArray:
    """[T; v] (2n,) a step later, with torque (n,) and unwinder held."""
    k1 = rate(model, state, torque_nm, unwind_speed_m_per_s)
    k2 = rate(model, state + 0.5 * step_s * k1, torque_nm, unwind_speed_m_per_s)
    k3 = rate(model, state + 0.5 * step_s * k2, torque_nm, unwind_speed_m_per_s)
    k4 = rate(model, state + step_s * k3, torque_nm, unwind_speed_m_per_s)
    return state + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def rate(model: WebModel, state: FloatArray, torque_nm: FloatArray, unwind_speed_m_per_s: float) -> FloatArray:
    """d[T; v]/dt (2n,): eqs. web_tension_dynamics and roller_velocity_dynamics."""
    n = model.n
    tension = np.concatenate(([model.tension_before_n], state[:n], [model.tension_after_n]))
    speed = np.concatenate(([unwind_speed_m_per_s], state[n:]))
    stretch = model.stiffness_n * np.diff(speed)
    carried = tension[:n] * speed[:n] - tension[1 : n + 1] * speed[1:]
    pulled = model.radius_m**2 * (tension[2:] - tension[1 : n + 1])
    turned = pulled - model.friction_nms_per_rad * speed[1:] + model.radius_m * torque_nm
    return np.concatenate(((stretch + carried) / model.length_m, turned / model.inertia_kg_m2))


def delay_steps(plants: Plants, setup: Setup) -> list[int]:
    """Integration steps from a sample to the torque that it causes, for each plant."""
    if plants.effects is None or plants.effects.latency_s is None:
        return [setup.delay_steps] * plants.count
    return [ceil(latency_s / setup.step_s - 1e-6) for latency_s in plants.effects.latency_s.tolist()]

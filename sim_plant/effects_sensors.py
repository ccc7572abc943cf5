"""What sensors make of the truth: filter, zero, drift and steps of the load cells; steps of an encoder's speed.

With the low pass of the amplifier (first order, corner f_c), the reading of channel i at time t is, in steps of it,

    y_i + z_i + k_i y_i + d_i t + W_i(t) + noise,    dy_i/dt = 2 pi f_c (T_i - y_i)

z is the zero, k how it moves with the tension, d a steady drift and W a random walk of spread w sqrt(t).
"""

from math import exp, pi

import numpy as np

from sim_plant.physics import STEP_S, FloatArray, compiled
from sim_plant.plant import Sensors
from sim_plant.plant_fields import each


def quantised(value: FloatArray, step: float) -> FloatArray:
    """The nearest multiple of `step`; 0 leaves the value as it is."""
    return step * np.rint(value / step) if step > 0.0 else value


class LoadCells:
    """The load cells of a line with n spans. `World` tells them the truth of every millisecond."""

    def __init__(self, sensors: Sensors, n: int, stream: np.random.Generator) -> None:
        self._stream = stream
        self._step_n = sensors.tension_step_n
        self._zero_n = each(sensors.tension_zero_n, n)
        self._gain = 1.0 + each(sensors.tension_zero_per_n, n)
        self._drift_n_per_s = each(sensors.tension_drift_n_per_s, n)
        self._walk_n = each(sensors.tension_walk_n_per_sqrt_s, n) * np.sqrt(STEP_S)
        corner_hz = sensors.tension_corner_hz
        self._share = 1.0 if corner_hz is None else 1.0 - exp(-2.0 * pi * corner_hz * STEP_S)
        self._filtered_n = np.zeros(n)
        self._walked_n = np.zeros((1, n))
        self.follow(np.empty((0, 3 * n + 1)))  # compiles now, not in the first millisecond

    def start(self, tension_n: FloatArray) -> None:
        """The filters have settled at these tensions (n,)."""
        self._filtered_n[:] = tension_n

    def follow(self, rows: FloatArray) -> None:
        """The milliseconds that have passed: a trace (m, 3n+1), whose first n columns are the true tensions."""
        _low_pass(rows, self._share, self._filtered_n)

    def draw(self, steps: int) -> None:
        """The random walks of the steps to come, from where they are."""
        self._walked_n = self._walked_n[-1] + np.cumsum(
            self._walk_n * self._stream.standard_normal((steps, len(self._walk_n))), axis=0
        )

    def reading_n(self, row: int, now_s: float, noise_n: FloatArray) -> FloatArray:
        """What the cells show, shape (n,), in step `row` of those drawn last."""
        drift_n = self._drift_n_per_s * now_s + self._walked_n[row]
        return quantised(self._gain * self._filtered_n + self._zero_n + drift_n + noise_n, self._step_n)


@compiled
def _low_pass(rows, share, filtered):
    """Advance `filtered` (n,) along the first n columns of `rows`: exact for an input that is held for each step."""
    for r in range(rows.shape[0]):
        for i in range(filtered.size):
            filtered[i] += share * (rows[r, i] - filtered[i])

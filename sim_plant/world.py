"""The simulated line in time: state, noise and inputs on a grid of 1 ms. Whoever owns a clock calls `advance`."""

from collections.abc import Callable
from math import floor, inf

import numpy as np

from sim_plant.physics import RATE, STEP_S, STEPS_PER_S, TARGET, VALUE, FloatArray, equilibrium, integrate
from sim_plant.plant import Plant

_BLOCK = 1024  #: steps for which noise is drawn, and trace is kept, at a time
_GRID_TOLERANCE = 1e-6  #: of a step: 0.57 s is step 570, though 0.57 * 1000 is a little less


class Timer:
    """Something of a device that happens at a time: set `due_s` (inf is never), `action(due_s)` is called then."""

    __slots__ = ("action", "due_s")

    def __init__(self, action: Callable[[float], None]) -> None:
        self.action = action
        self.due_s = inf


class World:
    """The line of `plant`. World time starts at 0 s, at standstill, without tension and torque.

    The trajectory depends on plant, seed and inputs alone: noise belongs to the number of a step, not to a call.
    """

    def __init__(self, plant: Plant, seed: int) -> None:
        self.plant = plant
        self.seed = seed
        self.n = plant.spans
        self.steps = 0  #: whole milliseconds integrated since the start
        self.on_rows: Callable[[int, FloatArray], None] | None = None
        """Told every piece of trace: number of its first row's step, rows as `physics.integrate` fills them. The
        row of step k holds the state at k ms. The array is used again: copy what you keep."""
        self._parameters = plant.parameters()
        self._coefficients = self._parameters.coefficients()
        self._boundary_n = self._parameters.boundary_n()
        self._state = np.zeros(2 * self.n)
        self._inputs = np.zeros((3, self.n + 1))
        self._trace = np.empty((_BLOCK, 3 * self.n + 1))
        self._timers: list[Timer] = []
        process, tension, speed, unwind = np.random.SeedSequence(seed).spawn(4)
        self._process_stream = np.random.default_rng(process)
        self._sensor_streams = [np.random.default_rng(s) for s in (tension, speed, unwind)]
        self.tension_n = self._state[: self.n]  #: true values now, shape (n,); views: do not write, copy to keep
        self.speed_m_per_s = self._state[self.n :]
        self.torque_nm = self._inputs[VALUE, : self.n]
        self._draw_noise()
        self._step_through(self._process_noise[:0], self._trace[:0])  # compiles now, not in the first millisecond

    @property
    def now_s(self) -> float:
        """Time of the state: a whole number of milliseconds."""
        return self.steps * STEP_S

    @property
    def unwind_speed_m_per_s(self) -> float:
        return float(self._inputs[VALUE, self.n])

    def advance(self, to_s: float) -> None:
        """Integrate the whole steps up to `to_s`; timers that are due by then act at their own times, in order."""
        while True:
            due = min(self._timers, key=lambda timer: timer.due_s, default=None)
            if due is None or due.due_s > to_s + _GRID_TOLERANCE * STEP_S:
                break
            due_s, due.due_s = due.due_s, inf
            self._integrate_to(due_s)
            due.action(due_s)
        self._integrate_to(to_s)

    def timer(self, action: Callable[[float], None]) -> Timer:
        timer = Timer(action)
        self._timers.append(timer)
        return timer

    def set_torque_nm(self, index: int, value: float) -> None:
        """The torque of roller `index` + 1 from now on."""
        self._inputs[:2, index] = value

    def set_torques_nm(self, values: FloatArray) -> None:
        """All torques from now on, shape (n,)."""
        self._inputs[:2, : self.n] = values

    def ramp_torque_nm(self, index: int, target: float, rate_nm_per_s: float) -> None:
        """Move the torque to `target`, from now on, in every step by `rate_nm_per_s` at most (inf: at once)."""
        self._ramp(index, target, rate_nm_per_s)

    def torque_command_nm(self, index: int) -> float:
        """Where the torque of roller `index` + 1 is, or is moving to."""
        return float(self._inputs[TARGET, index])

    def set_unwind_speed(self, value_m_per_s: float) -> None:
        """v0 from now on."""
        self._inputs[:2, self.n] = value_m_per_s

    def ramp_unwind_speed(self, target_m_per_s: float, rate_m_per_s2: float) -> None:
        """Move v0 to the target, from now on, at this rate (inf: at once)."""
        self._ramp(self.n, target_m_per_s, rate_m_per_s2)

    def start_at_equilibrium(self, tension_n: FloatArray, unwind_speed_m_per_s: float) -> FloatArray:
        """Put the line at the rest point of tensions (n,) at this v0. Returns the torques (n,) that hold it."""
        speed, torque = equilibrium(self._parameters, tension_n, unwind_speed_m_per_s)
        self.tension_n[:] = tension_n
        self.speed_m_per_s[:] = speed
        self.set_torques_nm(torque)
        self.set_unwind_speed(unwind_speed_m_per_s)
        return torque

    # A sensor's noise belongs to the millisecond: two readings within it are one measurement.

    def measure_tension_n(self, index: int) -> float:
        """What the load cell of span `index` + 1 shows now."""
        return float(self.tension_n[index] + self._tension_noise_n[self.steps % _BLOCK, index])

    def measure_speed_m_per_s(self, index: int) -> float:
        """What the encoder of roller `index` + 1 shows now."""
        return float(self.speed_m_per_s[index] + self._speed_noise_m_per_s[self.steps % _BLOCK, index])

    def measure_unwind_speed_m_per_s(self) -> float:
        return self.unwind_speed_m_per_s + float(self._unwind_noise_m_per_s[self.steps % _BLOCK])

    def measure_tensions_n(self) -> FloatArray:
        """All load cells, shape (n,)."""
        return self.tension_n + self._tension_noise_n[self.steps % _BLOCK]

    def measure_speeds_m_per_s(self) -> FloatArray:
        """All encoders, shape (n,)."""
        return self.speed_m_per_s + self._speed_noise_m_per_s[self.steps % _BLOCK]

    def _ramp(self, column: int, target: float, rate: float) -> None:
        self._inputs[TARGET, column] = target
        if rate == inf:
            self._inputs[VALUE, column] = target
        else:
            self._inputs[RATE, column] = rate

    def _integrate_to(self, to_s: float) -> None:
        last = floor(to_s * STEPS_PER_S + _GRID_TOLERANCE)
        while self.steps < last:
            begin = self.steps % _BLOCK
            end = min(_BLOCK, begin + last - self.steps)
            rows = self._trace[begin:end]
            self._step_through(self._process_noise[begin:end], rows)
            first = self.steps + 1
            self.steps += end - begin
            if end == _BLOCK:
                self._draw_noise()
            if self.on_rows is not None:
                self.on_rows(first, rows)

    def _step_through(self, noise: FloatArray, rows: FloatArray) -> None:
        integrate(self._coefficients, self._boundary_n, self._state, self._inputs, noise, rows)

    def _draw_noise(self) -> None:
        """Noise for the steps of the next block, each kind from its own stream."""
        sensors = self.plant.sensors
        tension, speed, unwind = self._sensor_streams
        self._process_noise = self._process_stream.standard_normal((_BLOCK, self.n))
        self._tension_noise_n = sensors.tension_noise_n * tension.standard_normal((_BLOCK, self.n))
        self._speed_noise_m_per_s = sensors.speed_noise_m_per_s * speed.standard_normal((_BLOCK, self.n))
        self._unwind_noise_m_per_s = sensors.speed_noise_m_per_s * unwind.standard_normal(_BLOCK)

"""The simulated line in time: state, noise and inputs on a grid of 1 ms. Whoever owns a clock calls `advance`."""

from collections.abc import Callable
from dataclasses import dataclass
from math import floor, inf

import numpy as np

from sim_plant.effects_line import FullLine
from sim_plant.effects_sensors import LoadCells, quantised
from sim_plant.physics import RATE, STEP_S, STEPS_PER_S, TARGET, VALUE, FloatArray, PlainLine
from sim_plant.plant import Plant

_BLOCK = 1024  #: steps for which noise is drawn, and trace is kept, at a time
_GRID_TOLERANCE = 1e-6  #: of a step: 0.57 s is step 570, though 0.57 * 1000 is a little less
_WELL_BEFORE_S = 2.0 * _GRID_TOLERANCE * STEP_S  #: so much before a time, it has not come by any reckoning


class Timer:
    """Something of a device that happens at a time: set `due_s` (inf is never), `action(due_s)` is called then.

    `sooner` is told every time that is set.
    """

    __slots__ = ("_due_s", "_sooner", "action")

    def __init__(self, action: Callable[[float], None], sooner: Callable[[float], None]) -> None:
        self.action = action
        self._due_s = inf
        self._sooner = sooner

    @property
    def due_s(self) -> float:
        return self._due_s

    @due_s.setter
    def due_s(self, value: float) -> None:
        self._due_s = value
        self._sooner(value)


@dataclass(frozen=True, slots=True)
class _Noise:
    """That of one block of steps, each kind from its own stream; shapes (_BLOCK, n), of the unwinder (_BLOCK,)."""

    process: FloatArray
    tension_n: FloatArray
    speed_m_per_s: FloatArray
    unwind_m_per_s: FloatArray


class World:
    """The line of `plant`. World time starts at 0 s, at standstill, without tension and torque.

    The trajectory depends on plant, seed and inputs alone: noise belongs to the number of a step, not to a call.
    The plain equations are integrated as long as they are the whole truth; `use_full_line` knows the rest.
    """

    def __init__(self, plant: Plant, seed: int) -> None:
        self.plant = plant
        self.seed = seed
        self.n = plant.spans
        self.steps = 0  #: whole milliseconds integrated since the start
        self.on_rows: Callable[[int, FloatArray], None] | None = None
        """Told every piece of trace: number of its first row's step, rows as `physics.integrate` fills them. The
        row of step k holds the state at k ms. The array is used again: copy what you keep."""
        self._inputs = np.zeros((3, self.n + 1))
        self._line: PlainLine | FullLine
        self._line = PlainLine(plant.parameters(), self._inputs) if plant.is_plain else FullLine(plant, self._inputs)
        self._trace = np.empty((_BLOCK, 3 * self.n + 1))
        self._timers: list[Timer] = []
        self._still_until_s = 0.0  #: before this no step ends and no timer is due: nothing to do for `advance`
        process, tension, speed, unwind, walk = np.random.SeedSequence(seed).spawn(5)
        self._process_stream = np.random.default_rng(process)
        self._sensor_streams = [np.random.default_rng(s) for s in (tension, speed, unwind)]
        sensors = plant.sensors
        self._load_cells: LoadCells | None = None
        if not sensors.load_cells_are_ideal:
            self._load_cells = LoadCells(sensors, self.n, np.random.default_rng(walk))
        self._speed_step_m_per_s = sensors.speed_step_m_per_s
        self._next_noise: _Noise | None = None
        self._look_at_line()
        self._begin_block()

    @property
    def now_s(self) -> float:
        """Time of the state: a whole number of milliseconds."""
        return self.steps * STEP_S

    @property
    def unwind_speed_m_per_s(self) -> float:
        """v0 as the line PLC drives it: without the ripple of an unwinder that runs out of true."""
        return float(self._inputs[VALUE, self.n])

    def advance(self, to_s: float) -> None:
        """Integrate the whole steps up to `to_s`; timers that are due by then act at their own times, in order."""
        if to_s < self._still_until_s:  # every frame and every value asks
            return
        while True:
            due = min(self._timers, key=lambda timer: timer.due_s, default=None)
            due_s = inf if due is None else due.due_s
            if due is None or due_s > to_s + _GRID_TOLERANCE * STEP_S:
                break
            due.due_s = inf
            self._integrate_to(due_s)
            due.action(due_s)
        self._integrate_to(to_s)
        self._still_until_s = min(due_s, (self.steps + 1) * STEP_S) - _WELL_BEFORE_S

    def timer(self, action: Callable[[float], None]) -> Timer:
        timer = Timer(action, self._heed)
        self._timers.append(timer)
        return timer

    def draw_ahead(self) -> None:
        """Have the noise of the next block ready: otherwise the step with which it begins takes longer. Changes
        nothing else."""
        if self._next_noise is None:
            self._next_noise = self._drawn()

    def set_torque_nm(self, index: int, value: float) -> None:
        """The torque of roller `index` + 1 from now on, whatever lag its drive has: also when its power goes off."""
        self._line.set_torque_nm(index, value)

    def command_torques_nm(self, values: FloatArray) -> None:
        """What all drives are told from now on, shape (n,); those that lag give it later."""
        self._inputs[:2, : self.n] = values
        self._follow_commands()

    def ramp_torque_nm(self, index: int, target: float, rate_nm_per_s: float) -> None:
        """Move the command to `target`, from now on, in every step by `rate_nm_per_s` at most (inf: at once)."""
        self._ramp(index, target, rate_nm_per_s)

    def torque_command_nm(self, index: int) -> float:
        """Where the torque of roller `index` + 1 is, or is moving to."""
        return float(self._inputs[TARGET, index])

    def torque_underway_nm(self, index: int) -> float:
        """How far the command of roller `index` + 1 is on its ramp; a drive without lag and steps gives just this."""
        return float(self._inputs[VALUE, index])

    def set_unwind_speed(self, value_m_per_s: float) -> None:
        """v0 from now on."""
        self._inputs[:2, self.n] = value_m_per_s

    def ramp_unwind_speed(self, target_m_per_s: float, rate_m_per_s2: float) -> None:
        """Move v0 to the target, from now on, at this rate (inf: at once)."""
        self._ramp(self.n, target_m_per_s, rate_m_per_s2)

    def start_at_equilibrium(self, tension_n: FloatArray, unwind_speed_m_per_s: float) -> FloatArray:
        """Put the line at the rest point of tensions (n,) at this v0. Returns the torques (n,) that hold it."""
        torque = self._line.start_at_equilibrium(tension_n, unwind_speed_m_per_s)
        self.command_torques_nm(torque)
        self.set_unwind_speed(unwind_speed_m_per_s)
        if self._load_cells is not None:
            self._load_cells.start(tension_n)
        return torque

    @property
    def is_plain(self) -> bool:
        """Whether the paper's two equations are what is integrated now."""
        return isinstance(self._line, PlainLine)

    @property
    def full_line(self) -> FullLine | None:
        """The full model, to look into; None as long as the plain equations do."""
        return None if isinstance(self._line, PlainLine) else self._line

    def use_full_line(self) -> FullLine:
        """Leave the plain equations for good, and go on from the present state by the full model, which is returned.

        The first time on a machine compiles for several seconds: `compile_full_line` does so beforehand.
        """
        if isinstance(self._line, PlainLine):
            self._line = FullLine.after(self.plant, self._line, self._inputs)
            self._look_at_line()
        return self._line

    def compile_full_line(self) -> None:
        """Have the full model ready for later, and change nothing."""
        FullLine(self.plant, self._inputs.copy())

    # What happens to the line. Rollers and spans count from 1 here, as in the paper; IndexError for one that is not
    # there, ValueError for a number that cannot be. Each of them leaves the plain equations.

    def break_web(self, span: int) -> None:
        """See `FullLine.break_web`."""
        self.use_full_line().break_web(span)

    def splice_web(self, span: int) -> None:
        """See `FullLine.splice_web`."""
        self.use_full_line().splice_web(span)

    def slacken_web(self, span: int, length_m: float) -> None:
        """See `FullLine.slacken_web`."""
        self.use_full_line().slacken_web(span, length_m)

    def set_friction_factor(self, roller: int, factor: float, rate_per_s: float = inf) -> None:
        """See `FullLine.set_friction_factor`."""
        self.use_full_line().set_friction_factor(roller, factor, rate_per_s)

    def set_slip(self, roller: int, mu_factor: float) -> None:
        """See `FullLine.set_slip`."""
        self.use_full_line().set_slip(roller, mu_factor)

    # A sensor's noise belongs to the millisecond: two readings within it are one measurement.

    def measure_tension_n(self, index: int) -> float:
        """What the load cell of span `index` + 1 shows now."""
        if self._load_cells is not None:
            return float(self.measure_tensions_n()[index])
        return float(self.tension_n[index] + self._noise.tension_n[self.steps % _BLOCK, index])

    def measure_speed_m_per_s(self, index: int) -> float:
        """What the encoder of roller `index` + 1 shows now."""
        if self._speed_step_m_per_s > 0.0:
            return float(self.measure_speeds_m_per_s()[index])
        return float(self.surface_speed_m_per_s[index] + self._noise.speed_m_per_s[self.steps % _BLOCK, index])

    def measure_unwind_speed_m_per_s(self) -> float:
        shown = self.unwind_speed_m_per_s + self._noise.unwind_m_per_s[self.steps % _BLOCK]
        return float(quantised(shown, self._speed_step_m_per_s))

    def measure_tensions_n(self) -> FloatArray:
        """All load cells, shape (n,)."""
        row = self.steps % _BLOCK
        if self._load_cells is not None:
            return self._load_cells.reading_n(row, self.now_s, self._noise.tension_n[row])
        return self.tension_n + self._noise.tension_n[row]

    def measure_speeds_m_per_s(self) -> FloatArray:
        """All encoders, shape (n,): the surface speed of a round roller, apart from slip and eccentricity."""
        shown = self.surface_speed_m_per_s + self._noise.speed_m_per_s[self.steps % _BLOCK]
        return quantised(shown, self._speed_step_m_per_s)

    def _look_at_line(self) -> None:
        """True values now, shape (n,); views: do not write, copy to keep. A change of the model makes new ones."""
        line = self._line
        self.tension_n, self.torque_nm = line.tension_n, line.torque_nm
        self.speed_m_per_s = line.speed_m_per_s  #: of the web at the rollers
        self.surface_speed_m_per_s = line.surface_speed_m_per_s  #: of the rollers: other than the web's when it slips

    def _ramp(self, column: int, target: float, rate: float) -> None:
        self._inputs[TARGET, column] = target
        if rate == inf:
            self._inputs[VALUE, column] = target
            self._follow_commands()
        else:
            self._inputs[RATE, column] = rate

    def _heed(self, due_s: float) -> None:
        """A timer has been set."""
        self._still_until_s = min(self._still_until_s, due_s - _WELL_BEFORE_S)

    def _follow_commands(self) -> None:
        if not isinstance(self._line, PlainLine):
            self._line.follow_commands()

    def _integrate_to(self, to_s: float) -> None:
        last = floor(to_s * STEPS_PER_S + _GRID_TOLERANCE)
        while self.steps < last:
            begin = self.steps % _BLOCK
            end = min(_BLOCK, begin + last - self.steps)
            rows = self._trace[begin:end]
            self._line.advance(self._noise.process[begin:end], rows)
            if self._load_cells is not None:
                self._load_cells.follow(rows)
            first = self.steps + 1
            self.steps += end - begin
            if end == _BLOCK:
                self._begin_block()
            if self.on_rows is not None:
                self.on_rows(first, rows)

    def _begin_block(self) -> None:
        self._noise = self._next_noise or self._drawn()
        self._next_noise = None
        if self._load_cells is not None:
            self._load_cells.draw(_BLOCK)

    def _drawn(self) -> _Noise:
        """The noise of the steps that come after those that have been drawn."""
        sensors = self.plant.sensors
        tension, speed, unwind = self._sensor_streams
        return _Noise(
            process=self._process_stream.standard_normal((_BLOCK, self.n)),
            tension_n=sensors.tension_noise_n * tension.standard_normal((_BLOCK, self.n)),
            speed_m_per_s=sensors.speed_noise_m_per_s * speed.standard_normal((_BLOCK, self.n)),
            unwind_m_per_s=sensors.speed_noise_m_per_s * unwind.standard_normal(_BLOCK),
        )

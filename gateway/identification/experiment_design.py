"""An experiment designed: as little movement as tells the wanted intervals in the time that is preferred.

What is told follows from the tolerances of the line's file (`experiment_information`), on the nominal line and corners
of its tolerances; how far tensions go with the controller in service is simulated on all corners
(`experiment_foresight`). Sensitivities are affine in the amplitude a, psi = psi_0 + a psi_1: two runs give the
information of any amplitude.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil, floor, inf

import numpy as np

from gateway.control.reference import MinimumJerk
from gateway.control.rollout import Course
from gateway.core.controller import Controller
from gateway.core.experiment import Abort, Experiment, ExperimentRefused, Leg, reasons_against, setpoints
from gateway.core.line import Line
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel
from gateway.identification.experiment_foresight import HELD, WINDOW_S, Foreseen, Foresight
from gateway.identification.experiment_information import (
    COMBINATIONS,
    closed_loop,
    half_widths,
    prior_precision,
    sensitivities,
    standing,
)
from gateway.identification.experiment_words import percent, speeds_text, too_little, why

PREFERRED_S = 5.0  #: at each speed
LONGEST_LEG_S = 60.0
KNOWN_S = 10.0  #: of a leg are simulated, unless it is brief; what a longer one tells is as its second half goes on
GRID_S = 0.5  #: of durations
GRID_N = 0.25  #: of amplitudes; no experiment has a smaller one
UNIT_N = 2.0  #: amplitude of the run from which others are scaled
DWELLS_S = (0.05, 0.1, 0.2, 0.4)  #: in whole periods, at least:
DWELL_PERIODS = 5
FAST = 0.8  #: of the greatest speed: the faster leg, unless speeds are given; the other has half of it
STRONG = ("stiffness_per_length", "radius_per_inertia", "friction_per_inertia")


@dataclass(frozen=True)
class Wanted:
    """Half-widths of 95 % intervals, as fractions."""

    strong: float = 0.005  #: of EA/L, R/J and f/J
    rest: float = 0.03  #: of EA, L, R, J, f each by itself

    def of(self, name: str) -> float:
        return self.strong if name in STRONG else self.rest

    def missed(self, widths: Mapping[str, float]) -> dict[str, float]:
        return {name: width for name, width in widths.items() if not width <= self.of(name)}  # what is no number, too

    def text(self) -> str:
        return f"{percent(self.strong)} of EA/L, R/J and f/J, {percent(self.rest)} of the rest"


@dataclass(frozen=True)
class DesignedExperiment:
    experiment: Experiment
    expected: dict[str, float]  #: half-widths of 95 % intervals, as fractions, on the nominal line
    worst: dict[str, float]  #: on the worst corner of the tolerances that was tried
    foreseen: Foreseen
    reasons: tuple[str, ...]  #: in plain words


def design_experiment(
    line: Line,
    config: Controller,
    *,
    tension_n: Sequence[float] | None = None,
    speed_m_per_s: float | None = None,
    speeds_m_per_s: Sequence[float] | None = None,
    wanted: Wanted | None = None,
    brief: bool = False,
    seed: int = 0,
) -> DesignedExperiment:
    """The experiment for a line that stands at these tensions and this speed (its first recipe's), under `config`.

    `speeds_m_per_s` are those of the legs. `brief`: `PREFERRED_S` at each speed, which may tell less than is wanted.
    Raises ExperimentRefused with the reason where none can be offered.
    """
    recipe = line.recipes[0]
    base: FloatArray = np.array(recipe.tension_n if tension_n is None else tension_n, dtype=np.float64)
    _check(line, config, base)
    most_n = _most_n(line, base)
    drawing = _Drawing(
        Foresight(line, config, base, recipe.speed_m_per_s if speed_m_per_s is None else speed_m_per_s),
        wanted or Wanted(),
        PREFERRED_S if brief else KNOWN_S,
        seed,
    )
    speeds = drawing.speeds(speeds_m_per_s)
    dwell, needs = _best_dwell(drawing, speeds, most_n)
    told = drawing.told(drawing.foresight.some_models, speeds, dwell)
    amplitude, duration = min(drawing.least_amplitude(told, most_n), most_n), PREFERRED_S
    while True:  # a longer experiment may go further, a smaller one takes longer
        experiment, foreseen = drawing.bounded(amplitude, dwell, speeds, duration)
        amplitude, before = max(experiment.amplitude_n), duration
        duration = before if brief else drawing.least_duration(told, amplitude, speeds)
        if duration <= before:
            break
    least = drawing.least_amplitude(told, amplitude, duration)
    if least < amplitude:  # what took the time was not for want of movement
        amplitude = least
        experiment, foreseen = drawing.bounded(amplitude, dwell, speeds, duration)
    quiet_n = amplitude
    experiment, foreseen = drawing.above_noise(experiment, foreseen, dwell, speeds, duration)
    amplitude = max(experiment.amplitude_n)
    experiment = drawing.with_abort(experiment, foreseen)
    expected, *corners = (drawing.widths(one, amplitude, duration) for one in told)
    worst = {name: max(widths[name] for widths in (expected, *corners)) for name in COMBINATIONS}
    reasons = why(
        experiment, line, speeds=speeds, duration_s=duration, least=duration == PREFERRED_S,
        quiet_n=quiet_n, most_n=most_n,
        needs={dwell * line.control.period_s: need for dwell, need in needs.items()}, expected=expected, worst=worst,
        foreseen=foreseen.text(), saturated_share=foreseen.saturated_share, drawn_in=drawing.foresight.drawn_in,
    )  # fmt: skip
    return DesignedExperiment(experiment, expected, worst, foreseen, reasons)


@dataclass(frozen=True)
class _Told:
    """Information of all legs of one plant by time: I = I_00 + a (I_01 + I_01') + a^2 I_11, (times, p, p)."""

    still: FloatArray
    mixed: FloatArray
    moved: FloatArray

    def at(self, amplitude_n: float, duration_s: float) -> FloatArray:
        whole = self.still + amplitude_n * (self.mixed + self.mixed.transpose(0, 2, 1)) + amplitude_n**2 * self.moved
        last, place = len(whole) - 1, duration_s / GRID_S
        if place <= last:
            return whole[round(place)]
        half = last // 2
        return whole[last] + (whole[last] - whole[half]) * (place - last) / (last - half)


@dataclass(frozen=True)
class _Drawing:
    """What a design is made from."""

    foresight: Foresight
    wanted: Wanted
    known_s: float  #: of a leg that are simulated
    seed: int

    @property
    def line(self) -> Line:
        return self.foresight.line

    def speeds(self, given: Sequence[float] | None) -> list[float]:
        """Of the legs, each once, slowest first."""
        most, foresight = self.line.limits.speed_max_m_per_s, self.foresight
        if given is None:
            tried: list[float] = (FAST * most * np.linspace(1.0, 0.1, 19)).tolist()
            fast = next((speed for speed in tried if foresight.can_go(speed)), None)
            if fast is None:
                raise ExperimentRefused(self._too_weak(tried[-1]))
            return [0.5 * fast, fast]
        found = sorted({float(speed) for speed in given})
        if not found or not (found[0] > 0.0 and found[-1] <= most):
            raise ExperimentRefused(f"legs at {speeds_text(found) or 'no speed'}; allowed: above 0, to {most:g} m/s")
        if not foresight.can_go(found[-1]):
            raise ExperimentRefused(self._too_weak(found[-1]))
        return found

    def _too_weak(self, speed: float) -> str:
        limit = self.line.limits.torque_nm
        return (
            f"at {speed:g} m/s a line within the tolerances takes {self.foresight.needs_nm(speed):.0f} Nm, the drives "
            f"give {limit:g} Nm, and more than {HELD * limit:g} Nm leaves no room to move: a lower speed, or narrower "
            "tolerances"
        )

    def experiment(self, amplitude_n: float, dwell: int, speeds: Sequence[float], duration_s: float) -> Experiment:
        """A leg takes the way to its speed longer than `duration_s`, which is what is computed with."""
        moves, before = self.line.moves, self.foresight.speed
        peak = MinimumJerk.PEAK if moves.shape == "minimum-jerk" else 1.0
        legs: list[Leg] = []
        for speed in speeds:
            way_s = peak * abs(speed - before) / moves.speed_rate_m_per_s2
            legs.append(Leg(duration_s=duration_s + ceil(way_s / GRID_S) * GRID_S, speed_m_per_s=speed))
            before = speed
        spans = self.foresight.task.tension_spans
        try:
            return Experiment(
                format=1,
                name="commissioning",
                amplitude_n=[amplitude_n if i in spans else 0.0 for i in range(self.line.n)],
                dwell_s=round(dwell * self.line.control.period_s, 9),
                rate_n_per_s=_rate_n_per_s(self.line),
                seed=self.seed,
                legs=legs,
                abort=Abort(deviation_n=2.0 * amplitude_n),
            )
        except ValueError as error:  # longer than any may be
            raise ExperimentRefused(f"{len(speeds)} speeds of {duration_s:g} s each: {error}") from error

    def told(self, models: list[WebModel], speeds: Sequence[float], dwell: int) -> list[_Told]:
        """What the legs tell of each plant, as a function of amplitude and duration."""
        period_s, task, base = self.line.control.period_s, self.foresight.task, self.foresight.base_n
        config, setup = self.foresight.config, self.foresight.setup
        unit = self.experiment(UNIT_N, dwell, speeds, PREFERRED_S)
        moves = setpoints(unit.model_copy(update={"legs": [Leg(duration_s=self.known_s)]}), base, period_s)
        tension, grid = np.vstack((base, moves)), round(GRID_S / period_s)
        sums: list[list[tuple[FloatArray, ...]]] = [[] for _ in models]
        for speed in speeds:
            run = closed_loop(config, models, Course(tension, np.full(len(tension), speed)), setup)
            if not np.abs(run.state).max() < min(model.stiffness_n for model in models):
                raise ExperimentRefused(
                    "with the controller in service a line within the tolerances runs away as soon as set-points move: "
                    "a calmer controller, or narrower tolerances"
                )
            both = (standing(models, base, speed, len(tension), setup), run)
            for i, found in enumerate(sums):
                still, moved = (sensitivities(one, i, task.noise, setup, task.draw_spans, coulomb=True) for one in both)
                slope = (moved - still) / UNIT_N
                found.append((_sums(still, still, grid), _sums(still, slope, grid), _sums(slope, slope, grid)))
        return [_Told(*(np.sum(parts, axis=0) for parts in zip(*found, strict=True))) for found in sums]

    def widths(self, told: _Told, amplitude_n: float, duration_s: float) -> dict[str, float]:
        return half_widths(told.at(amplitude_n, duration_s) + prior_precision(self.line, coulomb=True))

    def lack(self, told: Sequence[_Told], amplitude_n: float, duration_s: float) -> float:
        """The widest interval, in units of what is wanted of it: 1 or less is enough."""
        every = [self.widths(one, amplitude_n, duration_s) for one in told]
        # Of numpy: Python's own maximum passes over what is no number, where it does not come first.
        return float(np.max([width / self.wanted.of(name) for widths in every for name, width in widths.items()]))

    def least_amplitude(self, told: Sequence[_Told], most_n: float, duration_s: float = PREFERRED_S) -> float:
        """On its grid; infinity where the greatest is not enough."""
        if not self.lack(told, most_n, duration_s) <= 1.0:
            return inf
        low, high = 0, round(most_n / GRID_N)  # too little, enough
        while high - low > 1:
            middle = (low + high) // 2
            enough = self.lack(told, middle * GRID_N, duration_s) <= 1.0
            low, high = (low, middle) if enough else (middle, high)
        return high * GRID_N

    def least_duration(self, told: Sequence[_Told], amplitude_n: float, speeds: Sequence[float]) -> float:
        """At each speed, the preferred time or longer. Raises ExperimentRefused where the longest is not enough."""
        for duration in np.arange(PREFERRED_S, LONGEST_LEG_S + 0.5 * GRID_S, GRID_S).tolist():
            if self.lack(told, amplitude_n, duration) <= 1.0:
                return duration
        every = [self.widths(one, amplitude_n, LONGEST_LEG_S) for one in told]
        missed = self.wanted.missed({name: max(one[name] for one in every) for name in COMBINATIONS})
        raise ExperimentRefused(too_little(missed, self.wanted.text(), LONGEST_LEG_S, amplitude_n, speeds))

    def bounded(
        self, amplitude_n: float, dwell: int, speeds: Sequence[float], duration_s: float
    ) -> tuple[Experiment, Foreseen]:
        """The experiment with this amplitude, or the greatest below it that keeps tensions in their band."""
        low, high = self.foresight.low_n, self.foresight.high_n
        while True:
            experiment = self.experiment(amplitude_n, dwell, speeds, duration_s)
            foreseen = self.foresight.of(experiment)
            if low <= foreseen.tension_min_n and foreseen.tension_max_n <= high:
                return experiment, foreseen
            if amplitude_n <= GRID_N:
                raise ExperimentRefused(
                    f"the band is too narrow: already an amplitude of {amplitude_n:g} N makes {foreseen.text()} on a "
                    f"line within the tolerances, allowed are {low:g} to {high:g} N; wider limits, another set-point, "
                    "narrower tolerances, a calmer controller, or speeds nearer to that at which the line runs"
                )
            amplitude_n = max(_down(0.75 * amplitude_n), GRID_N)

    def above_noise(
        self, experiment: Experiment, foreseen: Foreseen, dwell: int, speeds: Sequence[float], duration_s: float
    ) -> tuple[Experiment, Foreseen]:
        """The experiment, or one that is larger by as much as it takes for its data not to be refused as quiet."""
        needs_n, most_n = self.foresight.needs_change_n, _most_n(self.line, self.foresight.base_n)
        while foreseen.change_n < needs_n:
            amplitude_n = max(experiment.amplitude_n)
            steps = max(ceil(amplitude_n * needs_n / foreseen.change_n / GRID_N), round(amplitude_n / GRID_N) + 1)
            if steps * GRID_N <= most_n:
                wider, foreseen_then = self.bounded(steps * GRID_N, dwell, speeds, duration_s)
                if max(wider.amplitude_n) > amplitude_n:
                    experiment, foreseen = wider, foreseen_then
                    continue
            if foreseen.nominal_change_n < needs_n:
                raise ExperimentRefused(
                    f"with {amplitude_n:g} N either way a tension would change by {foreseen.nominal_change_n:.2g} N in "
                    f"0.1 s, and it takes {needs_n:.2g} N to tell that from noise; limits leave no room for more: "
                    "wider limits, another set-point, narrower tolerances, or a calmer controller"
                )
            break  # as far as limits allow on a lively corner of the tolerances: a slow corner may be too quiet
        return experiment, foreseen

    def with_abort(self, experiment: Experiment, foreseen: Foreseen) -> Experiment:
        """Halfway from what is foreseen at worst to the tension limits, not beyond these, or twice what is foreseen."""
        limits, base, spans = self.line.limits, self.foresight.base_n, self.foresight.task.tension_spans
        room = float(np.minimum(base - limits.tension_min_n, limits.tension_max_n - base)[spans].min())
        worst = max(foreseen.deviation_n, max(experiment.amplitude_n))
        abort = Abort(
            deviation_n=floor(100.0 * min(2.0 * worst, room, max(0.5 * (worst + room), 1.1 * worst))) / 100.0,
            window_s=WINDOW_S,
            saturated_share=_allowed(foreseen.saturated_share),
            reversal_share=_allowed(foreseen.reversal_share),
            reversal_nm=self.foresight.reversal_nm,
        )
        designed = experiment.model_copy(update={"abort": abort})
        if reasons := reasons_against(designed, self.line, base, self.foresight.speed):
            raise ExperimentRefused("; ".join(reasons))
        return designed


def _check(line: Line, config: Controller, base: FloatArray) -> None:
    draw = [i for i, span in enumerate(line.spans) if span.control == "draw"]
    if len(draw) == line.n:
        raise ExperimentRefused("no span has a load cell: there is no tension to move and to see")
    if config.n != line.n or config.draw_spans != draw or abs(config.period_s - line.control.period_s) > 1e-9:
        raise ExperimentRefused("the controller is for another line: spans, draw-controlled spans or period differ")
    if len(base) != line.n or not (np.isfinite(base) & (base > 0.0)).all():
        raise ExperimentRefused(f"tensions of {base.tolist()} N; allowed: {line.n} of them, above 0")


def _rate_n_per_s(line: Line) -> float | None:
    """Of the set-points; None where steps are allowed."""
    return None if line.limits.tension_step_max_n >= 2.0 * GRID_N else line.moves.tension_rate_n_per_s


def _most_n(line: Line, base: FloatArray) -> float:
    """The greatest amplitude that set-points may have."""
    limits = line.limits
    low, high = limits.tension_min_n + limits.tension_margin_n, limits.tension_max_n - limits.tension_margin_n
    spans = [i for i, span in enumerate(line.spans) if span.control == "tension"]
    room: FloatArray = np.minimum(base - low, high - base)[spans]
    if room.min() < GRID_N:
        i = spans[int(room.argmin())]
        raise ExperimentRefused(
            f"the band is too narrow: span {i + 1} stands at {base[i]:g} N, set-points are allowed from {low:g} to "
            f"{high:g} N, and an experiment moves them by {GRID_N:g} N or more; wider limits, or another set-point"
        )
    steps = inf if _rate_n_per_s(line) is not None else 0.5 * limits.tension_step_max_n
    return _down(min(float(room.min()), steps))


def _best_dwell(drawing: _Drawing, speeds: Sequence[float], most_n: float) -> tuple[int, dict[int, float]]:
    """Periods, and what each dwell that was tried needs: an amplitude in N, or where none is enough infinity."""
    needs: dict[int, float] = {}
    lacks: dict[int, float] = {}
    for dwell in sorted({max(DWELL_PERIODS, round(dwell_s / drawing.line.control.period_s)) for dwell_s in DWELLS_S}):
        told = drawing.told(drawing.foresight.models[:1], speeds, dwell)
        needs[dwell] = drawing.least_amplitude(told, most_n)
        lacks[dwell] = drawing.lack(told, min(needs[dwell], most_n), PREFERRED_S)
    return min(needs, key=lambda dwell: (needs[dwell], lacks[dwell])), needs


def _sums(left: FloatArray, right: FloatArray, per_grid: int) -> FloatArray:
    """Of left_k' right_k up to each grid point (times + 1, p, p); (k, m, p) each."""
    blocks = len(left) // per_grid
    shape = (blocks, per_grid * left.shape[1], left.shape[2])
    a, b = (one[: blocks * per_grid].reshape(shape) for one in (left, right))
    sums: FloatArray = np.cumsum(a.transpose(0, 2, 1) @ b, axis=0)
    return np.concatenate((np.zeros((1, *sums.shape[1:])), sums))


def _allowed(share: float) -> float:
    """A quarter more than was foreseen, and a tenth of the periods."""
    return round(min(0.9, 1.25 * share + 0.1), 2)


def _down(amplitude_n: float) -> float:
    return GRID_N * int(amplitude_n / GRID_N + 1e-9)

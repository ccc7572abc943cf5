"""An experiment as data: tension set-points that move at random while the line runs, and what ends it early.

Everything that it will send is known before it is sent. In the j-th dwell, counted over all legs, span i stands at

    base_i + amplitude_i s_ij,    s_ij = 1 - 2 (z >> 63)  or, where the shape is "uniform",  (z >> 11) / 2^52 - 1

where z is the (j n + i)-th output of SplitMix64 (Steele, Lea and Flood 2014) that begins at `seed`: written out here,
because the stream of a library's generator may change with its version, and a judged experiment must not.
"""

import hashlib
from collections.abc import Iterator
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from gateway.core.canonical import canonical_bytes
from gateway.core.line import Line, Name, NonNegative, Positive, Strict
from gateway.core.line_limits import setpoint_bands_n
from gateway.core.signals import FloatArray

LONGEST_S = 600.0
Share = Annotated[float, Field(gt=0.0, le=1.0)]

_GOLDEN, _FIRST, _SECOND = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
_64_BITS = (1 << 64) - 1


class Leg(Strict):
    """A part of an experiment at one speed of the unwinder, with the way to it at the line's rate."""

    duration_s: Annotated[float, Field(gt=0.0, le=LONGEST_S)]
    speed_m_per_s: NonNegative | None = None  #: None: as the line runs when the experiment begins


class Abort(Strict):
    """What ends it early. Shares are of the periods of the last `window_s`."""

    deviation_n: Positive  #: of a measured tension from its set-point before the experiment
    window_s: Annotated[float, Field(gt=0.0, le=60.0)] = 1.0
    #: Periods in which a torque is at its greatest, or has gone one way as fast as it may for 10 ms (or a period, if
    #: that is longer).
    saturated_share: Share = 0.5
    #: Periods in which the torque of a drive has come back by more than `reversal_nm` from the farthest it had gone
    #: since it last did: what a loop does that chatters or swings. Noise and the steps themselves do it now and then.
    reversal_share: Share = 0.5
    reversal_nm: Positive = 5.0
    held_periods: Annotated[int, Field(ge=0, le=2)] = 1  #: in a row without a usable signal; more end it


class Experiment(Strict):
    """Set-points are counted from where they stand when it begins, and go back there."""

    format: Annotated[int, Field(ge=1, le=1)]
    name: Name = "experiment"
    description: Annotated[str, Field(max_length=400)] = ""  #: for people: what it is for
    shape: Literal["binary", "uniform"] = "binary"  #: levels: one of two, or any between
    amplitude_n: Annotated[list[NonNegative], Field(min_length=1, max_length=60)]  #: either way, one per span
    dwell_s: Annotated[float, Field(gt=0.0, le=60.0)]  #: from one level to the next; rounded to whole periods
    rate_n_per_s: Positive | None = None  #: how fast set-points go from level to level; None: at once
    seed: Annotated[int, Field(ge=0, le=_64_BITS >> 1)] = 0
    legs: Annotated[list[Leg], Field(min_length=1, max_length=20)]
    abort: Abort

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not any(self.amplitude_n):
            raise ValueError("amplitude_n is 0 for every span: nothing would move")
        if self.abort.deviation_n <= max(self.amplitude_n):
            raise ValueError(
                f"abort.deviation_n is {self.abort.deviation_n:g} N; allowed: more than the greatest amplitude, "
                f"{max(self.amplitude_n):g} N, or the experiment ends itself"
            )
        if self.duration_s > LONGEST_S:
            raise ValueError(f"the legs take {self.duration_s:g} s; allowed: {LONGEST_S:g} s")
        return self

    @property
    def n(self) -> int:
        return len(self.amplitude_n)

    @property
    def duration_s(self) -> float:
        return sum(leg.duration_s for leg in self.legs)

    @property
    def step_max_n(self) -> float:
        """The greatest change of a set-point from one level to the next."""
        return 2.0 * max(self.amplitude_n)

    def periods(self, period_s: float) -> int:
        """Control periods that it takes."""
        return sum(_whole(leg.duration_s, period_s) for leg in self.legs)


class ExperimentRefused(Exception):
    """An experiment that must not be run, or cannot be designed; the text says why."""


_adapter: TypeAdapter[Experiment] = TypeAdapter(Experiment)


def canonical(experiment: Experiment) -> bytes:
    """The one byte representation of an experiment, the same whoever writes it."""
    return canonical_bytes(experiment)


def experiment_hash(experiment: Experiment) -> str:
    """SHA-256 of the canonical bytes, in hexadecimal."""
    return hashlib.sha256(canonical(experiment)).hexdigest()


def parse_experiment(payload: bytes) -> Experiment:
    """The experiment in `payload` (JSON). Raises ExperimentRefused with every reason."""
    try:
        return _adapter.validate_json(payload)
    except ValidationError as error:
        reasons = (f"{'.'.join(map(str, e['loc']))}: {e['msg']}".removeprefix(": ") for e in error.errors())
        raise ExperimentRefused("; ".join(reasons)) from error


def course(
    experiment: Experiment, base_tension_n: FloatArray, base_speed_m_per_s: float, period_s: float
) -> Iterator[tuple[FloatArray, float]]:
    """What is sent period by period: tension set-points (n,) in N, and the speed in m/s that the unwinder goes to.

    While nothing changes it is the same array. Raises ValueError for a base of another size.
    """
    if base_tension_n.shape != (experiment.n,):
        raise ValueError(f"{experiment.n} amplitudes for {len(base_tension_n)} spans")
    dwell = _whole(experiment.dwell_s, period_s)
    reach_n = None if experiment.rate_n_per_s is None else experiment.rate_n_per_s * period_s
    tension = goal = base_tension_n
    k = 0
    for leg in experiment.legs:
        speed = base_speed_m_per_s if leg.speed_m_per_s is None else leg.speed_m_per_s
        for _ in range(_whole(leg.duration_s, period_s)):
            if k % dwell == 0:
                goal = base_tension_n + np.array(experiment.amplitude_n) * signs(experiment, k // dwell)
            k += 1
            if reach_n is None:
                tension = goal
            elif tension is not goal:
                way = goal - tension
                arrived = np.count_nonzero(np.abs(way) > reach_n) == 0
                tension = goal if arrived else tension + np.minimum(np.maximum(way, -reach_n), reach_n)
            yield tension, speed


def setpoints(experiment: Experiment, base_tension_n: FloatArray, period_s: float) -> FloatArray:
    """The tension set-points (k, n) in N of every period."""
    return np.array([tension for tension, _ in course(experiment, base_tension_n, 0.0, period_s)])


def speed_goals(experiment: Experiment, base_speed_m_per_s: float, period_s: float) -> FloatArray:
    """The speed (k,) in m/s that the unwinder goes to at the line's rate, of every period."""
    base = np.zeros(experiment.n)
    return np.array([speed for _, speed in course(experiment, base, base_speed_m_per_s, period_s)])


def signs(experiment: Experiment, dwell: int) -> FloatArray:
    """s_ij (n,), -1 to 1, of a dwell j counted from 0."""
    n = experiment.n
    words = [_splitmix64(experiment.seed, dwell * n + i) for i in range(n)]
    if experiment.shape == "binary":
        return np.array([1.0 - 2.0 * (word >> 63) for word in words])
    return np.array([(word >> 11) / 2.0**52 - 1.0 for word in words])


def reasons_against(
    experiment: Experiment, line: Line, base_tension_n: FloatArray, base_speed_m_per_s: float
) -> list[str]:
    """Why it must not be run on this line from these set-points; none: as far as can be said without a model."""
    if experiment.n != line.n or base_tension_n.shape != (line.n,):
        return [f"the experiment has {experiment.n} amplitudes, the line {line.n} spans"]
    limits, amplitude = line.limits, np.array(experiment.amplitude_n)
    low, high = setpoint_bands_n(line)
    found = [
        f"span {i + 1} would go from {base_tension_n[i] - amplitude[i]:g} to {base_tension_n[i] + amplitude[i]:g} N; "
        f"allowed: {low[i]:g} to {high[i]:g} N"
        for i in np.flatnonzero((base_tension_n - amplitude < low - 1e-9) | (base_tension_n + amplitude > high + 1e-9))
        if amplitude[i] > 0.0
    ]
    found += [
        f"span {i + 1} is draw-controlled: without a load cell nobody sees what its tension does; amplitude_n must be 0"
        for i, span in enumerate(line.spans)
        if span.control == "draw" and amplitude[i] > 0.0
    ]
    if experiment.rate_n_per_s is None and experiment.step_max_n > limits.tension_step_max_n * (1.0 + 1e-9):
        found.append(
            f"set-points would step by up to {experiment.step_max_n:g} N; allowed: limits.tension_step_max_n, "
            f"{limits.tension_step_max_n:g} N, or a rate_n_per_s"
        )
    if experiment.rate_n_per_s is not None and experiment.rate_n_per_s > line.moves.tension_rate_n_per_s * (1.0 + 1e-9):
        found.append(
            f"set-points would move at {experiment.rate_n_per_s:g} N/s; allowed: moves.tension_rate_n_per_s, "
            f"{line.moves.tension_rate_n_per_s:g} N/s"
        )
    speeds = [base_speed_m_per_s if leg.speed_m_per_s is None else leg.speed_m_per_s for leg in experiment.legs]
    if max(speeds) > limits.speed_max_m_per_s:
        found.append(f"a leg runs at {max(speeds):g} m/s; allowed: 0 to {limits.speed_max_m_per_s:g} m/s")
    return found


def _whole(time_s: float, period_s: float) -> int:
    """Periods, at least one."""
    return max(1, round(time_s / period_s))


def _splitmix64(seed: int, index: int) -> int:
    """The output `index` (from 0) of the generator that begins at `seed`."""
    z = (seed + (index + 1) * _GOLDEN) & _64_BITS
    z = ((z ^ (z >> 30)) * _FIRST) & _64_BITS
    z = ((z ^ (z >> 27)) * _SECOND) & _64_BITS
    return z ^ (z >> 31)

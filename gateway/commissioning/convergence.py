"""Whether an adaptation has come to its end: what the line does, beside what the model says of it. Pure.

A measurement is an experiment in which set-points move at the line's own rate, as in production, and stand long enough
for each move to be looked at by itself: proposed, judged, decided and run like any other, so that it is on record and
its data are there for the next model. Of each span the worst of its changes counts, from the begin of the move:

    RMSE_i <= 0.05 T_ref,i    OS_i <= 20 %    t_s,i <= 2 s    (eq. convergence_criteria)

overshoot of the step's size, or of T_ref,i where the span does not step, and the band of settling 2 % of T_ref,i. What
noise of the load cells adds to overshoot and settling is taken off by a mean over `SMOOTHED_S`.

The prediction is a rollout on the accepted model with the set-points and speeds of the recording, and the noise of its
load cells, looked at in the same way. Where what was measured is what was foreseen, a model of other data would foresee
the same in moves of this size: so the gap between the two says whether the line does what the model does not. (Data of
moves that stand for long tell too little by themselves; beside those of an experiment they tell what it left open.)
"""

from collections.abc import Sequence
from math import inf, isfinite
from typing import Annotated

import numpy as np
from pydantic import Field

from gateway.commissioning.candidates import NotOffered
from gateway.commissioning.past import Follows
from gateway.commissioning.simulated_loop import loop_of
from gateway.control.rollout import Course, plants_of_thetas, simulate
from gateway.core.controller import Controller
from gateway.core.deployment import Region
from gateway.core.experiment import Abort, Experiment, Leg, signs
from gateway.core.line import Line, Strict
from gateway.core.line_model import LineModel, noise_of, theta_of
from gateway.core.metrics import overshoot_pct, rmse_per_span_n, settling_time_s
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise

RMSE_SHARE, MOST_OVERSHOOT_PCT, MOST_SETTLING_S = 0.05, 20.0, 2.0
SIGNIFICANT = 0.1  #: of the predicted tracking error: a gap below it, noise included, leads to no other design
DWELL_S, STEPS = 2.5, 3  #: of a measurement: from step to step, and at each speed
SEEDS = 100  #: are tried, for one with which every span steps at each speed, and few neighbours against each other
OF_SETPOINT = 0.05  #: a step either way, of the mean set-point, as far as the region permits
REVERSAL_TIMES = 3.0  #: of the rms that the gate lets a torque chatter by: a noise that large is hardly ever there
ABORT_TIMES = 3.0  #: the greatest step either way: farther from its set-point no tension goes
SMOOTHED_S = 0.05
STANDS = 0.02  #: of the greatest speed, by which it may differ within a window, noise included


class SpanFigures(Strict):
    """Of a span in its worst change. null: it never settled."""

    rmse_n: float
    overshoot_pct: float
    settling_s: float | None
    setpoint_n: float  #: the lowest at which it was asked to stand

    @property
    def converged(self) -> bool:
        return (
            self.rmse_n <= RMSE_SHARE * self.setpoint_n
            and self.overshoot_pct <= MOST_OVERSHOOT_PCT
            and self.settling_s is not None
            and self.settling_s <= MOST_SETTLING_S
        )


class Diagnosis(Strict):
    """What was decided to follow from a measurement."""

    follows: Annotated[Follows, Field(strict=False)]  #: as text, too
    by: str
    because: str


class Convergence(Strict):
    """Of a configuration on its line. Spans are those with a load cell; `gap` is measured over predicted less 1."""

    spans: dict[str, SpanFigures]
    predicted: dict[str, SpanFigures]  #: on the accepted model
    rmse_n: float  #: over all spans and changes
    gap: float  #: of that
    diagnosis: Diagnosis | None = None  #: null: as the rules have it

    @property
    def converged(self) -> bool:
        return bool(self.spans) and all(one.converged for one in self.spans.values())  # of none nothing is known

    @property
    def settled(self) -> bool:
        """Nothing is left to do: the criteria are met, and no significant gain is predicted any more."""
        return self.converged and not self.gains

    @property
    def gains(self) -> bool:
        """A newer model would lead to another design; so it would where the gap is no number."""
        return not abs(self.gap) < SIGNIFICANT

    @property
    def follows(self) -> Follows:
        """As was decided; as the rules have it where nobody else has."""
        if self.diagnosis is not None:
            return self.diagnosis.follows
        return Follows.NEWER_MODEL if self.gains else Follows.LEAVE if self.converged else Follows.CALMER

    @property
    def worst(self) -> SpanFigures:
        """Of each figure the worst span's."""
        settling = [inf if one.settling_s is None else one.settling_s for one in self.spans.values()]
        return SpanFigures(
            rmse_n=max(one.rmse_n for one in self.spans.values()),
            overshoot_pct=max(one.overshoot_pct for one in self.spans.values()),
            settling_s=max(settling) if isfinite(max(settling)) else None,
            setpoint_n=min(one.setpoint_n for one in self.spans.values()),
        )

    @property
    def text(self) -> str:
        beyond = [f"span {name}" for name, one in self.spans.items() if not one.converged]
        worst = self.worst
        settling = "never settles" if worst.settling_s is None else f"settles within {worst.settling_s:.2f} s"
        met = "criteria met" if not beyond else f"criteria not met by {', '.join(beyond)}"
        return (
            f"{met}: error up to {worst.rmse_n:.2f} N, overshoot {worst.overshoot_pct:.0f} %, {settling}; "
            f"{self.gap:+.0%} beside the prediction"
        )


def measurement(
    line: Line, region: Region | None, tension_n: Sequence[float], speeds_m_per_s: Sequence[float], size: float,
    seed: int,
) -> Experiment:  # fmt: skip
    """Steps from set-points (n,), at each speed. Raises NotOffered."""
    limits, setpoint = line.limits, np.array(tension_n)
    step_n = limits.tension_step_max_n
    if region is not None and region.tension_step_max_n is not None:
        step_n = min(step_n, region.tension_step_max_n)
    low, high = limits.tension_min_n + limits.tension_margin_n, limits.tension_max_n - limits.tension_margin_n
    room = np.minimum.reduce([setpoint - low, high - setpoint, np.full(line.n, 0.5 * step_n)])
    measured = np.array([span.control == "tension" for span in line.spans])
    # All by as much: what a span does while its neighbour steps further says little of its own step.
    common = np.min(np.clip(OF_SETPOINT * setpoint.mean(), 0.0, room), where=measured, initial=np.inf)
    amplitude = np.where(measured, size * common, 0.0)
    greatest = float(amplitude.max())
    nearest_n = float(min(setpoint.min() - limits.tension_min_n, limits.tension_max_n - setpoint.max()))
    if not 0.0 < greatest < nearest_n:
        raise NotOffered("no set-point may step far enough for a look at its course: steps and limits are too narrow")
    asked = Experiment(
        format=1,
        name="measurement",
        description="steps that stand, to see how the configuration in service does",
        amplitude_n=amplitude.tolist(),
        dwell_s=DWELL_S,
        rate_n_per_s=line.moves.tension_rate_n_per_s,
        seed=seed,
        legs=[Leg(duration_s=STEPS * DWELL_S, speed_m_per_s=speed) for speed in speeds_m_per_s],
        # What the gate lets a torque chatter is no reason to end it.
        abort=Abort(
            deviation_n=min(ABORT_TIMES * greatest, nearest_n), reversal_nm=REVERSAL_TIMES * line.gate.chatter_max_nm
        ),
    )
    seeds = [asked.model_copy(update={"seed": SEEDS * seed + k}) for k in range(SEEDS)]
    return max(seeds, key=_suited)


def _suited(asked: Experiment) -> tuple[int, int]:
    """Spans that step at a speed, over all speeds; and as few neighbours as may be that step against each other."""
    levels = np.array([signs(asked, dwell) for dwell in range(STEPS * len(asked.legs))])
    steps = np.diff(levels, axis=0, prepend=np.zeros((1, asked.n)))
    stepping = np.ptp(levels.reshape(-1, STEPS, asked.n), axis=1)
    return int(np.count_nonzero(stepping)), -int(np.count_nonzero(steps[:, 1:] * steps[:, :-1] < 0.0))


def convergence(line: Line, recording: Recording, in_service: Controller, model: LineModel) -> Convergence:
    """Of a measurement's recording under `in_service`, which is judged by `model`.

    Raises NotOffered where the recording shows no change to be looked at.
    """
    measured = _figures(line, recording, recording.tension_n)
    foreseen = _figures(line, recording, _rolled_out(line, recording, in_service, model))
    rmse, foreseen_rmse = (float(np.sqrt(sum(one.rmse_n**2 for one in of.values()))) for of in (measured, foreseen))
    return Convergence(spans=measured, predicted=foreseen, rmse_n=rmse, gap=rmse / max(foreseen_rmse, 1e-9) - 1.0)


def _rolled_out(line: Line, recording: Recording, config: Controller, model: LineModel) -> FloatArray:
    """Tensions (k, n) of the model as its load cells tell them, with the set-points and speeds of the recording."""
    course, noise = Course(recording.tension_setpoint_n, recording.unwind_speed_m_per_s), noise_of(model) or Noise()
    simulated = simulate(config, plants_of_thetas([theta_of(model)]), course, loop_of(line, noise), record=True)
    tension_n: FloatArray = simulated.tension_n[0]
    return tension_n + noise.tension_n * np.random.default_rng(0).standard_normal(tension_n.shape)


def _figures(line: Line, recording: Recording, tension_n: FloatArray) -> dict[str, SpanFigures]:
    """By the number of the span, of tensions (k, n) under the recording's set-points."""
    setpoint, period_s = recording.tension_setpoint_n, recording.period_s
    time_s: FloatArray = np.arange(len(setpoint), dtype=np.float64) * period_s
    smooth = _smoothed(tension_n, max(1, round(SMOOTHED_S / period_s)))
    windows = _windows(line, recording)
    if not windows:
        raise NotOffered("no step of the recording can be looked at: the speed moved, or samples are missing")
    found = np.zeros((3, line.n))  # RMSE, overshoot, settling time: the worst of all changes
    for begin, end in windows:
        rows, asked, changed_s = slice(begin - 1, end), setpoint[begin - 1 : end], float(time_s[begin])
        one = (
            rmse_per_span_n(tension_n[begin:end], setpoint[begin:end]),
            overshoot_pct(time_s[rows], smooth[rows], asked, changed_s),
            settling_time_s(time_s[rows], smooth[rows], asked, changed_s),
        )
        found = np.maximum(found, one)
    lowest = np.min([setpoint[end - 1] for _, end in windows], axis=0)
    measured = [i for i, span in enumerate(line.spans) if span.control == "tension"]
    if not np.isfinite(found[:2, measured]).all():
        raise NotOffered("a tension is no number, or runs away, in the line's recording or on its model")
    rmse, overshoot, settling = found.tolist()
    return {
        str(i + 1): SpanFigures(
            rmse_n=rmse[i], overshoot_pct=overshoot[i], settling_s=settling[i] if isfinite(settling[i]) else None,
            setpoint_n=float(lowest[i]),
        )
        for i in measured
    }  # fmt: skip


def _windows(line: Line, recording: Recording) -> list[tuple[int, int]]:
    """From each change of set-points to the next, where the speed stands and every load cell tells."""
    setpoint, speed = recording.tension_setpoint_n, recording.unwind_speed_m_per_s
    spans = [i for i, span in enumerate(line.spans) if span.control == "tension"]
    moved = np.any(np.diff(setpoint, axis=0) != 0.0, axis=1)
    begins = (1 + np.flatnonzero(moved & ~np.concatenate(([False], moved[:-1])))).tolist()  # of moves, however long
    most = STANDS * line.limits.speed_max_m_per_s
    least = round((MOST_SETTLING_S + SMOOTHED_S) / recording.period_s)
    return [
        (begin, end)
        for begin, end in zip(begins, [*begins[1:], len(setpoint)], strict=True)
        if end - begin >= least
        and np.ptp(speed[begin:end]) <= most
        and np.isfinite(recording.tension_n[begin - 1 : end, spans]).all()
    ]


def _smoothed(values: FloatArray, samples: int) -> FloatArray:
    """Mean over so many samples until each (k, n), of those that are there; NaN where none is."""
    known = np.isfinite(values)
    before = np.zeros((1, values.shape[1]))
    sums = np.cumsum(np.vstack((before, np.where(known, values, 0.0))), axis=0)
    counts = np.cumsum(np.vstack((before, known)), axis=0)
    last = np.arange(1, len(values) + 1)
    first = np.maximum(last - samples, 0)
    there = counts[last] - counts[first]
    return np.divide(sums[last] - sums[first], there, out=np.full(values.shape, np.nan), where=there > 0.0)

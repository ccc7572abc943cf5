"""Physics from recordings."""

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np

from agents.code.algorithms.figures import figure, sentences
from agents.code.calls import Identify
from agents.code.job import Job, Outcome
from gateway.control.prediction import Unpredictable, free_run, predict, stretch_of
from gateway.core.line_model_names import COMBINATIONS, UNITS, split_name
from gateway.core.questions import Figure
from gateway.core.recording import Recording
from gateway.core.theta import Noise, nominal_theta
from gateway.identification.estimate import Interval
from gateway.identification.identify import Identified, identify
from gateway.identification.prediction_error import LEAST_S
from gateway.identification.recursive import estimated_recursively, live
from gateway.identification.validation import Validation

MOST_PARAMETERS = 14  #: told as figures, each with the ends of its interval; all stand in words
WARM_UP_S = 1.0


def identified(call: Identify, job: Job) -> Outcome:
    """Raises NotIdentified."""
    found = identify(job.recordings, job.line, Noise(), time.perf_counter)
    intervals = _in_order(found.estimate.intervals)
    figures = [part for name in list(intervals)[:MOST_PARAMETERS] for part in _interval(name, intervals[name])]
    return Outcome(figures=[*figures, *of_validation(found.validation)], words=sentences(_words(job, found, intervals)))


def of_validation(found: Validation, before: str = "") -> list[Figure]:
    """Means over spans and rollers, on data that the model was not made from. `before` stands before each name."""
    rows: list[Figure] = []
    for quantity, unit in (("tension", "N"), ("speed", "m/s")):
        of_it = f"{before}of {quantity}"
        rows += [
            figure(f"{of_it}: R2 a period ahead", found.mean(quantity, "r2")),
            figure(f"{of_it}: R2 a second ahead", found.mean(quantity, "r2_free")),
            figure(f"{of_it}: mean absolute error a period ahead", found.mean(quantity, "mae"), unit),
            figure(f"{of_it}: mean absolute error a second ahead", found.mean(quantity, "mae_free"), unit),
        ]
    return [
        *rows,
        figure(f"{before}normalised innovation squared", found.normalised),
        figure(f"{before}portmanteau statistic over its quantile", found.portmanteau),
    ]


def warm_up(job: Job) -> None:
    """The predictors, on a second of the first recording that can be used."""
    for recording in job.recordings:
        for part in recording.stretches(round(LEAST_S / recording.period_s)):
            _predict(job, part.part(0, round(max(LEAST_S, WARM_UP_S) / recording.period_s)))
            return


def _predict(job: Job, part: Recording) -> None:
    round_ = nominal_theta(job.line)
    with suppress(Unpredictable, ValueError):  # the call itself says what is wrong
        for theta in (round_, replace(round_, eccentricity=np.full(job.line.n, 0.001))):
            predicted = predict(theta, Noise(), stretch_of(part))
            free_run(theta, predicted, 0, 2)
        estimated_recursively(live(job.line), part)


def _words(job: Job, found: Identified, intervals: Mapping[str, Interval]) -> list[str]:
    validation, comparison = found.validation, found.comparison
    rows = [f"{row.estimate.method} {row.score:.2f}" for row in comparison.rows]
    units = {name: UNITS[split_name(name)[0]] for name in intervals}
    return [
        f"from {', '.join(one.source for one in job.recordings)}, {found.fitted.samples} samples",
        f"structure: {found.estimate.structure}",
        "on data held back it is " + ("valid" if validation.valid else "not valid"),
        *validation.findings,
        *(f"recommended: {one}" for one in validation.recommendations),
        f"errors a second ahead, in standard deviations of the sensors: {', '.join(rows)}",
        *(f"no estimate by {name}: {why}" for name, why in found.failed.items()),
        *(str(one) for one in found.warnings[:5]),
        *(f"{name} {one.value:.4g} ({one.low:.4g} to {one.high:.4g}) {units[name]}" for name, one in intervals.items()),
    ]


def _interval(name: str, one: Interval) -> list[Figure]:
    unit = UNITS[split_name(name)[0]]
    return [
        figure(name, one.value, unit), figure(f"{name}, from", one.low, unit), figure(f"{name}, to", one.high, unit),
    ]  # fmt: skip


def _in_order(intervals: Mapping[str, Interval]) -> dict[str, Interval]:
    """Those first that data tell best: the combinations."""
    return dict(sorted(intervals.items(), key=lambda item: split_name(item[0])[0] not in COMBINATIONS))

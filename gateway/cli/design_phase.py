"""Phase 1 of a line, composed: algorithm 1 for each architecture in workers, then the comparison and the choice."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.queues import SimpleQueue
from statistics import median
from threading import Thread

import numpy as np

from gateway.cli.timed_law import TimedLaw
from gateway.cli.workers import Workers, processors
from gateway.commissioning.architectures import ARCHITECTURES, Architecture
from gateway.commissioning.assessment import Assessment, assess
from gateway.commissioning.belief import words_on
from gateway.commissioning.ground import Ground, ground_of
from gateway.commissioning.records import Attempt, Trial
from gateway.commissioning.search import PatternSearch
from gateway.commissioning.selection import Candidate, candidate, explanation, ranked
from gateway.commissioning.trial import reasons_against, run_on, trial_of
from gateway.commissioning.tuning import Tuned, tune
from gateway.control.design import DesignRefused
from gateway.control.laws import make_law, untimed
from gateway.control.rollout import Course, Rollouts, run_law
from gateway.core.controller import Controller, config_hash
from gateway.core.line import Line
from gateway.core.line_model import LineModel, model_hash
from gateway.core.scenario import Scenario
from gateway.core.signals import FloatArray

MOST_OF_PERIOD = 0.3  #: that a step may take: samples and commands need the rest
PROBED_PERIODS = 50
BOX_PLANTS = 8  #: within the tolerances, beside the nominal model, for every final figure
PLANTS_TUNED_ON = {"mpc": 3}  #: in all; others on all of them: they cost a thousandth
LEAD_S, WATCHED_S = 0.2, 5.2  #: of each scenario while tuning: before the change, and in all

Told = tuple[str, Attempt]  #: architecture, and what was tried with it
_told: "SimpleQueue[Told | None]"  #: of a worker


@dataclass(frozen=True)
class Trace:
    """What a candidate did on the nominal model: tensions and torques (k, n) at `time_s` (k,)."""

    time_s: FloatArray
    setpoint_n: FloatArray
    tension_n: FloatArray
    torque_nm: FloatArray


@dataclass(frozen=True)
class Finished:
    """What a worker hands back for one architecture."""

    architecture: str
    tuned: Tuned
    values: dict[str, float]  #: of the attempt that is offered; the first guess where none is
    config: Controller | None
    trial: Trial | None
    refused: str
    traces: dict[str, Trace]  #: by scenario


@dataclass(frozen=True)
class Design:
    """The outcome of phase 1."""

    assessment: Assessment
    ground: Ground
    finished: list[Finished]
    candidates: list[Candidate]  #: ranked
    explanation: list[str]

    @property
    def chosen(self) -> Finished | None:
        """C*; None: nothing can be offered."""
        best = self.candidates[0]
        if best.score is None:
            return None
        return next(one for one in self.finished if one.architecture == best.architecture)


def run_design(
    line: Line,
    scenarios: Sequence[Scenario],
    names: Sequence[str],
    iterations: int,
    seed: int,
    on_attempt: Callable[[str, Attempt], None],
    speeds_m_per_s: Sequence[float] = (),
    model: LineModel | None = None,
) -> Design:
    """Tune, compare, choose, on the line's nominal model or on `model`. Raises DesignRefused where none can begin."""
    ground = ground_of(line, scenarios, BOX_PLANTS, seed, speeds_m_per_s, model)
    assessment = assess(line, ground.task)
    if model is not None:
        said = words_on(model, f"model {model_hash(model)[:12]}", scenarios)
        assessment = assessment.model_copy(update={"sentences": [*said, *assessment.sentences]})
    finished = _tuned_in_workers(ground, names, iterations, on_attempt)
    candidates = ranked([_candidate(one, ground, line) for one in finished])
    return Design(assessment, ground, finished, candidates, explanation(candidates))


def _tuned_in_workers(
    ground: Ground, names: Sequence[str], iterations: int, on_attempt: Callable[[str, Attempt], None]
) -> list[Finished]:
    told: SimpleQueue[Told | None] = get_context("spawn").SimpleQueue()

    def listen() -> None:
        while (heard := told.get()) is not None:
            on_attempt(*heard)

    listener = Thread(target=listen, daemon=True)
    listener.start()
    with Workers(min(len(names), processors()), _begin_worker, (told,)) as pool:
        # The slowest first: the others fill the gaps.
        order = sorted(names, key=lambda name: name not in PLANTS_TUNED_ON)
        running: dict[str, Future[Finished]] = {
            name: pool.submit(finish_architecture, name, ground, iterations) for name in order
        }
        wait(running.values())
        finished = [running[name].result() for name in names]
    # Only here: a worker that was ended in the middle of telling has the queue's lock for ever.
    told.put(None)
    listener.join()
    return finished


def _begin_worker(told: "SimpleQueue[Told | None]") -> None:
    import numba

    global _told
    _told = told
    numba.set_num_threads(1)  # the workers share the processors as it is


def finish_architecture(name: str, ground: Ground, iterations: int) -> Finished:
    """Algorithm 1 on one architecture, and its best on the whole ground."""
    architecture = ARCHITECTURES[name]
    plants = PLANTS_TUNED_ON.get(name, len(ground.models))
    if refused := _too_slow(architecture, ground):
        return Finished(name, Tuned((), converged=True), architecture.first(ground.task), None, None, refused, {})
    small = ground.shortened(plants, LEAD_S, WATCHED_S)
    tuned = tune(
        architecture, small, PatternSearch(), iterations, on_attempt=lambda attempt: _told.put((name, attempt))
    )
    values, config, trial, runs, refused = _validated(architecture, tuned, ground)
    if config is None:
        return Finished(name, tuned, values, None, trial, refused, {})
    traces: dict[str, Trace] = {}
    for scenario, course, run in zip(ground.scenarios, ground.courses, runs, strict=True):
        time_s: FloatArray = ground.setup.period_s * np.arange(course.periods, dtype=np.float64)
        traces[scenario.name] = Trace(time_s, course.tension_n, run.tension_n[0], run.torque_nm[0])
    return Finished(name, tuned, values, config, trial, "", traces)


def _validated(
    architecture: Architecture, tuned: Tuned, ground: Ground
) -> tuple[dict[str, float], Controller | None, Trial | None, list[Rollouts], str]:
    """The best attempt that holds on the whole ground too: it was tuned on a part of it. With its trial and runs."""
    values, trial, refused = architecture.first(ground.task), None, tuned.reasons()
    for attempt in reversed([one for one in tuned.history if one.accepted]):
        values = dict(attempt.values)
        config = architecture.design(ground.task, values, ground.speeds_m_per_s)
        runs = run_on(config, ground)
        trial = trial_of(config, ground, runs)
        against = reasons_against(trial, ground)
        if not against:
            return values, config, trial, runs, ""
        refused = "; ".join(against)
    return values, None, trial, [], refused


def _too_slow(architecture: Architecture, ground: Ground) -> str:
    """Why there is no sense in tuning: its steps do not fit into the control period on this computer."""
    try:
        config = architecture.design(ground.task, architecture.first(ground.task))
    except DesignRefused:
        return ""  # the attempts will say why
    took_s, period_s = step_time_s(config, ground, PROBED_PERIODS), ground.task.period_s
    if took_s <= MOST_OF_PERIOD * period_s:
        return ""
    share = f"{MOST_OF_PERIOD:.0%} of a period of {1e3 * period_s:g} ms"
    return f"a step of it takes {1e3 * took_s:.3g} ms on this computer, more than {share}"


def step_time_s(config: Controller, ground: Ground, most_periods: int = 10_000) -> float:
    """Median time that a step of the law takes in this process, from the change of the ground's first scenario on."""
    law, setup, whole = TimedLaw(make_law(untimed(config))), ground.setup, ground.courses[0]
    begin = max(whole.changed - 1, 0)
    part = slice(begin, begin + most_periods)
    course = Course(whole.tension_n[part], whole.unwind_speed_m_per_s[part], whole.changed - begin)
    run_law(law, ground.models[0], course, setup, *setup.draw(course.periods, ground.task.n))
    return median(law.step_s)


def _candidate(one: Finished, ground: Ground, line: Line) -> Candidate:
    architecture = ARCHITECTURES[one.architecture]
    return candidate(
        architecture.name,
        architecture.title,
        one.values,
        config_hash(one.config) if one.config else "",
        one.trial,
        step_time_s(one.config, ground) if one.config else None,
        one.refused,
        line.priorities,
    )

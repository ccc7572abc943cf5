"""Algorithm 1 of each architecture in a worker process, and its best on the whole ground.

A worker tells of every attempt, and asks of its decisions, through the process that has started it: agents are asked
from one place alone.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.queues import SimpleQueue
from statistics import median
from threading import Thread
from typing import TypeVar

import numpy as np
from numpy.linalg import LinAlgError

from gateway.cli.background import in_background
from gateway.cli.timed_law import TimedLaw
from gateway.cli.workers import Workers, processors
from gateway.commissioning.architectures import ARCHITECTURES, Architecture
from gateway.commissioning.asked_search import AskedSearch
from gateway.commissioning.beforehand import Beforehand, GateAnswer
from gateway.commissioning.decisions import Decided, Decider
from gateway.commissioning.ground import Ground
from gateway.commissioning.records import Attempt, Trial
from gateway.commissioning.search import alike, calmer
from gateway.commissioning.trial import reasons_against, run_on, trial_of
from gateway.commissioning.tuning import Tuned, tune
from gateway.control.design import DesignRefused
from gateway.control.laws import make_law, untimed
from gateway.control.rollout import Course, Rollouts, run_law
from gateway.core.controller import Controller
from gateway.core.questions import Question
from gateway.core.signals import FloatArray

MOST_CALMER = 4  #: designs, each by a factor of 2 in its knobs, that are looked at where the gate refuses
MOST_OF_PERIOD = 0.3  #: that a step may take: samples and commands need the rest
PROBED_PERIODS = 50
PLANTS_TUNED_ON = {"mpc": 3}  #: in all; others on all of them: they cost a thousandth
LEAD_S, WATCHED_S = 0.2, 5.2  #: of each scenario while tuning: before the change, and in all

T = TypeVar("T")
Told = tuple[str, Attempt]  #: architecture, and what was tried with it
Asked = tuple[str, Question]  #: architecture, and what is asked


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
    gate: GateAnswer | None = None  #: None: it was not asked


@dataclass(frozen=True)
class Tuning:
    """How each architecture is tuned. `questions`: attempts of each that a decider is asked about, the first ones."""

    site: str
    line: str
    iterations: int
    questions: Mapping[str, int]
    gate: Beforehand | None = None  #: by which the best of each is judged


@dataclass(frozen=True)
class _Wires:
    """Between a worker and the process that has started it."""

    told: "SimpleQueue[Told | None]"
    asked: "SimpleQueue[Asked | None]"
    answers: "dict[str, SimpleQueue[Decided]]"  #: by architecture


_wires: _Wires  #: of a worker


def tuned_in_workers(
    ground: Ground, how: Tuning, decider: Decider, on_attempt: Callable[[str, Attempt], None]
) -> list[Finished]:
    """Of each architecture of `how.questions`. `decider` always answers, and is asked from a thread of its own."""
    names, context = list(how.questions), get_context("spawn")
    wires = _Wires(context.SimpleQueue(), context.SimpleQueue(), {name: context.SimpleQueue() for name in names})
    listening = [
        _listening(wires.told, lambda told: on_attempt(*told)),
        _listening(wires.asked, lambda asked: wires.answers[asked[0]].put(decider.decide(asked[1]))),
    ]
    with Workers(min(len(names), processors()), _begin_worker, (wires,)) as pool:
        # The slowest first: the others fill the gaps.
        order = sorted(names, key=lambda name: name not in PLANTS_TUNED_ON)
        running: dict[str, Future[Finished]] = {
            name: pool.submit(finish_architecture, name, ground, how) for name in order
        }
        wait(running.values())
        finished = [running[name].result() for name in names]
    # Only here: a worker that was ended in the middle of telling has the queue's lock for ever.
    wires.told.put(None)
    wires.asked.put(None)
    for thread in listening:
        thread.join()
    return finished


def _listening(wire: "SimpleQueue[T | None]", heard: Callable[[T], None]) -> Thread:
    """Takes what comes on a wire, until None does."""

    def listen() -> None:
        while (found := wire.get()) is not None:
            heard(found)

    return in_background(listen)


def _begin_worker(wires: _Wires) -> None:
    import numba

    global _wires
    _wires = wires
    numba.set_num_threads(1)  # the workers share the processors as it is


@dataclass(frozen=True)
class _AskedAbove:
    """`Decider` of a worker: the process above asks, and always answers."""

    architecture: str

    def decide(self, question: Question) -> Decided:
        _wires.asked.put((self.architecture, question))
        return _wires.answers[self.architecture].get()


def finish_architecture(name: str, ground: Ground, how: Tuning) -> Finished:
    """Algorithm 1 on one architecture, and its best on the whole ground."""
    architecture = ARCHITECTURES[name]
    plants = PLANTS_TUNED_ON.get(name, len(ground.models))
    if refused := _too_slow(architecture, ground):
        return Finished(name, Tuned((), converged=True), architecture.first(ground.task), None, None, refused, {})
    small = ground.shortened(plants, LEAD_S, WATCHED_S)
    search = AskedSearch(_AskedAbove(name), how.site, how.line, how.questions[name])
    tuned = tune(
        architecture, small, search, how.iterations, on_attempt=lambda attempt: _wires.told.put((name, attempt))
    )
    values, config, trial, runs, refused = _validated(architecture, tuned, ground)
    if config is None:
        return Finished(name, tuned, values, None, trial, refused, {})
    good = _Good(values, config, trial, runs)
    answer = None
    if how.gate is not None:
        good, answer = _let_through(architecture, good, ground, how.gate)
    traces: dict[str, Trace] = {}
    for scenario, course, run in zip(ground.scenarios, ground.courses, good.runs, strict=True):
        time_s: FloatArray = ground.setup.period_s * np.arange(course.periods, dtype=np.float64)
        traces[scenario.name] = Trace(time_s, course.tension_n, run.tension_n[0], run.torque_nm[0])
    return Finished(name, tuned, good.values, good.config, good.trial, "", traces, answer)


@dataclass(frozen=True)
class _Good:
    """What holds on the whole ground."""

    values: dict[str, float]
    config: Controller
    trial: Trial | None
    runs: list[Rollouts]


def _let_through(architecture: Architecture, best: _Good, ground: Ground, gate: Beforehand) -> tuple[_Good, GateAnswer]:
    """The best, or where the gate refuses it the first of a few calmer ones that it lets through."""
    at_first = gate.answer(best.config)
    answer, values = at_first, best.values
    for times in range(1, MOST_CALMER + 1):
        if answer.passed:
            break
        before, values = values, calmer(architecture, values)
        if alike(before, values):
            break
        with suppress(DesignRefused, LinAlgError):  # a calmer one of which there is no design is left out
            config = architecture.design(ground.task, values, ground.speeds_m_per_s)
            runs = run_on(config, ground)
            trial = trial_of(config, ground, runs)
            if reasons_against(trial, ground):
                continue
            answer = gate.answer(config)
            if answer.passed:
                return _Good(values, config, trial, runs), answer.model_copy(update={"calmer": times})
    return best, at_first


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

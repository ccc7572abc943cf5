"""Identification and design by themselves, without a gate: what rounds of experiment, model and design are worth.

`rehearse` goes through the gate (`rehearse_gate`); benchmarks of identification and design take this.

The line runs as it would: under the controller in service, experiment and abort condition in the loop's own hands, data
as the loop has recorded them. What is estimated knows of the plant what the load cells and drives have told.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gateway.cli.rehearse_designs import Design, offered
from gateway.cli.rehearse_result import AdaptationResult, Found
from gateway.cli.stepped import CommandRefused, SteppedLoop
from gateway.cli.stepped_experiment import run_experiment
from gateway.commissioning.belief import believing
from gateway.control.design import DesignRefused, DesignTask, design_lqi, design_mpc, task_of, task_on
from gateway.core.controller import Controller
from gateway.core.experiment import Experiment, ExperimentRefused
from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.scenario import Scenario
from gateway.core.theta import Noise
from gateway.identification.experiment_design import design_experiment
from gateway.identification.identify import Identified, NotIdentified, identify
from sim_plant.plant import Plant

AT_EACH_SPEED_S = 5.0  #: of data, at most
SETTLE_S = 0.5  #: that the line runs before an experiment
LEFT_OPEN = 0.05  #: of a value that was found: what data leave open, and what drifts until the next experiment
SEEDS_APART = 1000  #: the noise of an experiment is that of no scenario
IN_SERVICE = "lqi"  #: of a round's designs, the one under which the next round's experiment runs


class NoExperiment(Exception):
    """The experiment could not be run, or not to its end; the text says why."""

    def __init__(self, text: str, unsafe_events: int = 0) -> None:
        super().__init__(text)
        self.unsafe_events = unsafe_events  #: until then


@dataclass(frozen=True)
class Adapted:
    """A round: what came of it, and the designs that it has brought with the task that each was made for."""

    result: AdaptationResult
    designs: list[tuple[Design, DesignTask]]


def adapt(
    line: Line,
    plant: Plant,
    scenario: Scenario,
    seed: int,
    rounds: int,
    tell: Callable[[str], None] = lambda text: None,
    first: Experiment | None = None,
) -> list[Adapted]:
    """Round after round, each on the data of all before it as well. Ends early where a round brings no model.

    The line stands as `scenario` has it at the begin when an experiment is made. `first` is the first experiment, where
    `first_experiment` has designed it already: it depends on nothing that is true of the plant.
    """
    found: list[Adapted] = []
    recordings: list[Recording] = []
    in_service: Controller = design_lqi(task_of(line))
    believed = line  #: by whose values and tolerances the next experiment is designed
    for number in range(1, rounds + 1):
        began_s, unsafe = time.perf_counter(), 0

        def doing(text: str, number: int = number) -> None:
            tell(f"adaptation {number}: {text}")

        try:
            doing("experiment")
            experiment = first if first and number == 1 else _experiment(believed, in_service, scenario, number)
            recording, unsafe = _recorded(line, in_service, plant, scenario, experiment, seed + SEEDS_APART * number)
            recordings.append(recording)
            identified = identify(recordings, line, Noise(), time.perf_counter, tell=doing)
        except (NoExperiment, NotIdentified) as refused:
            reasons = refused.reasons if isinstance(refused, NotIdentified) else [str(refused)]
            unsafe = refused.unsafe_events if isinstance(refused, NoExperiment) else unsafe
            found.append(Adapted(_result(number, recordings, None, reasons, unsafe, time.perf_counter() - began_s), []))
            break
        estimate = identified.estimate
        task = task_on(line, estimate.theta, estimate.noise)
        designs = designs_on(number, task)
        took_s = time.perf_counter() - began_s
        found.append(Adapted(_result(number, recordings, identified, [], unsafe, took_s), designs))
        in_service, believed = _next_in_service(designs, in_service), believing(line, estimate.theta, LEFT_OPEN)
    return found


def designs_on(number: int, task: DesignTask) -> list[tuple[Design, DesignTask]]:
    """What a round brings: designs on the model that it has ended with."""
    model = f"identified-{number}"
    return [
        (Design(f"adapt{number}-lqi", "lqi", model, design_lqi), task),
        (Design(f"adapt{number}-mpc-observer", "mpc", model, design_mpc), task),
    ]


def first_experiment(line: Line, scenario: Scenario) -> Experiment:
    """That of the first round. Raises NoExperiment."""
    return _experiment(line, design_lqi(task_of(line)), scenario, 1)


def _next_in_service(designs: Sequence[tuple[Design, DesignTask]], before: Controller) -> Controller:
    for design, task in designs:
        if design.law == IN_SERVICE:
            try:
                return offered(design, task)
            except DesignRefused:
                break
    return before


def _experiment(believed: Line, config: Controller, scenario: Scenario, seed: int) -> Experiment:
    """For the line as it is believed to be, standing as the scenario begins. Raises NoExperiment."""
    try:
        designed = design_experiment(
            believed, config, tension_n=scenario.tension_n, speed_m_per_s=scenario.speed_m_per_s, brief=True, seed=seed
        )
    except ExperimentRefused as refused:
        raise NoExperiment(str(refused)) from refused
    return _no_longer(designed.experiment)


def _recorded(
    line: Line, config: Controller, plant: Plant, scenario: Scenario, experiment: Experiment, seed: int
) -> tuple[Recording, int]:
    """And unsafe events at the drives. Raises NoExperiment where the line refuses it or it is aborted."""
    loop = SteppedLoop(line, config, plant, seed)
    loop.begin_in_production(np.array(scenario.tension_n), scenario.speed_m_per_s)
    loop.step(round(SETTLE_S / line.control.period_s))
    try:
        return run_experiment(loop, experiment), loop.truth.recorder.unsafe_total
    except CommandRefused as refused:
        raise NoExperiment(str(refused), loop.truth.recorder.unsafe_total) from refused


def _no_longer(experiment: Experiment) -> Experiment:
    """With no more than `AT_EACH_SPEED_S` at each speed."""
    legs = [leg.model_copy(update={"duration_s": min(leg.duration_s, AT_EACH_SPEED_S)}) for leg in experiment.legs]
    return experiment.model_copy(update={"legs": legs})


def _result(
    number: int, recordings: Sequence[Recording], identified: Identified | None, refused: list[str], unsafe: int,
    wall_s: float,
) -> AdaptationResult:  # fmt: skip
    data_s = sum(recording.samples * recording.period_s for recording in recordings)
    if identified is None:
        return AdaptationResult(
            number=number, data_s=data_s, refused=refused, unsafe_events=unsafe, wall_s=round(wall_s, 1)
        )
    estimate = identified.estimate
    return AdaptationResult(
        number=number,
        data_s=data_s,
        structure=str(estimate.structure),
        intervals={
            name: Found(value=interval.value, low=interval.low, high=interval.high)
            for name, interval in estimate.intervals.items()
        },
        normalised_innovation=identified.validation.normalised,
        valid=identified.validation.valid,
        findings=[*identified.validation.findings, *identified.choice.cautions],
        refused=[],
        unsafe_events=unsafe,
        wall_s=round(wall_s, 1),
    )

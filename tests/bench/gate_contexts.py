"""What a proposal is judged against, made as on a real line: an experiment on the true line, a model, a controller."""

import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from gateway.cli.identify_model import model_of_found
from gateway.control.design import DesignTask, design_lqi, design_pid, task_of, task_on
from gateway.core.controller import Controller, config_hash
from gateway.core.judge_context import DataReference, JudgeContext, LineState
from gateway.core.line import Line
from gateway.core.line_model import LineModel, model_hash
from gateway.core.proposal import (
    Change,
    ExperimentChange,
    GainsChange,
    ModelChange,
    Proposal,
    canonical,
)
from gateway.core.recording import Recording
from gateway.core.theta import Noise
from gateway.identification.identify import identify
from sim_plant.plant import Plant
from tests.bench.gate_plants import plant_number
from tests.closed_loop.recorded import TENSION_N, demonstration_line, recorded
from tests.independent.truth import Truth, truth_of, with_unruly_effects

NOW = datetime(2026, 8, 3, 14, 6, tzinfo=UTC)
SPEEDS_M_PER_S = (0.05, 0.1)
SPEED_M_PER_S = 0.05  #: at which the line runs when it is judged


@dataclass(frozen=True)
class GateLine:
    """A line in service: its truth, which only the judge's judge knows, and what the gateway has found of it."""

    number: int
    plant: Plant
    truth: Truth
    line: Line
    recording: Recording
    model: LineModel
    task: DesignTask  #: on the model
    plain: Controller  #: a PID, as designed on the line's file
    initial: Controller  #: an LQI, likewise
    adapted: Controller  #: on the model

    @property
    def latency_s(self) -> float:
        return self.line.control.latency_s


def gate_line(number: int) -> GateLine:
    """Raises NotIdentified where the data of the line give no model."""
    plant, line = plant_number(number), demonstration_line()
    truth = with_unruly_effects(truth_of(plant), np.random.default_rng([number, 7]))
    recording = recorded(plant, number, speeds_m_per_s=SPEEDS_M_PER_S)
    found = identify([recording], line, Noise(), time.perf_counter)
    model = model_of_found(line, [recording], found, instant(-60.0))
    task = task_on(line, found.estimate.theta, found.estimate.noise)
    file = task_of(line)
    return GateLine(
        number, plant, truth, line, recording, model, task, design_pid(file), design_lqi(file), design_lqi(task)
    )  # fmt: skip


def instant(seconds: float) -> str:
    """So long after the context's now."""
    return (NOW + timedelta(seconds=seconds)).isoformat()


def context_of(given: GateLine, in_service: Controller, baseline: Controller, *, first: bool = False) -> JudgeContext:
    """`first`: before a model has been accepted, on a line that creeps."""
    return JudgeContext(
        format=1,
        now=instant(0.0),
        state=LineState(
            state="RUN",
            tension_n=list(TENSION_N),
            speed_m_per_s=0.01 if first else SPEED_M_PER_S,
            since_change_s=3600.0,
        ),
        in_service=in_service,
        baseline=baseline,
        model=None if first else given.model,
        data=[] if first else [data_reference(given.recording)],
        latency_s=given.latency_s,
    )


def data_reference(recording: Recording) -> DataReference:
    return DataReference(path="data.csv", digest=recording.digest(), recorded=instant(-90.0))


def proposed(change: Change, context: JudgeContext, line: Line, **more: object) -> Proposal:
    """A proposal of the agents, made in this context."""
    fields: dict[str, object] = {
        "format": 1, "site": line.site, "line": line.line, "change": change, "base": config_hash(context.in_service),
        "model": None if context.model is None else model_hash(context.model), "reason": "it tracks better",
        "author": "agents", "created": instant(-30.0), "expires": instant(3600.0),
    }  # fmt: skip
    return Proposal(**(fields | more))  # type: ignore[arg-type]


def payload_of(change: GainsChange | ExperimentChange | ModelChange, context: JudgeContext, line: Line) -> bytes:
    return canonical(proposed(change, context, line))

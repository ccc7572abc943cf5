"""What a proposal is judged against, made as on a real line: an experiment on the true line, a model, a controller."""

import pickle
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from hashlib import sha256
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np

from gateway.cli.identify_model import model_of_found
from gateway.control.design import DesignRefused, DesignTask, design_lqi, design_pid, lqi_weights, task_of, task_on
from gateway.core.controller import Controller, config_hash
from gateway.core.deployment import Region
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
WHOLE = Region()
SPEED_M_PER_S = 0.05  #: at which the line runs when it is judged
CAUTION = 30.0  #: times the torque weight, of a first configuration for a line that nobody knows
#: By how much a line may have changed since a controller was designed for it: a factor either way.
DRIFT = {
    "stiffness_n": 1.3, "length_m": 1.15, "radius_m": 1.1, "inertia_kg_m2": 1.3, "friction_nms_per_rad": 1.6,
}  # fmt: skip
DRIFT_TRIES = 40
KEPT = Path("out/bench/gate-lines")
MADE_BY = ("gateway", "sim_plant", "tests/bench", "tests/closed_loop", "tests/independent")


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
    cautious: Controller  #: an LQI on the line's file, with so much torque weight that hardly any line swings under it

    @property
    def latency_s(self) -> float:
        return self.line.control.latency_s


def gate_line(number: int) -> GateLine:
    """Made once for one state of the code, and kept in out/. Raises NotIdentified where its data give no model."""
    kept = KEPT / f"{code_hash()[:16]}-{number}.pickle"
    if kept.exists():
        found: GateLine = pickle.loads(kept.read_bytes())
        return found
    found = made_line(number)
    KEPT.mkdir(parents=True, exist_ok=True)
    with NamedTemporaryFile(dir=KEPT, delete=False) as file:
        file.write(pickle.dumps(found))
    Path(file.name).replace(kept)
    return found


@cache
def code_hash() -> str:
    """Of all that a line in service is made by."""
    found = sha256()
    for path in sorted(path for folder in MADE_BY for path in Path(folder).rglob("*.py")):
        found.update(path.read_bytes())
    return found.hexdigest()


def made_line(number: int) -> GateLine:
    """Anew. Raises NotIdentified."""
    plant, line = plant_number(number), demonstration_line()
    truth = with_unruly_effects(truth_of(plant), np.random.default_rng([number, 7]))
    recording = _recorded(plant, number, line)
    found = identify([recording], line, Noise(), time.perf_counter)
    model = model_of_found(line, [recording], found, instant(-60.0))
    task = task_on(line, found.estimate.theta, found.estimate.noise)
    file = task_of(line)
    return GateLine(
        number, plant, truth, line, recording, model, task, design_pid(file), design_lqi(file), design_lqi(task),
        heavy_lqi(file),
    )  # fmt: skip


def _recorded(plant: Plant, number: int, line: Line) -> Recording:
    """Under the LQI of the line's file; under a calmer one where the line stops itself under that."""
    try:
        return recorded(plant, number, speeds_m_per_s=SPEEDS_M_PER_S)
    except AssertionError:
        return recorded(plant, number, speeds_m_per_s=SPEEDS_M_PER_S, config=heavy_lqi(task_of(line)))


def heavy_lqi(task: DesignTask) -> Controller:
    """An LQI that asks little of the drives."""
    weights = lqi_weights(task)
    return design_lqi(task, replace(weights, torque_per_nm2=CAUTION * weights.torque_per_nm2))


def outdated(task: DesignTask, generator: np.random.Generator) -> Iterator[Controller]:
    """Designs for what the line may have been before it drifted to where it is now."""
    for _ in range(DRIFT_TRIES):
        moved = {name: getattr(task.model, name) * float(np.exp(generator.uniform(-1.0, 1.0) * np.log(factor)))
                 for name, factor in DRIFT.items()}  # fmt: skip
        with suppress(DesignRefused):
            yield design_lqi(replace(task, model=replace(task.model, **moved)))


def instant(seconds: float) -> str:
    """So long after the context's now."""
    return (NOW + timedelta(seconds=seconds)).isoformat()


def context_of(
    given: GateLine, in_service: Controller, baseline: Controller | None, *, first: bool = False,
    region: Region = WHOLE,
) -> JudgeContext:  # fmt: skip
    """`first`: before a model has been accepted, on a line that creeps. `region`: of what is in service."""
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
        region=region,
        baseline=baseline,
        model=None if first else given.model,
        data=[] if first else [data_reference(given.recording)],
        latency_s=given.latency_s,
    )


def data_reference(recording: Recording) -> DataReference:
    return DataReference(path="data.csv", digest=recording.digest(), recorded=instant(-90.0))


def proposed(change: Change, context: JudgeContext, line: Line, **more: Any) -> Proposal:
    """A proposal of the agents, made in this context."""
    fields: dict[str, Any] = {
        "format": 1, "site": line.site, "line": line.line, "change": change, "base": config_hash(context.in_service),
        "model": None if context.model is None else model_hash(context.model), "reason": "it tracks better",
        "author": "agents", "created": instant(-30.0), "expires": instant(3600.0),
    }  # fmt: skip
    return Proposal(**(fields | more))


def payload_of(change: GainsChange | ExperimentChange | ModelChange, context: JudgeContext, line: Line) -> bytes:
    return canonical(proposed(change, context, line))

"""What `r2rgate design` writes beside the configuration. Schema in docs/schemas/design.schema.json."""

import os
import platform
import sys
from datetime import UTC, datetime
from importlib.metadata import version

from gateway.cli.design_phase import Design
from gateway.commissioning.assessment import Assessment
from gateway.commissioning.records import Attempt
from gateway.commissioning.selection import Candidate
from gateway.core.line import Line, Priorities, Strict
from gateway.core.line_model import LineModel, model_hash
from gateway.core.scenario import Scenario


class TuningResult(Strict):
    """Algorithm 1 on one architecture."""

    architecture: str
    converged: bool  #: the proposer expected nothing better; otherwise the iterations were used up
    history: list[Attempt]


class DesignResult(Strict):
    """Phase 1 of a line."""

    command: str
    date: str  #: ISO 8601
    versions: dict[str, str]
    machine: str
    line: str  #: site/line
    model: str = ""  #: hash of the identified model; "": the nominal model of the line's file
    seed: int
    plants: int  #: of the box within the line's tolerances, or the model's intervals, beside the nominal model
    assessment: Assessment
    scenarios: list[Scenario]
    priorities: Priorities
    candidates: list[Candidate]  #: the chosen one first
    tuning: list[TuningResult]
    chosen: str  #: the architecture; "" where none can be offered
    controller: str  #: hash of the configuration; "" likewise
    explanation: list[str]


LIBRARIES = ("r2rgate", "numpy", "scipy", "numba", "osqp")


def result_of(line: Line, found: Design, seed: int, model: LineModel | None = None) -> DesignResult:
    """The outcome of phase 1, to be kept."""
    chosen = found.candidates[0] if found.chosen is not None else None
    return DesignResult(
        command=" ".join(["r2rgate", *sys.argv[1:]]),
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        versions={name: version(name) for name in LIBRARIES},
        machine=f"{os.cpu_count()} processors, {platform.system()} {platform.release()}, "
        f"Python {platform.python_version()}",
        line=f"{line.site}/{line.line}",
        model="" if model is None else model_hash(model),
        seed=seed,
        plants=len(found.ground.models) - 1,
        assessment=found.assessment,
        scenarios=list(found.ground.scenarios),
        priorities=line.priorities,
        candidates=found.candidates,
        tuning=[
            TuningResult(architecture=one.architecture, converged=one.tuned.converged, history=list(one.tuned.history))
            for one in found.finished
        ],
        chosen=chosen.architecture if chosen else "",
        controller=chosen.hash if chosen else "",
        explanation=found.explanation,
    )

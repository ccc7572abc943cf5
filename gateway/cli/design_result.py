"""What `r2rgate design` writes beside the configuration. Schema in docs/schemas/design.schema.json."""

from gateway.cli.design_phase import Design
from gateway.cli.origin import command_line, machine, now_iso, versions_of
from gateway.commissioning.assessment import Assessment
from gateway.commissioning.records import Attempt, DecisionRecord, Stop
from gateway.commissioning.selection import Candidate
from gateway.core.line import Line, Priorities, Strict
from gateway.core.line_model import LineModel, model_hash
from gateway.core.scenario import Scenario


class TuningResult(Strict):
    """Algorithm 1 on one architecture."""

    architecture: str
    converged: bool  #: the proposer expected nothing better; otherwise the iterations were used up
    stopped: Stop | None = None  #: somebody else has expected nothing better
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
    priorities_otherwise: Priorities | None = None  #: weights that somebody has proposed; None: nobody has
    decisions: list[DecisionRecord] = []  #: what was left to judgement; of the tuning it stands with each attempt
    candidates: list[Candidate]  #: the one with the least score first
    tuning: list[TuningResult]
    chosen: str  #: the architecture; "" where none can be offered
    judged: str = ""  #: against what the gate was asked beforehand; "": it was not
    controller: str  #: hash of the configuration; "" likewise
    explanation: list[str]


LIBRARIES = ("r2rgate", "numpy", "scipy", "numba", "daqp", "osqp")


def result_of(line: Line, found: Design, seed: int, model: LineModel | None = None, judged: str = "") -> DesignResult:
    """The outcome of phase 1, to be kept."""
    name = "" if found.chosen is None else found.chosen.architecture
    chosen = next((one for one in found.candidates if one.architecture == name), None)
    return DesignResult(
        command=command_line(),
        date=now_iso(),
        versions=versions_of(LIBRARIES),
        machine=machine(),
        line=f"{line.site}/{line.line}",
        model="" if model is None else model_hash(model),
        seed=seed,
        plants=len(found.ground.models) - 1,
        assessment=found.assessment,
        scenarios=list(found.ground.scenarios),
        priorities=line.priorities,
        priorities_otherwise=found.priorities_otherwise,
        decisions=found.decisions,
        candidates=found.candidates,
        tuning=[
            TuningResult(
                architecture=one.architecture,
                converged=one.tuned.converged,
                stopped=one.tuned.stopped,
                history=list(one.tuned.history),
            )  # fmt: skip
            for one in found.finished
        ],
        chosen=name,
        judged=judged,
        controller=chosen.hash if chosen else "",
        explanation=found.explanation,
    )

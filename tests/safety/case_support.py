"""Proposals and what they are judged against, from simulated lines whose truth is known."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from gateway.cli.recordings import read_recording
from gateway.control.design import DesignTask, design_lqi, task_of, task_on
from gateway.core.controller import Controller, config_hash
from gateway.core.judge_context import DataReference, JudgeContext, LineState, parse_context
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_model import LineModel, model_hash, noise_of, theta_of
from gateway.core.proposal import Proposal, canonical
from gateway.core.recording import Recording
from gateway.core.theta import Noise
from gateway.core.verdict import RuleFinding, Verdict
from gateway.identification.estimate import Structure
from gateway.identification.model_record import Origin, model_from
from gateway.identification.prediction_error import fit
from gateway.identification.prior import prior_of
from safety.case import Case
from safety.judge import judge
from tests.closed_loop.recorded import TENSION_N

NOW = "2026-08-03T14:06:00+00:00"
CREATED, EXPIRES = "2026-08-03T14:05:00+00:00", "2026-08-03T15:05:00+00:00"
MADE = "2026-08-03T14:00:00+00:00"
SPEED_M_PER_S = 0.05
EXAMPLES = Path("docs/examples")
DIGEST = "0" * 64


@dataclass(frozen=True)
class Setting:
    """A line, what has been recorded of it, and the model that was made from that."""

    line: Line
    recording: Recording
    model: LineModel

    def context(self, **changes: Any) -> JudgeContext:
        state = LineState(state="RUN", tension_n=list(TENSION_N), speed_m_per_s=SPEED_M_PER_S)
        fields: dict[str, Any] = {
            "format": 1, "now": NOW, "state": state, "in_service": design_lqi(task_of(self.line)),
            "model": self.model,
            "data": [DataReference(path="experiment.csv", digest=self.recording.digest(), recorded=MADE)],
        }  # fmt: skip
        return JudgeContext(**{**fields, **changes})

    def task(self) -> DesignTask:
        """What a good redesign is made for."""
        return task_on(self.line, theta_of(self.model), noise_of(self.model))


def modelled(recording: Recording, line: Line, structure: Structure | None = None) -> LineModel:
    """Of the simplest structure, unless another one is wanted."""
    fitted = fit([recording], prior_of(line, structure or Structure()), Noise())
    return model_from(fitted.estimate, recording, Origin(line.site, line.line, MADE, "test"))


@cache
def published() -> Setting:
    """The published context: S_real, under the LQI of the line's file, at 0.05 m/s."""
    line = load_line((EXAMPLES / "line.toml").read_text(), "line.toml")
    line = line.model_copy(update={"gate": line.gate.model_copy(update={"corners": 8})})  # for the time that it takes
    context = parse_context((EXAMPLES / "judge-context.json").read_bytes())
    assert context.model is not None
    return Setting(line, read_recording(EXAMPLES / context.data[0].path), context.model)


def proposal(change: Any, context: JudgeContext, **changes: Any) -> Proposal:
    """About what `context` has in service."""
    fields: dict[str, Any] = {
        "format": 1, "site": "demo", "line": "line-1", "change": change, "base": config_hash(context.in_service),
        "model": None if context.model is None else model_hash(context.model), "reason": "a test", "author": "engineer",
        "created": CREATED, "expires": EXPIRES,
    }  # fmt: skip
    return Proposal.model_validate({**fields, **changes})


def gains(controller: Controller, context: JudgeContext, **changes: Any) -> Proposal:
    return proposal({"kind": "gains", "controller": controller.model_dump()}, context, **changes)


def verdict_of(given: Proposal, context: JudgeContext, of: Setting, seed: int = 1) -> Verdict:
    return judge(canonical(given), context, of.line, [of.recording] * len(context.data), seed)


def case_of(given: Proposal, context: JudgeContext, of: Setting, seed: int = 1, **line: Any) -> Case:
    """`line`: fields of the [gate] table, in place of the line's own."""
    changed = of.line.model_copy(update={"gate": of.line.gate.model_copy(update=line)})
    return Case(changed, context, given, DIGEST, [of.recording] * len(context.data), seed)


def refused(found: list[RuleFinding]) -> list[str]:
    """What is against it."""
    return [one.text for one in found if not one.passed]


def with_state(context: JudgeContext, **changes: Any) -> JudgeContext:
    """The same, but for `changes` of the line's state."""
    return context.model_copy(update={"state": context.state.model_copy(update=changes)})

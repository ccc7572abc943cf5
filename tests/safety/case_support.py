"""Proposals and what they are judged against, from simulated lines whose truth is known."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from gateway.control.design import design_lqg, design_lqi, task_of, task_on
from gateway.core.controller import Controller, config_hash
from gateway.core.judge_context import DataReference, JudgeContext, LineState
from gateway.core.line import Line
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
from tests.closed_loop.recorded import TENSION_N, demonstration_line, real_plant, recorded

NOW = "2026-08-03T14:06:00+00:00"
CREATED, EXPIRES = "2026-08-03T14:05:00+00:00", "2026-08-03T15:05:00+00:00"
MADE = "2026-08-03T14:00:00+00:00"
SPEEDS = (0.05, 0.1)
DIGEST = "0" * 64


@dataclass(frozen=True)
class Setting:
    """A line, what has been recorded of it, and the model that was made from that."""

    line: Line
    recording: Recording
    model: LineModel

    def context(self, **changes: Any) -> JudgeContext:
        state = LineState(state="RUN", tension_n=list(TENSION_N), speed_m_per_s=SPEEDS[0])
        fields: dict[str, Any] = {
            "format": 1, "now": NOW, "state": state, "in_service": design_lqi(task_of(self.line)),
            "model": self.model,
            "data": [DataReference(path="experiment.csv", digest=self.recording.digest(), recorded=MADE)],
        }  # fmt: skip
        return JudgeContext(**{**fields, **changes})

    def task(self):
        """What a good redesign is made for."""
        return task_on(self.line, theta_of(self.model), noise_of(self.model))


def modelled(recording: Recording, line: Line, structure: Structure | None = None) -> LineModel:
    """Of the simplest structure, unless another one is wanted."""
    fitted = fit([recording], prior_of(line, structure or Structure()), Noise())
    return model_from(fitted.estimate, recording, Origin(line.site, line.line, MADE, "test"))


@cache
def setting(plant: str = "s_real", seed: int = 5) -> Setting:
    """Five seconds at each of two speeds."""
    line = demonstration_line()
    recording = recorded(real_plant(plant), seed, speeds_m_per_s=SPEEDS, line=line)
    return Setting(line, recording, modelled(recording, line))


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


def redesigns(of: Setting) -> dict[str, Controller]:
    """Good ones, on the identified model."""
    task = of.task()
    return {"lqi": design_lqi(task), "lqg": design_lqg(task)}


def with_latency(context: JudgeContext, latency_s: float) -> JudgeContext:
    return context.model_copy(update={"latency_s": latency_s})


def untouched(of: Setting, **changes: Any) -> Setting:
    return replace(of, **changes)

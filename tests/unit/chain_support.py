"""A commissioning chain for tests: what has been tried, and what the gate would have on its list of it."""

from dataclasses import replace

from gateway.commissioning.chain import next_step
from gateway.commissioning.ladder import Next
from gateway.commissioning.past import Follows, Outcome, Past, Step, named
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import config_hash
from gateway.core.decisions import ProposalShown
from gateway.core.deployment import Region
from gateway.core.proposal import GainsChange, Proposal, proposal_hash
from gateway.core.verdict import RuleFinding, Verdict
from tests.unit.supervisor_support import line_of

FIRST_M_PER_S, WANTED_M_PER_S = 0.02, 0.12
KINDS = {
    Step.FIRST: "gains", Step.EXPERIMENT: "experiment", Step.MODEL: "model", Step.REDESIGN: "gains",
    Step.MEASUREMENT: "experiment",
}  # fmt: skip
LINE = line_of(2)


def asked(past, adaptations=1, **limits):
    return next_step(past, FIRST_M_PER_S, WANTED_M_PER_S, adaptations, **limits)


def looked_at(past, settled=True, gains=False):
    """The last measurement, once somebody has looked at it."""
    why = "as it should" if settled else "span 2 overshoots"
    follows = Follows.LEAVE if settled else Follows.NEWER_MODEL if gains else Follows.CALMER
    return [*past[:-1], replace(past[-1], converged=settled, follows=follows, why=why)]


def after(step: Next, past, outcome=Outcome.DONE) -> Past:
    """What the gate's list has of a proposal. A configuration is let through for what the last experiment has shown."""
    shown = max((one.speed_m_per_s for one in past if one.kind == "experiment" and one.outcome is Outcome.DONE),
                default=FIRST_M_PER_S)  # fmt: skip
    fastest = max(step.speeds_m_per_s, default=None)
    speed = {Step.FIRST: FIRST_M_PER_S, Step.REDESIGN: shown, Step.EXPERIMENT: fastest, Step.MEASUREMENT: fastest}
    done = outcome is Outcome.DONE or step.step is Step.EXPERIMENT
    return Past(KINDS[step.step], outcome, step.step, step.rung, "why", speed.get(step.step) if done else None, "p")


ADAPTED = [
    Past("gains", Outcome.DONE, Step.FIRST, speed_m_per_s=0.02),
    Past("experiment", Outcome.DONE, Step.EXPERIMENT, speed_m_per_s=0.12),
    Past("model", Outcome.DONE, Step.MODEL), Past("gains", Outcome.DONE, Step.REDESIGN, speed_m_per_s=0.12),
]  # fmt: skip


def concluded(past, follows):
    """Measured, and this was concluded from it."""
    measured = after(asked(past), past)
    return [*past, replace(measured, follows=follows, converged=True, why="as it should", speed_m_per_s=0.12)]


def shown(stage, rules=(), why="", step=Step.FIRST, rung=2):
    """As the gate shows a proposal of the chain; `rules` are those that fail."""
    config = design_lqi(task_of(LINE))
    proposal = Proposal(
        format=1, site=LINE.site, line=LINE.line, change=GainsChange(controller=config), base=config_hash(config),
        model=None, reason="to begin with", evidence=[named(step, rung)], author="rules",
        created="2026-01-05T06:00:00+00:00", expires="2026-01-05T07:00:00+00:00",
    )  # fmt: skip
    findings = [RuleFinding(rule=rule, passed=False, text="no") for rule in rules]
    verdict = Verdict(
        format=1, proposal=proposal_hash(proposal), payload="0" * 64, context="0" * 64, line="0" * 64, kind="gains",
        seed=1, accepted=not rules, findings=findings or [RuleFinding(rule="decay", passed=True, text="yes")],
        region=None if rules else Region(speed_max_m_per_s=0.02), judged=proposal.created, program_version="0",
    )  # fmt: skip
    return ProposalShown(
        format=1, stage=stage, why=why, proposal_hash=proposal_hash(proposal), shown=None, epoch=0, difference=[],
        proposal=proposal, verdict=verdict,
    )  # fmt: skip

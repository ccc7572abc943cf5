"""The judge: what every rule finds of a proposal, and nothing else. Pure: no clock, no files, no chance of its own.

The same bytes, context, line, recordings and seed give the same verdict. A rule that fails is a refusal. A finding near
its limit is drawn again (`draws`).
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from hashlib import sha256
from importlib.metadata import version

import numpy as np

from gateway.control.design import design_lqi, task_of
from gateway.control.prediction import Unpredictable, predict, stretch_of
from gateway.control.rollout import course_through, simulate
from gateway.core.deployment import Region
from gateway.core.judge_context import JudgeContext, context_hash
from gateway.core.line import Line
from gateway.core.proposal import Proposal, ProposalRefused, parse_proposal, proposal_hash
from gateway.core.recording import Recording
from gateway.core.theta import expected_noise, nominal_theta
from gateway.core.verdict import OF_THE_MOMENT, RuleFinding, ScenarioFigures, Verdict, line_hash
from safety.case import Case
from safety.draws import GoesOn, drawn_again, words_on
from safety.findings import told
from safety.rules import alignment, authority, roller_speed, validity
from safety.rules.table import FIGURES, REPORTED, RULES, Rule
from safety.simulated import plants_under_stress, setup_of

FORMAT_RULE, DATA_RULE = "format", "data"
OF_NO_DESIGN = OF_THE_MOMENT | {authority.RULE, validity.RULE, alignment.RULE}


def judge(
    payload: bytes, context: JudgeContext, line: Line, recordings: Sequence[Recording], seed: int,
    goes_on: GoesOn = lambda: None,
) -> Verdict:  # fmt: skip
    """`recordings` as `context.data` names them, one for each, in that order. `goes_on`: it will take as long again."""
    try:
        proposal = parse_proposal(payload, line.gate.proposal_max_bytes)
    except ProposalRefused as refused:
        return _verdict(payload, context, line, seed, None, [told(FORMAT_RULE, False, why) for why in refused.reasons])
    except Exception as error:  # whatever the parser stumbles over is no proposal
        return _verdict(payload, context, line, seed, None, [_failed(FORMAT_RULE, error)])
    case = Case(line, context, proposal, proposal_hash(proposal), recordings, seed)
    if wrong := _wrong_data(context, recordings):
        return _verdict(payload, context, line, seed, proposal, [told(DATA_RULE, False, text) for text in wrong])
    with np.errstate(all="ignore"):  # numbers that run away are found by the rules, not by warnings
        found = [(rule, _asked(rule, case)) for rule in RULES[proposal.kind]]
        findings = drawn_again(case, found, _asked, goes_on)
        at_first = [finding for _, some in found for finding in some]
        reported = [finding for rule in REPORTED[proposal.kind] for finding in _asked(rule, case)]
        reported += words_on(at_first, findings)
        figures = _figures(case)
    accepted = all(finding.passed for finding in findings)
    region = _region(case) if accepted and proposal.kind == "gains" else None
    return _verdict(payload, context, line, seed, proposal, findings, reported, figures, region)


def findings_on_design(proposal: Proposal, context: JudgeContext, line: Line, seed: int) -> list[RuleFinding]:
    """Of a configuration that nobody has proposed yet: no verdict, for some rules are not asked (`OF_NO_DESIGN`).

    Those that speak of the moment, of who proposes, and of the model and its data, which are the same for every design.
    """
    case = Case(line, context, proposal, proposal_hash(proposal), (), seed)
    with np.errstate(all="ignore"):
        rules = [rule for rule in RULES[proposal.kind] if rule.name not in OF_NO_DESIGN]
        return drawn_again(case, [(rule, _asked(rule, case)) for rule in rules], _asked, lambda: None)


def refusal(payload: bytes, context: JudgeContext, line: Line, seed: int, rule: str, text: str) -> Verdict:
    """Of a proposal that could not be judged."""
    try:
        proposal = parse_proposal(payload, line.gate.proposal_max_bytes)
    except Exception:  # that it is none as well changes nothing
        proposal = None
    return _verdict(payload, context, line, seed, proposal, [told(rule, False, text)])


def failed(payload: bytes, context: JudgeContext, line: Line, seed: int, error: Exception) -> Verdict:
    """Of a proposal over which the judge itself has stumbled."""
    return _verdict(payload, context, line, seed, None, [_failed("judge", error)])


def warm_up(line: Line) -> None:
    """Compile and load what verdicts need, so that the first one is as quick as the others."""
    config = design_lqi(task_of(line))
    plants = plants_under_stress([nominal_theta(line)], line.gate, 0)
    course = course_through(line.control.period_s, [(0.1, np.array(line.recipes[0].tension_n), 0.01)])
    simulate(config, plants, course, setup_of(line, expected_noise(line), 0, line.gate.stress_late_share))
    _predict_standing(line)


def _predict_standing(line: Line) -> None:
    """The predictor, on a second of a line at its first recipe, with rollers that are round and with others.

    Whatever judges a model, or is judged by one, needs it. Compiled with the first such verdict, which has its time
    limit, it would refuse that on a new machine.
    """
    recipe, samples, n = line.recipes[0], round(1.0 / line.control.period_s), line.n
    tension, speed = np.tile(np.array(recipe.tension_n), (samples, 1)), np.full(samples, recipe.speed_m_per_s)
    nothing = np.zeros((samples, n))
    standing = Recording(
        time_s=np.linspace(0.0, 1.0, samples, endpoint=False), tension_n=tension, tension_setpoint_n=tension,
        speed_m_per_s=nothing + speed[:, None], torque_nm=nothing, torque_actual_nm=nothing, unwind_speed_m_per_s=speed,
        controlled=np.ones(samples, dtype=np.bool_), period_s=line.control.period_s, source="warming up",
    )  # fmt: skip
    round_ = nominal_theta(line)
    with suppress(Unpredictable):  # then no verdict predicts either
        for theta in (round_, replace(round_, eccentricity=np.full(n, 0.001))):
            predict(theta, expected_noise(line), stretch_of(standing))


def _asked(rule: Rule, case: Case) -> list[RuleFinding]:
    """What it finds; that it failed, where it fails or finds nothing."""
    if rule.with_model_only and case.first:
        return []
    try:
        return rule.check(case) or [told(rule.name, False, f"rule {rule.name} found nothing, which is no yes")]
    except Exception as error:  # whatever it is, it is no yes
        return [_failed(rule.name, error)]


def _failed(name: str, error: Exception) -> RuleFinding:
    return told(name, False, f"rule {name} failed: {type(error).__name__}: {error}")


def _figures(case: Case) -> list[ScenarioFigures]:
    figures: Callable[[Case], list[ScenarioFigures]] | None = FIGURES.get(case.proposal.kind)
    try:
        return [] if figures is None or case.first else figures(case)
    except Exception:  # the rule that needs them has told why
        return []


def _region(case: Case) -> Region:
    """For what it was judged. Before a model is accepted nobody foresees how fast a step makes the rollers."""
    let = roller_speed.steps_let(case) if case.first else None
    return Region(
        speed_max_m_per_s=case.speed_max_m_per_s,
        tension_step_max_n=case.tension_step_n * (1.0 if let is None else let.of_tension()),
        speed_step_max_m_per_s=case.speed_step_m_per_s * (1.0 if let is None else let.of_speed()),
    )


def _wrong_data(context: JudgeContext, recordings: Sequence[Recording]) -> list[str]:
    """Recordings that are not those that the context names."""
    if len(recordings) != len(context.data):
        return [f"{len(recordings)} recordings were given; allowed: {len(context.data)}, as the context names them"]
    return [
        f"{one.path} is not the recording that the context names: its digest is {recording.digest()[:12]}; allowed: "
        f"{one.digest[:12]}"
        for one, recording in zip(context.data, recordings, strict=True)
        if one.digest != recording.digest()
    ]


def _verdict(
    payload: bytes,
    context: JudgeContext,
    line: Line,
    seed: int,
    proposal: Proposal | None,
    findings: list[RuleFinding],
    reported: Sequence[RuleFinding] = (),
    figures: Sequence[ScenarioFigures] = (),
    region: Region | None = None,
) -> Verdict:
    return Verdict(
        format=1,
        proposal=None if proposal is None else proposal_hash(proposal),
        payload=sha256(payload).hexdigest(),
        context=context_hash(context),
        line=line_hash(line),
        kind=None if proposal is None else proposal.kind,
        seed=seed,
        accepted=all(finding.passed for finding in findings),
        findings=findings,
        reported=list(reported),
        figures=list(figures),
        region=region,
        judged=context.now,
        program_version=version("r2rgate"),
    )

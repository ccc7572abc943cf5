"""The report's account of selection, and of each adaptation with diagnosis, change, verdict and result."""

from collections.abc import Mapping, Sequence

from gateway.cli.adaptation_story import Adaptation, adaptation_story
from gateway.cli.demo_asked_page import result_words, story_of, verdict_words
from gateway.cli.demo_result import PAPER_RMSE_N, AskedResult, ChainResult, ChangeResult, DemoResult
from gateway.cli.report import Section, Story, Table
from gateway.commissioning.past import Step
from gateway.core.line_problem import quoted
from gateway.core.scenario import PAPER
from gateway.core.verdict import Verdict

SELECTS = "design."
DIAGNOSES = "adapt.diagnosis"


def selection_section(chain: ChainResult) -> Section:
    """Which configuration was chosen to begin with, among which, and why."""
    tried = [one for one in chain.changes if one.step == Step.FIRST]
    changes = {one.proposal: one for one in tried if one.proposal}
    asked = [one for one in chain.asked if one.decision.startswith(SELECTS)]
    kept = {one.proposal for one in tried if one.stage == "kept"}
    chosen = [one for one in asked if one.proposal in kept] or asked
    stories = tuple(story_of(one, changes) for one in chosen[-1:])
    rows = tuple((one.name, one.reason or one.why, verdict_words(one), result_words(one)) for one in tried)
    heads = ("Candidate", "What it is", "Verdict", "Result")
    table = Table(
        "What was proposed to begin with, in order, on the line's file: no model is accepted yet.", heads, rows
    )
    said = (
        "The loop was started with an LQI on the line's file, which is Initial. "
        "This is what the gate let take its place for the first experiment."
    )
    return Section("Selection, with its justification", (said,), (table,), stories=stories)


def adaptations_section(result: DemoResult, chain: ChainResult, verdicts: Mapping[str, Verdict]) -> Section:
    """One story for each redesign that was kept. `verdicts`: by proposal, those that are at hand."""
    stories: list[Story] = []
    begin = 0
    for end, change in enumerate(chain.changes):
        if change.step == Step.REDESIGN and change.stage == "kept":
            stories.append(_adaptation(result, chain, chain.changes[begin:end], change, verdicts))
            begin = end + 1
    said = (
        "Each begins with what the line showed, and ends with what was measured on it. Two are asked for, as the paper "
        "has them: the second follows whatever was concluded before it."
    )
    if not stories:
        said = "No redesign came to be kept: what the gate found against each stands below, under Through the gate."
    return Section("Adaptations: diagnosis, change, verdict, result", (said,), stories=tuple(stories))


def _adaptation(
    result: DemoResult,
    chain: ChainResult,
    before: Sequence[ChangeResult],
    kept: ChangeResult,
    verdicts: Mapping[str, Verdict],
) -> Story:
    place = next((k for k, one in enumerate(result.configurations) if one.controller == kept.configuration), None)
    name = "a redesign that was not measured" if place is None else result.configurations[place].name
    earlier = result.configurations[place - 1].name if place else "what ran before"
    asked = [one for one in chain.asked if one.proposal == kept.proposal and one.decision != DIAGNOSES]
    last = asked[-1] if asked else None
    return adaptation_story(
        Adaptation(
            f"{earlier} \u2192 {name}",
            diagnosis=_diagnosis(chain, [*before, kept]),
            tried=[
                f"{one.name}: {one.reason or one.why}; {verdict_words(one)}"
                for one in before
                if one.step == Step.REDESIGN
            ],
            change=[f"{kept.reason} ({kept.proposal[:12]}, author {kept.author})"],
            verdict=[verdict_words(kept)],
            decision=[f"Approved {approval_words(kept)}"],
            result=[f"{result_words(kept)} {_measured(result, place)}"],
            lead="" if last is None else f"Why this one of {len(last.options)}, in the words of {_who(last)}:",
            quote="" if last is None else last.reason,
            judged=verdicts.get(kept.proposal),
        )
    )


def approval_words(change: ChangeResult) -> str:
    """Who approved, from which certificate, and over what."""
    if not change.approved_by:
        return "by nobody"
    certificate = f", from certificate {change.certificate[:16]}" if change.certificate else ""
    over = f"; over: {change.approved_over}" if change.approved_over else ""
    return f"by {change.approved_by}{certificate}{over}"


def _diagnosis(chain: ChainResult, changes: Sequence[ChangeResult]) -> list[str]:
    """What the line showed in `changes`, the last of which is the one that was kept, and what was concluded from it."""
    said: list[str] = []
    for place, one in enumerate(changes):
        if one.step == Step.MEASUREMENT:
            said.append(f"Measured on the line: {one.measured or one.why or one.stage}")
            said += [concluded(asked) for asked in _diagnoses(chain, changes[place + 1 :])]
        elif one.step in (Step.EXPERIMENT, Step.MODEL) and one.stage in ("done", "kept"):
            said.append(f"{one.step.capitalize()}: {one.reason}; {verdict_words(one)}")
    return said


def _diagnoses(chain: ChainResult, later: Sequence[ChangeResult]) -> list[AskedResult]:
    """Of a measurement: those that whatever was proposed after it names, up to the next measurement.

    A newer model is begun with an experiment; a calmer configuration is the next thing that is proposed.
    """
    until = next((k + 1 for k, one in enumerate(later) if one.step == Step.MEASUREMENT), len(later))
    named = {one.proposal for one in later[:until] if one.proposal}
    return [one for one in chain.asked if one.decision == DIAGNOSES and one.proposal in named]


def concluded(one: AskedResult) -> str:
    """By whom, what, and the reason in their own words."""
    option = next((option.title for option in one.options if option.id == one.chosen), one.chosen)
    return f"{_who(one).capitalize()} concluded: {option}. {quoted(one.reason)}"


def _who(one: AskedResult) -> str:
    return "the rules" if one.by == "rules" else f"agent {one.by}"


def _measured(result: DemoResult, place: int | None) -> str:
    """RMSE of both cases beside the configuration before, and the paper's own change."""
    if not place:
        return ""
    parts: list[str] = []
    names = list(PAPER_RMSE_N)
    for case in PAPER:
        before, now = result.rmse_n(place - 1, case.name), result.rmse_n(place, case.name)
        change = result.improvement_pct(place, case.name)
        if before is None or now is None or change is None:
            parts.append(f"{case.heading.lower()} not run")
            continue
        text = f"{case.heading.lower()} from {before:.3f} to {now:.3f} N ({-change:+.1f} %"
        if place < len(names):
            paper = [PAPER_RMSE_N[names[k]][case.name] for k in (place - 1, place)]
            text += f"; the paper's {paper[0]:.3f} to {paper[1]:.3f} N"
        parts.append(f"{text})")
    return f"RMSE: {', '.join(parts)}."

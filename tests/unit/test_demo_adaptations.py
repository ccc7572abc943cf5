"""The report's account of adaptations: each with the diagnosis that led to it, and with no other."""

from typing import Any

import pytest

from gateway.cli.asked_result import asked_result
from gateway.cli.demo_adaptations import adaptations_section, selection_section
from gateway.cli.demo_result import AskedResult, ChainResult, ChangeResult, DemoResult
from gateway.commissioning.past import Step
from tests.unit.test_demo_asked import change, interaction, shown


def asked(number: int, proposal: str, decision: str, reason: str) -> AskedResult:
    one = interaction(number, "adaptation", reason=reason)
    (found,) = asked_result([one], [shown(proposal, one)])
    return found.model_copy(update={"decision": decision})


def of(step: Step, proposal: str, stage: str = "done", **changes: Any) -> ChangeResult:
    return change(proposal, step=step, stage=stage, **changes)


def told(changes: list[ChangeResult], questions: list[AskedResult]) -> list[list[tuple[str, ...]]]:
    """What each story says, by part."""
    result = DemoResult.model_construct(configurations=[])
    chain = ChainResult.model_construct(changes=changes, asked=questions)
    stories = adaptations_section(result, chain, {}).stories
    return [[(name, text) for name, texts in story.facts for text in texts] for story in stories]


@pytest.mark.parametrize("newer_model", [False, True])
def test_a_diagnosis_stands_with_the_change_that_followed_from_it(newer_model: bool) -> None:
    """A calmer configuration hangs on the diagnosis itself; a newer model begins with an experiment."""
    measured = of(Step.MEASUREMENT, "m", measured="span 2 overshoots")
    between = [of(Step.EXPERIMENT, "e"), of(Step.MODEL, "o", "kept")] if newer_model else []
    kept = of(Step.REDESIGN, "r", "kept")
    question = asked(1, "e" if newer_model else "r", "adapt.diagnosis", "It swings.")
    (rows,) = told([measured, *between, kept], [question, asked(2, "r", "adapt.change", "It is calmer.")])
    said = [text for what, text in rows if what == "Diagnosis"]
    assert said[0] == "Measured on the line: span 2 overshoots"
    assert "concluded" in said[1] and "It swings." in said[1]
    assert len(said) == 2 + len(between)


def test_each_diagnosis_stands_once_with_its_own_measurement() -> None:
    changes = [
        of(Step.MEASUREMENT, "m1", measured="first"),
        of(Step.REDESIGN, "r1", "refused", why="far"),
        of(Step.MEASUREMENT, "m2", measured="second"),
        of(Step.REDESIGN, "r2", "kept"),
        of(Step.MEASUREMENT, "m3", measured="third"),
        of(Step.REDESIGN, "r3", "kept"),
    ]
    questions = [asked(k, f"r{k}", "adapt.diagnosis", f"reason {k}") for k in (1, 2, 3)]
    first, second = told(changes, questions)
    said = [text for what, text in first if what == "Diagnosis"]
    assert [text.rpartition(" ")[2] for text in said] == ["first", "1\u201d", "second", "2\u201d"]
    assert [text for what, text in first if what == "Tried before"] == [
        "candidate 1: MPC; accepted by 23 rules; the closest: corners: lowest tension, 4 for a limit of 2 N, margin 2 N"
    ]
    assert ["third" in text or "reason 3" in text for what, text in second if what == "Diagnosis"] == [True, True]


def test_the_change_is_told_in_the_words_of_who_chose_it_not_of_who_diagnosed() -> None:
    changes = [of(Step.MEASUREMENT, "m", measured="bad"), of(Step.REDESIGN, "r", "kept")]
    questions = [asked(1, "r", "adapt.change", "It is calmer."), asked(2, "r", "adapt.diagnosis", "It swings.")]
    chain = ChainResult.model_construct(changes=changes, asked=questions)
    (story,) = adaptations_section(DemoResult.model_construct(configurations=[]), chain, {}).stories
    assert story.quote == "It is calmer." and "agent adaptation" in story.lead


def test_where_no_redesign_was_kept_the_section_says_so() -> None:
    chain = ChainResult.model_construct(changes=[of(Step.REDESIGN, "r", "refused")], asked=[])
    section = adaptations_section(DemoResult.model_construct(configurations=[]), chain, {})
    assert section.stories == () and "No redesign" in section.paragraphs[0]


def test_a_selection_is_told_with_the_question_that_the_kept_candidate_came_of() -> None:
    changes = [of(Step.FIRST, "a", "refused"), of(Step.FIRST, "b", "kept"), of(Step.REDESIGN, "r", "kept")]
    questions = [
        asked(1, "a", "design.architecture", "Fast."), asked(2, "b", "design.architecture", "Sure."),
        asked(3, "r", "adapt.change", "Other."),
    ]  # fmt: skip
    section = selection_section(ChainResult.model_construct(changes=changes, asked=questions))
    assert [story.quote for story in section.stories] == ["Sure."] and len(section.tables[0].rows) == 2

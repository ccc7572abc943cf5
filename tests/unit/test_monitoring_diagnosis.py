"""The question what explains what was observed: made of the failure modes that fit, answered in both ways."""

import asyncio
from pathlib import Path

import pytest

from agents.answering import Agent
from agents.language_model.budget import Budget
from agents.language_model.client import LanguageModel
from agents.monitoring.diagnosis import NONE_OF_THEM, Mode, diagnosis_question, modes_for
from agents.rag.documents import Document
from agents.rag.index import Index
from agents.rag.library import open_library, program_notes
from agents.roles import ROLES
from gateway.core.interactions import Answer, Interaction
from gateway.core.questions import Figure, Question, wrong_with
from tests.stand_in.engine import Engine
from tests.stand_in.in_process import InProcess
from tests.stand_in.personas import PERSONAS
from tests.unit.language_model_support import SETTINGS, virtually
from tests.unit.supervisor_support import line_of

LINE = line_of(2)
DRAG = ["the torque of roller 4 rises from week to week", "its housing is warm", "tension 4 follows its set-point"]
FIGURES = [Figure(name="torque of roller 4, per week", value=0.4, unit="Nm")]
FAILURES = [one for one in program_notes() if one.kind == "failure"]


@pytest.fixture(name="index")
def _index(tmp_path: Path):
    with asyncio.run(open_library(tmp_path, 3)).index as index:
        yield index


def asked(index: Index, symptoms: list[str], figures: list[Figure] | None = None) -> Question:
    return diagnosis_question(LINE, symptoms, figures or [], asyncio.run(modes_for(index.ask, symptoms)))


async def answered(index: Index, question: Question, persona: str | None) -> tuple[Answer, Interaction]:
    kept: list[Interaction] = []

    async def keep(one: Interaction) -> None:
        kept.append(one)

    transport = InProcess(Engine(PERSONAS[persona or "perfect"], seed=1))
    async with LanguageModel(SETTINGS, asyncio.get_running_loop().time, transport) as model:
        agent = Agent("monitoring", index.ask, keep, model if persona else None, lambda _: Budget(200_000))
        return await agent.answer(question), kept[0]


def mode(name: str, share: float, text: str = "") -> Mode:
    note = Document(origin="note", name=name, title=name, tier=2, text=text, kind="failure")
    return Mode(note, share)


def test_what_is_seen_of_a_dry_bearing_offers_it_first_with_signature_and_test(index):
    question = asked(index, DRAG, FIGURES)
    assert question.agent == "monitoring" and question.decision in ROLES["monitoring"].decides
    assert question.options[0].id == question.usual == "bearing-drag-rise"
    assert question.options[-1].id == NONE_OF_THEM and len(question.options) > 2
    assert question.facts[:3] == [f"observed: {one}" for one in DRAG] and question.figures == FIGURES
    for part in ("bearing-drag-rise, signature: ", "bearing-drag-rise, test: "):
        assert any(fact.startswith(part) for fact in question.facts)
    assert {one.id for one in question.options[:-1]} <= {one.name for one in FAILURES}


@pytest.mark.parametrize("note", FAILURES, ids=lambda one: one.name)
def test_every_failure_mode_is_among_the_options_for_its_own_symptom(index, note):
    symptom = note.text.partition("## Symptom")[2].partition("## Signature")[0]
    assert note.name in [one.id for one in asked(index, [" ".join(symptom.split())]).options]


@pytest.mark.parametrize("persona", [None, "perfect", "adversarial", "hung"])
def test_it_is_answered_by_a_model_and_without_one_with_the_same_record(index, persona):
    question = asked(index, DRAG, FIGURES)
    answer, kept = virtually(answered(index, question, persona))
    assert not wrong_with(answer.choice, question) and kept.question == question and kept.agent == "monitoring"
    assert answer.by == ("rules" if persona in (None, "hung") else "monitoring")
    if answer.by == "rules":
        assert answer.choice.option == question.usual


def test_the_rules_name_a_cause_only_where_it_is_clearly_before_the_next():
    clear = diagnosis_question(LINE, DRAG, [], [mode("belt", 1.0), mode("bearing", 0.5)])
    assert (clear.usual, clear.why) == (
        "belt",
        "of the failure modes that are known it fits best, by 2.0 times the next one",
    )
    alike = diagnosis_question(LINE, DRAG, [], [mode("belt", 1.0), mode("bearing", 0.9)])
    assert alike.usual == NONE_OF_THEM and "belt and bearing fit about as well" in alike.why
    assert diagnosis_question(LINE, DRAG, [], [mode("belt", 1.0)]).usual == "belt"
    unknown = diagnosis_question(LINE, DRAG, [], [])
    assert [one.id for one in unknown.options] == [NONE_OF_THEM] == [unknown.usual]


def test_notes_that_somebody_has_added_may_have_any_name():
    modes = [mode("Drives/Our Belt.md", 1.0), mode("é" * 300, 0.5), mode("drives our belt md", 0.2)]
    question = diagnosis_question(LINE, DRAG, [], modes)
    assert [one.id for one in question.options] == ["drives-our-belt-md", "unnamed", NONE_OF_THEM]
    assert question.options[0].figures[0].value == 1.0


def test_symptoms_of_nothing_that_is_known_and_none_at_all(index):
    assert asked(index, ["xyzzy plugh"]).usual == NONE_OF_THEM
    with pytest.raises(ValueError, match="nothing was observed"):
        diagnosis_question(LINE, [], [], [])


def test_however_much_was_observed_it_stays_a_question(index):
    long = [f"{'tension swings and ' * 100}{k}" for k in range(40)]
    question = asked(index, long)
    assert len(question.facts) <= 64 and all(len(fact) <= 600 for fact in question.facts)

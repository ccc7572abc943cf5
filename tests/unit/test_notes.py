"""Notes of the knowledge: what is one, what is refused and why; that those that come with the product are."""

import tomllib
from collections import Counter
from pathlib import Path
from typing import get_args

import pytest

from agents.rag.notes import Note, NoteRefused, parse_note
from gateway.core.questions import Decision

KNOWLEDGE = Path("agents/knowledge")
HEAD = """+++
title = "Slip"
tier = 2
topic = "transport"
sources = ["somebody"]
confidence = 0.9
applies_to = "driven rollers"
serves = ["monitor.diagnosis"]
keywords = ["slipping"]
"""
FAILURE = 'kind = "failure"\nclass = "mechanical"\nadjustable = false\n'
BODY = "## Symptom\na\n## Signature\nb\n## Test\nc\n## Action\nd\n"


@pytest.fixture(scope="module")
def notes() -> list[Note]:
    return [parse_note(path.stem, path.read_text(encoding="utf-8")) for path in sorted(KNOWLEDGE.rglob("*.md"))]


def test_a_failure_mode_has_four_parts() -> None:
    note = parse_note("slip", f"{HEAD}{FAILURE}+++\n\n{BODY}")
    assert note.head.fault_class == "mechanical" and note.head.adjustable is False
    assert note.parts == {"Symptom": "a", "Signature": "b", "Test": "c", "Action": "d"}


def test_each_note_says_which_questions_it_answers(notes: list[Note]) -> None:
    """By those it is found in other words than its own; a question that two notes answer best tells neither."""
    asked = [question for note in notes for question in note.head.asked]
    assert all(len(note.head.asked) >= 4 for note in notes) and len(set(asked)) == len(asked)
    assert all(question.endswith("?") for question in asked)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "head between two lines"),
        ("# A title\n" + HEAD + "+++\ntext", "head between two lines"),
        (HEAD + "text", "head between two lines"),
        (HEAD + "+++\n\n", "no text"),
        (HEAD + "tier = 1\n+++\ntext", "not TOML"),
        (HEAD.replace("tier = 2", "tier = 4") + "+++\ntext", "tier"),
        (HEAD.replace("monitor.diagnosis", "monitor.diagnose") + "+++\ntext", "monitor.diagnosis"),
        (HEAD.replace('["monitor.diagnosis"]', "[]") + "+++\ntext", "serves"),
        (HEAD.replace("topic", "topik") + "+++\ntext", "topic"),
        (HEAD + "adjustable = true\n+++\ntext", "kind failure"),
        (HEAD + FAILURE + "+++\n" + BODY.replace("## Test", "## Tests"), "Symptom, Signature, Tests, Action"),
    ],
)
def test_what_is_no_note_is_refused_with_the_reason(content: str, said: str) -> None:
    with pytest.raises(NoteRefused) as refused:
        parse_note("slip", content)
    assert said in str(refused.value) and str(refused.value).startswith("slip: ")


def test_there_is_theory_and_practice_for_every_decision_and_failure_modes_of_every_class(notes: list[Note]) -> None:
    tiers = Counter(note.head.tier for note in notes)
    assert tiers[1] >= 60 and tiers[2] >= 60 and tiers[3] == 0  # the third is of a line
    served = Counter(decision for note in notes for decision in note.head.serves)
    assert all(served[decision] >= 3 for decision in get_args(Decision))
    failures = [note for note in notes if note.head.kind == "failure"]
    assert len(failures) >= 25 and len({note.head.fault_class for note in failures}) == 6


def test_names_and_titles_are_of_one_note_each(notes: list[Note]) -> None:
    assert max(Counter(note.name for note in notes).values()) == 1
    assert max(Counter(note.head.title for note in notes).values()) == 1


def test_no_note_tells_what_a_line_must_find_out_by_itself(notes: list[Note]) -> None:
    """Plants that the product is tried on stand in tests and examples, never in what it knows."""
    for note in notes:
        said = f"{note.head.title} {note.head.sources} {note.text}".lower()
        assert not any(word in said for word in ("s_real", "s_sim", "benchmark", "the paper")), note.name


@pytest.mark.parametrize(
    ("file", "least"), [("questions.toml", 60), ("questions_unseen.toml", 57), ("questions_unseen_more.toml", 60)]
)
def test_the_questions_that_retrieval_is_tried_on_are_answered_by_notes_that_there_are(
    notes: list[Note], file: str, least: int
) -> None:
    questions = tomllib.loads((Path("tests/bench") / file).read_text(encoding="utf-8"))["question"]
    names = {note.name for note in notes}
    assert len(questions) >= least
    assert {name for question in questions for name in question["answered_by"]} <= names

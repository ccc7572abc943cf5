"""Documents that say different things: seen by figures or heads, decided by tier, date and confidence."""

import pytest

from agents.rag.conflicts import conflicts_among, statements_in
from agents.rag.documents import Document
from agents.rag.library import program_notes
from tests.unit.rag_support import document

NOTE = document("torque-rate", "The torque rate limit is 1,000 Nm/s.", topic="drives", tier=1)
OURS = document("gearbox", "Torque rate limit of this line: 400 Nm/s.", topic="drives", tier=3)


def conflict(*documents: Document) -> tuple[str, str, str] | None:
    found = conflicts_among([(one, one.text) for one in documents])
    return (found[0].winner, found[0].loser, found[0].rule) if found else None


def test_what_is_known_of_this_line_counts_before_what_is_known_of_lines_in_any_order() -> None:
    for order in ([NOTE, OURS], [OURS, NOTE]):
        told = conflicts_among([(one, one.text) for one in order])[0]
        assert (told.winner, told.loser) == ("note:gearbox", "note:torque-rate")
        assert told.rule == "tier 3 counts before tier 1"
        assert (told.winner_says, told.loser_says) == (OURS.text, NOTE.text)


def test_in_one_tier_the_newer_counts_then_the_surer_then_the_better_answer() -> None:
    ours = OURS.model_copy(update={"tier": 1})
    dated = [one.model_copy(update={"date": date}) for one, date in ((NOTE, "2026-05-01"), (ours, "2026-04-30"))]
    assert conflict(*dated) == ("note:torque-rate", "note:gearbox", "the newer one, of 2026-05-01 against 2026-04-30")
    surer = ours.model_copy(update={"confidence": 0.99})
    assert conflict(NOTE, surer) == ("note:gearbox", "note:torque-rate", "the surer one, 0.99 against 0.9")
    assert (conflict(ours, NOTE) or "")[0] == "note:gearbox" and (conflict(NOTE, ours) or "")[0] == "note:torque-rate"


@pytest.mark.parametrize(
    "text",
    [
        "The torque rate limit is 900 Nm/s.",  # not apart
        "The torque rate limit is 300 to 700 Nm/s.",  # the ranges are not apart by enough
        "The torque limit is 400 Nm.",  # another measure
        "The width of the belt guard is 400 Nm/s.",  # about something else
        "The torque rate limit is 400 Nm/s at 10 m/min.",  # of what each figure is cannot be said
        "The torque rate limit is low.",
    ],
)
def test_no_conflict_where_nothing_says_otherwise(text: str) -> None:
    assert conflict(NOTE, OURS.model_copy(update={"text": text})) is None


def test_units_are_converted_and_of_unlike_documents_sentences_must_be_more_alike() -> None:
    slow = document("slow", "Thread paper and film at 6 m/min.", topic="operation")
    quick = document("quick", "Thread film at 0.5 m/s.", topic="operation")
    same = document("same", "Thread film at 0.1 m/s.", topic="operation")
    assert conflict(slow, quick) and not conflict(slow, same)
    elsewhere = quick.model_copy(update={"topic": "drives"})
    assert conflict(slow, elsewhere) is None
    keywords = {"keywords": ["threading", "creep speed"]}
    assert conflict(slow.model_copy(update=keywords), elsewhere.model_copy(update=keywords))
    assert conflict(slow, elsewhere.model_copy(update={"text": "Thread film and paper at 0.5 m/s."}))


def test_a_head_may_say_that_it_replaces_or_contradicts() -> None:
    old, new = document("old", "A.", tier=3), document("new", "B.", replaces=["old"])
    assert conflict(old, new) == ("note:new", "note:old", "new says that it replaces old")
    other = document("other", "C.", contradicts=["old"])
    assert conflict(other, old) == ("note:old", "note:other", "tier 3 counts before tier 2")


def test_ranges_and_thousands_are_read() -> None:
    (one,) = statements_in("Battery foil runs at 50 to 1,250 N/m width.")
    assert (one.measure, one.low, one.high) == ("force over width", 50.0, 1250.0)
    assert {"batteri", "foil", "width"} <= one.words


def test_the_notes_of_this_program_do_not_contradict_each_other() -> None:
    assert conflicts_among([(note, note.text) for note in program_notes()]) == []

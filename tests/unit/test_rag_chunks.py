"""Passages of documents: nothing is lost, none is too long, and words are repeated only where a paragraph is cut."""

from hypothesis import given
from hypothesis import strategies as st

from agents.rag.chunks import MOST_WORDS, OVERLAP_WORDS, Chunk, chunks_of

words = st.text("abcdefg.", min_size=1, max_size=6)
paragraphs = st.lists(words, min_size=1, max_size=400).map(" ".join)


@given(st.lists(paragraphs, max_size=8))
def test_every_word_is_in_a_passage_and_no_passage_is_too_long(parts: list[str]) -> None:
    chunks = chunks_of("\n\n".join(parts))
    assert all(0 < len(one.text.split()) <= MOST_WORDS for one in chunks)
    told = " ".join(one.text for one in chunks).split()
    rest = iter(told)
    assert all(word in rest for word in " ".join(parts).split())  # in their order


@given(st.lists(st.lists(words, min_size=1, max_size=MOST_WORDS).map(" ".join), max_size=8))
def test_paragraphs_that_fit_are_never_cut_and_nothing_is_repeated(parts: list[str]) -> None:
    told = [piece for one in chunks_of("\n\n".join(parts)) for piece in one.text.split("\n\n")]
    assert told == parts


def test_a_long_paragraph_is_cut_at_the_end_of_a_sentence_and_goes_on_with_the_words_before() -> None:
    sentences = [" ".join(f"w{k}x{n}" for n in range(49)) + " end." for k in range(6)]
    first, second, *_ = [one.text.split() for one in chunks_of(" ".join(sentences))]
    assert len(first) == 100 and first[-1] == "end."
    assert second[:OVERLAP_WORDS] == first[-OVERLAP_WORDS:]


def test_a_passage_ends_with_its_section_and_knows_its_heading() -> None:
    found = chunks_of("Before.\n\n# Symptom\nSlow.\n\nLate.\n\n## Action #\nWait.\n")
    assert found == [Chunk("", "Before."), Chunk("Symptom", "Slow.\n\nLate."), Chunk("Action", "Wait.")]
    assert chunks_of(" \n\n") == []

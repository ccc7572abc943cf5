"""The index: what is put in is found, embedders are never mixed, no kill and no reader is in the way of a new one."""

import asyncio
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.rag.documents import Generated
from agents.rag.index import Index
from agents.rag.index_file import IndexRefused
from agents.rag.library import INDEX, Opened, add_files, open_library, program_notes
from agents.rag.stages import Asked
from tests.unit.rag_support import WordCounter, document, index_of

DOCUMENTS = [
    document("belt-slip", "The belt slips under load.", keywords=["belt"], tier=2),
    document("oven", "The web softens in the oven.\n\n# Draw\n\nTension by draw disappears there.", tier=1),
    document("roller-four", "The belt of roller 4 was changed.", tier=3),
]


def names(index: Index, question: str, **asked: object) -> list[str]:
    return [hit.document.name for hit in index.retrieve(Asked(question, **asked)).hits]  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def notes(tmp_path_factory: pytest.TempPathFactory) -> Index:
    return index_of(tmp_path_factory.mktemp("notes") / INDEX, program_notes())


def opened(folder: Path, *given: object, **more: object) -> Opened:
    return asyncio.run(open_library(folder, 2, *given, **more))  # pyright: ignore[reportArgumentType]


def test_words_find_their_documents_in_either_spelling_and_by_what_stands_for_them(tmp_path: Path) -> None:
    spelled = document("ramp", "The feed-forward torque of set-points.", tier=1)
    with index_of(tmp_path / "i", [*DOCUMENTS, spelled]) as index:
        assert names(index, "Which belt slipped?") == ["belt-slip", "roller-four"]
        assert names(index, "drier")[0] == "oven"  # the glossary says that it is one
        for question in ("feedforward", "feed forward", "Feed-Forward!", "setpoint"):
            assert names(index, question)[0] == "ramp"
        assert names(index, "of the") == [] and names(index, "zebra") == []
        assert names(index, "belt", tiers=(3,)) == ["roller-four"] and names(index, "belt", most=1) == ["belt-slip"]


def test_the_passage_that_answers_is_quoted_under_its_heading(tmp_path: Path) -> None:
    with index_of(tmp_path / "i", DOCUMENTS) as index:
        passage = index.retrieve(Asked("Why does draw tension disappear?")).hits[0].passage
        assert (passage.heading, passage.text) == ("Draw", "Tension by draw disappears there.")


@pytest.mark.parametrize("embedder", [None, WordCounter()], ids=["by words", "by meaning"])
def test_a_question_that_a_document_answers_in_other_words_finds_it(
    tmp_path: Path, embedder: WordCounter | None
) -> None:
    said = [document("drag", "Friction of a bearing rises.", asked=["Why does it squeal?", "May I go on running?"])]
    with index_of(tmp_path / "i", [*DOCUMENTS, *said], embedder) as index:
        found = asyncio.run(index.ask(Asked("It squeals, why?"), embedder))
        assert found.hits[0].document.name == "drag" and found.hits[0].passage.text == "Friction of a bearing rises."
        by_meaning = [(one.document, one.score) for one in found.embedding_documents]
        assert embedder is None or (by_meaning[0][0] == 4 and by_meaning[0][1] > 2.0 * by_meaning[1][1])


@given(question=st.text(max_size=200))
def test_no_question_is_too_strange(notes: Index, question: str) -> None:
    notes.retrieve(Asked(question))


@pytest.mark.parametrize(
    "question", ['") OR rowid > 0 --', "title: tension NEAR(roller)", "tension* ^belt + -web", "'; DROP TABLE word"]
)
def test_the_language_of_the_search_is_only_words(notes: Index, question: str) -> None:
    assert all(hit.score > 0.0 for hit in notes.retrieve(Asked(question)).hits)


def test_most_questions_of_the_tuning_set_find_their_note(notes: Index) -> None:
    from tests.bench.knowledge import QUESTIONS, questions_in

    questions = questions_in(QUESTIONS)
    hits = [any(name in one.answered_by for name in names(notes, one.asked)) for one in questions]
    assert sum(hits) / len(hits) >= 0.75


def test_meaning_is_searched_with_the_embedder_of_the_index_and_no_other(tmp_path: Path) -> None:
    with index_of(tmp_path / "i", DOCUMENTS, WordCounter()) as index:
        found = asyncio.run(index.ask(Asked("the belt slips under load"), WordCounter()))
        assert found.hits[0].document.name == "belt-slip"
        assert found.embedding and found.embedding[0].score == pytest.approx(1.0, abs=0.3)
        assert found.ranked[0].embedding_rank == 1
        with pytest.raises(IndexRefused, match="made with counter .* not with other .*--reindex"):
            asyncio.run(index.ask(Asked("belt"), WordCounter("other")))
    with (
        index_of(tmp_path / "j", DOCUMENTS) as index,
        pytest.raises(IndexRefused, match="with no embedder, not with counter"),
    ):
        asyncio.run(index.ask(Asked("belt"), WordCounter()))


def test_vectors_are_searched_by_tier(tmp_path: Path) -> None:
    embedder = WordCounter()
    with index_of(tmp_path / "i", DOCUMENTS, embedder) as index:
        found = asyncio.run(index.ask(Asked("belt of roller", tiers=(1, 3)), embedder))
        assert {one.document.tier for one in found.ranked} == {1, 3}
        cosines = [one.score for one in found.embedding]
        assert cosines == sorted(cosines, reverse=True)


def test_a_library_is_indexed_once_and_again_when_something_has_changed(tmp_path: Path) -> None:
    first = opened(tmp_path)
    assert first.made and first.index.documents_count == len(program_notes())
    assert not opened(tmp_path).made
    (tmp_path / "in.txt").write_text("Zanzibar paper needs 90 N.")
    add_files(tmp_path, [tmp_path / "in.txt"], 2)
    second = opened(tmp_path)
    assert second.made and names(second.index, "zanzibar") == ["in.txt"]
    assert names(first.index, "zanzibar") == []  # who reads keeps what was opened
    (tmp_path / "in.txt").write_text("Zanzibar paper needs 80 N, not 90 N any more.")
    add_files(tmp_path, [tmp_path / "in.txt"], 2)
    assert "80 N" in opened(tmp_path).index.retrieve(Asked("zanzibar")).hits[0].passage.text


def test_what_was_made_of_the_line_stays_until_it_is_made_anew(tmp_path: Path) -> None:
    made = Generated(name="model", title="Model 3", text="Zanzibar web: roller 2 has 51 mm.", date="2026-05-01")
    assert names(opened(tmp_path, generated=[made]).index, "zanzibar")[0] == "model"
    assert not opened(tmp_path).made and not opened(tmp_path, generated=[made]).made
    assert names(opened(tmp_path, reindex=True).index, "zanzibar")[0] == "model"
    changed = made.model_copy(update={"text": "Zanzibar web: roller 2 has 52 mm.", "date": "2026-05-02"})
    again = opened(tmp_path, generated=[changed])
    assert again.made and "52 mm" in again.index.retrieve(Asked("zanzibar")).hits[0].passage.text
    assert "model" not in names(opened(tmp_path, generated=[]).index, "zanzibar")


def test_a_library_is_not_embedded_twice_and_not_by_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agents.rag.library.program_notes", lambda: tuple(DOCUMENTS))
    embedder = WordCounter()
    opened(tmp_path, embedder)
    assert len(embedder.embedded) == 7  # three heads, four passages
    (tmp_path / "in.txt").write_text("One more.")
    add_files(tmp_path, [tmp_path / "in.txt"], 2)
    opened(tmp_path, embedder)
    assert len(embedder.embedded) == 9
    for other in (None, WordCounter("other")):
        with pytest.raises(IndexRefused, match="--reindex"):
            opened(tmp_path, other)
    assert opened(tmp_path, WordCounter("other"), reindex=True).index.embedder == WordCounter("other").identity
    assert opened(tmp_path, reindex=True).index.embedder is None


def test_a_damaged_or_foreign_index_is_refused_and_made_anew_by_the_library(tmp_path: Path) -> None:
    path = tmp_path / INDEX
    opened(tmp_path).index.close()
    content = path.read_bytes()
    for damage in (b"", b"no database at all" * 100, content[:5000], content[:40_000] + b"\xff" * len(content)):
        path.write_bytes(damage)
        with pytest.raises(IndexRefused, match="made anew|make it anew"), Index(path) as index:
            index.retrieve(Asked("tension of the web"))
            index.documents()
    path.write_bytes(content[:5000])
    assert opened(tmp_path).made
    with pytest.raises(IndexRefused, match="there is no index"):
        Index(tmp_path / "absent")


VICTIM = """
import os, sys
from pathlib import Path
from agents.rag import index_file
from tests.unit.rag_support import document, index_of
fill = index_file._fill
def stops(connection, content):
    fill(connection, content)
    print("written", flush=True)
    sys.stdin.read()
index_file._fill = stops
index_of(Path(sys.argv[1]), [document("new", "Zanzibar.")])
"""


def test_a_kill_while_it_is_made_leaves_the_old_index_and_the_next_clears_up(tmp_path: Path) -> None:
    path = tmp_path / INDEX
    index_of(path, DOCUMENTS).close()
    before = path.read_bytes()
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    command = [sys.executable, "-c", VICTIM, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as victim:
        assert victim.stdout and victim.stdout.readline() == "written\n"
        victim.send_signal(signal.SIGKILL)
    assert path.read_bytes() == before and len(list(tmp_path.glob("*.part"))) == 1
    with Index(path) as index:
        assert names(index, "belt")[0] == "belt-slip"
    with index_of(path, [document("new", "Zanzibar.")]) as index:
        assert names(index, "zanzibar") == ["new"]
    assert list(tmp_path.glob("*.part")) == []


def test_where_nothing_can_be_written_it_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(IndexRefused, match="cannot be written"):
        index_of(tmp_path / "file" / INDEX, DOCUMENTS)

"""What the agents look up stays up to date: with the line, people's documents, an embedder that comes and goes."""

import asyncio
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

import agents.known as known_module
from agents.known import Knowledge
from agents.line_on_bus import LineKnown, LineNotTold
from agents.rag.embedder import EmbedderFailed
from agents.rag.index import Index
from agents.rag.index_file import IndexRefused
from agents.rag.library import ADDED, INDEX, add_files, open_library
from agents.rag.stages import Asked
from gateway.core.line_queries import Generated
from tests.unit.rag_support import WordCounter
from tests.unit.supervisor_support import until


def made(word: str, name: str = "model-1") -> Generated:
    return Generated(name=name, title=f"The {word} of this line", text=f"Its {word} is known.", date="2026-01-05")


class Line:
    """A gateway that tells what it is given, or why it does not."""

    def __init__(self, *documents: Generated) -> None:
        self.documents = list(documents)
        self.why = ""
        self.fails = False
        self.asked: list[str | None] = []

    async def knowledge_since(self, revision: str | None) -> LineKnown | None:
        self.asked.append(revision)
        if self.fails:
            raise ValueError("nobody has thought of it")
        if self.why:
            raise LineNotTold(self.why)
        now = str([one.text for one in self.documents])
        return None if revision == now else LineKnown(list(self.documents), ["the 7 oldest refusals of 9"], now)


class Failing(WordCounter):
    """An embedder that fails when it is told to, and can be held up while it embeds documents."""

    def __init__(self) -> None:
        super().__init__()
        self.fails = False
        self.held = False
        self.hangs = False
        self.let = asyncio.Event()
        self.let.set()

    async def embed(self, texts):
        if self.hangs:
            await asyncio.Event().wait()
        if len(texts) > 1:
            self.held = not self.let.is_set()
            await self.let.wait()
        if self.fails:
            raise EmbedderFailed("the server has gone")
        return await super().embed(texts)


class Story:
    def __init__(self, folder: Path, *documents: Generated, embedder: WordCounter | None = None) -> None:
        self.folder = folder
        self.line = Line(*documents)
        self.told: list[str] = []
        self.embedder = embedder
        self.away = False
        self.hangs = False
        self.known = Knowledge(folder, self.line, self._find, self.told.append)

    async def _find(self) -> WordCounter | None:
        if self.away:
            raise EmbedderFailed("nobody answers there")
        if self.hangs:
            await asyncio.Event().wait()
        return self.embedder

    async def look(self) -> None:
        """As `keep_up` does each time."""
        await self.known.hear()
        await self.known.look()

    async def names(self, word: str) -> list[str]:
        return [hit.document.key for hit in (await self.known.search(Asked(word))).hits if word in hit.passage.text]


@asynccontextmanager
async def begun(story: Story):
    async with story.known:
        await story.known.begin()
        yield story


def run(story) -> None:
    async def bounded() -> None:
        async with asyncio.timeout(60.0):
            await story()

    asyncio.run(bounded())


def test_what_is_known_of_the_line_is_there_at_once_and_follows_it(tmp_path):
    async def story() -> None:
        async with begun(Story(tmp_path, made("zanzibar"))) as one:
            assert await one.names("zanzibar") == ["line:model-1"]
            assert "left out of what is known: the 7 oldest refusals of 9" in one.told
            one.line.documents = [made("timbuktu")]
            await one.look()
            assert await one.names("timbuktu") == ["line:model-1"] and await one.names("zanzibar") == []
            said = list(one.told)
            await one.look()
            assert one.told == said and one.line.asked[0] is None and None not in one.line.asked[1:]

    run(story)


def test_documents_of_people_stay_and_new_ones_are_seen_beside_those_of_the_line(tmp_path):
    file = tmp_path / "belt.md"
    file.write_text("# Belts\n\nKilimanjaro belts slip.\n")
    folder = tmp_path / "knowledge"

    async def story() -> None:
        async with begun(Story(folder, made("zanzibar"))) as one:
            add_files(folder, [file], 3)
            with (await open_library(folder, 3)).index:  # as `r2rgate ask --add` does in another process
                pass
            await one.look()
            assert await one.names("Kilimanjaro") == ["file:belt.md"]
            assert await one.names("zanzibar") == ["line:model-1"]
            one.line.documents = [made("timbuktu")]
            await one.look()
            assert await one.names("Kilimanjaro") == ["file:belt.md"] and (folder / ADDED / "belt.md").is_file()

    run(story)


def test_a_line_that_cannot_tell_is_told_once_and_what_was_known_stays(tmp_path):
    async def story() -> None:
        one = Story(tmp_path, made("zanzibar"))
        async with begun(one):
            pass
        async with begun(Story(tmp_path)) as later:
            later.line.why = "the gate is shut"
            await later.look()
            await later.look()
            assert later.told.count("what is known of the line is as it was: the gate is shut") == 1
        silent = Story(tmp_path)
        silent.line.why = "nobody is there"
        (tmp_path / INDEX).unlink()
        async with begun(one), begun(silent):
            assert await silent.names("zanzibar") == ["line:model-1"]  # of the index from before

    run(story)


def test_while_the_next_index_is_made_questions_are_answered_from_the_one_before(tmp_path):
    embedder = Failing()

    async def story() -> None:
        async with begun(Story(tmp_path, made("zanzibar"), embedder=embedder)) as one:
            assert await one.names("zanzibar") == ["line:model-1"]  # by words: nothing is embedded yet
            assert embedder.embedded == []
            await one.look()
            assert await one.names("zanzibar") == ["line:model-1"] and embedder.embedded[-1] == "zanzibar"
            before = list(embedder.embedded)
            one.line.documents = [made("timbuktu")]
            embedder.let.clear()
            making = asyncio.create_task(one.look())
            await until(lambda: embedder.held)
            assert await one.names("zanzibar") == ["line:model-1"]
            embedder.let.set()
            await making
            assert await one.names("timbuktu") == ["line:model-1"]
            new = [text for text in embedder.embedded[len(before) :] if text not in ("zanzibar", "timbuktu")]
            assert new and all("timbuktu" in text for text in new)  # nothing is embedded twice

    run(story)


@pytest.mark.slow
def test_an_index_of_another_embedder_is_made_anew_and_never_mixed(tmp_path):
    async def story() -> None:
        first, second = WordCounter("one"), WordCounter("another")
        for embedder in (first, second, None):
            async with begun(Story(tmp_path, made("zanzibar"), embedder=embedder)) as one:
                assert await one.names("zanzibar") == ["line:model-1"]  # before and after it is made anew
                await one.look()
                assert await one.names("zanzibar") == ["line:model-1"]
            with Index(tmp_path / INDEX) as index:
                assert index.embedder == (None if embedder is None else embedder.identity)

    run(story)


def test_an_embedder_that_fails_is_told_once_and_things_are_looked_up_by_words(tmp_path):
    embedder = Failing()

    async def story() -> None:
        async with begun(Story(tmp_path, made("zanzibar"), embedder=embedder)) as one:
            await one.look()
            embedder.fails = True
            for _ in range(2):
                assert await one.names("zanzibar") == ["line:model-1"]
            one.line.documents = [made("timbuktu")]
            await one.look()
            assert one.told.count("looked up by words: the server has gone") == 1
            assert one.told.count("the index stays as it was: the server has gone") == 1
            assert await one.names("zanzibar") == ["line:model-1"]
            embedder.fails = False
            await one.look()
            assert await one.names("timbuktu") == ["line:model-1"]

    run(story)


def test_an_embedder_that_is_away_at_the_beginning_costs_no_vectors_and_is_used_once_it_is_there(tmp_path):
    embedder = WordCounter()

    async def story() -> None:
        async with begun(Story(tmp_path, made("zanzibar"), embedder=embedder)) as one:
            await one.look()
        whole, before = (tmp_path / INDEX).read_bytes(), list(embedder.embedded)
        later = Story(tmp_path, made("timbuktu"), embedder=embedder)
        later.away = True
        async with begun(later):
            for _ in range(2):
                assert await later.names("zanzibar") == ["line:model-1"]
                await later.look()
            assert (tmp_path / INDEX).read_bytes() == whole and embedder.embedded == before
            assert later.told.count("things are looked up by words: nobody answers there") == 1
            later.away = False
            await later.look()
            new = embedder.embedded[len(before) :]
            assert new and all("timbuktu" in text for text in new), "the vectors of before are taken over"
            assert await later.names("timbuktu") == ["line:model-1"] and embedder.embedded[-1] == "timbuktu"

    run(story)


def test_an_embedder_that_hangs_holds_up_neither_the_start_nor_a_question(tmp_path, monkeypatch):
    monkeypatch.setattr(known_module, "FIRST_S", 0.2)
    monkeypatch.setattr(known_module, "QUESTION_S", 0.2)
    embedder = Failing()

    async def story() -> None:
        one = Story(tmp_path, made("zanzibar"), embedder=embedder)
        one.hangs = True
        async with begun(one):
            assert one.told.count("things are looked up by words: no embedder within 0.2 s") == 1
            assert await one.names("zanzibar") == ["line:model-1"]
            one.hangs = False
            await one.look()
            embedder.hangs = True
            assert await one.names("zanzibar") == ["line:model-1"]
            assert one.told[-1] == "looked up by words: no vector within 0.2 s"
            embedder.hangs = False
            assert await one.names("zanzibar") == ["line:model-1"] and embedder.embedded[-1] == "zanzibar"

    run(story)


def test_without_an_index_things_are_looked_up_by_words_until_the_embedder_is_there(tmp_path):
    async def story() -> None:
        one = Story(tmp_path, made("zanzibar"), embedder=WordCounter())
        one.away = True
        async with begun(one):
            one.line.documents = [made("timbuktu")]
            await one.look()
            assert await one.names("timbuktu") == ["line:model-1"]
            one.away = False
            await one.look()
            with Index(tmp_path / INDEX) as index:
                assert index.embedder == WordCounter().identity

    run(story)


def test_a_folder_that_cannot_be_written_is_told_and_nothing_is_known(tmp_path):
    (tmp_path / "knowledge").write_text("no folder")

    async def story() -> None:
        async with begun(Story(tmp_path / "knowledge", made("zanzibar"))) as one:
            assert any("nothing is indexed" in text for text in one.told)
            with pytest.raises(IndexRefused):
                await one.names("zanzibar")

    run(story)


def test_it_goes_on_looking_by_itself(tmp_path, monkeypatch):
    monkeypatch.setattr(known_module, "LOOK_S", 0.0)

    async def story() -> None:
        async with begun(Story(tmp_path, made("zanzibar"))) as one:
            said = len(one.told)
            one.line.fails = True
            keeping = asyncio.create_task(one.known.keep_up())
            await until(lambda: "what is known stays as it was: ValueError: nobody has thought of it" in one.told)
            one.line.fails = False
            one.line.documents = [made("timbuktu")]
            await until(lambda: any("documents are known" in text for text in one.told[said:]))
            assert await one.names("timbuktu") == ["line:model-1"]
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)

    run(story)

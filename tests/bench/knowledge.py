"""`make bench-knowledge`: how well questions find their notes, how fast a search is, and how fast an index is made.

Questions stand in a file with the notes that answer each; those of this repository were there while the search was
tuned, so that what they measure says nothing of others: name a file with others. A hit: one of the first notes found is
among those that answer. Documents by the thousand are made of the notes' own sentences, shuffled: every word of a
question is in many of them, which is the slow case.
"""

import argparse
import asyncio
import importlib.util
import random
import re
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agents.rag.embedder import Embedder, EmbedderId, Vectors, unit_rows
from agents.rag.index import Index
from agents.rag.library import ADDED, INDEX, open_library, program_notes
from agents.rag.minilm import PACKAGE, MiniLm
from agents.rag.stages import Asked
from tests.bench.figures import Bench

QUESTIONS = Path(__file__).parent / "questions.toml"
DOCUMENTS, SENTENCES = 2000, 33  #: of so many sentences each, five passages
DIMENSION = 384  #: of vectors whose search is timed
SEED = 7100
LIBRARIES = ("numpy", "apsw", "sqlite-vec", "pydantic")


@dataclass(frozen=True)
class Question:
    asked: str
    answered_by: list[str]


class RandomVectors:
    """Stands in for an embedder where only the time of the search is measured."""

    identity = EmbedderId("random", DIMENSION, "0" * 64)

    async def embed(self, texts: Sequence[str]) -> Vectors:
        generator = np.random.default_rng(SEED)
        return unit_rows(generator.standard_normal((len(texts), DIMENSION)), len(texts), DIMENSION)


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench-knowledge", description=__doc__.splitlines()[0])
    parser.add_argument("--questions", type=Path, default=QUESTIONS, help="TOML as tests/bench/questions.toml")
    given = parser.parse_args()
    command = " ".join(["make bench-knowledge", *([f'ARGS="{" ".join(sys.argv[1:])}"'] if sys.argv[1:] else [])])
    questions = questions_in(given.questions)
    which = "tuning" if given.questions == QUESTIONS else given.questions.name
    bench = Bench("knowledge", [SEED], command=command, libraries=LIBRARIES)
    bench.tables["questions"] = which
    asyncio.run(_found(bench, questions, None, "_lexical"))
    asyncio.run(_speed(bench, questions))
    bench.finish()
    if importlib.util.find_spec(PACKAGE) is None:
        print("MiniLM is not installed (make minilm): not measured")
        return
    bench = Bench("knowledge-minilm", [SEED], command=command, libraries=LIBRARIES)
    bench.tables["questions"] = which
    asyncio.run(_found(bench, questions, MiniLm(), ""))
    bench.finish()


def questions_in(file: Path) -> list[Question]:
    """Those that a note answers."""
    listed = tomllib.loads(file.read_text(encoding="utf-8"))["question"]
    known = {note.name for note in program_notes()}
    for one in listed:
        if unknown := set(one["answered_by"]) - known:
            raise SystemExit(f"{file}: {one['asked']!r} is answered by {sorted(unknown)}, which is no note")
    return [Question(one["asked"], one["answered_by"]) for one in listed if one["answered_by"]]


def made_documents(folder: Path, count: int) -> None:
    """Markdown files of sentences of the notes, shuffled."""
    chosen = random.Random(SEED)
    sentences = [
        sentence for note in program_notes() for sentence in re.split(r"(?<=[.;])\s+", note.text) if sentence.strip()
    ]
    folder.mkdir(parents=True)
    for number in range(count):
        title = " ".join(chosen.choice(sentences).split()[:8])
        text = "\n\n".join(" ".join(chosen.sample(sentences, 3)) for _ in range(SENTENCES // 3))
        (folder / f"made-{number:04d}.md").write_text(f"# {title}\n\n{text}\n", encoding="utf-8")


async def _found(bench: Bench, questions: Sequence[Question], embedder: Embedder | None, suffix: str) -> None:
    """Over all of them, the share that finds its note first, and among the first three."""
    ranks: list[int] = []
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        opened = await open_library(Path(folder), 2, embedder)
        bench.figure(f"notes_index{suffix}_s", time.perf_counter() - began, "s", opened.index.chunks_count)
        with opened.index as index:
            for question in questions:
                names = [hit.document.name for hit in (await index.ask(Asked(question.asked, most=20), embedder)).hits]
                places = [names.index(name) + 1 for name in question.answered_by if name in names]
                ranks.append(min(places, default=0))
    for most in (1, 3, 10):
        share = sum(1 <= rank <= most for rank in ranks) / len(ranks)
        bench.figure(f"hit_at_{most}{suffix}", share, "", len(ranks))
    bench.tables[f"not among the first three{suffix}"] = {
        "heads": ("question", "rank of the best note that answers it; 0: beyond 20"),
        "rows": [(one.asked, rank) for one, rank in zip(questions, ranks, strict=True) if not 1 <= rank <= 3],
    }


async def _speed(bench: Bench, questions: Sequence[Question]) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made_documents(folder / ADDED, DOCUMENTS)
        began = time.perf_counter()
        (await open_library(folder, 2)).index.close()
        bench.figure("reindex_s", time.perf_counter() - began, "s", DOCUMENTS)
        bench.figure("index_mb", (folder / INDEX).stat().st_size / 1e6, "MB", DOCUMENTS)
        with Index(folder / INDEX) as index:
            bench.figure("passages", index.chunks_count, "", DOCUMENTS)
            _timed(bench, index, questions, None, "search")
        vectors = RandomVectors()
        opened = await open_library(folder, 2, vectors, reindex=True)
        with opened.index as index:
            _timed(bench, index, questions, await vectors.embed(["a question"]), "search_vectors")


def _timed(bench: Bench, index: Index, questions: Sequence[Question], vectors: Vectors | None, name: str) -> None:
    index.retrieve(Asked(questions[0].asked), vectors)  # reads the file, and the glossary
    times: list[float] = []
    for question in questions * 3:
        began = time.perf_counter()
        index.retrieve(Asked(question.asked), vectors)
        times.append(1e3 * (time.perf_counter() - began))
    bench.figure(f"{name}_p50_ms", float(np.percentile(times, 50)), "ms", len(times))
    bench.figure(f"{name}_p95_ms", float(np.percentile(times, 95)), "ms", len(times))


if __name__ == "__main__":
    main()

"""Where the knowledge for `r2rgate ask` lies, what is taken in, and the search itself."""

import asyncio
from dataclasses import dataclass
from os import environ
from pathlib import Path

import typer

from agents.rag.documents import Tier
from agents.rag.embedder import EmbedderFailed
from agents.rag.embedders import embedder_named
from agents.rag.index_file import IndexRefused
from agents.rag.library import INDEX, Opened, add_files, open_library
from agents.rag.stages import Asked, Retrieval
from gateway.cli.data_place import own_folder
from gateway.cli.process_commands import default_data_folder
from gateway.core.line import Agents, Line
from gateway.core.nearest import nearest
from gateway.core.questions import DECISIONS, Decision
from gateway.mailbox.paths import AGENTS_DATA, GATEWAY_DATA
from gateway.supervisor.knowledge.gathered import Known
from gateway.supervisor.knowledge.stored import known_in

FOLDER = "knowledge"  #: in the agents' data of a line


class AskRefused(Exception):
    """It cannot be asked like that; the text says why and what to do."""


@dataclass(frozen=True)
class Search:
    """In what is searched. `add`: files and folders that are taken in first."""

    line: Line | None
    data_dir: Path | None
    embedder: str
    add: list[Path]
    reindex: bool

    @property
    def folder(self) -> Path:
        """Of a line in its data; without one in a cache of the user."""
        if self.data_dir is not None:
            return own_folder(self.data_dir, AGENTS_DATA) / FOLDER
        if self.line is not None:
            return own_folder(default_data_folder(self.line), AGENTS_DATA) / FOLDER
        return Path(environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "r2rgate" / FOLDER

    @property
    def tier(self) -> Tier:
        """Of added documents without a head: what is added for a line is of this line."""
        return 2 if self.line is None else 3


@dataclass(frozen=True)
class Done:
    """`told`: what was taken in and what was not, in words; `found` None: nothing was asked."""

    found: Retrieval | None
    told: list[str]
    refused: bool


def asked_of(question: str | None, decision: str | None, most: int, nothing: bool) -> Asked | None:
    """None where nothing is asked, which `nothing` allows. Raises AskRefused."""
    known: dict[str, Decision] = {one: one for one in DECISIONS}
    if decision is not None and decision not in known:
        like = nearest(decision, known)
        hint = f"; did you mean {like}?" if like else ""
        raise AskRefused(f"--decision is {decision}; allowed: {', '.join(known)}{hint}")
    if question is None and nothing:
        return None
    if question is None or not question.strip():
        raise AskRefused('there is no question: r2rgate ask "why does tension swing once per turn"')
    return Asked(question, known[decision] if decision else None, most=most)


def run(search: Search, asked: Asked | None) -> Done:
    """Raises AskRefused."""
    try:
        return asyncio.run(_run(search, asked))
    except (IndexRefused, EmbedderFailed) as error:
        raise AskRefused(str(error)) from error
    except OSError as error:
        raise AskRefused(f"{error.filename}: {error.strerror}; --data-dir names another folder") from error


def _left_out(opened: Opened, of_line: Known | None) -> list[str]:
    return [f"left out: {text}" for text in (*opened.left_out, *(of_line.left_out if of_line else []))]


async def _run(search: Search, asked: Asked | None) -> Done:
    url = (search.line.agents if search.line else Agents()).url
    embedder = await embedder_named(search.embedder, url)
    records = search.folder.parent.with_name(GATEWAY_DATA)
    of_line = None if search.line is None else await asyncio.to_thread(known_in, records, search.line)
    added = add_files(search.folder, search.add, search.tier)
    if embedder is not None and (search.reindex or not (search.folder / INDEX).is_file()):
        typer.echo(f"making vectors of every passage with {embedder.identity.name}: this takes minutes, once", err=True)
    generated = None if of_line is None else of_line.documents
    opened = await open_library(search.folder, search.tier, embedder, generated, reindex=search.reindex)
    told = [f"{len(added.documents)} documents taken in: {search.folder}"] if search.add else []
    refused = dict.fromkeys((*added.refused, *opened.refused))
    told += [f"{one.file}: not taken in: {one.reason}" for one in refused]
    told += _left_out(opened, of_line)
    with opened.index as index:
        found = await index.ask(asked, embedder) if asked else None
    return Done(found, told, bool(refused))

"""What agents ask of the line, and get: models, controllers, recordings, knowledge. They look; nothing here writes.

Whatever cannot be given is refused with the reason. What takes time is done on a thread, one at a time of each sort.
"""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from pathlib import Path

from gateway.core.line import Line
from gateway.core.line_queries import (
    AskMalformed,
    AskRefused,
    ControllerTold,
    KnowledgePart,
    ModelTold,
    OfHash,
    OfKnowledge,
    OfRecording,
    RecordingLine,
    RecordingList,
    parse_ask,
)
from gateway.core.messages import Reply
from gateway.core.packed_recording import most_samples, packed
from gateway.core.recording import Recording
from gateway.core.topics import (
    AGENT_NAMES,
    ASK_CONTROLLER,
    ASK_KNOWLEDGE,
    ASK_MODEL,
    ASK_RECORDING,
    ASK_RECORDINGS,
    AgentName,
)
from gateway.mailbox.port import MAX_PAYLOAD, Mailbox
from gateway.supervisor import configurations, models
from gateway.supervisor.agents_cases import AgentsCases
from gateway.supervisor.configurations import ConfigurationsError, open_configurations
from gateway.supervisor.gate import Gate
from gateway.supervisor.knowledge.gathered import Known, LineKnowledge, now_of
from gateway.supervisor.lifecycle import Book
from gateway.supervisor.model_store import ModelsError
from gateway.supervisor.models import open_repository
from gateway.supervisor.proposal_records import iso, refused
from gateway.tasks.threads import Worker

Experiments = Callable[[float], list[tuple[Recording, float]]]  #: of so many seconds, the newest first; it may block
_HEAD_BYTES = 1024  #: of a part of the knowledge, beside what it tells


class LineDesk:
    def __init__(self, line: Line, gate: Gate, folder: Path, experiments: Experiments, cases: AgentsCases) -> None:
        """`folder`: of the line's data. Asks that are none go into `cases`."""
        self._line = line
        self._gate = gate
        self._folder = folder
        self._experiments = experiments
        self._cases = cases
        self._knowledge = LineKnowledge(line, folder)
        self._listed: dict[
            str, Recording
        ] = {}  #: by digest, of the last list: some few, and only of them parts are told
        self._reading, self._gathering = asyncio.Lock(), asyncio.Lock()
        self._stores = Worker("asked-stores")

    def serve_on(self, bus: Mailbox) -> None:
        served: dict[object, Callable[[bytes], Awaitable[bytes]]] = {
            ASK_MODEL: self._model,
            ASK_CONTROLLER: self._controller,
            ASK_RECORDINGS: self._recordings,
            ASK_RECORDING: self._recording,
            ASK_KNOWLEDGE: self._known,
        }
        for agent in AGENT_NAMES:
            for row in (ASK_MODEL, ASK_CONTROLLER, ASK_RECORDINGS, ASK_RECORDING, ASK_KNOWLEDGE):
                bus.serve(row.of(agent), partial(self._answer, agent, served[row]))

    async def _answer(
        self, agent: AgentName, answer: Callable[[bytes], Awaitable[bytes]], payload: bytes
    ) -> bytes:  # fmt: skip
        try:
            said = await answer(payload)
        except AskRefused as error:
            if isinstance(error, AskMalformed):
                self._cases.note("refused", f"it is not told: {error}", agent)
            return _bytes(refused("it is not told", error.reasons))
        if len(said) > MAX_PAYLOAD:
            return _bytes(refused("it is not told", [f"it has {len(said)} bytes; a message carries {MAX_PAYLOAD}"]))
        return said

    async def _model(self, payload: bytes) -> bytes:
        wanted = parse_ask(payload, OfHash).hash
        id_ = self._book().model if wanted is None else wanted
        if id_ is None:
            return ModelTold(hash=None, model=None).model_dump_json().encode()
        return await self._stores.do(self._stored_model, id_)

    async def _controller(self, payload: bytes) -> bytes:
        wanted = parse_ask(payload, OfHash).hash
        id_ = self._book().in_service if wanted is None else wanted
        if id_ is None:
            raise AskRefused(["the loop has not told yet what controls the line: start it, then ask again"])
        return await self._stores.do(self._stored_controller, id_)

    async def _recordings(self, _: bytes) -> bytes:
        async with self._reading:
            found = await asyncio.to_thread(self._experiments, self._line.gate.data_max_age_s)
            listed = await asyncio.to_thread(lambda: [_line_of(one, end_s) for one, end_s in found])
            self._listed = {line.digest: one for line, (one, _) in zip(listed, found, strict=True)}
        return RecordingList(recordings=listed).model_dump_json().encode()

    async def _recording(self, payload: bytes) -> bytes:
        asked = parse_ask(payload, OfRecording)
        one = self._listed.get(asked.digest)
        if one is None:
            raise AskRefused([f"there is no recording {asked.digest[:12]} in the last list: ask for the list"])
        async with self._reading:
            return await asyncio.to_thread(_part, one, asked.part)

    async def _known(self, payload: bytes) -> bytes:
        asked = parse_ask(payload, OfKnowledge)
        now = now_of(self._book())
        async with self._gathering:
            known = await asyncio.to_thread(self._knowledge.told, now)
            return await asyncio.to_thread(_told, known, asked)

    def _book(self) -> Book:
        """Raises AskRefused while the gate is shut."""
        if self._gate.deployer is None:
            shut = self._gate.shut_reply()
            raise AskRefused([f"{shut.text}: {'; '.join(shut.reasons)}"])
        return self._gate.deployer.book

    def _stored_model(self, id_: str) -> bytes:
        try:
            with open_repository(self._folder / models.FILE_NAME) as store:
                found = store.get(id_)
        except ModelsError as error:
            raise AskRefused([str(error)]) from error
        if found is None or (found.site, found.line) != (self._line.site, self._line.line):
            raise AskRefused([f"no model {id_[:12]} was ever stored for this line; proposals name those that were"])
        if found.model is None:
            raise AskRefused([f"model {id_[:12]}: {found.damage}"])
        return ModelTold(hash=id_, model=found.model).model_dump_json().encode()

    def _stored_controller(self, id_: str) -> bytes:
        try:
            with open_configurations(self._folder / configurations.FILE_NAME) as store:
                found = store.get(self._line.site, self._line.line, id_)
        except ConfigurationsError as error:
            raise AskRefused([str(error)]) from error
        if found is None:
            raise AskRefused([f"no configuration {id_[:12]} was ever stored for this line; proposals name those"])
        if found.controller is None:
            raise AskRefused([f"configuration {id_[:12]}: {found.damage}"])
        return ControllerTold(hash=id_, controller=found.controller).model_dump_json().encode()


def _part(one: Recording, part: int) -> bytes:
    parts = _parts(one)
    if part >= parts:
        raise AskRefused([f"part is {part}; allowed: 0 to {parts - 1}"])
    size = most_samples(one.n, MAX_PAYLOAD)
    return packed(one.part(part * size, (part + 1) * size))


def _parts(one: Recording) -> int:
    return -(-one.samples // most_samples(one.n, MAX_PAYLOAD))


def _line_of(one: Recording, end_s: float) -> RecordingLine:
    return RecordingLine(
        digest=one.digest(), source=one.source, ended=iso(end_s), samples=one.samples, spans=one.n,
        period_s=one.period_s, parts=_parts(one),
    )  # fmt: skip


def _told(known: Known, asked: OfKnowledge) -> bytes:
    """Raises AskRefused for a part of what is no longer so."""
    revision = known.revision
    if asked.part == 0 and asked.revision == revision:
        return _part_of(revision, 0, 0, [], [])
    if asked.part > 0 and asked.revision != revision:
        raise AskRefused(["the line has changed since the first part: begin anew"])
    parts = _shared_out([one.model_dump_json() for one in known.documents])
    if asked.part >= len(parts):
        raise AskRefused([f"part is {asked.part}; allowed: 0 to {len(parts) - 1}"])
    left_out = [] if asked.part else [text[:400] for text in known.left_out[:100]]
    return _part_of(revision, asked.part, len(parts), parts[asked.part], left_out)


def _shared_out(documents: Sequence[str]) -> list[list[str]]:
    """As many in each part as a message carries, in their order."""
    parts: list[list[str]] = [[]]
    room = MAX_PAYLOAD // 2  # the first part tells as well what is left out
    for one in documents:
        size = len(one.encode()) + 1
        if size > room and parts[-1]:
            parts.append([])
            room = MAX_PAYLOAD - _HEAD_BYTES
        parts[-1].append(one)
        room -= size
    return parts


def _part_of(revision: str, part: int, parts: int, documents: Sequence[str], left_out: list[str]) -> bytes:
    """`documents` are JSON already."""
    empty = KnowledgePart(revision=revision, part=part, parts=parts, documents=[], left_out=left_out)
    head, found, tail = empty.model_dump_json().partition('"documents":[')
    return f"{head}{found}{','.join(documents)}{tail}".encode()


def _bytes(answer: Reply) -> bytes:
    return answer.model_dump_json().encode()

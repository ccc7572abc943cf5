"""What an agent asks of the line over its bus: model, controller, recordings, what is known. It changes nothing."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from pydantic import ValidationError

from gateway.core.controller import Controller
from gateway.core.line import Strict
from gateway.core.line_model import LineModel
from gateway.core.line_queries import (
    ControllerTold,
    Generated,
    KnowledgePart,
    ModelTold,
    OfHash,
    OfKnowledge,
    OfRecording,
    RecordingLine,
    RecordingList,
)
from gateway.core.messages import Reply
from gateway.core.packed_recording import unpacked
from gateway.core.recording import ARRAYS, Recording
from gateway.core.topics import (
    ASK_CONTROLLER,
    ASK_KNOWLEDGE,
    ASK_MODEL,
    ASK_RECORDING,
    ASK_RECORDINGS,
    AgentName,
    AgentTopic,
)
from gateway.mailbox.port import Mailbox, Unreachable

ANSWER_S = 30.0  #: the gateway may have to read years of records
TRIES = 3  #: where the line changes while parts are on their way
_Told = TypeVar("_Told", bound=Strict)


class LineNotTold(Exception):
    """The line's gateway is not there, or refuses; the text says why."""


@dataclass(frozen=True)
class LineKnown:
    documents: list[Generated]
    left_out: list[str]  #: in words
    revision: str  #: the same as long as nothing has changed


class LineOnBus:
    """For one agent, by whose name the gateway counts what is asked. Every method raises LineNotTold."""

    def __init__(
        self, bus: Mailbox, agent: AgentName, pause: Callable[[float], Awaitable[None]] = asyncio.sleep
    ) -> None:
        self._bus = bus
        self._agent: AgentName = agent
        self._pause = pause  #: between the parts of what comes in several, so that none is refused

    async def model(self, hash_: str | None = None) -> LineModel | None:
        """By its hash; without one that in service: None where none has been accepted yet."""
        return (await self._told(ASK_MODEL, OfHash(hash=hash_), ModelTold)).model

    async def controller(self, hash_: str | None = None) -> Controller:
        """By its hash; without one that in service."""
        return (await self._told(ASK_CONTROLLER, OfHash(hash=hash_), ControllerTold)).controller

    async def recordings(self) -> list[Recording]:
        """Of experiments, as the gate judges by them: the newest first."""
        listed = await self._told(ASK_RECORDINGS, None, RecordingList)
        return [await self._recording(one) for one in listed.recordings]

    async def knowledge(self) -> list[Generated]:
        """What is known of this line: tier 3."""
        found = await self.knowledge_since(None)
        return [] if found is None else found.documents

    async def knowledge_since(self, revision: str | None) -> LineKnown | None:
        """None: it is still as it was at `revision`."""
        why = ""
        for _ in range(TRIES):
            first = await self._told(ASK_KNOWLEDGE, OfKnowledge(revision=revision), KnowledgePart)
            if first.parts == 0:
                return None
            parts = [first]
            try:
                while len(parts) < first.parts:
                    parts.append(await self._further(first.revision, len(parts)))
            except LineNotTold as changed:
                why = str(changed)
                continue
            return LineKnown([one for part in parts for one in part.documents], first.left_out, first.revision)
        raise LineNotTold(f"the line changes faster than it can be told: {why}")

    async def _further(self, revision: str, part: int) -> KnowledgePart:
        await self._pause(1.0 / ASK_KNOWLEDGE.most_per_s)
        return await self._told(ASK_KNOWLEDGE, OfKnowledge(revision=revision, part=part), KnowledgePart)

    async def _recording(self, one: RecordingLine) -> Recording:
        parts: list[Recording] = []
        for number in range(one.parts):
            await self._pause(1.0 / ASK_RECORDING.most_per_s)
            answer = await self._asked(ASK_RECORDING, OfRecording(digest=one.digest, part=number))
            try:
                parts.append(await asyncio.to_thread(unpacked, answer))
            except ValueError as error:
                otherwise = f"recording {one.digest[:12]} came as something else: {error}"
                raise LineNotTold(_refusal(answer, otherwise)) from error
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}
        found = Recording(**arrays, period_s=one.period_s, source=one.source)
        if found.digest() != one.digest:
            raise LineNotTold(f"recording {one.digest[:12]} did not come as it is in the list")
        return found

    async def _told(self, row: AgentTopic, ask: Strict | None, kind: type[_Told]) -> _Told:
        answer = await self._asked(row, ask)
        try:
            return kind.model_validate_json(answer)
        except ValidationError as error:
            raise LineNotTold(_refusal(answer, "the gateway answers as another version would")) from error

    async def _asked(self, row: AgentTopic, ask: Strict | None) -> bytes:
        payload = b"" if ask is None else ask.model_dump_json().encode()
        try:
            return await self._bus.request(row.of(self._agent), payload, ANSWER_S)
        except Unreachable as error:
            raise LineNotTold(str(error)) from error


def _refusal(answer: bytes, otherwise: str) -> str:
    """What stands in the place of what was asked for."""
    try:
        reply = Reply.model_validate_json(answer)
    except ValidationError:
        return otherwise
    return "; ".join([reply.text, *reply.reasons])

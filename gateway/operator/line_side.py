"""What the operator's process knows of the line: asked of the gateway, again and again, over its socket.

The gateway is the only one that it talks to. Where that is away, what was known stays, and says how old it is.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import TypeVar

from pydantic import ValidationError

from gateway.core.decisions import ListProposals, ProposalList, ProposalShown, ShowProposal
from gateway.core.line import Strict
from gateway.core.line_past import RecordsAfter, RecordsTold, TensionsBetween, TensionsTold
from gateway.core.messages import Reply
from gateway.core.people import ForPerson, Person, Said
from gateway.core.status import GatewayStatus
from gateway.core.topics import (
    GATEWAY_FOR_PERSON,
    GATEWAY_PAST,
    GATEWAY_PROPOSALS,
    GATEWAY_STATUS,
    Topic,
)
from gateway.mailbox.port import Mailbox, Unreachable

STATUS_S = 0.1  #: between two looks
PROPOSALS_S = 0.5
ASK_S = 2.0
ACT_S = 20.0  #: arming, and a deployment, take their time

Model = TypeVar("Model", bound=Strict)

TOPICS: tuple[Topic, ...] = (GATEWAY_STATUS, GATEWAY_PROPOSALS, GATEWAY_PAST, GATEWAY_FOR_PERSON)


class NotTold(Exception):
    """The gateway did not tell; the text says why."""


class LineSide:
    """`watch` as a task; then read `status`, `proposals`, `records`. All in one event loop."""

    def __init__(self, mailbox: Mailbox, clock: Callable[[], float] = time.monotonic) -> None:
        self.status: GatewayStatus | None = None
        self.status_s: float | None = None  #: of the clock, when it came
        self.proposals: ProposalList | None = None
        self.trouble = ""  #: why the last look came to nothing; empty: it did not
        self.on_status: list[Callable[[GatewayStatus], None]] = []
        self.on_proposals: list[Callable[[ProposalList], None]] = []  #: when they are others than before
        self._mailbox = mailbox
        self._clock = clock

    @property
    def age_s(self) -> float | None:
        """Of the status; None: there has been none."""
        return None if self.status_s is None else self._clock() - self.status_s

    async def watch(self) -> None:
        """Until it is cancelled."""
        await asyncio.gather(self._again(self._look, STATUS_S), self._again(self._look_at_proposals, PROPOSALS_S))

    async def shown(self, proposal: str) -> ProposalShown:
        """Everything on which a person decides. Raises NotTold."""
        return _told(ProposalShown, await self._ask(GATEWAY_PROPOSALS, ShowProposal(proposal=proposal)))

    async def records(self, after: int | None = None) -> RecordsTold:
        """Raises NotTold."""
        return _told(RecordsTold, await self._ask(GATEWAY_PAST, RecordsAfter(after=after)))

    async def tensions(self, asked: TensionsBetween) -> TensionsTold:
        """Raises NotTold."""
        return _told(TensionsTold, await self._ask(GATEWAY_PAST, asked))

    async def say(self, person: Person, said: Said) -> Reply:
        """In a person's name. A gateway that is away is an answer, too."""
        try:
            payload = ForPerson(person=person, said=said).model_dump_json().encode()
            return Reply.model_validate_json(await self._mailbox.request(GATEWAY_FOR_PERSON, payload, ACT_S))
        except (Unreachable, ValidationError) as error:
            return Reply(ok=False, state="", text=str(error), reasons=[str(error)])

    async def _look(self) -> None:
        status = _told(GatewayStatus, await self._request(GATEWAY_STATUS, b""))
        self.status, self.status_s = status, self._clock()
        for tell in self.on_status:
            tell(status)

    async def _look_at_proposals(self) -> None:
        found = _told(ProposalList, await self._ask(GATEWAY_PROPOSALS, ListProposals()))
        if found != self.proposals:
            self.proposals = found
            for tell in self.on_proposals:
                tell(found)

    async def _again(self, look: Callable[[], Awaitable[None]], every_s: float) -> None:
        while True:
            try:
                await look()
                self.trouble = ""
            except NotTold as error:
                self.trouble = str(error)
            await asyncio.sleep(every_s)

    async def _ask(self, topic: Topic, query: ListProposals | ShowProposal | RecordsAfter | TensionsBetween) -> bytes:
        return await self._request(topic, query.model_dump_json().encode())

    async def _request(self, topic: Topic, payload: bytes) -> bytes:
        try:
            return await self._mailbox.request(topic, payload, ASK_S)
        except Unreachable as error:
            raise NotTold(str(error)) from error


def _told(model: type[Model], answer: bytes) -> Model:
    """Raises NotTold: with what the gateway said instead."""
    try:
        return model.model_validate_json(answer)
    except ValidationError as error:
        try:
            reply = Reply.model_validate_json(answer)
        except ValidationError:
            raise NotTold(f"the gateway answered what is none, it is of another version: {error}") from None
        raise NotTold("; ".join([reply.text, *reply.reasons])) from None

"""What the operator's process knows of the line: asked of the gateway, again and again, over its socket.

The gateway is the only one that it talks to. Where that is away, what was known stays, and says how old it is.
"""

import asyncio
import time
from collections.abc import Callable, Coroutine
from typing import TypeVar

from pydantic import ValidationError

from gateway.core.access import AtTheDoor
from gateway.core.asked_before import AskedTold, ShowAsked
from gateway.core.courses import CoursesTold, ShowCourses
from gateway.core.decisions import ListProposals, ProposalList, ProposalShown, ShowProposal
from gateway.core.finding import finding
from gateway.core.line import Strict
from gateway.core.line_past import RecordsAfter, RecordsTold, TensionsBetween, TensionsTold
from gateway.core.messages import Reply
from gateway.core.people import ForPerson, Person, Said
from gateway.core.status import GatewayStatus
from gateway.core.topics import (
    GATEWAY_ACCESS,
    GATEWAY_ASKED,
    GATEWAY_COURSES,
    GATEWAY_FOR_PERSON,
    GATEWAY_PAST,
    GATEWAY_PROPOSALS,
    GATEWAY_STATUS,
    SAFE_S,
    Topic,
)
from gateway.mailbox.port import Mailbox, Unreachable
from gateway.mailbox.rights import OVERTAKES
from gateway.wording.catalogue import sentence

STATUS_S = 0.1  #: between two looks
PROPOSALS_S = 0.5
ASK_S = 2.0
ANSWERED_S = 10.0  #: for what is read from a disk: whoever gives up earlier asks again while it is still being read
MOST_ASKED = 3  #: of those at once
ACT_S = 20.0  #: arming, and a deployment, take their time

Model = TypeVar("Model", bound=Strict)

#: All but what people say.
READ: tuple[Topic, ...] = (
    GATEWAY_STATUS, GATEWAY_PROPOSALS, GATEWAY_PAST, GATEWAY_COURSES, GATEWAY_ASKED, GATEWAY_ACCESS,
)  # fmt: skip
TOPICS: tuple[Topic, ...] = (*READ, GATEWAY_FOR_PERSON)


class NotTold(Exception):
    """The gateway did not tell; the text says why."""


class Declined(NotTold):
    """It has answered, in words: there is no such thing, or not now."""


class LineSide:
    """`watch` as a task; then read `status`, `proposals`, `records`. All in one event loop."""

    def __init__(
        self, mailbox: Mailbox, saying: Mailbox | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`saying`: a way of its own for what people say, so that no reading keeps a stop from being heard."""
        self.status: GatewayStatus | None = None
        self.status_s: float | None = None  #: of the clock, when it came
        self.proposals: ProposalList | None = None
        self.proposals_s: float | None = None
        self.on_status: list[Callable[[GatewayStatus], None]] = []
        self.on_proposals: list[Callable[[ProposalList], None]] = []  #: when they are others than before
        self._mailbox = mailbox
        self._saying = saying or mailbox
        self._clock = clock
        self._troubles: dict[str, str] = {}  #: by what was asked for, while it is not told
        self._asking = asyncio.Semaphore(MOST_ASKED)

    @property
    def age_s(self) -> float | None:
        """Of the status; None: there has been none."""
        return None if self.status_s is None else self._clock() - self.status_s

    @property
    def proposals_age_s(self) -> float | None:
        """Of the list of proposals; None: there has been none."""
        return None if self.proposals_s is None else self._clock() - self.proposals_s

    @property
    def trouble(self) -> str:
        """Why the last looks came to nothing; empty: they did not."""
        return "; ".join(dict.fromkeys(self._troubles.values()))

    async def watch(self) -> None:
        """Until it is cancelled."""
        await asyncio.gather(self._again(self._look, STATUS_S), self._again(self._look_at_proposals, PROPOSALS_S))

    async def shown(self, proposal: str) -> ProposalShown:
        """Everything on which a person decides. Raises NotTold."""
        return _told(ProposalShown, await self._in_turn(GATEWAY_PROPOSALS, ShowProposal(proposal=proposal)))

    async def courses(self, proposal: str) -> CoursesTold:
        """Of the whole hash of one that waits; the first answer is mostly that they are being drawn. Raises NotTold."""
        return _told(CoursesTold, await self._in_turn(GATEWAY_COURSES, ShowCourses(proposal=proposal)))

    async def asked(self, proposal: str) -> AskedTold:
        """What was asked of agents before it was made, and the notes that were looked up. Raises NotTold."""
        return _told(AskedTold, await self._in_turn(GATEWAY_ASKED, ShowAsked(proposal=proposal)))

    async def records(self, after: int | None = None) -> RecordsTold:
        """Raises NotTold."""
        return _told(RecordsTold, await self._in_turn(GATEWAY_PAST, RecordsAfter(after=after)))

    async def tensions(self, asked: TensionsBetween) -> TensionsTold:
        """Raises NotTold."""
        return _told(TensionsTold, await self._in_turn(GATEWAY_PAST, asked))

    async def say(self, person: Person, said: Said) -> Reply:
        """In a person's name. A gateway that is away is an answer, too: to a stop or a hold, with what to press."""
        safe = said.command in OVERTAKES
        try:
            payload = ForPerson(person=person, said=said).model_dump_json().encode()
            within_s = SAFE_S if safe else ACT_S
            return Reply.model_validate_json(await self._saying.request(GATEWAY_FOR_PERSON, payload, within_s))
        except (Unreachable, ValidationError) as error:
            reply = Reply(ok=False, state="", text=str(error), reasons=[str(error)], known=False)
        if not safe:
            return reply
        found = finding("gateway-unanswered", command=said.command, because=reply.text)
        return reply.model_copy(update={"text": sentence(found), "findings": [found]})

    async def at_the_door(self, happened: AtTheDoor) -> bool:
        """For the audit. False: it has to be told again later."""
        try:
            answer = await self._mailbox.request(GATEWAY_ACCESS, happened.model_dump_json().encode(), ACT_S)
            return Reply.model_validate_json(answer).ok
        except (Unreachable, ValidationError):
            return False

    async def _look(self) -> None:
        status = _told(GatewayStatus, await self._request(GATEWAY_STATUS, b""))
        self.status, self.status_s = status, self._clock()
        for tell in self.on_status:
            tell(status)

    async def _look_at_proposals(self) -> None:
        found = _told(ProposalList, await self._ask(GATEWAY_PROPOSALS, ListProposals()))
        self.proposals_s = self._clock()
        if found != self.proposals:
            self.proposals = found
            for tell in self.on_proposals:
                tell(found)

    async def _again(self, look: Callable[[], Coroutine[object, object, None]], every_s: float) -> None:
        while True:
            try:
                await look()
                self._troubles.pop(look.__name__, None)
            except NotTold as error:
                self._troubles[look.__name__] = str(error)
            except Exception as error:  # of whoever is told: shown as trouble, and the next look has its turn
                self._troubles[look.__name__] = f"a fault of this program: {type(error).__name__}: {error}"
            await asyncio.sleep(every_s)

    async def _in_turn(self, topic: Topic, query: Strict) -> bytes:
        """Few at a time, so that those who look cannot fill the way to the gateway. Raises NotTold."""
        try:
            async with asyncio.timeout(ASK_S):
                await self._asking.acquire()
        except TimeoutError:
            raise NotTold("too much is being asked at once: try again in some seconds") from None
        try:
            return await self._request(topic, query.model_dump_json().encode(), ANSWERED_S)
        finally:
            self._asking.release()

    async def _ask(self, topic: Topic, query: ListProposals) -> bytes:
        return await self._request(topic, query.model_dump_json().encode())

    async def _request(self, topic: Topic, payload: bytes, within_s: float = ASK_S) -> bytes:
        try:
            return await self._mailbox.request(topic, payload, within_s)
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
        raise Declined("; ".join([reply.text, *reply.reasons])) from None

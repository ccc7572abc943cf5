"""The commissioning chain on a gateway that runs: asked over its socket, with its stores and its history beside it."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from pydantic import ValidationError

from gateway.cli.commission_changes import LineNow
from gateway.cli.commission_side import Away, CannotGoOn
from gateway.commissioning.past import OPEN_STAGES, Outcome, past_of
from gateway.core.decisions import (
    MOST_LISTED,
    Archive,
    LineChanged,
    ListProposals,
    ProposalList,
    ProposalShown,
    ShowProposal,
)
from gateway.core.line import Line
from gateway.core.messages import Reply
from gateway.core.recording import Recording
from gateway.core.status import GatewayStatus
from gateway.core.topics import GATEWAY_DECISION, GATEWAY_PROPOSALS, GATEWAY_PROPOSE, GATEWAY_STATUS, Topic
from gateway.mailbox.inbox import come_again_s
from gateway.mailbox.port import Mailbox, RemoteError, Unreachable
from gateway.supervisor import configurations as configurations_store
from gateway.supervisor import models as models_store
from gateway.supervisor.configurations import ConfigurationsError, open_configurations
from gateway.supervisor.experiments import MOST_EXPERIMENTS, newest_experiments
from gateway.supervisor.history import HistoryError
from gateway.supervisor.model_store import ModelsError
from gateway.supervisor.models import open_repository

TOPICS = (GATEWAY_PROPOSE, GATEWAY_PROPOSALS, GATEWAY_STATUS, GATEWAY_DECISION)  #: that are asked for
ANSWER_S = 20.0
POLL_S = 0.5
READY_WITHIN_S = 600.0
BACK_WITHIN_S = 120.0  #: a gateway that is started anew
STORED_WITHIN_S = 5.0
AGAIN_WITHIN_S = 120.0  #: for which a full inbox is waited for


class LiveGate:
    """Of `line`, whose gateway answers on `mailbox`. See GateSide. `pause` waits for seconds on `clock`."""

    def __init__(
        self,
        line: Line,
        mailbox: Mailbox,
        tell: Callable[[str], None],
        pause: Callable[[float], Awaitable[None]] = asyncio.sleep,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._line = line
        self._mailbox = mailbox
        self._tell = tell
        self._pause = pause
        self._clock = clock
        self._told = ""  #: for which proposal a person has been asked, and why
        self._settled: dict[str, ProposalShown] = {}  #: proposals to which nothing happens any more

    async def proposals(self) -> list[ProposalShown]:
        """Page by page: what others propose meanwhile moves older ones to the next page, and hides none."""
        found: dict[str, None] = {}
        wanted = skip = 0
        while not skip or skip < wanted:
            listed = await self._listed(skip)
            wanted = listed.since_change
            found |= dict.fromkeys(one.proposal for one in listed.proposals[: min(MOST_LISTED, wanted - skip)])
            skip += MOST_LISTED
        return [await self._shown(proposal) for proposal in reversed(found)]

    async def now(self) -> LineNow:
        listed, status = await self._listed(), await self._status()
        tension = [span.setpoint_n for span in status.spans if span.setpoint_n is not None]
        speed = status.speed_setpoint_m_per_s
        if listed.in_service is None or speed is None or len(tension) != self._line.n:
            raise CannotGoOn(f"the loop has not said how the line stands: {status.loop.next}")
        folder, site, name = Path(status.historian.path).parent, self._line.site, self._line.line
        try:
            with open_configurations(folder / configurations_store.FILE_NAME) as configurations:
                controller = configurations.find(listed.in_service, site, name).controller
            model = None
            if listed.model is not None:
                with open_repository(folder / models_store.FILE_NAME) as models:
                    model = models.find(listed.model, site, name).model
        except (ConfigurationsError, ModelsError) as error:
            raise CannotGoOn(str(error)) from error
        if controller is None or (listed.model is not None and model is None):
            raise CannotGoOn("the configuration or the model in service is damaged in the store")
        return LineNow(controller, model, tension, speed, datetime.fromtimestamp(status.wall_s, UTC))

    async def state(self) -> str:
        return (await self._status()).loop.state

    async def folder(self) -> Path:
        return Path((await self._status()).historian.path).parent

    async def recordings(self) -> list[Recording]:
        status = await self._stored()
        if status is None:
            return []
        changed_s = (await self._listed()).line_changed_s or 0.0
        begin_s = max(status.wall_s - self._line.gate.data_max_age_s, changed_s)
        path, until_s = Path(status.historian.path), status.wall_s + 1.0
        try:
            found = await asyncio.to_thread(newest_experiments, path, begin_s, until_s, MOST_EXPERIMENTS)
        except HistoryError:
            return []  # there is no history yet
        return [one for one, _ in found]

    async def _stored(self) -> GatewayStatus | None:
        """Once the historian has stored what there was when this was asked; None: it does not.

        Without this the newest experiment in the history may not be the newest one.
        """
        asked = status = await self._status()
        began_s = self._clock()
        while (age_s := status.historian.last_stored_age_s) is None or status.wall_s - age_s < asked.wall_s:
            if self._clock() - began_s > STORED_WITHIN_S:
                return None
            await self._pause(POLL_S)
            status = await self._status()
        return status

    async def ready(self) -> None:
        """In RUN, with set-points that stand as the gate asks; after a refusal for the moment, the cool-down later."""
        shown = await self.proposals()
        if shown and past_of(shown[-1]).outcome is Outcome.AGAIN:
            await self._pause(self._line.gate.cool_down_s)
        began_s, told = self._clock(), False
        while not (status := await self._status()).stands:
            if status.loop.state != "RUN" and not told:
                told = True
                self._tell(f"the line is in {status.loop.state}: {status.loop.next}")
            if self._clock() - began_s > READY_WITHIN_S:
                raise CannotGoOn(f"the line has not stood in RUN within {READY_WITHIN_S:g} s: start it, then go on")
            await self._pause(POLL_S)

    async def propose(self, payload: bytes) -> Reply:
        """Before the gate; where its inbox asks to come again, once it is time to."""
        began_s = self._clock()
        while True:
            reply = Reply.model_validate_json(await self._ask(GATEWAY_PROPOSE, payload))
            again_s = come_again_s(reply)
            if again_s is None or self._clock() + again_s - began_s > AGAIN_WITHIN_S:
                return reply
            await self._pause(again_s)

    async def line_changed(self, because: str) -> None:
        """The line is no longer as it was. Raises CannotGoOn where the gate does not take that."""
        said = LineChanged(because=because).model_dump_json().encode()
        reply = Reply.model_validate_json(await self._ask(GATEWAY_DECISION, said))
        if not reply.ok:
            raise CannotGoOn("; ".join([reply.text, *reply.reasons]))
        self._tell(reply.text)

    async def archive(self, command: Archive) -> Reply:
        return Reply.model_validate_json(await self._ask(GATEWAY_DECISION, command.model_dump_json().encode()))

    async def wait_for(self, proposal: str) -> None:
        shown = await self._shown(proposal)
        if shown.stage == "waiting" and self._told != (asked := f"{proposal} {shown.why}"):
            self._told = asked
            why = f"it was not taken: {shown.why}" if shown.why else "the gate lets it through"
            self._tell(f"  {why}; a person decides: r2rgate approve {proposal[:12]}")
        await self._pause(POLL_S)

    async def is_back(self, why: str) -> bool:
        began_s = self._clock()
        self._tell(f"{why}; it is waited for, {BACK_WITHIN_S:g} s at most")
        while self._clock() - began_s < BACK_WITHIN_S:
            with suppress(CannotGoOn):  # it answers before its gate is open, and before it has heard of the line
                await self.now()
                self._tell("the gateway answers again")
                return True
            await self._pause(POLL_S)
        return False

    async def _listed(self, skip: int = 0) -> ProposalList:
        query = ListProposals(most=MOST_LISTED, skip=skip)
        answer = await self._ask(GATEWAY_PROPOSALS, query.model_dump_json().encode())
        try:
            return ProposalList.model_validate_json(answer)
        except ValidationError:
            raise CannotGoOn(_refusal(answer)) from None

    async def _shown(self, proposal: str) -> ProposalShown:
        if proposal in self._settled:
            return self._settled[proposal]
        answer = await self._ask(GATEWAY_PROPOSALS, ShowProposal(proposal=proposal).model_dump_json().encode())
        try:
            shown = ProposalShown.model_validate_json(answer)
        except ValidationError:
            raise CannotGoOn(_refusal(answer)) from None
        if shown.stage not in OPEN_STAGES:
            self._settled[proposal] = shown
            why = f": {shown.why}" if shown.why else ""
            self._tell(f"  {proposal[:12]} ({shown.proposal.kind}) is {shown.stage}{why}")
        return shown

    async def _status(self) -> GatewayStatus:
        status = GatewayStatus.model_validate_json(await self._ask(GATEWAY_STATUS, b""))
        if (status.site, status.line) != (self._line.site, self._line.line):
            raise CannotGoOn(
                f"there runs {status.site}/{status.line}, the file describes {self._line.site}/{self._line.line}: name "
                "its --run-dir, or its file"
            )
        return status

    async def _ask(self, topic: Topic, payload: bytes) -> bytes:
        try:
            return await self._mailbox.request(topic, payload, ANSWER_S)
        except RemoteError as error:
            raise CannotGoOn(str(error)) from error
        except Unreachable as error:
            raise Away(str(error)) from error


def _refusal(answer: bytes) -> str:
    """What stands in the place of what was asked for."""
    try:
        reply = Reply.model_validate_json(answer)
    except ValidationError:
        return "what answers there is of another version than this command"
    return "; ".join([reply.text, *reply.reasons])

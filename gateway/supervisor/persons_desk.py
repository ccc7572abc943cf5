"""What people say through OPC UA and the page: held against their role once more, recorded, and handed on."""

from collections.abc import Awaitable, Callable

from pydantic import ValidationError

from gateway.core.alarms import AlarmSaid
from gateway.core.audit_record import Who
from gateway.core.decisions import Archive, Confirm, Decide, LineChanged, RollBackNow
from gateway.core.messages import Reply, command_bytes
from gateway.core.people import FOR_PERSON, why_may_not
from gateway.core.topics import GATEWAY_FOR_PERSON
from gateway.mailbox.port import PEER, Mailbox
from gateway.mailbox.rights import OVERTAKES
from gateway.supervisor.bounded import Bounded, with_left_out
from gateway.supervisor.operated import Operated
from gateway.supervisor.peers import who_is
from gateway.supervisor.said_inbox import COMMAND_EVENT, OF_PEOPLE, SaidInbox

A_PROGRAM = "a program"  #: that decides in a person's place, as the audit has it before its user's name

Decision = Decide | RollBackNow | Archive | LineChanged | Confirm


class PersonsDesk:
    """A handler on a mailbox."""

    def __init__(
        self,
        mailbox: Mailbox,
        command: Callable[[bytes, Who], Awaitable[Reply]],
        decide: Callable[[Decision, Who, int | None], Awaitable[Reply]],
        alarm: Callable[[AlarmSaid, Who], Awaitable[Reply]],
        operated: Operated,
        clock: Callable[[], float],
        event: Callable[..., None] = lambda *_, **__: None,
    ) -> None:
        """`decide` is told what was left out, too.

        `event`: of the gateway: kind, text and data.
        """
        self._command = command
        self._decide = decide
        self._alarm = alarm
        self._operated = operated
        self._refusals = Bounded(clock)
        self._inbox = SaidInbox(COMMAND_EVENT, OF_PEOPLE, clock, event)
        mailbox.serve(GATEWAY_FOR_PERSON, self._answer)

    async def _answer(self, payload: bytes) -> bytes:
        try:
            asked = FOR_PERSON.validate_json(payload)
        except ValidationError as error:
            reasons = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
            return _reply(Reply(ok=False, state="", text="not understood", reasons=reasons[:20]))
        person, said = asked.person, asked.said
        who = who_is(person, PEER.get())
        safe = said.command in OVERTAKES or isinstance(said, RollBackNow)
        if not safe and (refusal := self._inbox.refuse(who, len(payload))) is not None:
            return _reply(refusal)
        if reason := why_may_not(person, said.command):
            if (left_out := self._refusals.left_out(who.name)) is not None:
                what = with_left_out({"command": said.command, "because": reason}, left_out)
                await self._operated.recorded("refused-person", said.command, who, what, self._refusals, left_out)
            return _reply(Reply(ok=False, state="", text=reason, reasons=[reason]))
        if isinstance(said, Decide) and person.is_script:
            said = said.model_copy(update={"script": said.script or A_PROGRAM})
        left_out = self._operated.said.left_out(who.name)
        if left_out is None and isinstance(said, Decision | AlarmSaid) and not isinstance(said, RollBackNow):
            text = f"{person.name} says too much at once: try again in a minute"
            return _reply(Reply(ok=False, state="", text=text, reasons=[text]))
        if isinstance(said, Decision):
            return _reply(await self._decide(said, who, left_out))
        if isinstance(said, AlarmSaid):
            return _reply(await self._alarm(said, who))
        # First the line, then the record: a stop never waits for a disk, and is done whatever was said before.
        reply = await self._command(command_bytes(said), who)
        return _reply(await self._operated.keep(said, reply, who, left_out))


def _reply(reply: Reply) -> bytes:
    return reply.model_dump_json().encode()

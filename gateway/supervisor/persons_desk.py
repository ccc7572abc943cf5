"""What people say through OPC UA and the page: held against their role once more, recorded, and handed on."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from pydantic import ValidationError

from gateway.core.alarms import AlarmSaid
from gateway.core.audit_record import Who
from gateway.core.decisions import Archive, Confirm, Decide, LineChanged, RollBackNow
from gateway.core.messages import Command, Reply, command_bytes, in_words
from gateway.core.people import FOR_PERSON, why_may_not
from gateway.core.topics import GATEWAY_FOR_PERSON
from gateway.mailbox.port import PEER, Mailbox
from gateway.mailbox.rights import OVERTAKES
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.bounded import Bounded, with_left_out
from gateway.supervisor.peers import who_is
from gateway.supervisor.said_inbox import COMMAND_EVENT, OF_PEOPLE, SaidInbox

#: What one person can have recorded: more than any hand does, and little enough for a disk.
MOST_SAID, SAID_EVERY_S = 600, 1.0
RECORDED_S = 0.15  #: that the answer to a stop or a hold waits for its record, which is made all the same
A_PROGRAM = "a program"  #: that decides in a person's place, as the audit has it before its user's name

Decision = Decide | RollBackNow | Archive | LineChanged | Confirm


class PersonsDesk:
    """A handler on a mailbox; `close` at the end."""

    def __init__(
        self,
        mailbox: Mailbox,
        command: Callable[[bytes, Who], Awaitable[Reply]],
        decide: Callable[[Decision, Who, int | None], Awaitable[Reply]],
        alarm: Callable[[AlarmSaid, Who], Awaitable[Reply]],
        note: Callable[[str, Who, Mapping[str, Any]], Awaitable[object]],
        clock: Callable[[], float],
        event: Callable[..., None] = lambda *_, **__: None,
    ) -> None:
        """`note` appends a record to the audit; raises AuditUnavailable. `decide` is told what was left out, too.

        `event`: of the gateway: kind, text and data.
        """
        self._command = command
        self._decide = decide
        self._alarm = alarm
        self._note = note
        self._refusals = Bounded(clock)
        self._said = Bounded(clock, MOST_SAID, SAID_EVERY_S)
        self._event = event
        self._inbox = SaidInbox(COMMAND_EVENT, OF_PEOPLE, clock, event)
        self._recording: set[asyncio.Task[str]] = set()
        mailbox.serve(GATEWAY_FOR_PERSON, self._answer)

    async def close(self) -> None:
        """What was answered before it was on record is on record, or nobody could."""
        await asyncio.gather(*self._recording, return_exceptions=True)

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
                await self._recorded("refused-person", said.command, who, what, self._refusals, left_out)
            return _reply(Reply(ok=False, state="", text=reason, reasons=[reason]))
        if isinstance(said, Decide) and person.is_script:
            said = said.model_copy(update={"script": said.script or A_PROGRAM})
        left_out = self._said.left_out(who.name)
        if left_out is None and isinstance(said, Decision | AlarmSaid) and not isinstance(said, RollBackNow):
            text = f"{person.name} says too much at once: try again in a minute"
            return _reply(Reply(ok=False, state="", text=text, reasons=[text]))
        if isinstance(said, Decision):
            return _reply(await self._decide(said, who, left_out))
        if isinstance(said, AlarmSaid):
            return _reply(await self._alarm(said, who))
        return _reply(await self._operate(said, who, left_out))

    async def _operate(self, said: Command, who: Who, left_out: int | None) -> Reply:
        """First the line, then the record: a stop never waits for a disk, and is done whatever was said before."""
        reply = await self._command(command_bytes(said), who)
        if left_out is None:
            return reply
        what = with_left_out({"command": in_words(said), "done": reply.ok, "answer": reply.text}, left_out)
        unkept = await self._recorded("operated", said.command, who, what, self._said, left_out)
        return reply.model_copy(update={"text": f"{reply.text}{unkept}"}) if unkept else reply

    async def _recorded(
        self, kind: str, command: str, who: Who, what: Mapping[str, Any], bounded: Bounded, left_out: int
    ) -> str:
        """Empty once it is on record; else that it is not, or not yet, to be told."""
        task = asyncio.create_task(self._record(kind, who, what, bounded, left_out))
        self._recording.add(task)
        task.add_done_callback(self._recording.discard)
        await asyncio.wait((task,), timeout=RECORDED_S if command in OVERTAKES else None)
        if task.done():
            return task.result()
        task.add_done_callback(self._tell_unkept)
        return "; its record waits for the disk"

    async def _record(self, kind: str, who: Who, what: Mapping[str, Any], bounded: Bounded, left_out: int) -> str:
        if unkept := await self._kept(kind, who, what):
            bounded.undo(who.name, left_out + 1)
        return unkept

    def _tell_unkept(self, task: asyncio.Task[str]) -> None:
        """Of what was answered before."""
        if not task.cancelled() and (unkept := task.result()):
            self._event(COMMAND_EVENT, f"a stop or a hold was answered{unkept}", ok=False)

    async def _kept(self, kind: str, who: Who, what: Mapping[str, Any]) -> str:
        """Empty where it is; else that it is not, to be told."""
        try:
            await self._note(kind, who, what)
        except AuditUnavailable as error:
            return f"; it could not be recorded: {error}"
        return ""


def _reply(reply: Reply) -> bytes:
    return reply.model_dump_json().encode()

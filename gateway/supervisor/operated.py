"""What was said to the line, on record: first the line, then the record, and so many of each who says it."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from gateway.core.audit_record import Who
from gateway.core.messages import Command, Reply, in_words
from gateway.mailbox.rights import OVERTAKES
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.bounded import Bounded, with_left_out
from gateway.supervisor.said_inbox import COMMAND_EVENT

#: What one person, or one local user, can have recorded: more than any hand does, and little enough for a disk.
MOST_SAID, SAID_EVERY_S = 600, 1.0
RECORDED_S = 0.15  #: that the answer to a stop or a hold waits for its record, which is made all the same
#: What is no such record of a local process: a stop has its own, and the other changes nothing.
NOT_RECORDED = frozenset(("stop", "configuration"))

Note = Callable[[str, Who, Mapping[str, Any]], Awaitable[object]]


class Operated:
    """What waits for the disk is on record at `close`, or nobody could record it."""

    def __init__(
        self, note: Note, clock: Callable[[], float], event: Callable[..., None] = lambda *_, **__: None
    ) -> None:
        """`note` appends a record to the audit; raises AuditUnavailable. `event`: kind, text and data."""
        self._note = note
        self._event = event
        self.said = Bounded(clock, MOST_SAID, SAID_EVERY_S)  #: by who says it
        self._recording: set[asyncio.Task[str]] = set()

    async def close(self) -> None:
        await asyncio.gather(*self._recording, return_exceptions=True)

    async def keep_local(self, said: Command, reply: Reply, who: Who) -> Reply:
        """As `keep`, of what a local process has said."""
        if said.command in NOT_RECORDED:
            return reply
        return await self.keep(said, reply, who, self.said.left_out(who.name))

    async def keep(self, said: Command, reply: Reply, who: Who, left_out: int | None) -> Reply:
        """What the line has answered, with that it could not be recorded where so. `left_out`: None: it is, too."""
        if left_out is None:
            return reply
        what = with_left_out({"command": in_words(said), "done": reply.ok, "answer": reply.text}, left_out)
        unkept = await self.recorded("operated", said.command, who, what, self.said, left_out)
        return reply.model_copy(update={"text": f"{reply.text}{unkept}"}) if unkept else reply

    async def recorded(
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
        try:
            await self._note(kind, who, what)
        except AuditUnavailable as error:
            bounded.undo(who.name, left_out + 1)
            return f"; it could not be recorded: {error}"
        return ""

    def _tell_unkept(self, task: asyncio.Task[str]) -> None:
        """Of what was answered before."""
        if not task.cancelled() and (unkept := task.result()):
            self._event(COMMAND_EVENT, f"a stop or a hold was answered{unkept}", ok=False)

"""Records of what the loop tells: bounded by kind, written aside, so that neither a flood nor a slow disk holds up."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from gateway.core.audit_record import Who
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.bounded import Bounded, with_left_out

Append = Callable[[str, Who, Mapping[str, Any]], Awaitable[object]]


class LoopRecords:
    """`write` at an event, `close` at the end."""

    def __init__(self, append: Append, note: Callable[..., None], clock: Callable[[], float]) -> None:
        self._append = append
        self._note = note
        self._bounded = Bounded(clock)
        self._recording: set[asyncio.Task[None]] = set()

    def write(self, kind: str, who: Who, what: dict[str, object]) -> None:
        """What comes too often is counted, and told with the next."""
        if (left_out := self._bounded.left_out(kind)) is None:
            return
        task = asyncio.get_running_loop().create_task(self._record(kind, who, with_left_out(what, left_out), left_out))
        self._recording.add(task)
        task.add_done_callback(self._recording.discard)

    async def close(self) -> None:
        await asyncio.gather(*self._recording, return_exceptions=True)

    async def _record(self, kind: str, who: Who, what: Mapping[str, Any], left_out: int) -> None:
        try:
            await self._append(kind, who, what)
        except AuditUnavailable as error:
            self._bounded.undo(kind, left_out + 1)
            self._note("gate", f"what the loop told could not be recorded ({kind}): {error}")

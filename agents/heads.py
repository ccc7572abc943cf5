"""The heads of the line's audit, kept beside the agents: on another machine whoever rewrites the audit cannot take them
back. `r2rgate audit verify --against FILE` holds the audit against every one of them.
"""

import asyncio
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

from gateway.core.audit_head import AuditHead, kept_line, last_kept, parse_head, thinned
from gateway.core.topics import ASK_STATUS, AgentName
from gateway.files import read_bytes, written_beside
from gateway.mailbox.port import Mailbox, Unreachable

FILE = "audit-heads.txt"
ASK_S = 10.0  #: from one look to the next
ANSWER_S = 5.0
MOST_BYTES = 2**18  #: beyond it of each day but the newest lines one is kept


class Heads:
    """`keep_up` beside all else: what fails here is told once, and tried again."""

    def __init__(self, bus: Mailbox, agent: AgentName, line: str, path: Path, tell: Callable[[str], None]) -> None:
        self._bus = bus
        self._agent: AgentName = agent
        self._line = line
        self._path = path
        self._tell = tell
        self._told = ""
        self._last: AuditHead | None = None

    async def keep_up(self, pause_s: float = ASK_S) -> None:
        while True:
            trouble = ""
            try:
                answer = await self._bus.request(ASK_STATUS.of(self._agent), b"", ANSWER_S)
                if told := json.loads(answer)["audit_head"]:
                    await asyncio.to_thread(self.keep, parse_head(told), time.time())
            except Unreachable:
                pass  # nothing is recorded that could be kept
            except OSError as error:
                trouble = f"the heads of the audit are not kept: {self._path}: {error.strerror}"
            except (ValueError, KeyError, TypeError, RecursionError):
                trouble = "the heads of the audit are not kept: the gateway tells none as this version does"
            if trouble and trouble != self._told:
                self._tell(trouble)
            self._told = trouble
            await asyncio.sleep(pause_s)

    def keep(self, head: AuditHead, wall_s: float) -> None:
        """On the disk when this returns, where it is another than the last. Raises OSError."""
        if self._last is None:
            self._last = last_kept(self._read())
        last = self._last
        if head == last:
            return
        if last is not None and head.sequence <= last.sequence:
            self._tell(f"the audit's head is {head} now, and was {last}: it was made anew, or records are lost")
        self._path.parent.mkdir(parents=True, exist_ok=True)
        if self._path.exists() and self._path.stat().st_size > MOST_BYTES:
            written_beside(self._path, thinned(self._read()).encode(), 0o600).replace(self._path)
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        torn = self._read()[-1:] not in ("", "\n")  # a line that a cut of the power left unfinished
        with os.fdopen(os.open(self._path, flags, 0o600), "wb") as stream:
            stream.write(b"\n" * torn + kept_line(head, self._line, wall_s).encode())
            stream.flush()
            os.fsync(stream.fileno())
        self._last = head

    def _read(self) -> str:
        try:
            return read_bytes(self._path, 2 * MOST_BYTES).decode("utf-8", "replace")
        except FileNotFoundError:
            return ""

"""The audit as the gateway uses it: a record is on the disk before what it announces is done.

`append` returns when the record is stored for good, or raises AuditUnavailable; then nothing may be changed, and the
loop runs on. One thread writes; what waits is committed together, and each waits for its own. Who gives up waiting is
noted: a record of kind "not-done" names what was stored without anybody having been told.
"""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Future, InvalidStateError
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gateway.core.audit_record import BEFORE_FIRST, NotRecordable, Who, record_of
from gateway.supervisor.audit_anchor import NOTHING_YET, Anchor
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.audit_verify import MOST_AT_ONCE
from gateway.supervisor.audit_writer import NOT_DONE, NOT_TOLD, AuditWriter, Draft, this_process

#: Kinds of record that come as often as people, agents and strangers like. All others are decisions, or their ends.
OFTEN = frozenset(
    (
        "agents",
        "logged-in",
        "operated",
        "refused-person",
        "refused-decision",
        "wrong-logins",
        "received",
        "refused",
        "judged",
        "line-stopped",
    )
)  # fmt: skip
MOST_WAITING = 1000
MOST_BLOB_BYTES = 16 * 2**20
WITHIN_S = 10.0  #: longer than SQLite waits for a reader


@dataclass(frozen=True)
class AuditState:
    available: bool
    text: str  #: one sentence for a person
    last: Anchor  #: number and head of the last record
    decided: int = 0  #: number of the last record of a decision, or of what came of one


@dataclass(frozen=True)
class _Waiting:
    draft: Draft
    stored: "Future[Anchor]"  #: whoever settles it first, the writer or the one who gives up, has decided


class Audit:
    """`start`, then `append` from any event loop, or `append_and_wait` from any thread; `close` at the end."""

    def __init__(
        self,
        folder: Path,
        *,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        within_s: float = WITHIN_S,
    ) -> None:
        self.folder = folder
        self._within_s = within_s
        self._writer = AuditWriter(folder, clock, wall_clock)  # the thread's own
        self._queue: deque[_Waiting] = deque()
        self._given_up: list[int] = []  #: stored, nobody was told, and not noted yet
        self._too_late: list[int] = []  #: of these, that the writer has not heard of
        self._changed = threading.Condition()
        self._closing = False
        self._decided = 0
        self._state = AuditState(False, "starting", NOTHING_YET)
        self._thread = threading.Thread(target=self._live, name="audit", daemon=True)

    def start(self) -> None:
        """Opens and verifies in its own thread; `state` tells how that went."""
        self._thread.start()

    async def append(
        self, kind: str, who: Who, what: Mapping[str, Any], blobs: Mapping[str, bytes] | None = None
    ) -> Anchor:
        """Store a record. Returns its number and head once it is on the disk.

        `what` is JSON of at most 64 kB; what is large goes into `blobs`, by the part that it plays, each at most 16 MB,
        and is stored once however often it is referred to. Raises AuditUnavailable, and NotRecordable at once.
        """
        stored = self._submit(kind, who, what, blobs or {})
        try:
            async with asyncio.timeout(self._within_s):
                return await asyncio.wrap_future(stored)
        except asyncio.CancelledError:
            if not stored.cancel() and stored.exception() is None:  # the writer has settled it: noted as the others are
                self._give_up(stored.result())
            raise
        except TimeoutError:
            stored.cancel()
            return self._settled(stored)

    def append_and_wait(
        self, kind: str, who: Who, what: Mapping[str, Any], blobs: Mapping[str, bytes] | None = None
    ) -> Anchor:
        """As `append`, from a thread without an event loop."""
        stored = self._submit(kind, who, what, blobs or {})
        try:
            return stored.result(self._within_s)
        except TimeoutError:
            stored.cancel()
            return self._settled(stored)

    def state(self) -> AuditState:
        return self._state

    def close(self, timeout_s: float = WITHIN_S) -> bool:
        """Store what waits, and end. False: the disk did not answer in time."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _submit(self, kind: str, who: Who, what: Mapping[str, Any], blobs: Mapping[str, bytes]) -> "Future[Anchor]":
        draft = _checked(kind, who, what, blobs)
        with self._changed:
            if self._closing:
                raise AuditUnavailable("the audit has been closed: the gateway ends")
            if len(self._queue) >= MOST_WAITING:
                raise AuditUnavailable(f"{MOST_WAITING} records wait for the disk of {self.folder}: it does not answer")
            one = _Waiting(draft, Future())
            self._queue.append(one)
            self._changed.notify()
        return one.stored

    def _give_up(self, at: Anchor) -> None:
        """Whoever asked for this one is not told any more that it is stored."""
        with self._changed:
            self._too_late.append(at.sequence)
            self._changed.notify()

    def _settled(self, stored: "Future[Anchor]") -> Anchor:
        """What became of a record that was waited for too long."""
        try:
            return stored.result(0.0)  # it was stored in the last moment
        except CancelledError:
            raise AuditUnavailable(
                f"the disk of {self.folder} did not answer within {self._within_s:g} s: nothing may be changed"
            ) from None

    def _live(self) -> None:
        try:
            self._store([])  # opens
            while (batch := self._take()) is not None:
                self._store(batch)
        finally:
            self._writer.close()

    def _take(self) -> list[_Waiting] | None:
        """What waits; nothing: only such as nobody was told of. None: it is time to end."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._too_late or self._closing)
            if not self._queue and not self._too_late:
                return None
            self._given_up += self._too_late
            self._too_late.clear()
            return [self._queue.popleft() for _ in range(min(MOST_AT_ONCE, len(self._queue)))]

    def _store(self, batch: list[_Waiting]) -> None:
        batch = [one for one in batch if not one.stored.cancelled()]
        try:
            stored = self._writer.append([one.draft for one in batch])
        except Exception as error:
            self._refuse(batch, error)
            return
        decided = [at.sequence for one, at in zip(batch, stored, strict=True) if one.draft.kind not in OFTEN]
        self._decided = max([self._decided, *decided])
        self._state = self._recording()
        self._given_up += [at.sequence for one, at in zip(batch, stored, strict=True) if not _tell(one.stored, at)]
        self._note_given_up()

    def _refuse(self, batch: list[_Waiting], error: Exception) -> None:
        unavailable = error if isinstance(error, AuditUnavailable) else AuditUnavailable(f"the audit failed: {error!r}")
        self._state = AuditState(False, str(unavailable), self._writer.last, self._decided)
        for one in batch:
            if not one.stored.cancelled():
                try:
                    one.stored.set_exception(AuditUnavailable(str(unavailable)))
                except InvalidStateError:
                    pass  # given up meanwhile

    def _note_given_up(self) -> None:
        if not self._given_up:
            return
        what = {"sequences": list(self._given_up), "because": NOT_TOLD}
        try:
            self._writer.append([Draft(NOT_DONE, this_process(), what)])
        except Exception as error:
            self._refuse([], error)  # it is noted with the next one
            return
        self._given_up.clear()
        self._state = self._recording()

    def _recording(self) -> AuditState:
        return AuditState(True, "recording", self._writer.last, self._decided)


def _tell(stored: "Future[Anchor]", at: Anchor) -> bool:
    """False: nobody waits any more."""
    try:
        stored.set_result(at)
    except InvalidStateError:
        return False
    return True


def _checked(kind: str, who: Who, what: Mapping[str, Any], blobs: Mapping[str, bytes]) -> Draft:
    """Raises NotRecordable."""
    for part, payload in blobs.items():
        if len(payload) > MOST_BLOB_BYTES:
            raise NotRecordable(f"the blob {part} has {len(payload)} bytes; allowed: {MOST_BLOB_BYTES}")
    record = record_of(
        {
            "sequence": 1,
            "wall_s": 0.0,
            "monotonic_s": 0.0,
            "boot": "",
            "kind": kind,
            "who": who,
            "what": dict(what),
            "blobs": dict.fromkeys(blobs, BEFORE_FIRST),  # their heads are made by the thread that writes
            "previous": BEFORE_FIRST,
        }
    )
    return Draft(kind, who, record.what, dict(blobs))

"""The historian: keeps every telemetry frame and event of a line, in a thread of its own.

Every FLUSH_S what is new is handed to the kernel, so that a SIGKILL loses at most that and the time of one write.
Nothing here raises into the process or makes it wait. When the disk is full, slow or gone, or the file is damaged, the
historian stops storing, says so in its health, keeps what is new as far as memory allows, and goes on when it can. A
damaged file is moved aside and kept.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import apsw

from gateway.core.line import History
from gateway.core.messages import Event
from gateway.core.steady_clock import SteadyClock
from gateway.core.telemetry import frame_dtype
from gateway.supervisor.retention import Retention, retention_of
from gateway.supervisor.store import NotOurs, Run, boot_id
from gateway.supervisor.writer import BLOB_S, DiskFull, Writer

FILE_NAME = "history.sqlite"
FLUSH_S = 0.8
STALLED_S = 3.0  #: a turn that takes longer than this: the disk does not answer
MAX_WAITING_BYTES = 32 * 2**20  #: frames that wait for the disk; beyond it what comes is lost
MAX_WAITING_EVENTS = 10_000
KEPT = retention_of(History())
RESERVE_BYTES = 64 * 2**20  #: left free on the disk, for the rest of the machine


@dataclass(frozen=True, slots=True)
class Health:
    storing: bool
    text: str  #: one sentence for a person
    frames_stored: int = 0
    frames_lost: int = 0  #: came while nothing could be stored and memory was full
    events_lost: int = 0
    last_stored_s: float | None = None  #: monotonic: what had come until then is stored
    moved_aside: str = ""  #: where the last damaged file is kept


class Historian:
    """`start`, then `frame` and `event` from any one thread, `close` at the end."""

    def __init__(
        self,
        folder: Path,
        site: str,
        line: str,
        spans: int,
        *,
        retention: Retention = KEPT,
        reserve_bytes: int = RESERVE_BYTES,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self.path = folder / FILE_NAME
        self._retention = retention
        self._clock = clock
        self._wall_clock = wall_clock
        now_s = clock()
        run = Run(boot_id(), now_s, wall_clock() - now_s, site, line, spans)
        self._steady = SteadyClock(clock, wall_clock, run.boot)
        self._writer = Writer(self.path, run, reserve_bytes)  # the thread's own
        self._max_frames = MAX_WAITING_BYTES // frame_dtype(spans).itemsize
        # Between the two threads: append and popleft are atomic, the health is replaced as a whole by the historian's
        # thread, and each counter has one writer.
        self._frames: deque[bytes] = deque()
        self._events: deque[Event] = deque()
        self._new_frames: list[bytes] = []  # taken off the queue, not committed yet
        self._new_events: list[Event] = []
        self._frames_lost = 0
        self._events_lost = 0
        self._turn_began_s: float | None = None
        self._health = Health(False, "starting")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._live, name="historian", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def frame(self, payload: bytes) -> None:
        """A well-formed telemetry frame of this line. Never waits; counted as lost when memory is full."""
        if len(self._frames) + len(self._new_frames) < self._max_frames:
            self._frames.append(payload)
        else:
            self._frames_lost += 1

    def event(self, event: Event) -> None:
        """Never waits; counted as lost when memory is full."""
        if len(self._events) + len(self._new_events) < MAX_WAITING_EVENTS:
            self._events.append(event)
        else:
            self._events_lost += 1

    def health(self) -> Health:
        began_s = self._turn_began_s
        stalled = began_s is not None and self._clock() - began_s > STALLED_S
        text = "not storing: the disk does not answer; see the system's log"
        health = self._health
        return replace(
            health,
            storing=health.storing and not stalled,
            text=text if stalled else health.text,
            frames_lost=health.frames_lost + self._frames_lost,
            events_lost=health.events_lost + self._events_lost,
        )

    def close(self, timeout_s: float = 5.0) -> bool:
        """Store what is left and end the thread. False when the disk did not let it finish in time."""
        self._stop.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _live(self) -> None:
        stopping = False
        while not stopping:
            stopping = self._stop.wait(FLUSH_S)
            self._turn_began_s = self._clock()
            self._turn(stopping)
            self._turn_began_s = None
        with suppress(apsw.Error):  # what was stored lies in the log or the tail and is found again
            self._writer.close()

    def _turn(self, finish: bool) -> None:
        until_s = self._clock()
        self._steady.look()
        _move(self._frames, self._new_frames)
        _move(self._events, self._new_events)
        idle = not self._new_frames
        try:
            wall_ahead_s = self._wall_clock() - self._clock()
            self._writer.store(self._new_frames, self._new_events, wall_ahead_s)
            self._stored(until_s)
            if finish or idle or self._writer.gathered_s() >= BLOB_S:
                self._pack()
        except Exception as error:  # the thread must outlive whatever happens to the disk
            self._recover(error)

    def _pack(self) -> None:
        """Whoever holds the database for a while delays this alone: what is new lies in the tail."""
        try:
            self._writer.pack()
            if self._steady.agreed_ahead_s is not None:
                self._writer.date(self._steady.agreed_ahead_s)
            self._writer.expire(self._retention, self._clock())
        except apsw.BusyError as error:
            self._health = replace(self._health, text=f"storing, beside the history: {_explain(error)}")

    def _stored(self, until_s: float) -> None:
        something = self._new_frames or self._new_events
        self._health = replace(
            self._health,
            storing=True,
            text="storing",
            frames_stored=self._health.frames_stored + len(self._new_frames),
            last_stored_s=until_s if something else self._health.last_stored_s,
        )
        self._new_frames.clear()
        self._new_events.clear()

    def _recover(self, error: Exception) -> None:
        text = _explain(error)
        if not isinstance(error, (apsw.Error, OSError, DiskFull, NotOurs)):
            self._discard()
        if not isinstance(error, DiskFull):
            with suppress(apsw.Error):
                self._writer.disconnect()  # begin from the file the next time
        if isinstance(error, (apsw.CorruptError, apsw.NotADBError)):
            try:
                kept = move_aside(self.path, self._wall_clock())
                text = f"the history was damaged and is kept as {kept}; a new one is begun"
                self._health = replace(self._health, moved_aside=str(kept))
            except OSError as second:
                text = f"the history is damaged ({error}) and cannot be moved aside: {second}"
        self._health = replace(self._health, storing=False, text=f"not storing: {text}")

    def _discard(self) -> None:
        """Not the disk but something in the batch is at fault: it must not come back for ever."""
        self._health = replace(
            self._health,
            frames_lost=self._health.frames_lost + len(self._new_frames),
            events_lost=self._health.events_lost + len(self._new_events),
        )
        self._new_frames.clear()
        self._new_events.clear()


def _move(queue: deque[Any], onto: list[Any]) -> None:
    for _ in range(len(queue)):
        onto.append(queue.popleft())


def move_aside(path: Path, wall_s: float) -> Path:
    """Rename a damaged history and its write-ahead log, never onto an older one. Returns where it lies now.

    Its tail stays: that is sound, and goes into the next one.
    """
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(wall_s))
    kept = path.with_name(f"{path.stem}-damaged-{stamp}{path.suffix}")
    number = 1
    while kept.exists():
        number += 1
        kept = path.with_name(f"{path.stem}-damaged-{stamp}-{number}{path.suffix}")
    for ending in ("-wal", "-shm"):
        companion = path.with_name(path.name + ending)
        if companion.exists():
            companion.rename(kept.with_name(kept.name + ending))
    path.rename(kept)
    return kept


def _explain(error: Exception) -> str:
    if isinstance(error, (DiskFull, apsw.FullError)):
        return f"the disk is full ({error}): free some space, storing goes on by itself"
    if isinstance(error, NotOurs):
        return str(error)
    if isinstance(error, apsw.BusyError):
        return "another program holds the history's lock: close it, storing goes on by itself"
    if isinstance(error, (apsw.ReadOnlyError, apsw.CantOpenError, PermissionError)):
        return f"the history cannot be written ({error}): check the data folder's owner and rights"
    return f"{type(error).__name__}: {error}"

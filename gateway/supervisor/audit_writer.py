"""Appends to the audit: records and their blobs in one transaction, then the anchor. One thread at a time.

It writes only upon what it has verified: the tail of the chain and the anchor agree. What does not is left as it is.
"""

import fcntl
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gateway.core.audit_record import BEFORE_FIRST, AuditRecord, Who, canonical, head_of
from gateway.storage.sqlite_file import begin, open_there, told, transaction
from gateway.supervisor.audit_anchor import FILE_NAME as ANCHOR
from gateway.supervisor.audit_anchor import NOTHING_YET, Anchor, AnchorDamaged, read_anchor, write_anchor
from gateway.supervisor.audit_file import FILE_NAME, KIND, WHAT_TO_DO, AuditFile, AuditUnavailable
from gateway.supervisor.audit_verify import against_anchor, chained
from gateway.supervisor.store import boot_id

LOCK = "audit.lock"
TAIL = 100  #: records before the anchor's that are verified at opening
BEGUN, NOT_DONE = "begun", "not-done"  #: the kinds of record that the audit itself makes
NOT_TOLD = "whoever asked for these records was not told that they are stored: what they announce was not done"


@dataclass(frozen=True)
class Draft:
    """A record to be: it gets its number, time and predecessor when it is written."""

    kind: str
    who: Who
    what: Mapping[str, Any]
    blobs: Mapping[str, bytes] = field(default_factory=dict[str, bytes])


def this_process() -> Who:
    return Who(name="r2rgate gateway", uid=os.getuid(), pid=os.getpid())


class AuditWriter:
    """`append`, and `close` at the end. Every method raises AuditUnavailable; then nothing that it was given counts."""

    def __init__(
        self,
        folder: Path,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self.folder = folder
        self.path = folder / FILE_NAME
        self._clock = clock
        self._wall_clock = wall_clock
        self._boot = boot_id()
        self._lock: int | None = None
        self._file: AuditFile | None = None
        self._inode: int | None = None
        self._last = NOTHING_YET  #: of the open file, committed and anchored
        self._known = NOTHING_YET  #: the last that this process has stored itself: it is in the file for ever

    @property
    def last(self) -> Anchor:
        """The last record that is stored for good."""
        return self._last

    def append(self, drafts: Sequence[Draft]) -> list[Anchor]:
        """Store records, in one transaction. Returns their numbers and heads once they are on the disk, and anchored.

        Given none it opens and verifies, and begins where there is nothing at all.
        """
        try:
            with told(self.path, KIND):
                return self._append(self._ready(), drafts)
        except BaseException:
            self.disconnect()  # whatever came of it: the next one verifies before it writes
            raise

    def begin(self, what: Mapping[str, Any], who: Who) -> Anchor:
        """Begin in a folder out of which the audit was moved, at a person's command."""
        self.lock()
        self._begin(what, who)
        return self._last

    def disconnect(self) -> None:
        """Close the database; the next `append` opens and verifies it again."""
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def close(self) -> None:
        self.disconnect()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def lock(self) -> None:
        """Be the only one who writes, until `close`. Raises AuditUnavailable where another process does."""
        if self._lock is not None:
            return
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(self.folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise AuditUnavailable(
                f"another process writes the audit in {self.folder}: a gateway runs, or one is beginning anew"
            ) from None
        except BaseException:
            os.close(descriptor)
            raise
        self._lock = descriptor

    def _ready(self) -> AuditFile:
        if self._file is not None and self._still_there():
            return self._file
        self.disconnect()
        self.lock()
        self._connect()
        assert self._file is not None
        return self._file

    def _connect(self) -> None:
        try:
            anchor = read_anchor(self.folder)
        except AnchorDamaged as error:
            raise AuditUnavailable(f"{error}. {WHAT_TO_DO}") from error
        if self._known.sequence and anchor in (None, NOTHING_YET):
            raise AuditUnavailable(f"the audit in {self.folder} is gone: {_made_anew(self._known)}")
        if anchor is None:
            if traces := _traces(self.folder):
                raise AuditUnavailable(
                    f"{self.folder / ANCHOR} is missing, but {', '.join(traces)} is there: nobody can tell whether "
                    f"records are lost. {WHAT_TO_DO}"
                )
            self._begin({"because": "there was no audit here"}, this_process())
        elif anchor == NOTHING_YET and not self._holds_records():
            # Interrupted when it was begun; what was moved aside then is named.
            self._begin({"because": "there was no record here", "kept": _traces(self.folder)}, this_process())
        else:
            self._resume(anchor)

    def _begin(self, what: Mapping[str, Any], who: Who) -> None:
        # The anchor first: from now on an absent database is one that was lost, or has no record yet.
        self._anchor(NOTHING_YET)
        self._use(AuditFile(self.folder, begin(self.path, KIND)), NOTHING_YET)
        assert self._file is not None
        self._append(self._file, [Draft(BEGUN, who, what)])

    def _resume(self, anchor: Anchor) -> None:
        if not self.path.exists():
            raise AuditUnavailable(
                f"{self.path} is missing; {ANCHOR} says that {anchor.sequence} records were stored. {WHAT_TO_DO}"
            )
        self._use(AuditFile(self.folder, open_there(self.path, KIND)), anchor)
        assert self._file is not None
        last, not_told = _verify_tail(self._file, anchor)
        if self._known.sequence and not _holds(self._file, self._known):
            raise AuditUnavailable(f"the audit in {self.folder} is another one: {_made_anew(self._known)}")
        if last != anchor:
            self._anchor(anchor)  # where none can be written now, no note is added at each attempt
            # Noted first, anchored with the note: interrupted in between, it is noted again.
            self._last = last
            self._append(self._file, [Draft(NOT_DONE, this_process(), {"sequences": not_told, "because": NOT_TOLD})])

    def _use(self, file: AuditFile, last: Anchor) -> None:
        self._file, self._last = file, last
        self._inode = self.path.stat().st_ino

    def _holds_records(self) -> bool:
        if not self.path.is_file() or not self.path.stat().st_size:
            return False
        with AuditFile(self.folder, begin(self.path, KIND)) as file:
            return file.last() > 0

    def _append(self, file: AuditFile, drafts: Sequence[Draft]) -> list[Anchor]:
        if not drafts:
            return []
        stored: list[Anchor] = []
        last = self._last
        with transaction(file.connection):
            for draft in drafts:
                content = canonical(self._record(draft, last))
                last = Anchor(last.sequence + 1, head_of(content))
                for payload in draft.blobs.values():
                    _store_blob(file, payload)
                file.connection.execute(
                    "INSERT INTO record (sequence, content, head) VALUES (?, ?, ?)", (last.sequence, content, last.head)
                )
                stored.append(last)
        self._anchor(last)
        self._known = last
        return stored

    def _anchor(self, last: Anchor) -> None:
        try:
            write_anchor(self.folder, last)
        except OSError as error:
            raise AuditUnavailable(
                f"{self.folder / ANCHOR} cannot be written: {error.strerror}: {KIND.undone}. Look whether the disk is "
                "full, broken, or read-only"
            ) from error
        self._last = last

    def _record(self, draft: Draft, last: Anchor) -> AuditRecord:
        return AuditRecord(
            sequence=last.sequence + 1,
            wall_s=self._wall_clock(),
            monotonic_s=self._clock(),
            boot=self._boot,
            kind=draft.kind,
            who=draft.who,
            what=dict(draft.what),
            blobs={part: head_of(payload) for part, payload in draft.blobs.items()},
            previous=last.head,
        )

    def _still_there(self) -> bool:
        try:
            return self.path.stat().st_ino == self._inode
        except FileNotFoundError:
            return False


def _store_blob(file: AuditFile, payload: bytes) -> None:
    id_ = head_of(payload)
    file.connection.execute("INSERT INTO blob (id, content) VALUES (?, ?) ON CONFLICT DO NOTHING", (id_, payload))
    if not file.connection.changes() and file.blob(id_) is None:
        raise AuditUnavailable(f"{file.path} is damaged: blob {id_} is not what was stored. {WHAT_TO_DO}")


def _holds(file: AuditFile, known: Anchor) -> bool:
    row = next(file.rows(known.sequence), None)
    return row is not None and Anchor(row.sequence, row.head) == known


def _made_anew(known: Anchor) -> str:
    """Database and anchor may agree: whoever writes both can make them so."""
    return (
        f"this gateway has stored record {known.sequence}, {known.head}, and it is not there. Somebody has exchanged "
        f"database and anchor together. {WHAT_TO_DO}"
    )


def _traces(folder: Path) -> list[str]:
    """What says that there was an audit in a folder, now or earlier."""
    return sorted(path.name for pattern in (f"{FILE_NAME}*", "audit-*") for path in folder.glob(pattern))


def _verify_tail(file: AuditFile, anchor: Anchor) -> tuple[Anchor, list[int]]:
    """The last record, and those beyond the anchor, without such as only note others.

    Raises AuditUnavailable where the tail is damaged, or does not reach the anchor.
    """
    first = max(1, anchor.sequence - TAIL)
    last, at_anchor, beyond = NOTHING_YET, NOTHING_YET, list[int]()
    for one in chained(file.rows(first), first - 1, BEFORE_FIRST if first == 1 else None):
        if one.damage:
            raise AuditUnavailable(f"{file.path}: {one.damage}. {WHAT_TO_DO}")
        last = Anchor(one.row.sequence, one.row.head)
        if last.sequence == anchor.sequence:
            at_anchor = last
        if last.sequence > anchor.sequence and one.record is not None and one.record.kind != NOT_DONE:
            beyond.append(last.sequence)
    if wrong := against_anchor(at_anchor, anchor, last.sequence or file.last()):
        raise AuditUnavailable(f"{file.path}: {wrong}. {WHAT_TO_DO}")
    return last, beyond

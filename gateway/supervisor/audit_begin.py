"""A new audit in place of one that is damaged, lost or full: only at a person's command, and the old one is kept."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from gateway.core.audit_record import NotRecordable, Who
from gateway.storage.sqlite_file import told
from gateway.supervisor.audit_anchor import FILE_NAME as ANCHOR
from gateway.supervisor.audit_anchor import Anchor, sync_folder
from gateway.supervisor.audit_file import FILE_NAME, KIND
from gateway.supervisor.audit_verify import Verification, verify
from gateway.supervisor.audit_writer import AuditWriter


@dataclass(frozen=True)
class BegunAnew:
    kept: Path  #: the folder in which the old files lie, under their own names: it can be verified and shown
    before: Verification  #: what was found of the old one
    first: Anchor  #: of the new one


def begin_anew(
    folder: Path,
    because: str,
    who: Who,
    clock: Callable[[], float] = time.monotonic,
    wall_clock: Callable[[], float] = time.time,
) -> BegunAnew:
    """Move the audit of `folder` aside, and begin one whose first record says why, and where the old one ended.

    Raises AuditUnavailable, also where a gateway runs; NotRecordable where no reason is given.
    """
    if not because.strip():
        raise NotRecordable("a new audit needs a reason")
    writer = AuditWriter(folder, clock, wall_clock)
    try:
        with told(folder / FILE_NAME, KIND):
            writer.lock()
            before = verify(folder)
            kept = _move_aside(folder, wall_clock())
            what = {"because": because, "kept": kept.name, "before": _in_short(before)}
            return BegunAnew(kept, before, writer.begin(what, who))
    finally:
        writer.close()


def _move_aside(folder: Path, wall_s: float) -> Path:
    # A folder of this kind tells, whenever this is interrupted, that there was an audit before.
    stamp = datetime.fromtimestamp(wall_s, UTC).strftime("audit-%Y%m%dT%H%M%SZ")
    names = (stamp, *(f"{stamp}-{k}" for k in range(2, 1000)))
    kept = next(path for name in names if not (path := folder / name).exists())
    kept.mkdir()
    sync_folder(folder)
    for path in sorted([*folder.glob(f"{FILE_NAME}*"), *folder.glob(f"{ANCHOR}*")]):
        path.rename(kept / path.name)
    sync_folder(kept)
    sync_folder(folder)
    return kept


def _in_short(before: Verification) -> dict[str, object]:
    anchor = before.anchor and {"sequence": before.anchor.sequence, "head": before.anchor.head}
    return {
        "records": before.records, "head": before.head, "anchor": anchor, "sound": before.sound,
        "problems": [text[:500] for text in before.problems[:10]],
    }  # fmt: skip

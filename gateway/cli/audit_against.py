"""Whether an audit holds a head that was printed elsewhere, and the head that reports carry."""

import json
from pathlib import Path

from gateway.core.audit_export import RecordLine, parse_line
from gateway.core.audit_head import AuditHead
from gateway.core.audit_record import NotRecordable
from gateway.supervisor.audit_anchor import AnchorDamaged, read_anchor
from gateway.supervisor.audit_file import FILE_NAME, AuditFile, AuditUnavailable

MOVED_ASIDE = "audit-*"  #: folders of audits in whose place a person has begun anew


def head_in(folder: Path) -> str:
    """NUMBER:HASH of the last record of the audit in `folder`; empty: there is none, or its anchor is damaged."""
    try:
        anchor = read_anchor(folder)
    except (AnchorDamaged, OSError):
        return ""
    return str(AuditHead(anchor.sequence, anchor.head)) if anchor is not None and anchor.sequence else ""


def why_not_contained(folder: Path, head: AuditHead) -> str:
    """Why the audit of `folder` does not hold the record with this head; empty: it does."""
    try:
        found = _head_at(folder, head.sequence)
    except AuditUnavailable as error:
        return f"record {head.sequence} was noted elsewhere, and cannot be looked up: {error}"
    if found == head.hash:
        return ""
    for aside in sorted(folder.glob(MOVED_ASIDE)):
        if (aside / FILE_NAME).is_file() and _holds(aside, head):
            return (
                f"record {head.sequence} with this head is not in this audit but in {aside}, in whose place this one "
                f"was begun: r2rgate audit verify --data-dir {aside} --against {head}"
            )
    if found is None:
        return (
            f"record {head.sequence} was noted elsewhere and is not there: records are lost, or the audit was made anew"
        )
    return (
        f"record {head.sequence} is not the one whose head was noted elsewhere, {head.hash}: this one has {found}. The "
        "audit was made anew, or another line's is meant"
    )


def why_not_exported(path: Path, head: AuditHead) -> str:
    """The same of an export, which is sound. Raises OSError."""
    with path.open("rb") as stream:
        for payload in stream:
            try:
                line = parse_line(payload)
            except (NotRecordable, json.JSONDecodeError):
                continue
            if isinstance(line, RecordLine) and line.record.sequence == head.sequence:
                said = f"record {head.sequence} is not the one whose head was noted elsewhere, {head.hash}"
                return "" if line.head == head.hash else f"{said}: this one has {line.head}"
    return f"record {head.sequence} was noted elsewhere and is not in this export"


def _head_at(folder: Path, sequence: int) -> str | None:
    with AuditFile(folder) as file:
        row = next(file.rows(sequence), None)
    return None if row is None or row.sequence != sequence else row.head


def _holds(folder: Path, head: AuditHead) -> bool:
    try:
        return _head_at(folder, head.sequence) == head.hash
    except AuditUnavailable:
        return False

"""Records of the audit on the terminal, and which are meant."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import typer

from gateway.core.audit_record import AuditRecord
from gateway.core.line_problem import printable
from gateway.supervisor.audit_verify import Chained, Verification
from gateway.supervisor.find_version import LEAST_PREFIX
from gateway.supervisor.record_words import IN_EVERY_LANGUAGE, in_a_sentence

SHORT = 12  #: letters of a hash


def print_verification(found: Verification, folder: Path) -> None:
    typer.echo(f"audit in {folder}: {'sound' if found.sound else 'NOT SOUND'}")
    typer.echo(f"  {found.records} records, {found.blobs} blobs; last record: {found.records}:{found.head}")
    if found.beyond_anchor and found.sound:
        typer.echo(f"  the last {found.beyond_anchor} were interrupted: what they announce was not done")
    for text in found.problems:
        typer.echo(f"  {printable(text)}")


def print_record(one: Chained) -> None:
    """A heading, then what was done and what it refers to."""
    record = one.record
    if one.damage:
        typer.echo(f"#{one.row.sequence}  DAMAGED: {printable(one.damage)}")
    if record is None:
        return
    when = datetime.fromtimestamp(record.wall_s, UTC).strftime("%Y-%m-%d %H:%M:%S")
    typer.echo(f"#{record.sequence}  {when} UTC  {record.kind}  by {printable(_who(record))}  {one.row.head[:SHORT]}")
    if record.kind in IN_EVERY_LANGUAGE:
        typer.echo(f"    {in_a_sentence(record.kind, record.who.name, record.what)}")
    for key, value in record.what.items():
        text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        typer.echo(f"    {printable(key)}: {printable(text)}")
    for part, id_ in record.blobs.items():
        typer.echo(f"    {part}: -> {id_[:SHORT]}")


def _who(record: AuditRecord) -> str:
    who = record.who
    known = (
        ("uid", who.uid),
        ("pid", who.pid),
        ("certificate", who.certificate and who.certificate[:SHORT]),
    )
    said = ", ".join(f"{name} {value}" for name, value in known if value is not None)
    return f"{who.name} ({said})" if said else who.name


def found_in(one: Chained, kind: str | None, since_s: float | None, id_: str | None) -> bool:
    """Whether a record is meant; a damaged one always is, unless its number is not the one that is asked for."""
    record = one.record
    if id_ is not None and id_ == str(one.row.sequence):
        return True
    if record is None:
        return id_ is None
    if kind is not None and record.kind != kind:
        return False
    if since_s is not None and record.wall_s < since_s:
        return False
    return id_ is None or (len(id_) >= LEAST_PREFIX and _mentions(one.row.head, record, id_.lower()))


def _mentions(head: str, record: AuditRecord, id_: str) -> bool:
    ids = (head, record.previous, *record.blobs.values())
    return any(one.startswith(id_) for one in ids[:1] + ids[2:]) or _says(record.what, id_)


def _says(value: Any, id_: str) -> bool:
    if isinstance(value, str):
        return value.lower().startswith(id_)
    if isinstance(value, dict):
        return any(_says(one, id_) for one in value.values())
    return isinstance(value, list) and any(_says(one, id_) for one in value)

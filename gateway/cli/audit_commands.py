"""`r2rgate audit`: what was recorded, whether it is still that, and a new audit in place of a damaged one."""

import json
import os
import pwd
import re
import sys
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from gateway.cli.audit_against import why_not_contained, why_not_exported
from gateway.cli.audit_view import found_in, print_record, print_verification
from gateway.cli.data_place import gateway_data
from gateway.cli.process_commands import REFUSED, DataFolder, read_line
from gateway.core.audit_export import RecordLine, blob_line, line_text, wrong_in
from gateway.core.audit_head import AuditHead, heads_in, parse_head
from gateway.core.audit_record import BEFORE_FIRST, NotRecordable, Who
from gateway.core.line_problem import printable
from gateway.core.nearest import nearest
from gateway.files import MOST_BYTES, read_bytes
from gateway.supervisor.audit_begin import begin_anew as begin_audit_anew
from gateway.supervisor.audit_file import FILE_NAME, AuditFile, AuditUnavailable
from gateway.supervisor.audit_verify import Chained, chained
from gateway.supervisor.audit_verify import verify as verify_audit

app = typer.Typer(
    name="audit",
    help="Who changed what, when and why: append-only, each record chained to the one before.",
    no_args_is_help=True,
)

UNSOUND = 1  #: exit code
SHOWN = 50
_UNITS_S = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}

Json = Annotated[bool, typer.Option("--json", help="Print as JSON.")]
LineOption = Annotated[
    Path | None, typer.Option("--line", help="The line description; not needed where one line has an audit.")
]


@app.command()
def verify(
    line: LineOption = None,
    data_dir: DataFolder = None,
    against: Annotated[
        str | None,
        typer.Option(
            "--against",
            "--head",
            help="NUMBER:HASH as the log, the page, OPC UA or a report printed it, or a file that has it: the last "
            "one there, and of audit-heads.txt, which the agents keep, every one. It must be in the audit still.",
        ),
    ] = None,
    export_file: Annotated[
        Path | None, typer.Option("--export", help="Verify this export instead; no database is needed.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Every record, the chain, what they refer to, and that none is lost at the end.

    Chain and anchor can be made anew together by whoever may write both; a head that lies elsewhere shows it.

    Exit code: 0 sound, 1 not sound, 2 refused.

    Example: r2rgate audit verify --line line.toml

    Example: r2rgate audit verify --against 301:39103...

    Example: r2rgate audit verify --against report.html
    """
    heads = _heads_of(against)
    if export_file is not None:
        _verify_export(export_file, heads, as_json)
        return
    folder = audit_folder(line, data_dir)
    found = verify_audit(folder)
    missing = [why for head in heads if (why := why_not_contained(folder, head))]
    for why in missing:
        found.problem(why)
    if as_json:
        anchor = found.anchor and vars(found.anchor).copy()
        held = {"against": str(heads[-1]), "heads": len(heads), "contained": not missing} if heads else {}
        document = {"folder": str(folder), "sound": found.sound, **vars(found), "anchor": anchor, **held}
        typer.echo(json.dumps(document, indent=2))
    else:
        print_verification(found, folder)
        if heads and not missing:
            more = f", and {len(heads) - 1} heads before" if len(heads) > 1 else ""
            typer.echo(f"  it contains {heads[-1]}{more}")
    raise typer.Exit(0 if found.sound else UNSOUND)


@app.command()
def show(
    line: LineOption = None,
    data_dir: DataFolder = None,
    kind: Annotated[str | None, typer.Option("--kind", help="Only records of this kind.")] = None,
    since: Annotated[
        str | None, typer.Option("--since", help="Only from then on: 2026-11-22T14:00+01:00, or 30min, 8h, 7d ago.")
    ] = None,
    id_: Annotated[
        str | None,
        typer.Option(
            "--id", help="Only the record of this number, or those that mention this id (from six letters on)."
        ),
    ] = None,
    last: Annotated[int, typer.Option("--last", min=1, help="So many at most, the newest.")] = SHOWN,
    as_json: Json = False,
) -> None:
    """Records, the newest last. A damaged one is shown as such. Exit code: 0 shown, 2 refused.

    Example: r2rgate audit show --since 8h

    Example: r2rgate audit show --id 08067a72 --json
    """
    folder = audit_folder(line, data_dir)
    since_s = None if since is None else instant_of(since)
    try:
        with AuditFile(folder) as file:
            records = list(chained(file.rows(), 0, BEFORE_FIRST))
    except AuditUnavailable as error:
        refuse(error)
    if kind is not None:
        _require_kind(kind, records)
    chosen = [one for one in records if found_in(one, kind, since_s, id_)][-last:]
    if as_json:
        typer.echo(json.dumps([_data(one) for one in chosen], indent=2))
        return
    for one in chosen:
        print_record(one)
    if not chosen:
        typer.echo(f"none of {len(records)} records is meant; without options the last {SHOWN} are shown", err=True)


@app.command()
def export(
    out: Annotated[Path, typer.Option("--out", help="The file to write (JSON lines); - for standard output.")],
    line: LineOption = None,
    data_dir: DataFolder = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file if it exists.")] = False,
) -> None:
    """All records with what they refer to, as JSON lines (docs/schemas/audit-export.schema.json).

    Only a sound audit is exported. Exit code: 0 written, 1 not sound, 2 refused.

    Example: r2rgate audit export --out audit.jsonl
    """
    folder = audit_folder(line, data_dir)
    if str(out) != "-" and out.exists() and not force:
        refuse(f"{out} exists and was left as it was; use another --out, or --force to overwrite it")
    found = verify_audit(folder)
    if not found.sound:
        print_verification(found, folder)
        raise typer.Exit(UNSOUND)
    try:
        with AuditFile(folder) as file:
            if str(out) == "-":
                for text in _lines(file, found.records):
                    sys.stdout.write(text + "\n")
                return
            part = out.with_name(out.name + ".part")
            with part.open("w", encoding="ascii") as stream:
                stream.writelines(text + "\n" for text in _lines(file, found.records))
            part.replace(out)
    except (AuditUnavailable, NotRecordable) as error:
        refuse(error)
    except OSError as error:
        refuse(f"--out {out} cannot be written: {error.strerror}; name a file in a folder that you may write")
    typer.echo(f"{out}: {found.records} records, {found.blobs} blobs, head {found.head}")


@app.command("begin-anew")
def begin_anew(
    because: Annotated[str, typer.Option("--because", help="Why; it becomes the first record.")],
    line: LineOption = None,
    data_dir: DataFolder = None,
) -> None:
    """Begin a new audit and keep the old files aside. For an audit that is damaged or lost; end the gateway first.

    Exit code: 0 begun, 2 refused.

    Example: r2rgate audit begin-anew --because "disk replaced, last copy from 3 November lost"
    """
    folder = audit_folder(line, data_dir)
    try:
        begun = begin_audit_anew(folder, because, this_user())
    except (AuditUnavailable, NotRecordable) as error:
        refuse(error)
    before = begun.before
    typer.echo(f"begun: {folder / FILE_NAME}, record 1, head {begun.first.head}")
    typer.echo(f"kept: {begun.kept}, {before.records} records, {'sound' if before.sound else 'not sound'}")
    typer.echo(f"  r2rgate audit verify --data-dir {begun.kept}")


def audit_folder(line: Path | None, data_dir: Path | None) -> Path:
    described = None if line is None else read_line(line)
    advice = "a gateway begins one when it starts"
    try:
        folder = gateway_data(described, data_dir, "audit.*", "audits", advice, AuditUnavailable)
        if not folder.is_dir() and not folder.parent.is_dir():
            raise AuditUnavailable(f"there is no folder {folder}, so no audit: {advice}")
    except AuditUnavailable as error:
        refuse(error)
    return folder


def _lines(file: AuditFile, last: int) -> Iterator[str]:
    known = set[str]()
    for row in file.rows():
        if row.sequence > last:  # recorded since it was verified
            return
        record = row.record()
        for id_ in record.blobs.values():
            payload = None if id_ in known else file.blob(id_)
            if payload is not None:
                yield line_text(blob_line(payload))
                known.add(id_)
        yield line_text(RecordLine(head=row.head, record=record))


def _verify_export(path: Path, heads: list[AuditHead], as_json: bool) -> None:
    try:
        with path.open("rb") as stream:
            wrong = list(wrong_in(stream))
        wrong += [missing for head in heads if (missing := why_not_exported(path, head))]
    except OSError as error:
        refuse(f"{path} cannot be read: {error.strerror}")
    if as_json:
        typer.echo(json.dumps({"file": str(path), "sound": not wrong, "problems": wrong}, indent=2))
    else:
        typer.echo(f"{path}: {'sound' if not wrong else 'NOT SOUND'}")
        for text in wrong:
            typer.echo(f"  {printable(text)}")
    raise typer.Exit(UNSOUND if wrong else 0)


def _heads_of(against: str | None) -> list[AuditHead]:
    if against is None:
        return []
    try:
        if against.strip() and os.path.lexists(against):
            return heads_in(read_bytes(Path(against), MOST_BYTES).decode("utf-8", "replace"))
        return [parse_head(against)]
    except OSError as error:
        refuse(f"--against {against}: the file cannot be read: {error.strerror}")
    except ValueError as error:
        refuse(f"--against {against}: {error}")


def _require_kind(kind: str, records: list[Chained]) -> None:
    known = sorted({one.record.kind for one in records if one.record is not None})
    if kind not in known:
        like = nearest(kind, known)
        hint = f"; did you mean {like}?" if like else ""
        refuse(f"--kind {kind}: there is no such record; kinds here: {', '.join(known)}{hint}")


def instant_of(text: str) -> float:
    """Unix time of what was given as --since."""
    ago = re.fullmatch(r"(\d+(?:\.\d+)?)(s|min|h|d)", text)
    if ago is not None:
        return time.time() - float(ago[1]) * _UNITS_S[ago[2]]
    try:
        return datetime.fromisoformat(text).astimezone().timestamp()  # without a zone: that of this machine
    except (ValueError, OverflowError):
        refuse(f"--since {text}: allowed is a date and time such as 2026-11-22T14:00, or 30min, 8h, 7d (ago)")


def _data(one: Chained) -> dict[str, Any]:
    record = None if one.record is None else one.record.model_dump()
    return {"sequence": one.row.sequence, "head": one.row.head, "record": record, "damage": one.damage}


def this_user() -> Who:
    uid = os.getuid()
    try:
        name = pwd.getpwuid(uid).pw_name
    except KeyError:
        name = f"user {uid}"
    return Who(name=name, uid=uid, pid=os.getpid())


def refuse(why: object) -> NoReturn:
    for text in str(why).splitlines():
        typer.echo(printable(text), err=True)
    raise typer.Exit(REFUSED)

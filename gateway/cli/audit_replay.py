"""`r2rgate audit replay`: a verdict once more, from nothing but what lies in the audit."""

import json
from dataclasses import dataclass
from typing import Annotated

import typer

from gateway.cli.audit_commands import UNSOUND, Json, LineOption, audit_folder, refuse
from gateway.cli.process_commands import DataFolder
from gateway.core.audit_record import BEFORE_FIRST, AuditRecord
from gateway.core.judge_context import JudgeContext
from gateway.core.line import Line
from gateway.core.line_problem import printable
from gateway.core.packed_recording import unpacked
from gateway.core.recording import Recording
from gateway.core.verdict import Verdict, canonical
from gateway.supervisor.audit_file import AuditFile, AuditUnavailable
from gateway.supervisor.audit_verify import chained
from gateway.supervisor.find_version import LEAST_PREFIX

JUDGED = ("accepted", "refused")  #: kinds of records


class NotReplayable(Exception):
    """The text says why."""


@dataclass(frozen=True)
class Judged:
    """A verdict with all that it was given on."""

    sequence: int
    payload: bytes
    context: JudgeContext
    line: Line
    recordings: list[Recording]
    verdict: Verdict


def replay(
    id_: Annotated[
        str, typer.Argument(metavar="ID", help="Of a proposal, six letters or more; or the number of a record.")
    ],
    line: LineOption = None,
    data_dir: DataFolder = None,
    as_json: Json = False,
) -> None:
    """Judge a proposal once more, from what was stored when it was judged: the same verdict, or what differs.

    Line's file, context, recordings and seed are those in the audit. Another version of the program may judge
    otherwise; that is said. Takes as long as the first time. Exit code: 0 the same, 1 not the same, 2 refused.

    Example: r2rgate audit replay 08067a72
    """
    try:
        with AuditFile(audit_folder(line, data_dir)) as file:
            judged = judged_in(file, id_)
    except (NotReplayable, AuditUnavailable) as error:
        refuse(error)
    from safety.judge import judge  # compiles

    again = judge(judged.payload, judged.context, judged.line, judged.recordings, judged.verdict.seed)
    told = differences(judged.verdict, again)
    same = canonical(again) == canonical(judged.verdict)
    if as_json:
        typer.echo(
            json.dumps({"record": judged.sequence, "same": same, "differences": told, "verdict": again.model_dump()})
        )
    else:
        word = "accepted" if again.accepted else "refused"
        known = f"record {judged.sequence}, seed {judged.verdict.seed}, {len(again.findings)} findings"
        typer.echo(f"{'the same verdict' if same else 'NOT THE SAME VERDICT'}: {word} ({known})")
        for text in told:
            typer.echo(f"  {printable(text)}")
    raise typer.Exit(0 if same else UNSOUND)


def judged_in(file: AuditFile, id_: str) -> Judged:
    """The newest verdict on a proposal, or that of a record. Raises NotReplayable, AuditUnavailable."""
    records = [one.record for one in chained(file.rows(), 0, BEFORE_FIRST) if one.record is not None]
    found = [record for record in records if record.kind in JUDGED and _is_meant(record, id_)]
    if not found:
        count = sum(record.kind in JUDGED for record in records)
        raise NotReplayable(
            f"{id_}: of the {count} verdicts in the audit none is meant; `r2rgate audit show --kind accepted` and "
            "`--kind refused` list them"
        )
    if len({str(record.what["proposal"]) for record in found}) > 1:
        raise NotReplayable(f"{len(found)} verdicts are on proposals that begin with {id_}: give more letters")
    record = found[-1]
    parts = {name: _blob(file, record, name) for name in record.blobs}
    if missing := {"verdict", "context", "line"} - parts.keys():
        because = record.what.get("because", "")
        raise NotReplayable(f"record {record.sequence} has no {', '.join(sorted(missing))}: {because}")
    numbers = sorted(int(name.removeprefix("data-")) for name in parts if name.startswith("data-"))
    payload = file.blob(str(record.what["proposal"]))
    if payload is None:
        raise NotReplayable(f"the proposal of record {record.sequence} is lost: `r2rgate audit verify` tells more")
    try:
        return Judged(
            record.sequence,
            payload,
            JudgeContext.model_validate_json(parts["context"]),
            Line.model_validate_json(parts["line"]),
            [unpacked(parts[f"data-{number}"]) for number in numbers],
            Verdict.model_validate_json(parts["verdict"]),
        )
    except ValueError as error:  # pydantic's errors are some
        raise NotReplayable(f"record {record.sequence} was written by another version: {error}") from error


def differences(before: Verdict, after: Verdict) -> list[str]:
    """In words; empty where nothing differs."""
    told: list[str] = []
    if before.program_version != after.program_version:
        told.append(f"judged by version {before.program_version} then, by {after.program_version} now")
    old, new = ([one.model_dump() for one in verdict.findings + verdict.reported] for verdict in (before, after))
    if len(old) != len(new):
        told.append(f"{len(old)} findings then, {len(new)} now")
    for was, now in zip(old, new, strict=False):
        if was != now:
            told.append(f"{was['rule']}, then: {_said(was)}; now: {_said(now)}")
    return told


def _said(finding: dict[str, object]) -> str:
    return f"{'passed' if finding['passed'] else 'refused'}, {finding['text']}"


def _is_meant(record: AuditRecord, id_: str) -> bool:
    if id_ == str(record.sequence):
        return True
    return len(id_) >= LEAST_PREFIX and str(record.what.get("proposal", "")).startswith(id_.lower())


def _blob(file: AuditFile, record: AuditRecord, name: str) -> bytes:
    content = file.blob(record.blobs[name])
    if content is None:
        raise NotReplayable(f"{name} of record {record.sequence} is lost: `r2rgate audit verify` tells more")
    return content

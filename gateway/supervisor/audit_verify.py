"""Whether the audit is what was recorded: the whole chain, every blob, and that it reaches its anchor."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from gateway.core.audit_record import BEFORE_FIRST, AuditRecord, NotRecordable
from gateway.storage.sqlite_file import told
from gateway.supervisor.audit_anchor import FILE_NAME as ANCHOR
from gateway.supervisor.audit_anchor import Anchor, AnchorDamaged, read_anchor
from gateway.supervisor.audit_file import KIND, AuditFile, AuditUnavailable, Row

MOST_AT_ONCE = 64  #: records in one commit
MOST_BEYOND = 100  #: records that an interruption may leave beyond the anchor: a commit, and attempts to note it
MOST_PROBLEMS = 50  #: told one by one


@dataclass
class Verification:
    """What was found."""

    records: int = 0
    blobs: int = 0
    head: str = BEFORE_FIRST  #: of the last record
    anchor: Anchor | None = None
    beyond_anchor: int = 0  #: records that nobody was told of: interrupted between commit and anchor
    problems: list[str] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        return not self.problems

    def problem(self, text: str) -> None:
        if len(self.problems) < MOST_PROBLEMS:
            self.problems.append(text)


@dataclass(frozen=True)
class Chained:
    """A row, held against the one before."""

    row: Row
    record: AuditRecord | None  #: None: it is damaged
    damage: str  #: "": none


def chained(rows: Iterable[Row], sequence: int, head: str | None) -> Iterable[Chained]:
    """Each row; `sequence` and `head` are those of the one before the first, None where it is not known."""
    for row in rows:
        damage, record = "", None
        try:
            record = row.record()
        except NotRecordable as error:
            damage = f"record {row.sequence} is damaged: {error}"
        if row.sequence != sequence + 1:
            damage = damage or f"records {sequence + 1} to {row.sequence - 1} are missing"
        elif record is not None and head is not None and record.previous != head:
            damage = f"record {row.sequence} does not follow record {sequence}: one of them was exchanged"
        sequence, head = row.sequence, row.head
        yield Chained(row, record, damage)


def against_anchor(found: Anchor | None, anchor: Anchor, last: int) -> str:
    """What is wrong with records up to `last`, of which the anchor's is `found`; "": nothing."""
    if anchor.sequence > last:
        first = last + 1
        lost = f"record {first} is" if first == anchor.sequence else f"records {first} to {anchor.sequence} are"
        return f"{lost} lost: {ANCHOR} says that record {anchor.sequence} was stored"
    if last - anchor.sequence > MOST_BEYOND:
        return (
            f"{ANCHOR} is older than the records: it names record {anchor.sequence} of {last}, and an interruption "
            f"leaves at most {MOST_BEYOND} beyond it"
        )
    if found != anchor:
        return f"record {anchor.sequence} is not the one that {ANCHOR} says was stored"
    return ""


def verify(folder: Path) -> Verification:
    """Everything, from the first record to the last. Never raises for what is damaged or absent: it tells."""
    result = Verification()
    try:  # before the records: what is appended meanwhile only goes beyond it
        result.anchor = read_anchor(folder)
        if result.anchor is None:
            result.problem(f"{folder / ANCHOR} is missing: nobody can tell whether the last records are still there")
    except AnchorDamaged as error:
        result.problem(str(error))
    except OSError as error:
        result.problem(f"{folder / ANCHOR} cannot be read: {error.strerror}")
    try:
        with AuditFile(folder) as file:
            _verify_file(file, result)
    except AuditUnavailable as error:
        result.problem(str(error))
    return result


def _verify_file(file: AuditFile, result: Verification) -> None:
    with told(file.path, KIND):
        checks = [str(text) for (text,) in file.connection.execute("PRAGMA integrity_check(10)").fetchall()]
    for text in checks:
        if text != "ok":
            result.problem(f"{file.path} is damaged: {text}")
    blobs = set(file.blob_ids())  # before the records, for the same reason
    referred: set[str] = set()
    at_anchor = Anchor(0, BEFORE_FIRST)
    for one in chained(file.rows(), 0, BEFORE_FIRST):
        result.records, result.head = one.row.sequence, one.row.head
        if one.damage:
            result.problem(one.damage)
        if result.anchor is not None and one.row.sequence == result.anchor.sequence:
            at_anchor = Anchor(one.row.sequence, one.row.head)
        if one.record is not None:
            _verify_blobs(file, one.record, referred, result)
    result.blobs = len(referred)
    for id_ in sorted(blobs - referred):
        result.problem(f"no record refers to blob {id_[:64]}")
    if result.anchor is not None:
        if wrong := against_anchor(at_anchor, result.anchor, result.records):
            result.problem(wrong)
        result.beyond_anchor = max(0, result.records - result.anchor.sequence)


def _verify_blobs(file: AuditFile, record: AuditRecord, referred: set[str], result: Verification) -> None:
    """Those that no earlier record has referred to."""
    for part, id_ in record.blobs.items():
        if id_ not in referred and file.blob(id_) is None:
            result.problem(f"the {part} of record {record.sequence} is missing or damaged: blob {id_}")
        referred.add(id_)

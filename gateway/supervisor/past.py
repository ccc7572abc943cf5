"""A line's past for whoever looks at it: records of the audit in words, and tensions out of the history.

It only reads, in a thread of each sort, one question at a time; an answer always fits a message.
"""

from collections.abc import Callable
from itertools import islice
from pathlib import Path

from pydantic import ValidationError

from gateway.core.audit_record import AuditRecord, NotRecordable
from gateway.core.line import Line
from gateway.core.line_past import PAST_QUERY, RecordsAfter, RecordsTold, RecordTold, TensionsBetween
from gateway.core.messages import Reply
from gateway.core.proposal import ProposalRefused, parse_proposal
from gateway.core.topics import GATEWAY_PAST
from gateway.mailbox.port import MAX_PAYLOAD, Mailbox
from gateway.storage.sqlite_file import open_to_read, told
from gateway.supervisor.audit_file import FILE_NAME, KIND, AuditFile, AuditUnavailable, Row
from gateway.supervisor.history import History, HistoryError
from gateway.supervisor.past_tensions import NotTold, thinned
from gateway.supervisor.record_words import IN_EVERY_LANGUAGE, in_a_sentence
from gateway.tasks.threads import Worker
from gateway.wording.catalogue import languages

BUSY_MS = 500
_HEAD_BYTES = 200  #: of an answer, beside its records


class Past:
    """A handler on a mailbox; `close` at the end."""

    def __init__(self, line: Line, mailbox: Mailbox, folder: Path, history: Callable[[], Path]) -> None:
        """`folder`: of the audit."""
        self._line = line
        self._history = history
        self._records = _Records(folder)
        self._reading, self._thinning = Worker("records"), Worker("trends")
        mailbox.serve(GATEWAY_PAST, self._answer)

    async def close(self) -> None:
        await self._reading.close(self._records.close)
        await self._thinning.close()

    async def _answer(self, payload: bytes) -> bytes:
        try:
            asked = PAST_QUERY.validate_json(payload)
        except ValidationError as error:
            reasons = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
            return _refused("not understood", reasons[:20])
        try:
            if isinstance(asked, RecordsAfter):
                return await self._reading.do(self._records.told, asked)
            return await self._thinning.do(self._tensions, asked)
        except (AuditUnavailable, HistoryError, NotTold) as error:
            return _refused("it is not told", [str(error)])

    def _tensions(self, asked: TensionsBetween) -> bytes:
        with History(self._history()) as history:
            return thinned(history, asked, self._line.control.period_s).model_dump_json().encode()


class _Records:
    """The audit's file, kept open between two questions: checking it anew each time would take long."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file: AuditFile | None = None
        self._inode = 0

    def close(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def told(self, asked: RecordsAfter) -> bytes:
        """Raises AuditUnavailable."""
        try:
            return self._told(self._opened(), asked)
        except AuditUnavailable:
            self.close()
            raise

    def _opened(self) -> AuditFile:
        """Of an audit that was begun anew, the new one."""
        path = self._folder / FILE_NAME
        with told(path, KIND):
            if not path.is_file():
                raise AuditUnavailable(KIND.absent.format(path=path))
            inode = path.stat().st_ino
            if self._file is None or inode != self._inode:
                self.close()
                self._file, self._inode = AuditFile(self._folder, open_to_read(path, KIND, BUSY_MS)), inode
        return self._file

    def _told(self, file: AuditFile, asked: RecordsAfter) -> bytes:
        last = file.last()
        first = max(1, last - asked.most + 1) if asked.after is None else asked.after + 1
        records = [_record(file, row).model_dump_json() for row in islice(file.rows(first), asked.most)]
        kept = _that_fit(records, newest=asked.after is None)
        head = RecordsTold(format=1, last=last, records=[]).model_dump_json()
        return head.replace('"records":[]', f'"records":[{",".join(kept)}]').encode()


def _that_fit(records: list[str], *, newest: bool) -> list[str]:
    """As many as a message carries: of the newest the last, else the first, after which is asked again."""
    room, kept = MAX_PAYLOAD - _HEAD_BYTES, list[str]()
    for one in reversed(records) if newest else records:
        room -= len(one.encode()) + 1
        if room < 0:
            break
        kept.append(one)
    return kept[::-1] if newest else kept


def _record(file: AuditFile, row: Row) -> RecordTold:
    try:
        record = row.record()
    except NotRecordable as error:
        text = f"this record is damaged: {error}; `r2rgate audit verify` tells more"
        return RecordTold(sequence=row.sequence, wall_s=0.0, kind="damaged", who="", text=text, what={})
    text = in_a_sentence(record.kind, record.who.name, record.what, _reason(file, record))
    said = {
        language: in_a_sentence(record.kind, record.who.name, record.what, language=language)
        for language in languages()[1:] if record.kind in IN_EVERY_LANGUAGE
    }  # fmt: skip
    return RecordTold(
        sequence=record.sequence, wall_s=record.wall_s, kind=record.kind, who=record.who.name, text=text,
        what=dict(record.what), said=said,
    )  # fmt: skip


def _reason(file: AuditFile, record: AuditRecord) -> str:
    """Of a proposal, as whoever made it gave it; empty where it is none, or lost."""
    if record.kind != "proposed" or "proposal" not in record.blobs:
        return ""
    content = file.blob(record.blobs["proposal"])
    try:
        return "" if content is None else parse_proposal(content, len(content)).reason
    except ProposalRefused:
        return ""


def _refused(text: str, reasons: list[str]) -> bytes:
    return Reply(ok=False, state="", text=text, reasons=reasons).model_dump_json().encode()

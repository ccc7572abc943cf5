"""The audit of a gateway as its gate uses it: written by its own thread, read where it lies, and not read twice."""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from gateway.core.audit_record import Who, head_of
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_file import AuditFile, AuditUnavailable
from gateway.supervisor.book_file import entries_in, newest_in
from gateway.supervisor.deployer_sides import NotAtHand
from gateway.supervisor.lifecycle import Entry
from gateway.tasks.threads import Worker, beside

MOST_KEPT, MOST_BYTES = 64, 32_000_000  #: proposals and verdicts that are being looked at; one is kept in any case
LOOKED_AT = ("proposal", "verdict")  #: parts of a record


class KeptAudit:
    """The audit of a folder: written by its own thread, read where it lies."""

    def __init__(self, folder: Path, audit: Audit) -> None:
        self._folder = folder
        self._audit = audit
        #: The last ones that were asked for; None: it is not what was stored.
        self._blobs: OrderedDict[str, bytes | None] = OrderedDict()
        self._bytes = 0  #: of all of them
        self._reader = Worker("audit-reader")
        self._trouble = ""  #: why nothing could be fetched

    async def append(
        self, kind: str, who: Who, what: Mapping[str, Any], blobs: Mapping[str, bytes] | None = None
    ) -> object:
        stored = await self._audit.append(kind, who, what, blobs)
        for part, content in (blobs or {}).items():
            if part in LOOKED_AT:
                self._keep(await beside(len(content), head_of, content), content)
        return stored

    async def fetch(self, ids: Iterable[str]) -> None:
        """In a thread, so that `blob` does not wait for a disk. Raises AuditUnavailable."""
        wanted = list(ids)
        for id_ in wanted:
            if id_ in self._blobs:
                self._blobs.move_to_end(id_)
        missing = [one for one in wanted if self._blobs.get(one) is None][:MOST_KEPT]
        if not missing:
            return
        try:
            found = await self._reader.do(self._read, missing)
        except AuditUnavailable as error:
            self._trouble = str(error)
            raise
        self._trouble = ""
        for id_ in missing:
            if id_ in found or self._blobs.get(id_) is None:  # else it was stored meanwhile
                self._keep(id_, found.get(id_))

    def blob(self, id_: str) -> bytes | None:
        if id_ not in self._blobs:
            raise NotAtHand(self._trouble or f"{id_[:12]} was not read from the audit yet: ask again")
        self._blobs.move_to_end(id_)
        return self._blobs[id_]

    async def newest(self, most: int, skip: int) -> list[Entry]:
        return await self._of_records(lambda: newest_in(self._folder, most, skip))

    async def recall(self, beginning: str) -> list[Entry]:
        return await self._of_records(lambda: entries_in(self._folder, beginning))

    async def _of_records(self, look: Callable[[], list[Entry]]) -> list[Entry]:
        try:
            return await self._reader.do(look)
        except (ValueError, KeyError) as error:
            raise AuditUnavailable(f"the records of a proposal are damaged: {error}; `r2rgate audit verify`") from error

    def _read(self, ids: Iterable[str]) -> dict[str, bytes]:
        with AuditFile(self._folder) as file:
            return {id_: content for id_ in ids if (content := file.blob(id_)) is not None}

    def _keep(self, id_: str, content: bytes | None) -> None:
        self._bytes += len(content or b"") - len(self._blobs.pop(id_, None) or b"")
        self._blobs[id_] = content
        while len(self._blobs) > MOST_KEPT or (self._bytes > MOST_BYTES and len(self._blobs) > 1):
            self._bytes -= len(self._blobs.popitem(last=False)[1] or b"")

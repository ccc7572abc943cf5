"""The audit of a gateway as its gate uses it: written by its own thread, read where it lies, and not read twice."""

import asyncio
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gateway.core.audit_record import Who, head_of
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_file import AuditFile

MOST_KEPT, LARGEST_KEPT = 64, 1_000_000  #: proposals and verdicts that are being looked at, bytes of one
LOOKED_AT = ("proposal", "verdict")  #: parts of a record


class KeptAudit:
    """The audit of a folder: written by its own thread, read where it lies."""

    def __init__(self, folder: Path, audit: Audit) -> None:
        self._folder = folder
        self._audit = audit
        self._blobs: OrderedDict[str, bytes] = OrderedDict()  #: the last ones that were asked for

    async def append(
        self, kind: str, who: Who, what: Mapping[str, Any], blobs: Mapping[str, bytes] | None = None
    ) -> object:
        stored = await self._audit.append(kind, who, what, blobs)
        for part, content in (blobs or {}).items():
            if part in LOOKED_AT:
                self._keep(head_of(content), content)
        return stored

    async def fetch(self, ids: Iterable[str]) -> None:
        """In a thread, so that `blob` does not wait for a disk. Raises AuditUnavailable."""
        if missing := [one for one in ids if one not in self._blobs][:MOST_KEPT]:
            for id_, content in (await asyncio.to_thread(self._read, missing)).items():
                self._keep(id_, content)

    def blob(self, id_: str) -> bytes | None:
        """A file is looked at before it is read, which takes its time: what has a hash for a name is read once."""
        if (known := self._blobs.get(id_)) is not None:
            self._blobs.move_to_end(id_)
            return known
        found = self._read([id_]).get(id_)
        if found is not None:
            self._keep(id_, found)
        return found

    def _read(self, ids: Iterable[str]) -> dict[str, bytes]:
        with AuditFile(self._folder) as file:
            return {id_: content for id_ in ids if (content := file.blob(id_)) is not None}

    def _keep(self, id_: str, content: bytes) -> None:
        if len(content) > LARGEST_KEPT:
            return
        self._blobs[id_] = content
        while len(self._blobs) > MOST_KEPT:
            self._blobs.popitem(last=False)

"""The audit of a gateway as its gate uses it: written by its own thread, read where it lies, and not read twice."""

from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gateway.core.audit_record import Who
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_file import AuditFile

MOST_KEPT, LARGEST_KEPT = 64, 1_000_000  #: proposals and verdicts that are being looked at, bytes of one


class KeptAudit:
    """The audit of a folder: written by its own thread, read where it lies."""

    def __init__(self, folder: Path, audit: Audit) -> None:
        self._folder = folder
        self._audit = audit
        self._blobs: OrderedDict[str, bytes] = OrderedDict()  #: the last ones that were asked for

    async def append(
        self, kind: str, who: Who, what: Mapping[str, Any], blobs: Mapping[str, bytes] | None = None
    ) -> object:
        return await self._audit.append(kind, who, what, blobs)

    def blob(self, id_: str) -> bytes | None:
        """A file is looked at before it is read, which takes its time: what has a hash for a name is read once."""
        if (known := self._blobs.get(id_)) is not None:
            self._blobs.move_to_end(id_)
            return known
        with AuditFile(self._folder) as file:
            found = file.blob(id_)
        if found is not None and len(found) <= LARGEST_KEPT:
            self._blobs[id_] = found
            while len(self._blobs) > MOST_KEPT:
                self._blobs.popitem(last=False)
        return found

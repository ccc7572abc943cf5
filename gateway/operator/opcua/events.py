"""Events: every record of the audit that comes while the server runs, and every proposal that begins to wait.

They are emitted by the Server object, where every client looks for them.
"""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.server.server import Server

from gateway.core.decisions import ProposalShown
from gateway.core.line_past import RecordTold
from gateway.operator.line_side import LineSide, NotTold
from gateway.operator.opcua.space import STRING, UINT32, Space

RECORD, WAITING = "AuditRecordEventType", "ProposalWaitingEventType"
LOW, MEDIUM = 200, 500  #: severities

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ


class Events:
    def __init__(self, server: Server, space: Space, line: LineSide) -> None:
        self._server = server
        self._space = space
        self._line = line
        self._after: int | None = None  #: sequence of the last record that was told
        self._waiting: set[str | None] = set()  #: shown hashes that were told
        self._record: Any = None
        self._proposal: Any = None

    async def make(self) -> None:
        number = self._space.namespace
        record = await self._server.create_custom_event_type(
            number, RECORD, properties=[("Sequence", UINT32), ("Kind", STRING), ("Who", STRING)]
        )
        waiting = await self._server.create_custom_event_type(
            number, WAITING, properties=[("ProposalId", STRING), ("ShownHash", STRING), ("BaseRevision", UINT32)]
        )
        self._record = await self._server.get_event_generator(record)
        self._proposal = await self._server.get_event_generator(waiting)

    async def look(self) -> None:
        """Ask for new records, and tell of them. What was there before the first look is told by nobody."""
        try:
            told = await self._line.records(self._after)
        except NotTold:
            return
        if self._after is not None and told.last >= self._after:
            for record in told.records:
                self._after = record.sequence  # also of one that cannot be told: none is told twice
                await self._tell(record)
        else:
            self._after = told.last

    async def waiting(self, shown: Sequence[ProposalShown]) -> None:
        """Tell of those that wait and have not been told of, as they are shown now."""
        for one in reversed(shown):
            if one.shown not in self._waiting:
                self._waiting.add(one.shown)
                event = self._proposal.event
                event.ProposalId, event.ShownHash, event.BaseRevision = one.proposal_hash, one.shown or "", one.epoch
                event.Severity = MEDIUM
                await self._proposal.trigger(
                    message=f"a proposal of {one.proposal.author} waits for a person: {one.proposal_hash[:12]}"
                )
        self._waiting = {one.shown for one in shown}

    async def _tell(self, record: RecordTold) -> None:
        event = self._record.event
        event.Sequence, event.Kind, event.Who, event.Severity = record.sequence, record.kind, record.who, LOW
        await self._record.trigger(datetime.fromtimestamp(record.wall_s, UTC), f"{record.who}: {record.text}")

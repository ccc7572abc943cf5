"""Why a person must decide on what waits, where small changes pass by their verdict alone.

It depends on two proposals that never change, so it is found once for each, out of what has been fetched before.
"""

from gateway.core.line import Line
from gateway.core.proposal import GainsChange
from gateway.core.small_change import beyond_small
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.deployer_sides import NotAtHand
from gateway.supervisor.lifecycle import Entry, Stage
from gateway.supervisor.proposal_records import ProposalRecords

MOST_AT_ONCE = 24  #: that are looked at together


class SmallChanges:
    def __init__(self, line: Line, records: ProposalRecords) -> None:
        self._share = line.gate.small_share
        self._records = records
        #: By what waits: what it was held against, and why a person must decide.
        self._found: dict[str, tuple[str, list[str]]] = {}

    async def look(self) -> None:
        """At some of what waits and was not looked at, the oldest first; the rest has its turn with the next looks."""
        book = self._records.book
        waiting = [one for one in book.undecided if one.stage is Stage.WAITING]
        self._found = {one.proposal: self._found[one.proposal] for one in waiting if one.proposal in self._found}
        wanted = [one for one in waiting if one.kind in book.trusted and self._known(one) is None][:MOST_AT_ONCE]
        if wanted:
            await self._records.fetch([*wanted, *(book.entries[one] for one in set(book.trusted.values()))])
        for one in wanted:
            self.why_a_person(one)

    def why_a_person(self, entry: Entry) -> list[str] | None:
        """Empty: the verdict is enough. None: it was not looked at yet."""
        if (trusted := self._records.book.trusted.get(entry.kind)) is None:
            return [f"no person has approved a change of {entry.kind} yet, or one was rolled back since"]
        if (known := self._known(entry)) is not None:
            return known
        try:
            reasons = self._compared(self._records.book.entries[trusted], entry)
        except NotAtHand:
            return None
        except AuditUnavailable as error:  # it is lost
            reasons = [str(error)]
        self._found[entry.proposal] = trusted, reasons
        return reasons

    def _known(self, entry: Entry) -> list[str] | None:
        trusted, reasons = self._found.get(entry.proposal, ("", []))
        return reasons if trusted and trusted == self._records.book.trusted.get(entry.kind) else None

    def _compared(self, before: Entry, entry: Entry) -> list[str]:
        """Raises AuditUnavailable."""
        now = self._records.proposal(entry)
        reasons = beyond_small(self._records.proposal(before).change, now.change, self._share)
        if isinstance(now.change, GainsChange):
            regions = [
                verdict and verdict.region for verdict in (self._records.verdict(before), self._records.verdict(entry))
            ]
            if regions[0] is None or regions[1] is None or not regions[1].within(regions[0]):
                reasons.append("it would be in service further than what a person approved")
        return reasons

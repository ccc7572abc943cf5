"""The records of what becomes of proposals: each step is stored before it counts, with what lies beside it."""

import asyncio
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from math import inf
from typing import Any

from gateway.core.audit_record import Who
from gateway.core.finding import Finding
from gateway.core.judge_context import JudgeContext
from gateway.core.messages import Reply
from gateway.core.proposal import Proposal
from gateway.core.steady_clock import Age, SteadyClock
from gateway.core.verdict import Verdict
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.deployer_sides import AuditSide
from gateway.supervisor.lifecycle import Book, Entry, Impossible, clock_fields
from gateway.wording.catalogue import sentence


class ProposalRecords:
    """`book` is what the audit says."""

    def __init__(self, book: Book, audit: AuditSide, clock: SteadyClock) -> None:
        self.book = book
        self.one_step = asyncio.Lock()  #: for whoever takes steps that rest on one another
        self.trouble = ""  #: why the last step, or the last look at the line, came to nothing
        self._audit = audit
        self._clock = clock

    async def step(
        self, kind: str, what: Mapping[str, Any], who: Who, blobs: Mapping[str, bytes] | None = None
    ) -> None:
        """A record, on the disk before the book knows of it. Raises Impossible, AuditUnavailable."""
        if reason := self.book.why_not(kind, what):
            raise Impossible(reason)
        what = {**what, **clock_fields(self._clock.now())}
        await self._audit.append(kind, who, what, blobs)
        self.book.apply(kind, what)

    def now_for(self, entry: Entry) -> float | None:
        """Unix time now by the clock as it was when the proposal came, wherever that has been set to since.

        The earliest that it can be: where it came before this boot of the machine, it may be later.
        """
        received = entry.received
        return None if received is None else received.wall_s + self._clock.age(received).least_s

    def age(self, entry: Entry) -> Age:
        """How long ago the proposal came. A record without a time is none that this program writes: for ever ago."""
        return Age(inf, inf) if entry.received is None else self._clock.age(entry.received)

    async def note(self, kind: str, who: Who, what: Mapping[str, Any]) -> None:
        """A record that is no step of a proposal. Raises AuditUnavailable."""
        await self._audit.append(kind, who, what)

    async def was_forgotten(self, proposal: str) -> bool:
        """Whether it was made before, and is done with for so long that the book has it no more."""
        if not self.book.forgotten or proposal in self.book.entries:
            return False
        return bool(await self._audit.recall(proposal))

    async def newest(self, most: int, skip: int) -> list[Entry] | None:
        """A page of proposals, the newest first, as the records have them; None: the book has all of it."""
        held = list(reversed(self.book.entries.values()))[: skip + most]
        if all(one.number == self.book.made - 1 - place for place, one in enumerate(held)):
            if len(held) == skip + most or not self.book.forgotten:
                return None
        found = await self._audit.newest(most, skip)
        return [self.book.entries.get(one.proposal, one) for one in found]

    async def recall(self, beginning: str) -> list[Entry]:
        """Those whose hash begins so, with such as the book has forgotten."""
        held = [entry for hash_, entry in self.book.entries.items() if hash_.startswith(beginning)]
        if not self.book.forgotten or (held and held[0].proposal == beginning):
            return held
        found = await self._audit.recall(beginning)
        return [self.book.entries.get(one.proposal, one) for one in found]

    async def fetch(self, entries: Iterable[Entry]) -> None:
        """What lies beside these, so that nobody waits for it afterwards. What cannot be read says so then."""
        ids = [id_ for one in entries for id_ in (one.proposal, one.verdict) if id_ is not None]
        try:
            await self._audit.fetch(ids)
        except AuditUnavailable:
            pass

    def proposal(self, entry: Entry) -> Proposal:
        """Once it is fetched. Raises AuditUnavailable."""
        return Proposal.model_validate_json(self._kept(entry.proposal))

    def verdict(self, entry: Entry) -> Verdict | None:
        """None: there is none yet. Once it is fetched. Raises AuditUnavailable."""
        return None if entry.verdict is None else Verdict.model_validate_json(self._kept(entry.verdict))

    async def context(self, verdict: Verdict) -> JudgeContext:
        """In which it was judged. Raises AuditUnavailable."""
        await self._audit.fetch([verdict.context])
        return JudgeContext.model_validate_json(self._kept(verdict.context))

    def _kept(self, id_: str) -> bytes:
        """Raises NotAtHand, and AuditUnavailable where it is no longer what was stored."""
        if (content := self._audit.blob(id_)) is None:
            raise AuditUnavailable(f"the audit has lost {id_[:12]}: `r2rgate audit verify` tells more")
        return content


def done(text: str) -> Reply:
    return Reply(ok=True, state="", text=text)


def refused(text: str, reasons: list[str]) -> Reply:
    return Reply(ok=False, state="", text=text, reasons=reasons)


def refused_by(text: str, findings: list[Finding]) -> Reply:
    reasons = [sentence(one) for one in findings]
    return Reply(ok=False, state="", text=text, reasons=reasons, findings=findings)


def not_known(text: str, reasons: list[str]) -> Reply:
    """Whether it was done is not known yet: it was asked for, and no answer came."""
    return Reply(ok=False, state="", text=f"not known: {text}", reasons=reasons, known=False)


def iso(wall_s: float) -> str:
    """Unix time as ISO 8601 with zone."""
    return datetime.fromtimestamp(wall_s, UTC).isoformat(timespec="milliseconds")

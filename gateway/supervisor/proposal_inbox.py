"""Proposals come in, and are judged in the background. The verdict is that of the judge of this process alone.

They are judged in turns (`mailbox.inbox`): whoever proposes much waits behind himself, and nobody behind him.
"""

import asyncio
import hashlib
from collections.abc import Callable, Collection, Sequence
from datetime import datetime
from typing import Any, NamedTuple

from gateway.core.audit_record import Who
from gateway.core.canonical import known_hashes
from gateway.core.controller import config_hash
from gateway.core.experiment import experiment_hash
from gateway.core.judge_context import JudgeContext, context_hash, dated
from gateway.core.judge_context import canonical as canonical_context
from gateway.core.line import Line
from gateway.core.line_model import LineModel, model_hash
from gateway.core.messages import Reply
from gateway.core.packed_recording import packed
from gateway.core.proposal import (
    ExperimentChange,
    GainsChange,
    Proposal,
    ProposalRefused,
    canonical,
    parse_proposal,
    proposal_hash,
)
from gateway.core.recording import Recording
from gateway.core.verdict import Verdict, canonical_line, verdict_hash
from gateway.core.verdict import canonical as canonical_verdict
from gateway.mailbox.inbox import FairQueue
from gateway.supervisor.admission import bounds_of, caller_of, turned_away, why_not_author
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.deployer_sides import JudgeSide, Surroundings
from gateway.supervisor.lifecycle import PROPOSED, Impossible, Stage
from gateway.supervisor.peers import GATEWAY, in_directory
from gateway.supervisor.proposal_records import ProposalRecords, done, refused
from gateway.tasks.threads import beside

AT_ONCE = 2  #: that are being judged: one has its context made up while the judge is at the other


class Inbox:
    def __init__(
        self, line: Line, records: ProposalRecords, judge: JudgeSide, surroundings: Surroundings,
        people: Callable[[], Collection[str]] = tuple,
    ) -> None:  # fmt: skip
        """`people`: who may come in through the page or OPC UA, by name."""
        self._line = line
        self._records = records
        self._judge = judge
        self._surroundings = surroundings
        self._people = people
        self._judging: dict[str, asyncio.Task[None]] = {}
        self._waiting: FairQueue[str] = FairQueue()
        self._closed = False
        self._known: set[str] = set()  #: that wait or are being judged

    async def propose(self, payload: bytes, who: Who) -> Reply:
        """Take a proposal in, and judge it in the background."""
        try:
            taken = await beside(len(payload), _taken_in, payload, self._line.gate.proposal_max_bytes)
        except ProposalRefused as malformed:
            return await self._malformed(payload, malformed, who)
        proposal, hash_ = taken.proposal, taken.hash
        wrong = [
            f"it is for {proposal.site}/{proposal.line}; allowed: {self._line.site}/{self._line.line}"
            for _ in range((proposal.site, proposal.line) != (self._line.site, self._line.line))
        ]
        if self._line.gate.autonomy == "closed":
            wrong.append('the line takes no changes: gate.autonomy is "closed" in its file')
        try:
            differs = await in_directory(why_not_author, proposal.author, who, frozenset(self._people()))
        except TimeoutError:
            return refused("it is not judged", ["the users of this machine are not told in time: propose it again"])
        if differs is not None:
            return turned_away(differs)
        if wrong:
            return refused("it is not judged", wrong)
        caller = caller_of(who)
        full = self._waiting.refuse(caller, bounds_of(who, self._line), self._line.gate.verdict_max_s)
        if full is not None:
            return turned_away(full)
        what = {
            "proposal": hash_,
            "change": proposal.kind,
            "author": proposal.author,
            "base": proposal.base,
            "changes": taken.changes,
            "created": proposal.created,
            "expires": proposal.expires,
            "expires_s": datetime.fromisoformat(proposal.expires).timestamp(),
        }
        try:
            if await self._records.was_forgotten(hash_):
                return refused("it is not judged", [f"proposal {hash_[:12]} was made before, and is done with"])
            async with self._records.one_step:
                await self._records.step(PROPOSED, what, who, {"proposal": taken.content})
        except (Impossible, AuditUnavailable) as error:
            return refused("it is not judged", [str(error)])
        self._begin(hash_, who)
        text = f"proposal {hash_[:12]} ({proposal.kind}) is being judged: `r2rgate proposals {hash_[:12]}` shows how"
        return done(text)

    def judge_again(self) -> None:
        """What was being judged when the process before this one ended, or could not be recorded."""
        for entry in self._records.book.undecided:
            if entry.stage is Stage.RECEIVED and entry.proposal not in self._known:
                self._begin(entry.proposal, GATEWAY)

    async def judged(self) -> None:
        """Until nothing is being judged any more."""
        while self._judging:
            await asyncio.gather(*self._judging.values())
            await asyncio.sleep(0)  # what ends begins the next one

    async def close(self) -> None:
        self._closed = True
        judging = list(self._judging.values())
        for task in judging:
            task.cancel()
        await asyncio.gather(*judging, return_exceptions=True)

    def _begin(self, proposal: str, who: Who) -> None:
        self._known.add(proposal)
        self._waiting.put(caller_of(who), proposal)
        self._begin_next()

    def _begin_next(self) -> None:
        while len(self._judging) < AT_ONCE and len(self._waiting) and not self._closed:
            proposal = self._waiting.take()
            task = asyncio.get_running_loop().create_task(self._judged(proposal))
            self._judging[proposal] = task
            task.add_done_callback(lambda _, proposal=proposal: self._end(proposal))

    def _end(self, proposal: str) -> None:
        self._judging.pop(proposal, None)
        self._known.discard(proposal)
        self._begin_next()

    async def _judged(self, hash_: str) -> None:
        try:
            kind, what, blobs = await self._judgement(hash_)
        except Exception as error:  # what cannot be judged is refused, whatever the reason
            kind, blobs = "refused", dict[str, bytes]()
            what = {"proposal": hash_, "because": f"it could not be judged: {type(error).__name__}: {error}"[:1000]}
        async with self._records.one_step:
            entry = self._records.book.entries.get(hash_)
            if entry is None or entry.stage is not Stage.RECEIVED:
                return  # it has expired meanwhile, or what it would change is gone
            try:
                await self._records.step(kind, what, GATEWAY, blobs)
            except (AuditUnavailable, Impossible) as error:
                self._records.trouble = str(error)  # it stays as received, and is judged again
            except Exception as error:  # a fault of this program: as above, and said as one
                self._records.trouble = f"a verdict could not be recorded: {type(error).__name__}: {error}"

    async def _judgement(self, hash_: str) -> tuple[str, dict[str, Any], dict[str, bytes]]:
        entry = self._records.book.entries[hash_]
        await self._records.fetch([entry])
        proposal = self._records.proposal(entry)
        context, recordings = await self._surroundings.context(self._records.book)
        if (now_s := self._records.now_for(entry)) is not None:
            context = dated(context, now_s)
        verdict = await self._judge.judge(canonical(proposal), context, recordings)
        in_service = self._records.book.model
        what, blobs = await asyncio.to_thread(self._to_record, verdict, context, recordings, in_service)
        return "accepted" if verdict.accepted else "refused", {"proposal": hash_, **what}, blobs

    def _to_record(
        self, verdict: Verdict, context: JudgeContext, recordings: Sequence[Recording], in_service: str | None
    ) -> tuple[dict[str, Any], dict[str, bytes]]:
        """Of a verdict, and what lies beside it: hashed, and packed, which takes seconds."""
        what = {
            "verdict": verdict_hash(verdict),
            "context": context_hash(context),
            "model": None if context.model is None else _id_of(context.model, in_service),
            "line": verdict.line,
            "seed": verdict.seed,
            "because": _first_reason(verdict),
        }
        blobs = {
            "verdict": canonical_verdict(verdict),
            "context": canonical_context(context),
            "line": canonical_line(self._line),
        }
        return what, blobs | {f"data-{number}": packed(one) for number, one in enumerate(recordings, start=1)}

    async def _malformed(self, payload: bytes, malformed: ProposalRefused, who: Who) -> Reply:
        what = {"payload": await beside(len(payload), _sha256, payload), "reasons": malformed.reasons[:20]}
        try:
            await self._records.note("malformed-proposal", who, what)
        except AuditUnavailable as error:
            return refused("it is no proposal", [*malformed.reasons, str(error)])
        return refused("it is no proposal", malformed.reasons)


class _Taken(NamedTuple):
    """A proposal as it came in."""

    proposal: Proposal
    hash: str
    content: bytes  #: canonical
    changes: str  #: hash of what it brings


def _taken_in(payload: bytes, most_bytes: int) -> _Taken:
    """Raises ProposalRefused."""
    proposal = parse_proposal(payload, most_bytes)
    return _Taken(proposal, proposal_hash(proposal), canonical(proposal), _brings(proposal))


def _sha256(payload: bytes) -> str:
    return hashlib.sha256(payload).hexdigest()


def _id_of(model: LineModel, in_service: str | None) -> str:
    """As the one in service is called, where it is that one."""
    return in_service if in_service in known_hashes(model) and in_service is not None else model_hash(model)


def _brings(proposal: Proposal) -> str:
    """The hash of what it brings."""
    change = proposal.change
    if isinstance(change, GainsChange):
        return config_hash(change.controller)
    return experiment_hash(change.experiment) if isinstance(change, ExperimentChange) else model_hash(change.model)


def _first_reason(verdict: Verdict) -> str:
    reasons = verdict.reasons
    more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    return (reasons[0] + more)[:1000] if reasons else ""

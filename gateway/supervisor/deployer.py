"""The one way in: proposals are judged, decided, put on the line, watched, kept or rolled back, audited step by step.

Every step is a record of the audit, stored before what it announces is done; without an audit nothing is changed, and
the loop runs on. What the loop says of itself settles what a record left open: after a restart, after an answer that
did not come. The verdict is taken from the judge that this process has started, from nobody else.
"""

import asyncio
import hashlib
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any

from gateway.core.audit_record import Who
from gateway.core.controller import config_hash
from gateway.core.decisions import Decide, ProposalLine, ProposalList, ProposalShown, shown_hash
from gateway.core.deployment import Deployment, InService
from gateway.core.experiment import experiment_hash
from gateway.core.judge_context import canonical as canonical_context
from gateway.core.judge_context import context_hash
from gateway.core.line import Line
from gateway.core.line_model import model_hash
from gateway.core.messages import AskConfiguration, Deploy, Keep, Renew, Reply, Rollback, RunExperiment, WatchGood
from gateway.core.proposal import (
    ExperimentChange,
    GainsChange,
    Proposal,
    ProposalRefused,
    canonical,
    parse_proposal,
    proposal_hash,
)
from gateway.core.small_change import beyond_small
from gateway.core.verdict import Verdict, canonical_line, verdict_hash
from gateway.core.verdict import canonical as canonical_verdict
from gateway.mailbox.port import RemoteError, Unreachable
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.deployer_sides import AuditSide, JudgeSide, LoopSide, NotKnown, NotTakenUp, Surroundings
from gateway.supervisor.kept_recording import packed
from gateway.supervisor.lifecycle import PERSON, PROPOSED, SCRIPT, VERDICT, Book, Entry, Impossible, Stage, reconciled

LEASE_S = 5.0  #: of a deployment on probation; renewed every third of it
UNHEARD_S = 10.0  #: after an experiment should be over
LONGEST_REASON = 500  #: characters of one for the loop
GATEWAY = Who(name="gateway")
MOST_SETTLING = 1000  #: records in a row from one look at the loop; more is a fault of this program


class Deployer:
    """`propose`, `decide` and `roll_back` for others; `watch` a few times a second. All in one event loop."""

    def __init__(
        self,
        line: Line,
        book: Book,
        audit: AuditSide,
        loop: LoopSide,
        judge: JudgeSide,
        surroundings: Surroundings,
        take_up: Callable[[Proposal, str | None], None],
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
    ) -> None:
        self.book = book
        self.trouble = ""  #: why the last look came to nothing
        self._line = line
        self._audit = audit
        self._loop = loop
        self._judge = judge
        self._surroundings = surroundings
        self._take_up = take_up  #: into the stores, before it is put into service; raises NotTakenUp
        self._clock = clock
        self._wall_clock = wall_clock
        self._one_step = asyncio.Lock()
        self._judging: dict[str, asyncio.Task[None]] = {}
        self._renewed_s = clock()
        self._probation_since_s = clock()
        self._experiment: tuple[str, float] | None = None  #: that runs, and when its end is overdue
        self._looked_at: set[str] = set()  #: proposals that would pass without a person, or not
        self._settled = False  #: the loop has been asked since this process began
        #: Model and configuration by which, and for which, this process has told the loop what can be recovered.
        self._looked_after: tuple[str | None, str] | None = None
        self._unwatched = ""  #: why the loop has not taken that

    async def propose(self, payload: bytes, who: Who) -> Reply:
        """Take a proposal in, and judge it in the background."""
        try:
            proposal = parse_proposal(payload, self._line.gate.proposal_max_bytes)
        except ProposalRefused as refused:
            return await self._malformed(payload, refused, who)
        wrong = [
            f"it is for {proposal.site}/{proposal.line}; allowed: {self._line.site}/{self._line.line}"
            for _ in range((proposal.site, proposal.line) != (self._line.site, self._line.line))
        ]
        if self._line.gate.autonomy == "closed":
            wrong.append('the line takes no changes: gate.autonomy is "closed" in its file')
        if wrong:
            return self._refused("it is not judged", wrong)
        hash_ = proposal_hash(proposal)
        what = {
            "proposal": hash_,
            "change": proposal.kind,
            "author": proposal.author,
            "base": proposal.base,
            "changes": _brings(proposal),
            "created": proposal.created,
            "expires": proposal.expires,
            "expires_s": datetime.fromisoformat(proposal.expires).timestamp(),
        }
        try:
            async with self._one_step:
                await self._step(PROPOSED, what, who, {"proposal": canonical(proposal)})
        except (Impossible, AuditUnavailable) as error:
            return self._refused("it is not judged", [str(error)])
        self._begin_judging(hash_)
        text = f"proposal {hash_[:12]} ({proposal.kind}) is being judged: `r2rgate proposals {hash_[:12]}` shows how"
        return self._done(text)

    async def decide(self, decision: Decide, who: Who) -> Reply:
        """A person's word. The approval is of what was shown, and good once."""
        async with self._one_step:
            entry = self.book.entries.get(decision.proposal)
            if reasons := self._why_not_decide(entry, decision):
                return self._refused("nothing was decided", reasons)
            assert entry is not None  # _why_not_decide says so
            by = SCRIPT if decision.script else PERSON
            what = {"proposal": entry.proposal, "shown": decision.shown, "comment": decision.comment, "by": by}
            try:
                if not decision.approve:
                    await self._step("rejected", {**what, "because": decision.comment or f"by {who.name}"}, who)
                    return self._done(f"proposal {entry.proposal[:12]} is rejected")
                found = await self._settle()
                if reasons := self._why_not_decide(self.book.entries[entry.proposal], decision):
                    return self._refused("the line has changed since it was shown", reasons)
                await self._step("approved", what, who)
                return await self._carry_out(self.book.entries[entry.proposal], found, who)
            except (AuditUnavailable, Unreachable, Impossible, NotTakenUp, NotKnown) as error:
                return self._refused("it is not carried out", [str(error)])

    async def roll_back(self, comment: str, who: Who) -> Reply:
        """To the last known good configuration, now. Done even where the audit is not there: it is the safe side."""
        recorded = ""
        async with self._one_step:
            on_the_line = self.book.on_the_line
            given_up = on_the_line is not None and on_the_line.stage is not Stage.RUNNING
            try:
                await self._audit.append("rollback-asked", who, {"comment": comment})
            except AuditUnavailable as error:
                recorded = f"; it could not be recorded: {error}"
            try:
                reply = await self._loop.tell(Rollback(reason=comment or f"asked for by {who.name}"))
                await self._settle()
            except (Unreachable, AuditUnavailable, Impossible) as error:
                return self._refused("not confirmed", [f"{error}{recorded}"])
        further = ""
        if reply.in_service is not None and not given_up:
            further = "; to go further back, propose what ran before (`r2rgate configurations list`)"
        return reply.model_copy(update={"text": reply.text + further + recorded})

    def look_again(self) -> None:
        """The loop has told of a change that this process did not order, or of its start."""
        self._settled = False

    async def watch(self) -> None:
        """Proposals expire, leases are renewed, what is on probation is kept or left to fall back.

        After a start it goes on from what the records and the loop say.
        """
        if self._one_step.locked():
            return
        async with self._one_step:
            try:
                await self._tidy()
                await self._approve_small()
                if self.book.on_the_line is not None or not self._settled or self._to_look_after():
                    found = await self._settle()
                    await self._look_after(found)
            except (AuditUnavailable, Unreachable, Impossible) as error:
                self.trouble = str(error)  # without a renewal the loop falls back by itself; the next look settles it
            else:
                self.trouble = self._unwatched

    async def judged(self) -> None:
        """Until nothing is being judged any more."""
        while self._judging:
            await asyncio.gather(*self._judging.values())

    async def close(self) -> None:
        judging = list(self._judging.values())
        for task in judging:
            task.cancel()
        await asyncio.gather(*judging, return_exceptions=True)

    def listed(self, most: int) -> ProposalList:
        """The newest first."""
        newest = list(reversed(self.book.entries.values()))[:most]
        return ProposalList(
            format=1,
            site=self._line.site,
            line=self._line.line,
            in_service=self.book.in_service,
            last_known_good=self.book.last_known_good,
            epoch=self.book.epoch,
            model=self.book.model,
            proposals=[_line_of(entry, self._why(entry)) for entry in newest],
        )

    def shown(self, beginning: str) -> ProposalShown | str:
        """The proposal whose hash begins so; a sentence where there is not exactly one."""
        found = [entry for hash_, entry in self.book.entries.items() if hash_.startswith(beginning)]
        if len(found) != 1:
            return f"{len(found)} proposals begin with {beginning}: `r2rgate proposals` lists them"
        (entry,) = found
        proposal = self._proposal(entry)
        return ProposalShown(
            format=1, stage=entry.stage, why=self._why(entry), proposal_hash=entry.proposal,
            shown=self._shown_hash(entry), epoch=self.book.epoch,
            difference=self._surroundings.difference(proposal, self.book), proposal=proposal,
            verdict=self._verdict(entry),
        )  # fmt: skip

    def _why(self, entry: Entry) -> str:
        """What there is to say of its stage."""
        if entry.stage is Stage.PROBATION:
            return f"not kept yet: {self._unseen(self._clock()) or 'about to be'}"
        if entry.stage is Stage.WAITING and self._line.gate.autonomy == "approve-first":
            return "; ".join(self._why_a_person(entry))
        return entry.why

    def _shown_hash(self, entry: Entry) -> str | None:
        if entry.stage is not Stage.WAITING or entry.verdict is None or self.book.in_service is None:
            return None
        return shown_hash(entry.proposal, entry.verdict, self.book.in_service, self.book.epoch)

    def _why_not_decide(self, entry: Entry | None, decision: Decide) -> list[str]:
        if entry is None:
            return [f"there is no proposal {decision.proposal[:12]}: `r2rgate proposals` lists them"]
        if entry.stage is not Stage.WAITING:
            return [f"proposal {entry.proposal[:12]} is {entry.stage}{f': {entry.why}' if entry.why else ''}"]
        if self._wall_clock() >= entry.expires_s:
            return [f"it has expired at {entry.expires}"]
        if decision.shown != self._shown_hash(entry):
            return ["what was shown is no longer what would be done: look at it again, then decide"]
        return []

    def _begin_judging(self, proposal: str) -> None:
        task = asyncio.get_running_loop().create_task(self._judged(proposal))
        self._judging[proposal] = task
        task.add_done_callback(lambda _: self._judging.pop(proposal, None))

    async def _judged(self, hash_: str) -> None:
        try:
            kind, what, blobs = await self._judgement(hash_)
        except Exception as error:  # what cannot be judged is refused, whatever the reason
            kind, blobs = "refused", dict[str, bytes]()
            what = {"proposal": hash_, "because": f"it could not be judged: {type(error).__name__}: {error}"[:1000]}
        async with self._one_step:
            if self.book.entries[hash_].stage is not Stage.RECEIVED:
                return  # it has expired meanwhile, or what it would change is gone
            try:
                await self._step(kind, what, GATEWAY, blobs)
            except (AuditUnavailable, Impossible) as error:
                self.trouble = str(error)  # it stays as received, and is judged again

    async def _judgement(self, hash_: str) -> tuple[str, dict[str, Any], dict[str, bytes]]:
        proposal = self._proposal(self.book.entries[hash_])
        context, recordings = await self._surroundings.context(self.book)
        verdict = await self._judge.judge(canonical(proposal), context, recordings)
        what = {
            "proposal": hash_,
            "verdict": verdict_hash(verdict),
            "context": context_hash(context),
            "seed": verdict.seed,
            "because": _first_reason(verdict),
        }
        blobs = {
            "verdict": canonical_verdict(verdict),
            "context": canonical_context(context),
            "line": canonical_line(self._line),
        }
        blobs |= {f"data-{number}": packed(one) for number, one in enumerate(recordings, start=1)}
        return "accepted" if verdict.accepted else "refused", what, blobs

    async def _carry_out(self, entry: Entry, found: InService, who: Who) -> Reply:
        proposal = self._proposal(entry)
        self._take_up(proposal, entry.verdict)
        if isinstance(proposal.change, GainsChange):
            return await self._deploy(entry, proposal.change, found, who)
        if isinstance(proposal.change, ExperimentChange):
            await self._step("experiment-begins", {"proposal": entry.proposal}, who)
            reply = await self._loop.tell(RunExperiment(experiment=proposal.change.experiment, proposal=entry.proposal))
            if not reply.ok:
                because = "; ".join([reply.text, *reply.reasons])[:1000]
                await self._step("experiment-ends", {"proposal": entry.proposal, "because": because}, GATEWAY)
                return reply
            return self._done(f"{reply.text}; `r2rgate proposals {entry.proposal[:12]}` shows when it is done")
        await self._step("model-in-service", {"proposal": entry.proposal, "model": entry.changes}, who)
        return self._done(f"model {entry.changes[:12]} is what proposals are judged by from now on")

    async def _deploy(self, entry: Entry, change: GainsChange, found: InService, who: Who) -> Reply:
        verdict, epoch = self._verdict(entry), found.epoch + 1
        if verdict is None or not verdict.accepted or verdict.region is None:
            return self._refused("it is not carried out", ["no verdict lets it through"])
        watch = await self._surroundings.recovery(found.last_known_good, verdict.region, self.book)
        deployment = Deployment(
            controller=change.controller, hash=entry.changes, epoch=epoch, lease_s=LEASE_S, region=verdict.region,
            watch=watch,
        )  # fmt: skip
        named = {"proposal": entry.proposal, "epoch": epoch}
        what = {"configuration": entry.changes, "before": found.hash, "region": verdict.region.model_dump()}
        await self._step("deploying", {**named, **what, "watched": watch is not None}, who)
        self._surroundings.begin_probation()
        reply = await self._loop.tell(Deploy(deployment=deployment))
        if not reply.ok and reply.in_service is not None and reply.in_service.epoch < epoch:
            because = "; ".join([reply.text, *reply.reasons])[:1000]
            await self._step("not-deployed", {**named, "because": because}, GATEWAY)
            return reply
        await self._settle()  # what the loop says it runs, read back
        self._probation_since_s = self._renewed_s = self._clock()
        now = self.book.entries[entry.proposal]
        if now.stage is not Stage.PROBATION:
            return self._refused(f"it is {now.stage}", [now.why])
        unwatched = "" if watch else "; no model is accepted yet, by which the loop would see what can be recovered"
        return self._done(
            f"{entry.changes[:12]} controls the line as epoch {epoch}, on probation for {self._line.gate.probation_s:g}"
            f" s of running; `r2rgate rollback` takes it back at once, `r2rgate proposals` shows how it does{unwatched}"
        )

    async def _look_after(self, found: InService) -> None:
        entry, now_s = self.book.on_the_line, self._clock()
        if entry is None:
            await self._look_after_good(found)
            return
        if entry.stage is Stage.RUNNING:
            await self._end_unheard(entry, now_s)
            return
        if against := self._surroundings.against_keeping():
            await self._loop.tell(Rollback(reason=against))
            await self._settle()
        elif entry.stage is Stage.KEEPING or not self._unseen(now_s):
            await self._keep(entry, found)
        elif now_s - self._renewed_s >= LEASE_S / 3.0:
            await self._loop.tell(Renew(epoch=entry.epoch or found.epoch))
            self._renewed_s = now_s

    def _to_look_after(self) -> bool:
        book = self.book
        return book.model is not None and (book.model, book.last_known_good) != self._looked_after

    def _unseen(self, now_s: float) -> str:
        """Why what is on probation is not kept yet."""
        since_s, probation_s = now_s - self._probation_since_s, self._line.gate.probation_s
        if since_s < probation_s:
            return f"it has been watched for {since_s:.0f} s of {probation_s:g} s"
        return self._surroundings.unseen()

    async def _keep(self, entry: Entry, found: InService) -> None:
        """What cannot be kept is taken back."""
        if entry.stage is Stage.PROBATION:
            await self._step("keeping", {"proposal": entry.proposal, "epoch": entry.epoch}, GATEWAY)
        watch = None
        try:
            watch = await self._surroundings.recovery(entry.changes, found.region, self.book)
            reply = await self._loop.tell(Keep(epoch=entry.epoch or found.epoch, watch=watch))
            because = "" if reply.ok else "; ".join([reply.text, *reply.reasons])
        except NotKnown as error:
            because = str(error)
        if because:
            await self._loop.tell(Rollback(reason=f"it could not be kept: {because}"[:LONGEST_REASON]))
        elif watch is not None:
            self._looked_after = self.book.model, entry.changes
        await self._settle()

    async def _look_after_good(self, found: InService) -> None:
        """A model that is new in service looks after what runs, too."""
        pair = self.book.model, found.last_known_good
        if self.book.model is None or pair == self._looked_after:
            return
        self._looked_after, self._unwatched = pair, ""  # a refusal would be the same again
        try:
            watch = await self._surroundings.recovery(found.last_known_good, found.region, self.book)
            if watch is None:
                return
            reply = await self._loop.tell(WatchGood(watch=watch))
            because = "" if reply.ok else "; ".join([reply.text, *reply.reasons])
        except NotKnown as error:
            because = str(error)
        except Unreachable:
            self._looked_after = None
            raise
        if because:
            self._unwatched = f"the loop does not watch by the model in service: {because}"

    async def _end_unheard(self, entry: Entry, now_s: float) -> None:
        """Of an experiment whose end nobody has told: the loop was started anew, or this process."""
        if self._experiment is None or self._experiment[0] != entry.proposal:
            change = self._proposal(entry).change
            takes_s = change.experiment.duration_s if isinstance(change, ExperimentChange) else 0.0
            self._experiment = (entry.proposal, now_s + takes_s + UNHEARD_S)
        elif now_s >= self._experiment[1]:
            what = {"proposal": entry.proposal, "because": "the loop has not told its end"}
            await self._step("experiment-ends", what, GATEWAY)

    async def experiment_ended(self, hash_: str, because: str) -> None:
        """The loop has told that an experiment is over; `because` empty: complete."""
        async with self._one_step:
            entry = self.book.on_the_line
            if entry is None or entry.stage is not Stage.RUNNING or entry.changes != hash_:
                return
            try:
                await self._step("experiment-ends", {"proposal": entry.proposal, "because": because}, GATEWAY)
            except AuditUnavailable as error:
                self.trouble = str(error)

    async def _settle(self) -> InService:
        """Ask the loop what it runs, and record until the book says so too. Raises Unreachable, AuditUnavailable."""
        reply = await self._loop.tell(AskConfiguration())
        if reply.in_service is None:
            raise RemoteError("the loop does not say what controls the line")
        found = reply.in_service
        for _ in range(MOST_SETTLING):
            if (step := reconciled(self.book, found)) is None:
                self._settled = True
                return found
            await self._step(*step, GATEWAY)
        raise Impossible("the book does not come to what the loop says")

    def _proposal(self, entry: Entry) -> Proposal:
        return Proposal.model_validate_json(self._kept(entry.proposal))

    def _verdict(self, entry: Entry) -> Verdict | None:
        return None if entry.verdict is None else Verdict.model_validate_json(self._kept(entry.verdict))

    def _kept(self, id_: str) -> bytes:
        """Raises AuditUnavailable where it is no longer what was stored."""
        if (content := self._audit.blob(id_)) is None:
            raise AuditUnavailable(f"the audit has lost {id_[:12]}: `r2rgate audit verify` tells more")
        return content

    async def _tidy(self) -> None:
        """What is left over: of time, of a gateway that ended before it could go on, of an audit that was not there."""
        now_s = self._wall_clock()
        for entry in self.book.undecided:
            if now_s >= entry.expires_s:
                what = {"proposal": entry.proposal, "because": f"nobody decided until {entry.expires}"}
                await self._step("expired", what, GATEWAY)
            elif entry.stage is Stage.APPROVED:
                because = "it was approved, and not carried out: decide again"
                await self._step("approval-lapsed", {"proposal": entry.proposal, "because": because}, GATEWAY)
            elif entry.stage is Stage.RECEIVED and entry.proposal not in self._judging:
                self._begin_judging(entry.proposal)

    async def _approve_small(self) -> None:
        """Where the line's file allows it: what is like enough to what a person approved passes by its verdict alone.

        One a look, and each once: what could not be carried out waits for a person.
        """
        if self._line.gate.autonomy != "approve-first" or self.book.on_the_line is not None:
            return
        for entry in self.book.entries.values():
            if entry.stage is Stage.WAITING and entry.proposal not in self._looked_at:
                self._looked_at.add(entry.proposal)
                if not self._why_a_person(entry):
                    found = await self._settle()
                    what = {"proposal": entry.proposal, "by": VERDICT, "like": self.book.trusted[entry.kind]}
                    await self._step("approved", what, GATEWAY)
                    await self._carry_out(self.book.entries[entry.proposal], found, GATEWAY)
                return

    def _why_a_person(self, entry: Entry) -> list[str]:
        """Why a person must decide; empty: the verdict is enough."""
        if (trusted := self.book.trusted.get(entry.kind)) is None:
            return [f"no person has approved a change of {entry.kind} yet, or one was rolled back since"]
        before, now = self.book.entries[trusted], self._proposal(entry)
        reasons = beyond_small(self._proposal(before).change, now.change, self._line.gate.small_share)
        if isinstance(now.change, GainsChange):
            regions = [verdict and verdict.region for verdict in (self._verdict(before), self._verdict(entry))]
            if regions[0] is None or regions[1] is None or not regions[1].within(regions[0]):
                reasons.append("it would be in service further than what a person approved")
        return reasons

    async def _step(
        self, kind: str, what: Mapping[str, Any], who: Who, blobs: Mapping[str, bytes] | None = None
    ) -> None:
        """A record, on the disk before the book knows of it. Raises Impossible, AuditUnavailable."""
        if reason := self.book.why_not(kind, what):
            raise Impossible(reason)
        what = {**what, "at_s": self._wall_clock()}
        await self._audit.append(kind, who, what, blobs)
        self.book.apply(kind, what)

    async def _malformed(self, payload: bytes, refused: ProposalRefused, who: Who) -> Reply:
        what = {"payload": hashlib.sha256(payload).hexdigest(), "reasons": refused.reasons[:20]}
        try:
            await self._audit.append("malformed-proposal", who, what)
        except AuditUnavailable as error:
            return self._refused("it is no proposal", [*refused.reasons, str(error)])
        return self._refused("it is no proposal", refused.reasons)

    def _done(self, text: str) -> Reply:
        return Reply(ok=True, state="", text=text)

    def _refused(self, text: str, reasons: list[str]) -> Reply:
        return Reply(ok=False, state="", text=text, reasons=reasons)


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


def _line_of(entry: Entry, why: str) -> ProposalLine:
    return ProposalLine(
        proposal=entry.proposal, kind=entry.kind, author=entry.author, stage=entry.stage, why=why,  # type: ignore[arg-type]
        created=entry.created, expires=entry.expires, epoch=entry.epoch,
    )  # fmt: skip


def iso(wall_s: float) -> str:
    """Unix time as ISO 8601 with zone."""
    return datetime.fromtimestamp(wall_s, UTC).isoformat(timespec="milliseconds")

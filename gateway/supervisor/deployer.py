"""The one way in: proposals are judged, decided, put on the line, watched, kept or rolled back, audited step by step.

Every step is a record of the audit, stored before what it announces is done; without an audit nothing is changed, and
the loop runs on. Here is what people and programs ask for, and what passes without a person; `proposal_inbox` has
proposals judged, `on_the_line` carries out what is approved.
"""

import asyncio
import os
from collections.abc import Awaitable, Callable, Mapping
from math import inf
from typing import Any

from gateway.core.audit_record import Who
from gateway.core.decisions import MOST_LISTED, Confirm, Decide, ProposalLine, ProposalList, ProposalShown, shown_hash
from gateway.core.deployment import InService, Region, WiringStatus, least_shown
from gateway.core.finding import Finding, finding
from gateway.core.judge_context import JudgeContext
from gateway.core.line import Line
from gateway.core.messages import Reply
from gateway.core.people import Role
from gateway.core.proposal import Proposal, canonical
from gateway.core.recording import Recording
from gateway.core.status import ChangeStatus
from gateway.core.steady_clock import AGREES_AFTER_S, SteadyClock
from gateway.core.verdict import line_hash
from gateway.mailbox.port import NotSent, Unreachable
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.bounded import with_left_out
from gateway.supervisor.deployer_sides import AuditSide, JudgeSide, LoopSide, NotKnown, NotTakenUp, Surroundings
from gateway.supervisor.four_eyes import (
    APPROVED_ONCE,
    FirstApproval,
    approver_of,
    still_counts,
    why_no_person,
    why_not_second,
)
from gateway.supervisor.lifecycle import (
    CONFIRMED,
    LINE_CHANGED,
    ON_THE_LINE,
    PERSON,
    SCRIPT,
    UNDECIDED,
    VERDICT,
    Book,
    Entry,
    Impossible,
    Stage,
)
from gateway.supervisor.on_the_line import OnTheLine
from gateway.supervisor.peers import GATEWAY
from gateway.supervisor.proposal_inbox import Inbox
from gateway.supervisor.proposal_records import ProposalRecords, done, not_known, refused, refused_by
from gateway.supervisor.small_changes import SmallChanges
from gateway.supervisor.store import boot_id

RETRY_S = 30.0  #: after what passes by its verdict could not be carried out; then twice as long each time
MOST_RETRIES = 5  #: then it waits for a person


class Deployer:
    """`propose`, `decide` and `roll_back` for others; `hold` and `watch` a few times a second, neither of which waits
    for the other. All in one event loop.
    """

    def __init__(
        self,
        line: Line,
        book: Book,
        audit: AuditSide,
        loop: LoopSide,
        judge: JudgeSide,
        surroundings: Surroundings,
        take_up: Callable[[Proposal, str | None], Awaitable[None]],
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
        own_uid: int | None = None,
        roles: Callable[[], Mapping[str, Role] | None] = lambda: None,
        note: Callable[..., None] = lambda *_, **__: None,
    ) -> None:
        """`take_up` puts into the stores what is about to be put into service; raises NotTakenUp.

        `own_uid`: the user that the gateway runs as; None: that of this process. `roles`: of the people who may come
        in, None while they are not known. `note`: an event of the gateway: kind, text and data.
        """
        self.book = book
        self.book.line = line_hash(line)
        self._roles = roles
        self._own_uid = os.getuid() if own_uid is None else own_uid
        self._line = line
        self._surroundings = surroundings
        clocks = SteadyClock(clock, wall_clock, boot_id())
        self._records = ProposalRecords(book, audit, clocks)
        self._inbox = Inbox(line, self._records, judge, surroundings, lambda: roles() or ())
        self._on_the_line = OnTheLine(line, self._records, loop, surroundings, take_up, clock, note)
        self._small = SmallChanges(line, self._records)
        self._clock = clock
        self._recalled: dict[str, Entry] = {}  #: that the book has forgotten, and somebody has asked for last
        #: Of proposals that would pass without a person, or not: when that is looked at again; inf: never.
        self._looked_at_again_s: dict[str, float] = {}
        self._failures: dict[str, int] = {}  #: to carry out what passes without a person, by proposal

    @property
    def trouble(self) -> str:
        """Why the last look came to nothing; empty: it did not."""
        return self._records.trouble

    @property
    def unexplained(self) -> list[Finding]:
        """What is in service, where no record says how it came to be."""
        hash_ = self.book.unexplained
        if hash_ is None or hash_ != self.book.in_service:
            return []
        return [finding("configuration-unexplained", configuration=hash_[:12], epoch=self.book.epoch)]

    @property
    def unconfirmed(self) -> list[Finding]:
        """What is in service, where nobody has judged or confirmed it, though the records say how it came to be."""
        hash_ = self.book.in_service
        if hash_ is None or self.unexplained or not self.book.is_unconfirmed:
            return []
        return [finding("configuration-unconfirmed", configuration=hash_[:12])]

    @property
    def wiring(self) -> WiringStatus | None:
        """Of the line, as the loop told it last; None: it has not told yet."""
        return self._on_the_line.wiring

    async def propose(self, payload: bytes, who: Who) -> Reply:
        """Take a proposal in, and judge it in the background."""
        return await self._inbox.propose(payload, who)

    async def decide(self, decision: Decide, who: Who) -> Reply:
        """A person's word, straight from the mailbox. The approval is of what was shown, and good once."""
        approver = approver_of(who)
        if decision.approve and self._line.gate.approvals > 1 and (reason := why_no_person(who, self._own_uid)):
            return refused("nothing was decided", [reason])
        if decision.script:
            who = who.model_copy(update={"name": f"{decision.script}, run by {who.name}"})
        async with self._records.one_step:
            entry = self.book.entries.get(decision.proposal) or self._recalled.get(decision.proposal)
            if reasons := self._why_not_decide(entry, decision, approver):
                return refused("nothing was decided", reasons)
            assert entry is not None  # _why_not_decide says so
            by = SCRIPT if decision.script else PERSON
            what = {"proposal": entry.proposal, "shown": decision.shown, "comment": decision.comment, "by": by}
            try:
                if not decision.approve:
                    await self._records.step("rejected", {**what, "because": decision.comment or f"by {who.name}"}, who)
                    return done(f"proposal {entry.proposal[:12]} is rejected")
                found = await self._on_the_line.settle()
                entry = self.book.entries[entry.proposal]
                if reasons := self._why_not_decide(entry, decision, approver):
                    return refused("the line has changed since it was shown", reasons)
                if self._line.gate.approvals > 1:
                    if (first := self._first(entry)) is None:
                        return await self._approve_once(
                            entry, {**what, "approver": list(approver), "name": who.name}, who
                        )
                    what |= {"by": SCRIPT if SCRIPT in (by, first.by) else PERSON, "first": first.name}
                await self._records.step("approved", what, who)
                return await self._carry_out(entry.proposal, found, who)
            except (AuditUnavailable, Unreachable, Impossible, NotTakenUp, NotKnown) as error:
                return refused("it is not carried out", [str(error)])

    async def roll_back(self, comment: str, who: Who, left_out: int | None = 0) -> Reply:
        """To the last known good configuration, now. Done even where the audit is not there: it is the safe side.

        The line first, which waits for no disk and for no step that is under way; what is deployed in between goes back
        as soon as its step is over. `left_out`: how many were done and not recorded before it; None: nor is this one.
        """
        reason, recorded = comment or f"asked for by {who.name}", ""
        try:
            reply = await self._on_the_line.back(reason)
        except NotSent as error:
            return refused("not confirmed", [str(error)])
        except Unreachable as error:
            return not_known("whether it was taken back; `r2rgate proposals` shows what runs", [str(error)])
        if left_out is None and not self._on_watch() and not self._records.one_step.locked():
            self.look_again()  # whoever says it without end holds up nothing
            return reply
        async with self._records.one_step:
            given_up = self._on_watch()
            try:
                if left_out is not None:
                    await self._records.note("rollback-asked", who, with_left_out({"comment": comment}, left_out))
            except AuditUnavailable as error:
                recorded = f"; it could not be recorded: {error}"
            try:
                await self._on_the_line.settle()
                if self._on_watch():
                    reply = await self._on_the_line.roll_back(reason)
            except (Unreachable, AuditUnavailable, Impossible) as error:
                return not_known("whether it was taken back; `r2rgate proposals` shows it", [f"{error}{recorded}"])
        further = ""
        if reply.in_service is not None and not given_up:
            further = "; to go further back, propose what ran before (`r2rgate configurations list`)"
        return reply.model_copy(update={"text": reply.text + further + recorded})

    def _on_watch(self) -> bool:
        """Whether the book has a change on its way to the line, or on probation."""
        change = self.book.on_the_line
        return change is not None and change.stage is not Stage.RUNNING

    async def line_changed(self, because: str, who: Who) -> Reply:
        """From now on it is another line: what was learned of it, and what was judged by that, counts no more."""
        async with self._records.one_step:
            try:
                if reason := self.book.why_not(LINE_CHANGED, {}):
                    return refused("nothing is changed", [reason])
                # The loop first: it can only become narrower by it, whatever becomes of the record.
                narrowed = await self._on_the_line.narrow()
                if not narrowed.ok:
                    return refused("nothing is changed", narrowed.reasons or [narrowed.text])
                await self._records.step(LINE_CHANGED, {"because": because}, who)
            except (NotSent, Impossible) as error:
                return refused("nothing is changed", [str(error)])
            except (AuditUnavailable, Unreachable) as error:
                text = "whether the loop goes no further than a first configuration; it is not on record: say it again"
                return not_known(text, [str(error)])
        return done(
            "from now on proposals are judged on the line's file: it must be right for the new web and parts, so write "
            "its values there and start the gateway anew where they lie beyond its tolerances. What is in service "
            "stays, for low speed and small steps, until something else is approved"
        )

    async def confirm(self, said: Confirm, who: Who) -> Reply:
        """A person answers for what is in service: an unjudged one that has shown itself, or one no record explains."""
        told_apart = self._line.gate.approvals > 1 or self._roles()
        if told_apart and why_no_person(who, self._own_uid):
            return refused_by("nothing is confirmed", [finding("confirm-by-no-person", who=who.name)])
        async with self._records.one_step:
            try:
                await self._on_the_line.look_after()
                what = {"configuration": said.configuration, "because": said.because}
                if missing := await self._not_shown(what):
                    return refused_by("nothing is confirmed", missing)
                await self._records.step(CONFIRMED, what, who)
                self._on_the_line.settled = False  # the loop is told with the next look
            except (AuditUnavailable, Unreachable, Impossible) as error:
                return refused("nothing is confirmed", [str(error)])
        return done(
            f"{said.configuration[:12]} is confirmed; it goes no further than a first configuration until one is "
            "proposed for more, and approved"
        )

    async def _not_shown(self, what: Mapping[str, Any]) -> list[Finding]:
        """What a first configuration has not been seen to do since it controls the line. Raises as `settle`.

        One that no record explains is not armed before it is confirmed: it cannot have shown anything.
        """
        hash_ = str(what["configuration"])
        if hash_ == self.book.unexplained or self.book.why_not(CONFIRMED, what):
            return []
        found = await self._on_the_line.settle()
        least_n, least_m_per_s = least_shown(self._line)
        missing: list[Finding] = []
        if not found.tension_moved:
            missing.append(finding("move-not-shown", configuration=hash_[:12], least_n=least_n))
        if not found.speed_changed:
            missing.append(finding("speed-change-not-shown", configuration=hash_[:12], least_m_per_s=least_m_per_s))
        return missing

    async def hold_against_records(self, within_s: float) -> str:
        """Why what the loop runs is not held against the records yet; empty: it is. Raises Unreachable.

        `within_s`: for another step to end first; the loop's answer has its own time.
        """
        if self._on_the_line.settled:
            return ""
        try:
            async with asyncio.timeout(within_s):
                await self._records.one_step.acquire()
        except TimeoutError:
            return "another change is under way"
        try:
            await self._on_the_line.look_after()
        except (AuditUnavailable, Impossible) as error:
            return str(error)
        finally:
            self._records.one_step.release()
        return "" if self._on_the_line.settled else "what becomes of a change is not known yet"

    def look_again(self) -> None:
        """The loop has told of a change that this process did not order, or of its start."""
        self._on_the_line.settled = False

    async def experiment_ended(self, hash_: str, because: str) -> None:
        """The loop has told that an experiment is over; `because` empty: complete."""
        await self._on_the_line.experiment_ended(hash_, because)

    async def hold(self) -> None:
        """What is on probation has its lease renewed, or goes back: whatever the audit and `watch` wait for."""
        try:
            await self._on_the_line.hold()
        except Unreachable as error:
            self._records.trouble = str(error)  # the next `watch` asks the loop

    async def watch(self) -> None:
        """Proposals expire, what is on probation is kept or left to fall back.

        After a start it goes on from what the records and the loop say.
        """
        if self._records.one_step.locked():
            return
        async with self._records.one_step:
            try:
                await self._tidy()
                await self._approve_small()
                await self._on_the_line.look_after()
            except (AuditUnavailable, Unreachable, Impossible, NotTakenUp, NotKnown) as error:
                # What nobody holds the loop takes back by itself; the next look settles it.
                self._records.trouble = str(error)
            else:
                self._records.trouble = self._on_the_line.unconfined or self._on_the_line.unwatched
            if self.book.forget():
                for noted in (self._looked_at_again_s, self._failures):
                    for one in noted.keys() - self.book.entries.keys():
                        del noted[one]

    async def judged(self) -> None:
        """Until nothing is being judged any more."""
        await self._inbox.judged()

    async def judged_as(self, entry: Entry) -> tuple[bytes, JudgeContext, Region]:
        """The bytes that were judged, in which context, and for what. Raises AuditUnavailable, NotKnown."""
        await self._records.fetch([entry])
        verdict = self._records.verdict(entry)
        if verdict is None or verdict.region is None:
            raise NotKnown("it was not accepted")
        return canonical(self._records.proposal(entry)), await self._records.context(verdict), verdict.region

    async def context(self) -> tuple[JudgeContext, list[Recording]]:
        """What a proposal would be judged against now. Raises NotKnown."""
        return await self._surroundings.context(self.book)

    async def close(self) -> None:
        await self._inbox.close()
        await self._surroundings.close()

    async def at_hand(self, beginning: str | None = None, *, difference: bool = False) -> None:
        """Before `watch`, `listed`, `shown` and `decide`: what they need of the disk. `beginning`: of this proposal.

        `difference`: also what is needed to tell what it would change. One that the book has forgotten is shown until
        the next is asked for.
        """
        if self._line.gate.autonomy == "approve-first":  # whether it passes by itself depends on what it is
            await self._small.look()
        if beginning is not None:
            try:
                found = await self._records.recall(beginning)
            except AuditUnavailable:
                found = []  # it is said not to be there, until it can be read
            await self._records.fetch(found[:1])
            self._recalled = {one.proposal: one for one in found if one.proposal not in self.book.entries}
        if difference:
            await self._surroundings.at_hand(self.book)

    async def page(self, most: int, skip: int) -> ProposalList:
        """As `listed`, also of what the book has forgotten. Raises AuditUnavailable."""
        return self.listed(most, skip, await self._records.newest(most, skip))

    def listed(self, most: int, skip: int = 0, page: list[Entry] | None = None) -> ProposalList:
        """The newest first, but for the first `skip`; with those that are not done with, where none are left out.

        `page`: these of them, as the records have them.
        """
        entries = list(reversed(self.book.entries.values()))
        newest = entries[skip : skip + most] if page is None else page
        if not skip:  # whoever proposes much must not hide what waits
            told = {entry.proposal for entry in newest}
            older = (entry for entry in entries if entry.proposal not in told)
            newest += [entry for entry in older if entry.stage in (*UNDECIDED, *ON_THE_LINE)][:MOST_LISTED]
        return ProposalList(
            format=1,
            site=self._line.site,
            line=self._line.line,
            in_service=self.book.in_service,
            last_known_good=self.book.last_known_good,
            epoch=self.book.epoch,
            model=self.book.model,
            line_changed_s=self.book.line_changed_s,
            since_change=self.book.made - self.book.before_change,
            proposals=[_line_of(entry, self._why(entry)) for entry in newest],
        )

    def shown(self, beginning: str) -> ProposalShown | str:
        """The proposal whose hash begins so; a sentence where there is not exactly one."""
        known = {**self._recalled, **self.book.entries}
        found = [entry for hash_, entry in known.items() if hash_.startswith(beginning)]
        if len(found) != 1:
            return f"{len(found)} proposals begin with {beginning}: `r2rgate proposals` lists them"
        (entry,) = found
        proposal, first = self._records.proposal(entry), self._first(entry)
        return ProposalShown(
            format=1, stage=entry.stage, why=self._why(entry), proposal_hash=entry.proposal,
            shown=self._shown_hash(entry), epoch=self.book.epoch,
            difference=self._surroundings.difference(proposal, self.book), proposal=proposal,
            verdict=self._records.verdict(entry), approvals=self._line.gate.approvals,
            approved_by=None if first is None else first.name,
        )  # fmt: skip

    def change(self) -> ChangeStatus | None:
        """What is being done to the line now."""
        if (entry := self.book.on_the_line) is None:
            return None
        return ChangeStatus(
            proposal=entry.proposal, kind=entry.kind, stage=entry.stage, since_wall_s=entry.since_s,
            text=self._why(entry),
        )  # fmt: skip

    def _why(self, entry: Entry) -> str:
        """What there is to say of its stage."""
        if entry.stage is Stage.DEPLOYING:
            return "whether the loop has taken it is not known yet"
        if entry.stage is Stage.KEEPING:
            return "whether the loop has kept it is not known yet"
        if entry.stage is Stage.PROBATION:
            return f"not kept yet: {self._on_the_line.unseen() or 'about to be'}"
        if entry.stage is not Stage.WAITING:
            return entry.why
        reasons = [entry.why, self._why_not_recent(entry)]
        if self._line.gate.autonomy == "approve-first":
            by_person = self._small.why_a_person(entry)
            not_yet = ["whether it passes by its verdict alone was not looked at yet"]
            reasons += not_yet if by_person is None else by_person
        if self._line.gate.approvals > 1:
            first = self._first(entry)
            two = "it takes two people" if first is None else f"{first.name} has approved it, it takes another person"
            reasons = [two, *reasons]
        return "; ".join(reason for reason in reasons if reason)

    def _shown_hash(self, entry: Entry) -> str | None:
        if entry.stage is not Stage.WAITING or entry.verdict is None or self.book.in_service is None:
            return None
        return shown_hash(entry.proposal, entry.verdict, self.book.in_service, self.book.epoch, self.book.model)

    def _first(self, entry: Entry) -> FirstApproval | None:
        """The first approval of what would be approved now; None: there is none."""
        first = entry.first
        if first is None or first.shown != self._shown_hash(entry):
            return None
        return first if still_counts(first, self._own_uid, self._roles()) else None

    async def _approve_once(self, entry: Entry, what: dict[str, Any], who: Who) -> Reply:
        await self._records.step(APPROVED_ONCE, what, who)
        return done(
            f"your approval of {entry.proposal[:12]} is on record, as the first of two: it is carried out once another "
            f"person has approved it, too, before {entry.expires}"
        )

    async def _carry_out(self, proposal: str, found: InService, who: Who) -> Reply:
        """What has just been approved. Raises as `OnTheLine.carry_out`.

        Where it comes to nothing before the loop is told of it, the approval counts no more, on record and at once.
        """
        try:
            return await self._on_the_line.carry_out(self.book.entries[proposal], found, who)
        except (NotTakenUp, NotKnown, Impossible) as error:
            if self.book.entries[proposal].stage is Stage.APPROVED:
                because = f"it was approved, and not carried out: {error}"
                await self._records.step("approval-lapsed", {"proposal": proposal, "because": because}, GATEWAY)
            raise

    def _why_not_decide(self, entry: Entry | None, decision: Decide, approver: tuple[str, ...]) -> list[str]:
        if entry is None:
            return [f"there is no proposal {decision.proposal[:12]}: `r2rgate proposals` lists them"]
        if entry.stage is not Stage.WAITING:
            return [f"proposal {entry.proposal[:12]} is {entry.stage}{f': {entry.why}' if entry.why else ''}"]
        if (decision.approve or self._has_expired(entry)) and (because := self._why_not_recent(entry)):
            return [because]
        if because := self.book.why_outdated(entry):
            return [because]
        if decision.revision not in (None, self.book.epoch):
            now = f"in service is revision {self.book.epoch}"
            return [f"what was shown was of revision {decision.revision}, {now}: look at it again, then decide"]
        if decision.shown != self._shown_hash(entry):
            return ["what was shown is no longer what would be done: look at it again, then decide"]
        first = self._first(entry) if decision.approve and self._line.gate.approvals > 1 else None
        same = "" if first is None else why_not_second(first, approver)
        return [same] if same else []

    async def _tidy(self) -> None:
        """What is left over: of time, of a gateway that ended before it could go on, of an audit that was not there."""
        for entry in self.book.undecided:
            if self._has_expired(entry):
                what = {"proposal": entry.proposal, "because": f"nobody decided until {entry.expires}"}
                await self._records.step("expired", what, GATEWAY)
            elif because := self.book.why_outdated(entry):
                await self._records.step("superseded", {"proposal": entry.proposal, "because": because}, GATEWAY)
            elif entry.stage is Stage.APPROVED:
                because = "it was approved, and not carried out: decide again"
                await self._records.step("approval-lapsed", {"proposal": entry.proposal, "because": because}, GATEWAY)
        self._inbox.judge_again()

    def _has_expired(self, entry: Entry) -> bool:
        """For certain: then it is on record. A time that is no number has gone by."""
        return not self._records.age(entry).least_s < self._stands_s(entry)

    def _why_not_recent(self, entry: Entry) -> str:
        """Why it may not be approved: it has expired, or may have. Empty: it stands for certain."""
        if self._records.age(entry).most_s < self._stands_s(entry):
            return ""
        if self._has_expired(entry):
            return f"it has expired at {entry.expires}"
        return (
            f"whether it has expired, at {entry.expires}, is not known: it came before this computer was started, and "
            f"the clock was not seen to agree then, or is not yet ({AGREES_AFTER_S / 60.0:g} min after a start): wait, "
            "or propose it again"
        )

    def _stands_s(self, entry: Entry) -> float:
        """From when it came: as long as it was to stand then, and no longer than the line's file allows."""
        if entry.received is None:
            return 0.0
        return min(entry.expires_s - entry.received.wall_s, self._line.gate.expiry_max_s)

    async def _approve_small(self) -> None:
        """Where the line's file allows it: what is like enough to what a person approved passes by its verdict alone.

        One a look. What was not looked at yet waits for the next look; what could not be carried out is tried again,
        `MOST_RETRIES` times, and then waits for a person.
        """
        now_s = self._clock()
        if self._line.gate.autonomy != "approve-first" or self.book.on_the_line is not None:
            return
        for entry in self.book.entries.values():
            if entry.stage is Stage.WAITING and now_s >= self._looked_at_again_s.get(entry.proposal, now_s):
                if self._why_not_recent(entry) or (reasons := self._small.why_a_person(entry)) is None:
                    continue
                self._looked_at_again_s[entry.proposal] = inf
                if not reasons:
                    await self._approve(entry)
                return

    async def _approve(self, entry: Entry) -> None:
        """By its verdict alone. Raises as `OnTheLine.carry_out`."""
        try:
            found = await self._on_the_line.settle()
            what = {"proposal": entry.proposal, "by": VERDICT, "like": self.book.trusted[entry.kind]}
            await self._records.step("approved", what, GATEWAY)
            await self._carry_out(entry.proposal, found, GATEWAY)
        except Exception:
            failures = self._failures[entry.proposal] = self._failures.get(entry.proposal, 0) + 1
            if failures <= MOST_RETRIES:
                self._looked_at_again_s[entry.proposal] = self._clock() + RETRY_S * 2.0 ** (failures - 1)
            raise


def _line_of(entry: Entry, why: str) -> ProposalLine:
    return ProposalLine(
        proposal=entry.proposal, kind=entry.kind, author=entry.author, stage=entry.stage, why=why,
        created=entry.created, expires=entry.expires, epoch=entry.epoch,
    )  # fmt: skip

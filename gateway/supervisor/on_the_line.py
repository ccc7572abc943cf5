"""What a change does to the line: carried out, on probation under watch, kept or taken back, as the loop has it.

What the loop says of itself settles what a record left open: after a restart, after an answer that did not come.
"""

from collections.abc import Awaitable, Callable
from typing import Any

from gateway.core.audit_record import Who
from gateway.core.deployment import Deployment, InService, WiringStatus, first_region
from gateway.core.line import Line
from gateway.core.messages import (
    AskConfiguration,
    Command,
    Confirmed,
    Deploy,
    Keep,
    Narrow,
    Renew,
    Reply,
    Rollback,
    RunExperiment,
)
from gateway.core.proof import Grounds
from gateway.core.proposal import ExperimentChange, GainsChange, Proposal
from gateway.mailbox.port import NotSent, RemoteError, Unreachable
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.deployer_sides import LoopSide, NotKnown, Surroundings
from gateway.supervisor.good_watch import GoodWatch
from gateway.supervisor.lifecycle import Entry, Impossible, Stage, reconciled
from gateway.supervisor.peers import GATEWAY
from gateway.supervisor.proposal_records import ProposalRecords, done, not_known, refused

LEASE_S = 5.0  #: of a deployment on probation; renewed every third of it
UNHEARD_S = 10.0  #: after an experiment should be over
UNRECORDED_S = 60.0  #: a disk that hangs for less takes back nothing that is good; a full one does, as an audit must
LONGEST_REASON = 500  #: characters of one for the loop
ASKED_AGAIN_S = 10.0  #: though it has told of no change: what it tells may get lost
LATE_S = 30.0  #: for so long a loop that has not answered may still do what it was told: it builds, then waits
MOST_SETTLING = 1000  #: records in a row from one look at the loop; more is a fault of this program


#: Findings of the loop that speak against the moment, as `gateway.loop.deploy` has them, and its watch.
PASSING = frozenset(
    {
        "no-change-now", "experiment-under-way", "setpoints-move", "signals-held", "line-too-fast", "on-probation",
        "doubt-saturated", "doubt-cell-stuck", "doubt-cell-drifts", "doubt-torque-not-compared",
    }
)  # fmt: skip
AGAIN = "it waits, and may be approved again once that has passed"
TOLD_LATER = "`r2rgate proposals` and the events tell it once the loop has been asked"


class OnTheLine:
    """Its steps are taken one at a time: whoever calls holds the records' lock, but for `experiment_ended`, `hold`."""

    def __init__(
        self,
        line: Line,
        records: ProposalRecords,
        loop: LoopSide,
        surroundings: Surroundings,
        take_up: Callable[[Proposal, str | None], Awaitable[None]],
        clock: Callable[[], float],
        note: Callable[..., None],
    ) -> None:
        self.unconfined = ""  #: why what no record explains goes further than a first configuration; empty: it does not
        self.wiring: WiringStatus | None = None  #: as the loop told it last
        self.settled = False  #: the loop has been asked since this process began, or since it told of a change
        self._line = line
        self._records = records
        self._loop = loop
        self._surroundings = surroundings
        self._take_up = take_up  #: into the stores, before it is put into service; raises NotTakenUp
        self._clock = clock
        self._renewed_s = clock()
        self._probation_since_s = clock()
        self._followed_s = clock()  #: it was looked after last, and whatever was to be recorded was
        self._experiment: tuple[str, float] | None = None  #: that runs, and when its end is overdue
        self._note = note
        self._asked_s = clock()  #: what it runs
        #: Proposals of which the loop was told something and has not answered: until when it may still do it.
        self._unanswered: dict[str, float] = {}
        change = records.book.on_the_line
        if change is not None and change.stage in (Stage.DEPLOYING, Stage.KEEPING):
            self._unanswered[change.proposal] = clock() + LATE_S  # the process before this one has told it
        self._good_watch = GoodWatch(records.book, surroundings, self._tell, clock)

    @property
    def unwatched(self) -> str:
        """Why the loop does not watch by the model in service; empty: it does, or there is none."""
        return self._good_watch.unwatched

    async def settle(self) -> InService:
        """Ask the loop what it runs, and record until the book says so too. Raises Unreachable, AuditUnavailable."""
        reply = await self._tell(AskConfiguration())
        self._asked_s = self._clock()
        if reply.in_service is None:
            raise RemoteError("the loop does not say what controls the line")
        found = reply.in_service
        self.wiring = found.wiring
        for _ in range(MOST_SETTLING):
            if (step := reconciled(self._records.book, found)) is None:
                self.settled = True
                return found
            kind, what = step
            if kind == "not-deployed" and self._clock() < self._unanswered.get(what["proposal"], 0.0):
                return found  # it may still take it
            await self._record_outcome(kind, what)
        raise Impossible("the book does not come to what the loop says")

    async def _record_outcome(self, kind: str, what: dict[str, Any]) -> None:
        """What the loop has said of itself; where its answer had not come, an event tells it, too."""
        proposal = what.get("proposal", "")
        unanswered = proposal in self._unanswered
        await self._records.step(kind, {**what, "unanswered": True} if unanswered else what, GATEWAY)
        if kind == "deployed":
            self._probation_since_s = self._renewed_s = self._followed_s = self._clock()
            if unanswered:
                self._surroundings.change_taken()
                self._renewed_s -= LEASE_S  # nobody knows how much of it is left
        if unanswered and kind != "keeping":
            del self._unanswered[proposal]
            because = f": {what['because']}" if what.get("because") else ""
            epoch = f" (epoch {what['epoch']})" if "epoch" in what else ""
            told = f"proposal {proposal[:12]} is {kind}{epoch}, though the loop's answer did not come{because}"
            self._note("outcome", told, proposal=proposal, outcome=kind, epoch=what.get("epoch"))

    async def _tell(self, command: Command, entry: Entry | None = None) -> Reply:
        """By the proposal of `entry`. Raises Unreachable; then the loop is asked again what it runs."""
        grounds = None if entry is None else _grounds(entry)
        try:
            return await self._loop.tell(command, grounds)
        except Unreachable:
            self.settled = False
            raise

    def _not_answered(self, proposal: str, error: Unreachable) -> None:
        """One that has answered that it failed does not do it later."""
        self._unanswered[proposal] = self._clock() + (0.0 if isinstance(error, RemoteError) else LATE_S)

    async def hold(self) -> None:
        """Look at what is on probation, and renew its lease or take it back. Raises Unreachable.

        It needs no record and no lock: a lease is over sooner than a disk that hangs is given up. What the loop says
        afterwards is recorded by `settle`. Where nothing can be recorded for `UNRECORDED_S`, it is left to fall back.
        """
        entry, now_s = self._records.book.on_the_line, self._clock()
        if entry is None or entry.stage not in (Stage.PROBATION, Stage.KEEPING):
            return
        if against := self._surroundings.against_keeping(now_s):
            await self.back(against)
            self.settled = False
        elif (
            now_s - self._renewed_s >= LEASE_S / 3.0
            and now_s - self._followed_s < UNRECORDED_S
            and entry.epoch is not None
        ):
            reply = await self._tell(Renew(epoch=entry.epoch), entry)
            self._renewed_s = now_s
            self.settled = self.settled and reply.ok  # one that is refused is kept by now, or has gone back

    async def look_after(self) -> None:
        """Keeps what is on probation; ends what is over. Raises as `settle`, and Impossible."""
        unheard = self._clock() - self._asked_s >= ASKED_AGAIN_S
        if self._records.book.on_the_line is not None or not self.settled or unheard or self._good_watch.is_due():
            await self._look_after(await self.settle())
        self._followed_s = self._clock()

    async def carry_out(self, entry: Entry, found: InService, who: Who) -> Reply:
        await self._records.fetch([entry])
        proposal = self._records.proposal(entry)
        if (other := self._records.book.on_the_line) is not None:  # a lease is not kept waiting for a store
            raise Impossible(f"proposal {other.proposal[:12]} is {other.stage}: one change at a time")
        await self._take_up(proposal, entry.verdict)
        if isinstance(proposal.change, GainsChange):
            return await self._deploy(entry, proposal.change, found, who)
        if isinstance(proposal.change, ExperimentChange):
            return await self._run(entry, proposal.change, who)
        await self._records.step("model-in-service", {"proposal": entry.proposal, "model": entry.changes}, who)
        return done(f"model {entry.changes[:12]} is what proposals are judged by from now on")

    async def _run(self, entry: Entry, change: ExperimentChange, who: Who) -> Reply:
        named = {"proposal": entry.proposal}
        await self._records.step("experiment-begins", named, who)
        try:
            reply = await self._tell(RunExperiment(experiment=change.experiment, proposal=entry.proposal), entry)
        except NotSent as error:
            await self._records.step("experiment-ends", {**named, "because": str(error)}, GATEWAY)
            return refused("it is not run", [str(error)])
        except Unreachable as error:
            self._not_answered(entry.proposal, error)
            return not_known("whether the experiment runs; its events tell", [str(error)])
        if not reply.ok:
            because = "; ".join([reply.text, *reply.reasons])[:1000]
            await self._records.step("experiment-ends", {**named, "because": because}, GATEWAY)
            return reply
        return done(f"{reply.text}; `r2rgate proposals {entry.proposal[:12]}` shows when it is done")

    async def back(self, reason: str) -> Reply:
        """The loop is told, and nothing is recorded. Raises Unreachable. A reason that is too long is cut."""
        return await self._tell(Rollback(reason=reason[:LONGEST_REASON]))

    async def roll_back(self, reason: str) -> Reply:
        """Now. Raises as `settle`, and Impossible."""
        reply = await self.back(reason)
        await self.settle()
        return reply

    async def narrow(self, *, confine: bool = False) -> Reply:
        """To what a first configuration is judged for; `confine`: also a line that runs faster. Raises as `settle`."""
        reply = await self._tell(Narrow(region=first_region(self._line), confine=confine))
        await self.settle()
        return reply

    async def experiment_ended(self, hash_: str, because: str) -> None:
        """The loop has told that an experiment is over; `because` empty: complete."""
        async with self._records.one_step:
            entry = self._records.book.on_the_line
            if entry is None or entry.stage is not Stage.RUNNING or entry.changes != hash_:
                return
            try:
                await self._record_outcome("experiment-ends", {"proposal": entry.proposal, "because": because})
            except AuditUnavailable as error:
                self._records.trouble = str(error)

    def unseen(self) -> str:
        """Why what is on probation is not kept yet."""
        return self._unseen(self._clock())

    async def _deploy(self, entry: Entry, change: GainsChange, found: InService, who: Who) -> Reply:
        verdict, epoch = self._records.verdict(entry), found.epoch + 1
        if verdict is None or not verdict.accepted or verdict.region is None:
            return refused("it is not carried out", ["no verdict lets it through"])
        watch = await self._surroundings.recovery(found.last_known_good, verdict.region, self._records.book)
        deployment = Deployment(
            controller=change.controller, hash=entry.changes, epoch=epoch, lease_s=LEASE_S, region=verdict.region,
            watch=watch,
        )  # fmt: skip
        named = {"proposal": entry.proposal, "epoch": epoch}
        what = {"configuration": entry.changes, "before": found.hash, "region": verdict.region.model_dump()}
        await self._records.step("deploying", {**named, **what, "watched": watch is not None}, who)
        self._surroundings.begin_probation()
        try:
            reply = await self._tell(Deploy(deployment=deployment), entry)
        except NotSent as error:
            await self._records.step("not-deployed", {**named, "because": str(error)}, GATEWAY)
            return refused("it is not deployed", [str(error)])
        except Unreachable as error:
            self._not_answered(entry.proposal, error)
            return not_known(f"whether it controls the line as epoch {epoch}; {TOLD_LATER}", [str(error)])
        if not reply.ok and reply.in_service is not None and reply.in_service.epoch < epoch:
            because = "; ".join([reply.text, *reply.reasons])[:1000]
            codes = {one.code for one in reply.findings}
            passes = entry.by_person and bool(codes) and codes <= PASSING
            await self._records.step("put-off" if passes else "not-deployed", {**named, "because": because}, GATEWAY)
            return reply.model_copy(update={"text": f"{reply.text}; {AGAIN}"}) if passes else reply
        try:
            await self.settle()  # what the loop says it runs, read back
        except (Unreachable, AuditUnavailable) as error:
            self._unanswered[entry.proposal] = self._clock() + LATE_S
            return not_known(f"it was deployed as epoch {epoch}, and is not on record; {TOLD_LATER}", [str(error)])
        now = self._records.book.entries[entry.proposal]
        if now.stage is Stage.DEPLOYING:
            self._unanswered[entry.proposal] = self._clock() + LATE_S
            return not_known(f"whether it controls the line as epoch {epoch}; {TOLD_LATER}", reply.reasons)
        if now.stage is not Stage.PROBATION:
            return refused(f"it is {now.stage}", [now.why])
        unwatched = "" if watch else "; no model is accepted yet, by which the loop would see what can be recovered"
        return done(
            f"{entry.changes[:12]} controls the line as epoch {epoch}, on probation for {self._line.gate.probation_s:g}"
            f" s of running; `r2rgate rollback` takes it back at once, `r2rgate proposals` shows how it does{unwatched}"
        )

    async def _look_after(self, found: InService) -> None:
        entry, now_s = self._records.book.on_the_line, self._clock()
        if found.hash == self._records.book.unexplained and (entry is None or entry.stage is Stage.RUNNING):
            await self._confine(found)
            entry = self._records.book.on_the_line
        if entry is None:
            if self._goes_too_far(found):  # a loop that was started anew before its disk knew
                await self.narrow()
            if not found.confirmed and found.hash in self._records.book.confirmed:
                await self._tell(Confirmed(configuration=found.hash))
            await self._good_watch.look(found)
            return
        if entry.stage is Stage.RUNNING:
            await self._end_unheard(entry, now_s)
            return
        if entry.stage is Stage.DEPLOYING:  # the loop has not answered, and may still take it
            return
        if against := self._surroundings.against_keeping(now_s):
            await self.roll_back(against)
        elif entry.stage is Stage.KEEPING or not self._unseen(now_s):
            await self._keep(entry, found)

    async def _confine(self, found: InService) -> None:
        """What no record explains: back, where there is something to go back to, else no further than a first one."""
        if found.on_probation:
            await self.roll_back("no record says how it came to the line")
        elif not found.region.within(first_region(self._line)):
            reply = await self.narrow(confine=True)
            self.unconfined = "" if reply.ok else "; ".join([reply.text, *reply.reasons])

    def _goes_too_far(self, found: InService) -> bool:
        """For a line that has changed, and of which nothing has been learned since."""
        book = self._records.book
        changed = book.line_changed_s is not None and book.model is None
        return changed and not found.on_probation and not found.region.within(first_region(self._line))

    def _unseen(self, now_s: float) -> str:
        since_s, probation_s = now_s - self._probation_since_s, self._line.gate.probation_s
        watched = "" if since_s >= probation_s else f"it has been watched for {since_s:.0f} s of {probation_s:g} s"
        return self._surroundings.unseen() or watched

    async def _keep(self, entry: Entry, found: InService) -> None:
        """What cannot be kept is taken back."""
        if entry.stage is Stage.PROBATION:
            await self._records.step("keeping", {"proposal": entry.proposal, "epoch": entry.epoch}, GATEWAY)
        watch = None
        try:
            watch = await self._surroundings.recovery(found.good_if_kept, found.region, self._records.book)
            reply = await self._tell(Keep(epoch=entry.epoch or found.epoch, watch=watch), entry)
            because = "" if reply.ok else "; ".join([reply.text, *reply.reasons])
        except NotKnown as error:
            because = str(error)
        except NotSent:
            raise
        except Unreachable as error:
            self._not_answered(entry.proposal, error)
            raise
        if not because and watch is not None:
            self._good_watch.taken(found.good_if_kept)
        await self.settle()
        # One that was told before, and whose answer did not come, may have kept it: then the second is refused.
        if because and self._records.book.entries[entry.proposal].stage is Stage.KEEPING:
            await self.roll_back(f"it could not be kept: {because}")

    async def _end_unheard(self, entry: Entry, now_s: float) -> None:
        """Of an experiment whose end nobody has told: the loop was started anew, or this process."""
        if self._experiment is None or self._experiment[0] != entry.proposal:
            await self._records.fetch([entry])
            change = self._records.proposal(entry).change
            takes_s = change.experiment.duration_s if isinstance(change, ExperimentChange) else 0.0
            self._experiment = (entry.proposal, now_s + takes_s + UNHEARD_S)
        elif now_s >= self._experiment[1]:
            because = "the loop has not told its end"
            if entry.proposal in self._unanswered:
                because = "whether it ran is not known: the loop has neither answered nor told its end"
            await self._record_outcome("experiment-ends", {"proposal": entry.proposal, "because": because})


def _grounds(entry: Entry) -> Grounds:
    return Grounds(proposal=entry.proposal, verdict=entry.verdict, approval=entry.approval)

"""The gate of a gateway process: audit, stores, judge and deployer, and what of them is asked over the mailbox."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from gateway.core.audit_record import AuditRecord, Who
from gateway.core.decisions import DECISION, QUERY, Archive, Confirm, Decide, LineChanged, ListProposals, RollBackNow
from gateway.core.deployment import WiringStatus
from gateway.core.finding import Finding, finding
from gateway.core.line import Line
from gateway.core.messages import Command, Deploy, Event, Keep, Reply, WatchGood
from gateway.core.people import Role
from gateway.core.proof import Grounds
from gateway.core.status import ChangeStatus
from gateway.core.topics import GATEWAY_DECISION, GATEWAY_PROPOSALS, GATEWAY_PROPOSE
from gateway.core.wiring_proof import WiringProof, proof_hash
from gateway.mailbox.inbox import RateLimiter, name_of
from gateway.mailbox.paths import LOOP_DATA
from gateway.mailbox.port import PEER, Mailbox, RemoteError
from gateway.mailbox.to_loop import ToLoop
from gateway.supervisor import configurations as configurations_store
from gateway.supervisor import models as models_store
from gateway.supervisor.admission import bounds_of, caller_of, turned_away
from gateway.supervisor.alarms import SHELVED
from gateway.supervisor.archiving import archive
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.book_file import CannotBegin, book_in, done_in
from gateway.supervisor.bounded import Bounded, with_left_out
from gateway.supervisor.configurations import (
    Configurations,
    ConfigurationsError,
    begin_configurations,
    open_configurations,
)
from gateway.supervisor.deployer import Deployer
from gateway.supervisor.deployer_sides import JudgeSide
from gateway.supervisor.experiments import ENDS as EXPERIMENT_ENDS
from gateway.supervisor.in_service import InServiceView
from gateway.supervisor.intrusions import Intrusions
from gateway.supervisor.kept_audit import KeptAudit
from gateway.supervisor.lifecycle import WIRING_PROVED
from gateway.supervisor.line_stops import hear_stop
from gateway.supervisor.loop_records import LoopRecords
from gateway.supervisor.model_store import ModelsError
from gateway.supervisor.models import Models, begin_repository
from gateway.supervisor.patience import Patience
from gateway.supervisor.peers import GATEWAY, who_at_once, who_of
from gateway.supervisor.proposal_records import refused
from gateway.supervisor.said_inbox import DECISION_EVENT, OF_DECISIONS, SaidInbox
from gateway.supervisor.store_writer import StoreWriter
from gateway.supervisor.surroundings import LineSurroundings

LOOP_TIME_S = 2.5
CONFIGURATION_CHANGES = ("start", "deployed", "kept", "rolled-back")
PROVED = WIRING_PROVED  #: the kind of event, too
WIRING = "wiring"  #: the kind of event: whether it is proved is another than before
OPENS_S, OPENS_TURN_S = 2.0, 0.05  #: that an arming waits for the gate to open, or for a step that is under way
BUILD_TIME_S = 15.0  #: for what the loop builds and warms before it answers


async def believe_all() -> bool:
    """Within one process whoever answers is the loop."""
    return True


class LoopOverMailbox:
    def __init__(self, to_loop: ToLoop) -> None:
        self.has_answered: Callable[[], Awaitable[bool]] = believe_all  #: whether it was the line's loop
        self._to_loop = to_loop

    async def tell(self, command: Command, grounds: Grounds | None = None) -> Reply:
        time_s = BUILD_TIME_S if isinstance(command, Deploy | Keep | WatchGood) else LOOP_TIME_S
        reply = await self._to_loop.tell(command, time_s, grounds)
        if not await self.has_answered():
            raise RemoteError("what answered is not the line's loop, and is not believed (false-loop)")
        return reply


class Gate:
    """`look` and `hold` a few times a second, `close` at the end. It opens as soon as audit and stores are there."""

    def __init__(
        self,
        line: Line,
        mailbox: Mailbox,
        to_loop: ToLoop,
        folder: Path,
        judge: JudgeSide,
        around: Callable[[Configurations, Models], LineSurroundings],
        note: Callable[..., None],
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
        loops: Path | None = None,
    ) -> None:
        """`folder`: the gateway's; `loops`: the loop's, of which it reads what that was started with; None: beside."""
        self.deployer: Deployer | None = None
        #: Of the people who may come in; None: nobody has told yet.
        self.roles: Callable[[], Mapping[str, Role] | None] = lambda: None
        self.stop_asked: Callable[[], Who | None] = lambda: None  #: who asked the gateway for the last stop
        self._line = line
        self._folder = folder
        self._judge = judge
        self._around = around
        self._note = note
        self._clock = clock
        self._wall_clock = wall_clock
        self.loop = LoopOverMailbox(to_loop)
        self.audit = Audit(folder, clock=clock, wall_clock=wall_clock)
        self.audit.start()
        self._stores: tuple[Configurations, Models] | None = None
        self._writer = StoreWriter(line, folder, loops or folder.with_name(LOOP_DATA), wall_clock)
        self._start_recorded = False
        self._shut = "the gate is about to open"  #: why it is, while it is
        self._in_service = InServiceView(line, folder)
        self._told = ""
        self._proofs: set[str] = set()  #: of the wiring, that are or are being recorded since this process began
        self._refusals = Bounded(clock)
        self._loop_records = LoopRecords(self.audit.append, note, clock)
        self._intrusions = Intrusions(self._loop_records, clock)
        self._rates = RateLimiter(clock)
        self._turned_away = Bounded(clock)
        self._decisions = SaidInbox(DECISION_EVENT, OF_DECISIONS, clock, note)
        self._rollbacks = Bounded(clock)
        self._learned: str | None = None  #: what ran when the stores were told last, or should have been
        self._to_learn = False
        self._learning = Patience(clock)
        self._telling: set[asyncio.Task[None]] = set()
        mailbox.serve(GATEWAY_PROPOSE, self._answer_propose)
        mailbox.serve(GATEWAY_PROPOSALS, self.answer_query)
        mailbox.serve(GATEWAY_DECISION, self._answer_decision)

    async def look(self) -> None:
        """Never raises for what the disk or the loop do."""
        if self.deployer is None:
            await self._open()
        if self.deployer is not None:
            await self.deployer.at_hand()
            await self.deployer.watch()
            await self._learn_again(self.deployer)
        trouble = self._shut if self.deployer is None else self.deployer.trouble
        if trouble != self._told:
            self._told = trouble
            self._note("gate", f"the gate waits: {trouble}" if trouble else "the gate is open")

    async def hold(self) -> None:
        """The lease of what is on probation, however long a look takes."""
        if self.deployer is not None:
            await self.deployer.hold()

    def loop_begins(self) -> None:
        """Another start of the loop is there, whether its events have come or were lost: it is asked what it runs."""
        if self.deployer is not None:
            self.deployer.look_again()

    def hear(self, event: Event) -> None:
        """What the loop tells: that an experiment is over, or that it runs something else, is for the records."""
        self._intrusions.hear(event)
        hear_stop(event, self._loop_records, lambda: self.stop_asked())
        if event.kind == PROVED:
            self._spawn(self._proved(event))
        if self.deployer is None:
            return
        if event.kind in (*CONFIGURATION_CHANGES, PROVED, WIRING):
            self.deployer.look_again()
        if event.kind not in EXPERIMENT_ENDS:
            return
        hash_, reason = str(event.data.get("hash", "")), str(event.data.get("reason", ""))
        self._spawn(self._experiment_ended(self.deployer, hash_, reason))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._telling.add(task)
        task.add_done_callback(self._telling.discard)

    async def _proved(self, event: Event) -> None:
        """On record: by whom what no pull can show was answered, and for which wiring it all holds."""
        try:
            proof = WiringProof.model_validate(event.data.get("proof"))
            self._proofs.add(hash_ := proof_hash(proof))
            answers = [one.model_dump(mode="json") for one in proof.answers]
            what = {"wiring": proof.wiring, "wall_s": proof.wall_s, "answers": answers, "proof": hash_}
            try:
                await self.audit.append(PROVED, GATEWAY, what)
            except BaseException:
                self._proofs.discard(hash_)
                raise
        except Exception as error:
            self._note("gate", f"the proof of the wiring is not on record: {type(error).__name__}: {error}")

    async def _experiment_ended(self, deployer: Deployer, hash_: str, reason: str) -> None:
        """Where it cannot be recorded, the deployer ends it later, as one whose end nobody has told."""
        try:
            await deployer.experiment_ended(hash_, reason)
        except Exception as error:
            self._note("gate", f"the end of an experiment is not recorded yet: {type(error).__name__}: {error}")

    def unexplained(self) -> list[Finding]:
        """What was changed at the loop, or tried there, and no record explains."""
        if self.deployer is None:
            return self._intrusions.recent()
        return [*self._intrusions.recent(), *self.deployer.unexplained, *self._unexplained_proof(self.deployer)]

    def _unexplained_proof(self, deployer: Deployer) -> list[Finding]:
        """The proof by which the loop takes the wiring as proved, where no record says how it came to be."""
        proof = None if deployer.wiring is None else deployer.wiring.proof
        if proof is None or proof in self._proofs or proof in deployer.book.wiring_proofs:
            return []
        return [finding("wiring-proof-unexplained", proof=proof[:12])]

    def unconfirmed(self) -> list[Finding]:
        """That what is in service is a first configuration, which nobody has judged or confirmed."""
        return [] if self.deployer is None else self.deployer.unconfirmed

    def wiring(self) -> WiringStatus | None:
        """Whether the line is wired as it was proved to be, as the loop told it last."""
        return None if self.deployer is None else self.deployer.wiring

    def not_to_be_armed(self) -> list[Finding]:
        """Why the line must not be armed; empty: the records say how what is in service came to be."""
        return [] if self.deployer is None else self.deployer.unexplained

    async def hold_against_records(self) -> list[Finding]:
        """Why the line must not be armed, what it runs being not known yet; empty: it is. Raises Unreachable."""
        turns = round(OPENS_S / OPENS_TURN_S)
        while self.deployer is None and turns > 0:  # `look` is opening it
            turns -= 1
            await asyncio.sleep(OPENS_TURN_S)
        because = self._shut if self.deployer is None else await self.deployer.hold_against_records(OPENS_S)
        return [finding("configuration-not-looked-at", because=because)] if because else []

    async def shelvings(self) -> list[AuditRecord] | None:
        """The records of alarms that were shelved or taken off the shelf; None: they cannot be read yet."""
        if self.deployer is None:
            return None
        try:
            return await asyncio.to_thread(lambda: list(done_in(self._folder, [SHELVED])))
        except (AuditUnavailable, ValueError, KeyError):
            return None

    def change(self) -> ChangeStatus | None:
        """What a proposal does to the line now."""
        return None if self.deployer is None else self.deployer.change()

    async def close(self) -> None:
        for task in self._telling:
            task.cancel()
        await asyncio.gather(*self._telling, return_exceptions=True)
        await self._loop_records.close()
        if self.deployer is not None:
            await self.deployer.close()
        for store in (self._stores or ()) if self.deployer is None else ():  # else its surroundings have closed them
            await asyncio.to_thread(store.close)
        await asyncio.to_thread(self.audit.close)

    async def _open(self) -> None:
        """Once a record of the start is on the disk, the records before it are read."""
        try:
            if not self._start_recorded:
                installed = await asyncio.to_thread(version, "r2rgate")
                await self.audit.append("gateway-start", GATEWAY, {"version": installed})
                self._start_recorded = True
            book = await asyncio.to_thread(book_in, self._folder)
            if self._stores is None:
                self._stores = await asyncio.to_thread(_stores_in, self._folder)
            await self._writer.store_given()
        except (AuditUnavailable, CannotBegin, ConfigurationsError, ModelsError) as error:
            self._shut = str(error)
            return
        self.deployer = Deployer(
            self._line, book, KeptAudit(self._folder, self.audit), self.loop, self._judge,
            self._around(*self._stores), self._writer.take_up, self._clock, self._wall_clock,
            roles=lambda: self.roles(), note=self._note,
        )  # fmt: skip

    async def _learn_again(self, deployer: Deployer) -> None:
        """A loop that was started later has been given something else."""
        runs = deployer.book.in_service
        if runs != self._learned:
            self._learned, self._to_learn = runs, True
            self._learning.begin_anew()
        if not self._to_learn or not self._learning.is_due():
            return
        try:
            await self._writer.store_given()
        except ConfigurationsError as error:
            if self._learning.failed():
                self._note(
                    "gate",
                    f"what the loop was started with is not stored, and is tried again: {error}",
                    code="given-not-stored",
                )
            return
        self._to_learn = False
        if self._learning.succeeded():
            self._note("gate", "what the loop was started with is stored now", code="given-stored")

    async def propose(self, payload: bytes, who: Who) -> Reply:
        """Take a proposal in, to be judged in the background; of each caller no more than the inbox allows."""
        if self.deployer is None:
            return self.shut_reply()  # nothing is counted, nothing noted: who asks before the gate is open asks again
        if (refusal := self._rates.refuse(caller_of(who), bounds_of(who, self._line), len(payload))) is not None:
            return await self._turn_away(refusal, who)
        reply = await self.deployer.propose(payload, who)
        self._note("proposal", f"{who.name}: {reply.text}", ok=reply.ok, reasons=reply.reasons)
        return reply

    async def _turn_away(self, refusal: Finding, who: Who) -> Reply:
        """Who floods costs one event and one record now and then; how many were left out stands in the next."""
        reply = turned_away(refusal)
        # By group: a flood of processes has no more to say than one of them.
        if (left_out := self._turned_away.left_out(caller_of(who).group)) is None:
            return reply
        text = f"{name_of(caller_of(who))}: {reply.text}: {reply.reasons[0]}"
        self._note("proposal", text, ok=False, left_out=left_out, findings=[refusal])
        what = {"code": refusal.code, "parameters": refusal.parameters, "because": reply.reasons[0]}
        try:
            await self.audit.append("refused-proposal", who, with_left_out(what, left_out))
        except AuditUnavailable:
            self._turned_away.undo(caller_of(who).group, left_out + 1)
        return reply

    async def _answer_propose(self, payload: bytes) -> bytes:
        return (await self.propose(payload, await who_of(PEER.get()))).model_dump_json().encode()

    async def answer_query(self, payload: bytes) -> bytes:
        """What is asked of proposals, and changes nothing."""
        try:
            query = QUERY.validate_json(payload)
        except ValidationError as error:
            return _not_understood(error)
        if self.deployer is None:
            return self.shut_reply().model_dump_json().encode()
        if isinstance(query, ListProposals):
            await self.deployer.at_hand()
            try:
                found = await self.deployer.page(query.most, query.skip)
            except AuditUnavailable as error:
                return Reply(ok=False, state="", text=str(error), reasons=[str(error)]).model_dump_json().encode()
            told = found.model_copy(update={"controller": await self._in_service.told(self.deployer.book)})
            return told.model_dump_json().encode()
        await self.deployer.at_hand(query.proposal, difference=True)
        found = self.deployer.shown(query.proposal)
        if isinstance(found, str):
            return Reply(ok=False, state="", text=found, reasons=[found]).model_dump_json().encode()
        return found.model_dump_json().encode()

    async def _answer_decision(self, payload: bytes) -> bytes:
        try:
            decision = DECISION.validate_json(payload)
        except ValidationError as error:
            return _not_understood(error)
        if isinstance(decision, RollBackNow):  # the safe side: always done, at once, and on record now and then
            who = who_at_once(PEER.get())
            reply = await self.decide(decision, who, self._rollbacks.left_out(caller_of(who).group))
        else:
            who = await who_of(PEER.get())
            reply = self._decisions.refuse(who, len(payload)) or await self.decide(decision, who)
        return reply.model_dump_json().encode()

    async def decide(
        self, decision: Decide | RollBackNow | Archive | LineChanged | Confirm, who: Who, left_out: int | None = 0
    ) -> Reply:
        """What a person, or a program in a person's place, says; `left_out`: as of `Bounded`, where none is refused."""
        if self.deployer is None:
            reply = self.shut_reply()
        elif isinstance(decision, Decide):
            await self.deployer.at_hand(decision.proposal)
            reply = await self.deployer.decide(decision, who)
        elif isinstance(decision, Archive):
            reply = await self._archive(decision, who)
        elif isinstance(decision, Confirm):
            reply = await self.deployer.confirm(decision, who)
        elif isinstance(decision, LineChanged):
            reply = await self._line_changed(self.deployer, decision, who)
        else:
            reply = await self.deployer.roll_back(decision.comment, who, left_out)
        if left_out is not None:
            self._note(DECISION_EVENT, f"{who.name}: {reply.text}", ok=reply.ok, reasons=reply.reasons)
        if isinstance(decision, Decide) and not reply.ok:
            await self._record_refusal(decision, reply, who)
        return reply

    async def _record_refusal(self, decision: Decide, reply: Reply, who: Who) -> None:
        """Whoever is refused again and again is counted, and fills no disk."""
        if (left_out := self._refusals.left_out(who.name)) is None:
            return
        because = "; ".join([reply.text, *reply.reasons])[:1000]
        what = {"proposal": decision.proposal, "approve": decision.approve, "because": because}
        try:
            await self.audit.append("refused-decision", who, with_left_out(what, left_out))
        except AuditUnavailable as error:
            self._refusals.undo(who.name, left_out + 1)
            self._note("gate", f"a refusal could not be recorded: {error}")

    async def _archive(self, said: Archive, who: Who) -> Reply:
        """With a connection of its own, in a thread, as all that writes to a store."""
        line, now_s = self._line, self._wall_clock()
        try:
            store = await asyncio.to_thread(open_configurations, self._folder / configurations_store.FILE_NAME)
        except ConfigurationsError as error:
            return refused("nothing was archived", [str(error)])
        try:
            return await archive(self.audit, store, line.site, line.line, said, who, now_s)
        finally:
            await asyncio.to_thread(store.close)

    async def _line_changed(self, deployer: Deployer, said: LineChanged, who: Who) -> Reply:
        reply = await deployer.line_changed(said.because, who)
        if reply.ok:
            try:
                await self._writer.supersede_models(deployer.book.model, said.because)
            except ModelsError as error:  # nothing is judged by it any more all the same
                self._note("gate", f"a model is not marked as superseded: {error}")
        return reply

    def shut_reply(self) -> Reply:
        """To whoever asks before the gate is open."""
        return Reply(ok=False, state="", text="the gate is shut", reasons=[self._shut])


def _stores_in(folder: Path) -> tuple[Configurations, Models]:
    """Raises ConfigurationsError and ModelsError."""
    configurations = begin_configurations(folder / configurations_store.FILE_NAME)
    try:
        return configurations, begin_repository(folder / models_store.FILE_NAME)
    except ModelsError:
        configurations.close()
        raise


def _not_understood(error: ValidationError) -> bytes:
    reasons = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
    return Reply(ok=False, state="", text="not understood", reasons=reasons[:20]).model_dump_json().encode()

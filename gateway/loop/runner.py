"""Commands and periods in one order: a command takes effect between two periods, never within one."""

import asyncio
from collections import deque
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from gateway.core.controller import ControllerRefused
from gateway.core.finding import Finding
from gateway.core.messages import (
    Arm,
    AskConfiguration,
    Command,
    Deploy,
    Drill,
    Hold,
    Keep,
    KeepProof,
    Narrow,
    Prove,
    Reply,
    Rollback,
    Start,
    Stop,
    WatchGood,
)
from gateway.core.proof import Proof
from gateway.core.states import LoopState, Phase
from gateway.loop.arming import forbidden, not_armed, prepare_links, refusal_to_arm, release_links, unheard
from gateway.loop.aside import Aside
from gateway.loop.commands import carry_out, proof_to_keep
from gateway.loop.containment import Part
from gateway.loop.cycle import SUPERVISED, Cycle
from gateway.loop.deploy import NOT_DONE, Prepared, durable_after, prepare, require
from gateway.loop.kept import Durable, Store
from gateway.loop.pacer import Tick
from gateway.loop.persistence import AGAIN_S, NotPersisted, Persistence
from gateway.loop.refused import Refused, coded, said
from gateway.tasks.cleanup import end
from gateway.wording.catalogue import sentences
from safety.actions import Action, found

HEARD_AGAIN_S = 1.0  #: for devices that were lost to tell what speaks against arming, or that nothing does
PERSISTED_S = 1.0  #: for the disk to have what was taken back, until the answer says that it has not
MAX_WAITING = 32  #: commands between two periods; more are refused, but for what is SAFE
MAX_TO_ITS_END = 8  #: that build or write, one after the other: behind a disk that hangs they do not pile up
UNDONE_S = 0.3  #: that the answer to a stop waits for an arming to be undone, which goes on
#: Before everything else and in this order; each has one place of its own, however many ask for it.
SAFE: tuple[type[Command], ...] = (Stop, Hold)
BOUNDARY_SHARE = 0.1  #: of a period, for the commands of one boundary; what is left over waits for the next

Answer = asyncio.Future[Reply]


@dataclass(slots=True)
class Waiting:
    """A command that waits for its boundary, with what was prepared for it."""

    command: Command
    prepared: Prepared
    proof: Proof | None
    answer: Answer


class Runner:
    """`store`: where what is known to be good outlives this process; None: nowhere."""

    def __init__(self, cycle: Cycle, store: Store | None = None) -> None:
        self.cycle = cycle
        self._aside = Aside()
        self._disk = Aside()  # of its own: what is taken back does not wait for what is being built
        self._persistence = Persistence(cycle.configurations, store, self._disk, cycle.tell)
        self._configuring = asyncio.Lock()
        self._to_their_end: set[asyncio.Task[Reply]] = set()  #: whoever waits; asyncio itself keeps tasks only weakly
        self._undoing: set[asyncio.Task[None]] = set()
        self._waiting: deque[Waiting] = deque()
        self._safe: dict[type[Command], Waiting] = {}  #: what is SAFE and waits
        self._passed = asyncio.Event()
        self._arming: asyncio.Task[Reply | None] | None = None  #: its proofs
        self._armed: asyncio.Task[Reply] | None = None  #: the arming that was asked for last
        self._stops = 0  #: that were asked for
        self._ending = False
        self._settling: asyncio.Task[None] | None = None  #: the disk hears of load cells that are contradicted
        self._over = False  #: there will be no boundary any more

    async def period(self, tick: Tick) -> None:
        """Carry out what waits, then one control period."""
        if self._ending:
            self._carry_out(Stop(), None, None, tick.now_s)
        self._carry_out_waiting(tick.now_s)
        await self.cycle.period(tick)
        self._persistence.look()
        self._begin_to_settle()
        self._passed.set()
        self._passed.clear()  # whoever waited goes on all the same

    def _carry_out_waiting(self, now_s: float) -> None:
        """In their order, as many as there is time for; at least one, and what is SAFE goes first."""
        cycle = self.cycle
        until_s = cycle.clock() + BOUNDARY_SHARE * cycle.limits.period_s
        while (waiting := self._next()) is not None:
            reply = self._carry_out(waiting.command, waiting.prepared, waiting.proof, now_s)
            if not waiting.answer.done():
                waiting.answer.set_result(reply)
            if cycle.clock() >= until_s:
                return

    def _next(self) -> Waiting | None:
        for kind in SAFE:
            if kind in self._safe:
                return self._safe.pop(kind)
        return self._waiting.popleft() if self._waiting else None

    def _carry_out(self, command: Command, prepared: Prepared, proof: Proof | None, now_s: float) -> Reply:
        """A command that fails stops the line in order, as any part of a period does."""
        name = command.command
        run = self.cycle.containment.run
        reply = run(
            Part(f"the command {name}", of_configuration=False), None,
            carry_out, self.cycle, command, now_s, prepared, proof,
        )  # fmt: skip
        return reply or self.refused(f"{name} failed within the loop, which stops the line for it")

    async def end(self) -> None:
        """From now on the line is being stopped, and no other command is taken. Periods must go on until it rests."""
        self._ending = True
        self._stops += 1
        self._refuse_waiting((Arm, Drill), "not armed: it was stopped")
        await self._cancel_arming()

    async def over(self, within_s: float) -> None:
        """The last period is over: nothing is decided any more, and the disk has what was, if it takes it in time."""
        self._over = True
        while (waiting := self._next()) is not None:
            if not (answer := waiting.answer).done():
                answer.set_result(self.refused("the loop is ending"))
        await self.persisted(within_s)
        await self._wiring_settled(within_s)
        if self._settling is not None:
            await end(self._settling)

    async def persisted(self, within_s: float) -> str:
        """Once the disk has what was decided last; else why it has not. Empty: it has."""
        return await self._persistence.caught_up(within_s)

    @property
    def at_rest(self) -> bool:
        return self.cycle.machine.phase in (Phase.SILENT, Phase.OFF)

    async def submit(self, command: Command, proof: Proof | None = None) -> Reply:
        """Do `command` at the next boundary between periods; the reply says what was done, or why not.

        Who may say it is not asked here (`door`). `proof` is kept with a configuration that is kept.
        """
        if isinstance(command, Stop):
            return await self._stop(command)
        if self._ending:
            return self.refused("the loop is ending")
        if isinstance(command, Hold):
            self._refuse_waiting((Start, Prove), "not started: it was held")
            return await self._at_boundary(command)
        if isinstance(command, AskConfiguration):  # whoever only asks takes nobody's place
            return self._carry_out(command, None, None, self.cycle.clock())
        if len(self._waiting) >= MAX_WAITING:
            return self.refused("too many commands at once: try again")
        return await self._in_turn(command, proof)

    async def _in_turn(self, command: Command, proof: Proof | None) -> Reply:
        match command:
            case Arm() | Drill():  # it comes to its end, and is undone, even where nobody waits for it any more
                if self._armed is not None and not self._armed.done():
                    return self.refused("arming is under way")
                self._armed = asyncio.create_task(self._arm(command))
                return await asyncio.shield(self._armed)
            case Deploy() | Keep() | WatchGood():  # what is written ahead is decided, whoever waits for it
                return await self._to_its_end(self._configure_next(command, proof))
            case Rollback() | Narrow():
                return await self._take_back(command)
            case KeepProof():
                return await self._to_its_end(self._keep_proof(command))
            case _:
                return await self._at_boundary(command)

    async def _to_its_end(self, work: Coroutine[Any, Any, Reply]) -> Reply:
        """Whoever gives up waiting for it cuts nothing; what would wait behind too much of it is refused."""
        if len(self._to_their_end) >= MAX_TO_ITS_END:
            work.close()
            return self.refused("too much waits for the disk, or to be built: try again")
        task = asyncio.create_task(work)
        self._to_their_end.add(task)
        task.add_done_callback(self._to_their_end.discard)
        return await asyncio.shield(task)

    def close(self) -> None:
        """What is still being worked on aside ends by itself."""
        self._aside.close()
        self._disk.close()

    async def _stop(self, command: Stop) -> Reply:
        """Whatever else waits, and also into an arming, whose undoing it waits for a little, and does not cut."""
        self._stops += 1
        self._refuse_waiting((Arm, Drill), "not armed: it was stopped")
        undone = asyncio.create_task(self._cancel_arming())
        self._undoing.add(undone)
        undone.add_done_callback(self._undoing.discard)
        reply = await self._at_boundary(command)
        await asyncio.wait((undone,), timeout=UNDONE_S)
        return reply

    async def _at_boundary(self, command: Command, prepared: Prepared = None, proof: Proof | None = None) -> Reply:
        if self._over:
            return self.refused("the loop is ending")
        kind = type(command)
        if kind in self._safe:
            return await asyncio.shield(self._safe[kind].answer)
        waiting = Waiting(command, prepared, proof, asyncio.get_running_loop().create_future())
        if kind in SAFE:
            self._safe[kind] = waiting
        else:
            self._waiting.append(waiting)
        return await asyncio.shield(waiting.answer)  # others may wait for the same

    async def _keep_proof(self, command: KeepProof) -> Reply:
        """On the disk, and then the line is proved by it."""
        cycle = self.cycle
        try:
            proof = proof_to_keep(cycle, command)
            await self._disk.do(lambda: cycle.wiring.write(proof, command.only))
        except Refused as refused:
            return refused.reply(cycle.machine.state.name)
        except OSError as error:
            return self.refused(f"nothing could be kept at {cycle.wiring.path}: {error.strerror or error}")
        reply = await self._at_boundary(command)
        if reply.ok:
            await self._wiring_settled(PERSISTED_S)
            cycle.tell("wiring-proved", reply.text, proof=proof.model_dump(mode="json"))
        return reply

    async def _arm(self, command: Arm | Drill) -> Reply:
        self._arming = asyncio.create_task(self._prove())
        stops = self._stops
        try:
            await asyncio.wait([self._arming])
            if self._arming.cancelled():
                return self.refused("not armed: it was stopped")
            if self._stops != stops and self._arming.result() is None:  # it came when everything was proven already
                await release_links(self.cycle)
                return self.refused("not armed: it was stopped")
            refusal = self._arming.result()
            reply = refusal or await self._at_boundary(command)
            if refusal is None and not reply.ok:  # proven, and then stopped or refused: nothing stays active
                await release_links(self.cycle)
        finally:  # only now: a second arming would prove, and then release, what this one has armed
            self._arming = None
        while reply.ok and self.cycle.machine.phase in (Phase.ARMING, Phase.DRILLING):
            await self._passed.wait()
        if not reply.ok:
            return reply
        if isinstance(command, Drill):
            return await self._drilled(reply)
        if self.cycle.machine.state is not LoopState.READY:
            refusal = self.refused(f"not armed: {self.cycle.machine.reason}")
            return refusal.model_copy(update={"findings": self.cycle.watch.drives.standing_as_data()})
        return reply.model_copy(update={"state": self.cycle.machine.state.name})

    async def _drilled(self, reply: Reply) -> Reply:
        """The drill is over: the devices are left, and what was seen of them is told."""
        cycle = self.cycle
        if self.at_rest:
            await release_links(cycle)
        data = [each.as_data() for each in cycle.drill.findings]
        if data or not cycle.drill.watchdogs:
            text = "not drilled; mend what is named and try again" if data else f"not drilled: {cycle.machine.reason}"
            return self.refused(text, data)
        shown = [watchdog.model_dump(mode="json") for watchdog in cycle.drill.watchdogs]
        cycle.tell("drilled", cycle.machine.reason, watchdogs=shown)
        return reply.model_copy(update={"state": cycle.machine.state.name, "text": cycle.machine.reason})

    async def _configure_next(self, command: Deploy | Keep | WatchGood, proof: Proof | None) -> Reply:
        async with self._configuring:
            return await self._configure(command, proof)

    async def _configure(self, command: Deploy | Keep | WatchGood, proof: Proof | None) -> Reply:
        """Build, warm and measure what the command brings, and have it on the disk, while periods go on; then do it.

        The disk first: after a restart the line runs what somebody was told is kept, and no epoch is used twice.
        """
        cycle = self.cycle

        def ahead() -> Durable:
            require(cycle, command)  # what it was prepared for may have been taken back since
            return durable_after(cycle.configurations, command, proof)

        try:
            await self._signals_are_there(command)
            require(cycle, command)
            prepared = await self._aside.do(lambda: prepare(cycle, command))
            await self._signals_are_there(command)
            return await self._persistence.write_ahead(ahead, lambda: self._at_boundary(command, prepared, proof))
        except ControllerRefused as refused:
            return self._not_done(NOT_DONE[type(command)], refused.findings or [str(refused)])
        except NotPersisted as failed:
            return self._not_done(NOT_DONE[type(command)], [str(failed)])
        except Refused as refused:
            return refused.reply(cycle.machine.state.name).model_copy(update={"in_service": cycle.in_service()})

    def _not_done(self, text: str, reasons: Sequence[str | Finding]) -> Reply:
        """A refusal says what is in service, as every answer to such a command does."""
        return self.refused(text, reasons).model_copy(update={"in_service": self.cycle.in_service()})

    async def _take_back(self, command: Rollback | Narrow) -> Reply:
        """At once; the answer waits, a while, until a loop that starts anew would know it, too."""
        reply = await self._at_boundary(command)
        if reply.ok and (why := await self._persistence.caught_up(PERSISTED_S)):
            text = f"{reply.text}; a loop that starts anew does not know it yet: {why}; it is tried again"
            return reply.model_copy(update={"text": text})
        return reply

    async def _signals_are_there(self, command: Command) -> None:
        """A frame that came late must not use up what a person has approved; a line that misses more is stopped."""
        cycle = self.cycle
        while isinstance(command, Deploy) and cycle.account.held and cycle.machine.phase in SUPERVISED:
            await self._passed.wait()

    async def _prove(self) -> Reply | None:
        """Whatever must hold before torque is possible, also of devices that have come back. None: it holds.

        Touches no link unless the line is at rest, and nothing speaks against it. Cancelled or refused, it leaves every
        link silent and every device released.

        A link that commands leaves a device alone that was lost; a silent one asks for what it can. So one that has
        nothing to tell after a stop is given the chance to be heard first. What the line PLC says against arming
        needs no waiting for, and a drive that stays enabled is not left without its orders.
        """
        cycle = self.cycle
        if self.at_rest:  # who asks while the line still stops gives no part that failed another chance
            cycle.containment.begin_anew()
        try:
            if cycle.machine.phase is Phase.OFF and unheard(cycle) and not forbidden(cycle) and not cycle.any_enabled():
                await release_links(cycle)
                given_up_s = cycle.clock() + HEARD_AGAIN_S
                while unheard(cycle) and cycle.clock() < given_up_s:
                    await self._passed.wait()
            if (refusal := refusal_to_arm(cycle)) is not None:
                return refusal
            if cycle.machine.phase is Phase.OFF:
                await release_links(cycle)
            reasons = await prepare_links(cycle)
            self._look_at_wiring()
        except BaseException:  # cancelled by a stop, or a link that failed: nothing stays half-way
            if self.at_rest:
                await release_links(cycle)
            raise
        if not reasons:
            return None
        await release_links(cycle)
        return not_armed(cycle, reasons)

    def _begin_to_settle(self) -> None:
        if self.cycle.wiring.behind and (self._settling is None or self._settling.done()):
            self._settling = asyncio.create_task(self._settle_wiring())

    async def _settle_wiring(self) -> None:
        """Until the disk knows which load cells are contradicted; that it does not take them is told once."""
        wiring, told = self.cycle.wiring, False
        while wiring.behind:
            wiring.behind, contradicted = False, wiring.contradicted
            if not await self._disk.do(partial(wiring.settle, contradicted)):
                wiring.behind = True
                if not told:
                    self._tell_of_disk("alarm", "contradicted-cells-not-kept", because=wiring.unkept)
                told = True
                await asyncio.sleep(AGAIN_S)
        if told:
            self._tell_of_disk("file", "contradicted-cells-kept")

    def _tell_of_disk(self, kind: str, code: str, **parameters: str) -> None:
        one = found(code, Action.NONE, **parameters)
        self.cycle.tell(kind, one.text, findings=[one])

    async def _wiring_settled(self, within_s: float) -> None:
        """Once it does, or after `within_s`."""
        self._begin_to_settle()
        if self._settling is not None:
            await asyncio.wait([self._settling], timeout=within_s)

    def _look_at_wiring(self) -> None:
        """The devices have been prepared. Whoever looks on need not wait until they ask whether it is proved still."""
        cycle, before = self.cycle, self.cycle.wiring.status()
        if cycle.wiring.look(cycle.links):
            cycle.drill.forget()
        if cycle.wiring.status() == before:
            return
        against = cycle.wiring.against
        told = [found(one.code, Action.NONE, **one.parameters) for one in against]
        cycle.tell("wiring", sentences(against) or "the devices are those that were proved", findings=told)

    async def _cancel_arming(self) -> None:
        """Once: what the first stop has begun to undo is not cut by the second."""
        if self._arming is not None:
            await end(self._arming)

    def _refuse_waiting(self, kinds: tuple[type[Command], ...], text: str) -> None:
        """What waits for its period and is overtaken by what is SAFE; also an arming that has proven everything."""
        for waiting in [waiting for waiting in self._waiting if isinstance(waiting.command, kinds)]:
            self._waiting.remove(waiting)
            if not waiting.answer.done():
                waiting.answer.set_result(self.refused(text))

    def refused(self, text: str, reasons: Sequence[str | Finding] = ()) -> Reply:
        """Not done, and why."""
        state = self.cycle.machine.state.name
        return Reply(ok=False, state=state, text=text, reasons=said(reasons), findings=coded(reasons))

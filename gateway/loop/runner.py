"""Commands and periods in one order: a command takes effect between two periods, never within one."""

import asyncio
from collections import deque

from gateway.core.controller import ControllerRefused
from gateway.core.messages import (
    MAX_COMMAND,
    Arm,
    Command,
    Deploy,
    Keep,
    MalformedMessage,
    Reply,
    Stop,
    WatchGood,
    parse_command,
)
from gateway.core.states import LoopState, Phase
from gateway.loop.aside import Aside
from gateway.loop.commands import carry_out, forbidden, prepare_to_arm, release, unheard
from gateway.loop.cycle import SUPERVISED, Cycle
from gateway.loop.deploy import against
from gateway.loop.kept import OnTop, Store
from gateway.loop.pacer import Tick

KEPT_AGAIN_S = 1.0
HEARD_AGAIN_S = 1.0  #: for devices that were lost to tell what speaks against arming, or that nothing does
MAX_WAITING = 32  #: commands between two periods; more are refused, but for a stop

Answer = asyncio.Future[Reply]


class Runner:
    """`store`: where what is known to be good outlives this process; None: nowhere."""

    def __init__(self, cycle: Cycle, store: Store | None = None) -> None:
        self.cycle = cycle
        self._store = store
        self._aside = Aside()
        self._configuring = asyncio.Lock()
        self._waiting: deque[tuple[Command, Answer]] = deque()
        self._passed = asyncio.Event()
        self._arming: asyncio.Task[Reply | None] | None = None
        self._keeping: asyncio.Task[None] | None = None
        self._ending = False

    async def period(self, tick: Tick) -> None:
        """Carry out what waits, then one control period."""
        if self._ending:
            carry_out(self.cycle, Stop(), tick.now_s)
        while self._waiting:
            command, answer = self._waiting.popleft()
            reply = carry_out(self.cycle, command, tick.now_s)
            if not answer.done():
                answer.set_result(reply)
        await self.cycle.period(tick)
        if self.cycle.configurations.to_keep:
            self._keep_anew()
        self._passed.set()
        self._passed.clear()  # whoever waited goes on all the same

    async def end(self) -> None:
        """From now on the line is being stopped, and no other command is taken. Periods must go on until it rests."""
        self._ending = True
        await self._cancel_arming()

    @property
    def at_rest(self) -> bool:
        return self.cycle.machine.phase in (Phase.SILENT, Phase.OFF)

    async def command(self, payload: bytes) -> bytes:
        """Answer a command from outside. Never raises for what is in `payload`."""
        try:
            large = len(payload) > MAX_COMMAND
            command = await self._aside.do(lambda: parse_command(payload)) if large else parse_command(payload)
            reply = await self.submit(command)
        except MalformedMessage as error:
            reply = self._refused(f"not a command: {error}")
        return reply.model_dump_json().encode()

    async def submit(self, command: Command) -> Reply:
        """Do `command` at the next boundary between periods; the reply says what was done, or why not."""
        if isinstance(command, Stop):  # whatever else waits, and also into an arming
            self._refuse_waiting_arms()
            await self._cancel_arming()
            return await self._at_boundary(command)
        if self._ending:
            return self._refused("the loop is ending")
        if len(self._waiting) >= MAX_WAITING:
            return self._refused("too many commands at once: try again")
        match command:
            case Arm():
                return await self._arm(command)
            case Deploy():
                async with self._configuring:
                    return await self._deploy(command)
            case Keep():
                async with self._configuring:
                    return await self._keep(command)
            case WatchGood():
                async with self._configuring:
                    return await self._watch_good(command)
            case _:
                return await self._at_boundary(command)

    def close(self) -> None:
        """What is still being worked on aside ends by itself."""
        self._aside.close()

    async def _at_boundary(self, command: Command) -> Reply:
        answer: Answer = asyncio.get_running_loop().create_future()
        (self._waiting.appendleft if isinstance(command, Stop) else self._waiting.append)((command, answer))
        return await answer

    async def _arm(self, command: Arm) -> Reply:
        if self._arming is not None:
            return self._refused("arming is under way")
        self._arming = asyncio.create_task(self._prove())
        try:
            await asyncio.wait([self._arming])
            if self._arming.cancelled():
                return self._refused("not armed: it was stopped")
            refusal = self._arming.result()
            reply = refusal or await self._at_boundary(command)
            if refusal is None and not reply.ok:  # proven, and then stopped or refused: nothing stays active
                await release(self.cycle)
        finally:  # only now: a second arming would prove, and then release, what this one has armed
            self._arming = None
        while reply.ok and self.cycle.machine.phase is Phase.ARMING:
            await self._passed.wait()
        if not reply.ok:
            return reply
        if self.cycle.machine.state is not LoopState.READY:
            return self._refused(f"not armed: {self.cycle.machine.reason}")
        return reply.model_copy(update={"state": self.cycle.machine.state.name})

    async def _deploy(self, command: Deploy) -> Reply:
        """Build and warm what is to run, and note that its epoch is used up, while periods go on; then swap."""
        configurations, deployment = self.cycle.configurations, command.deployment
        await self._signals_are_there()
        if reasons := against(self.cycle, deployment):
            return self._refused("not deployed", reasons)
        try:
            candidate = await self._aside.do(lambda: configurations.candidate(deployment))
        except ControllerRefused as refused:
            return self._refused("not deployed", [str(refused)])
        good = configurations.good
        if self._store is not None:
            store = self._store
            try:
                await self._aside.do(lambda: store.write(deployment.epoch, good.config, good.region, good.watch))
            except OSError as error:
                return self._refused("not deployed", [f"nothing could be kept at {store.path}: {error.strerror}"])
        await self._signals_are_there()
        configurations.prepared = deployment, candidate
        reply = await self._at_boundary(command)
        if not reply.ok and self._store is not None and configurations.on_top is not None:
            configurations.to_keep = True  # the disk is to have again what runs on
        return reply

    async def _signals_are_there(self) -> None:
        """A frame that came late must not use up what a person has approved; a line that misses more is stopped."""
        cycle = self.cycle
        while cycle.account.held and cycle.machine.phase in SUPERVISED:
            await self._passed.wait()

    async def _keep(self, command: Keep) -> Reply:
        """The disk first: after a restart the line runs what somebody was told is kept."""
        configurations, watch = self.cycle.configurations, command.watch
        good, then = configurations.good, configurations.good_if_kept
        running = configurations.running
        on_top = None if then is running else OnTop(controller=running.config, region=running.region)
        if configurations.probation is None or configurations.epoch != command.epoch:
            return await self._at_boundary(command)  # which refuses it
        if watch is not None:
            try:
                recovery = await self._aside.do(lambda: configurations.recovery(watch, then.config))
            except ControllerRefused as refused:
                return self._refused("not kept", [str(refused)])
            configurations.prepared_watch = watch, recovery
        if self._store is None:
            return await self._at_boundary(command)
        store, epoch = self._store, command.epoch
        try:
            await self._aside.do(lambda: store.write(epoch, then.config, then.region, watch, on_top))
            reply = await self._at_boundary(command)
            if not reply.ok:  # rolled back meanwhile
                await self._aside.do(lambda: store.write(epoch, good.config, good.region, good.watch))
        except OSError as error:
            return self._refused("not kept", [f"nothing could be kept at {store.path}: {error.strerror}"])
        return reply

    async def _watch_good(self, command: WatchGood) -> Reply:
        """Made, and on the disk, while periods go on."""
        configurations, watch = self.cycle.configurations, command.watch
        good, epoch, on_top = configurations.good, configurations.epoch, configurations.on_top
        if configurations.probation is not None:
            return await self._at_boundary(command)  # which refuses it
        try:
            recovery = await self._aside.do(lambda: configurations.recovery(watch, good.config))
            if (store := self._store) is not None:
                await self._aside.do(lambda: store.write(epoch, good.config, good.region, watch, on_top))
        except ControllerRefused as refused:
            return self._refused("not watched by another model", [str(refused)])
        except OSError as error:
            return self._refused("not watched by another model", [f"nothing could be kept: {error.strerror}"])
        configurations.prepared_watch = watch, recovery
        return await self._at_boundary(command)

    def _keep_anew(self) -> None:
        """A loop that starts anew must not run what was given up. Aside, and again where the disk refuses."""
        configurations, store = self.cycle.configurations, self._store
        configurations.to_keep = False
        if store is None:
            return

        async def keep() -> None:
            async with self._configuring:
                good, epoch, on_top = configurations.good, configurations.epoch, configurations.on_top
                try:
                    await self._aside.do(lambda: store.write(epoch, good.config, good.region, good.watch, on_top))
                except OSError:
                    await asyncio.sleep(KEPT_AGAIN_S)
                    configurations.to_keep = True

        self._keeping = asyncio.create_task(keep())

    async def _prove(self) -> Reply | None:
        """As `prepare_to_arm`, for devices that have come back, too.

        A link that commands leaves a device alone that was lost; a silent one asks for what it can. So one that has
        nothing to tell after a stop is given the chance to be heard first. What the line PLC says against arming
        needs no waiting for, and a drive that stays enabled is not left without its orders.
        """
        cycle = self.cycle
        if cycle.machine.phase is Phase.OFF and unheard(cycle) and not forbidden(cycle) and not cycle.any_enabled():
            try:
                await release(cycle)
                given_up_s = cycle.clock() + HEARD_AGAIN_S
                while unheard(cycle) and cycle.clock() < given_up_s:
                    await self._passed.wait()
            except BaseException:  # a stop, or a link that failed
                await release(cycle)
                raise
        return await prepare_to_arm(cycle)

    async def _cancel_arming(self) -> None:
        if self._arming is not None:
            self._arming.cancel()
            await asyncio.wait([self._arming])

    def _refuse_waiting_arms(self) -> None:
        """An arming that has proven everything and waits for its period is stopped like one that is under way."""
        for waiting in [waiting for waiting in self._waiting if isinstance(waiting[0], Arm)]:
            self._waiting.remove(waiting)
            if not waiting[1].done():
                waiting[1].set_result(self._refused("not armed: it was stopped"))

    def _refused(self, text: str, reasons: list[str] | None = None) -> Reply:
        return Reply(ok=False, state=self.cycle.machine.state.name, text=text, reasons=reasons or [])

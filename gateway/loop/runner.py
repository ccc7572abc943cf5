"""Commands and periods in one order: a command takes effect between two periods, never within one."""

import asyncio
from collections import deque

from gateway.core.messages import Arm, Command, MalformedMessage, Reply, parse_command
from gateway.core.states import LoopState, Phase
from gateway.loop.commands import carry_out, prepare_to_arm
from gateway.loop.cycle import Cycle
from gateway.loop.pacer import Tick

MAX_WAITING = 32  #: commands between two periods; more are refused


class Runner:
    def __init__(self, cycle: Cycle) -> None:
        self.cycle = cycle
        self._waiting: deque[tuple[Command, asyncio.Future[Reply]]] = deque()
        self._passed: asyncio.Event = asyncio.Event()
        self._arming = False

    async def period(self, tick: Tick) -> None:
        """Carry out what waits, then one control period."""
        while self._waiting:
            command, answer = self._waiting.popleft()
            reply = carry_out(self.cycle, command, tick.now_s)
            if not answer.done():
                answer.set_result(reply)
        await self.cycle.period(tick)
        self._passed.set()
        self._passed = asyncio.Event()

    async def command(self, payload: bytes) -> bytes:
        """Answer a command from outside. Never raises for what is in `payload`."""
        try:
            reply = await self.submit(parse_command(payload))
        except MalformedMessage as error:
            reply = self._refused(f"not a command: {error}")
        return reply.model_dump_json().encode()

    async def submit(self, command: Command) -> Reply:
        """Do `command` at the next boundary between periods; the reply says what was done, or why not."""
        if len(self._waiting) >= MAX_WAITING:
            return self._refused("too many commands at once: try again")
        if isinstance(command, Arm):
            return await self._arm(command)
        return await self._at_boundary(command)

    async def _at_boundary(self, command: Command) -> Reply:
        answer: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
        self._waiting.append((command, answer))
        return await answer

    async def _arm(self, command: Arm) -> Reply:
        if self._arming:
            return self._refused("arming is under way")
        self._arming = True
        try:
            refusal = await prepare_to_arm(self.cycle)
            reply = refusal or await self._at_boundary(command)
            while reply.ok and self.cycle.machine.phase is Phase.ARMING:
                await self._passed.wait()
        finally:
            self._arming = False
        if reply.ok and self.cycle.machine.state is not LoopState.READY:
            return self._refused(f"not armed: {self.cycle.machine.reason}")
        return reply.model_copy(update={"state": self.cycle.machine.state.name}) if reply.ok else reply

    def _refused(self, text: str) -> Reply:
        return Reply(ok=False, state=self.cycle.machine.state.name, text=text)

"""One unit on a connection of its own: its transaction each cycle, its proofs, its reconnection.

A unit has a connection to itself so that one that is dead, slow or lies cannot delay or damage what another says. A
request that is still running when the next cycle begins is not doubled: that cycle's samples are lost, and counted. A
connection on which nothing answers any more is dropped, with all that waits in it, and a lost one is made again
beside the cycle, with growing pauses; the first request on it is sent alone.
"""

import asyncio
from collections.abc import Callable

from drivers.modbus.client import ModbusConnection, ModbusFailed, ModbusTimeout
from drivers.modbus.device import ANSWERS_ALLOWED, Setting
from drivers.modbus.plan import Request
from drivers.modbus.unit import Payloads, Unit
from gateway.core.signals import Inputs, LinkHealth

EXCHANGE_SHARE = 0.8  #: of a period; what has not come by then leaves room for the next request
REQUEST_TIMEOUT_S = 0.5  #: of `prepare`
LEAVE_TIMEOUT_S = 0.2
MUTE_S = 0.3  #: without any answer, until the connection is dropped
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0  #: between attempts to connect


class Session:
    """`on_done` is called when the exchange of a cycle has ended, however it did."""

    def __init__(
        self,
        unit: Unit,
        host: str,
        port: int,
        period_s: float,
        health: LinkHealth,
        on_done: Callable[["Session"], None],
    ) -> None:
        self.unit = unit
        self._connection = ModbusConnection(host, port)
        self._period_s = period_s
        self._health = health
        self._on_done = on_done
        self._task: asyncio.Task[None] | None = None
        self._open = False  #: the cycle in which the exchange began still takes its answer
        self._sent_s = 0.0
        self._numbers: list[list[float]] | None = None  #: of this cycle
        self._unanswered = 0  #: requests in a row that ended without an answer
        self._mute = 0  #: exchanges in a row without any answer
        self._connecting: asyncio.Task[None] | None = None
        self._retry_s = float("-inf")
        self._pause_s = FIRST_PAUSE_S
        self._before: list[tuple[Setting, float]] = []  #: what `configure` has changed

    @property
    def where(self) -> str:
        return self._connection.where

    async def connect(self) -> bool:
        """Try once."""
        self._mute = 0
        return await self._connection.connect()

    # proving the unit

    async def ensure_connected(self) -> bool:
        await _cancel(self._connecting)
        if self._connection.connected:
            return True
        await _cancel(self._task)  # it would take the new connection for its own
        return await self.connect()

    async def check(self) -> list[str]:
        """What speaks against the unit before anything is written. Reads only."""
        unit, reasons = self.unit, list[str]()
        unit.identity.void()
        try:
            for proof in (unit.identity, unit.trust):
                for k in range(len(proof.groups)):
                    reasons += await proof.judge(k, self._connection, _now_s() + REQUEST_TIMEOUT_S)
                    if reasons and proof is unit.identity and k == 0:
                        return reasons  # another device: what else it says means nothing
        except ModbusTimeout as error:
            return [*reasons, self._in_words(error)]
        if not reasons:
            unit.identity.confirm()
            unit.standing.doubt = ""
        return reasons

    async def configure(self) -> list[str]:
        """Write every setting and read it back. Returns the first that fails; `undo` takes back what was written."""
        self._before.clear()
        for setting in self.unit.settings:
            if reason := await self._set(setting):
                return [reason]
        return []

    async def _set(self, setting: Setting) -> str:
        try:
            before = await self._read(setting)
            try:
                await self._write(setting, setting.counts)
            except ModbusTimeout:
                self._before.append((setting, before))  # it may have been written all the same
                raise
            self._before.append((setting, before))
            found = await self._read(setting)
        except (ModbusFailed, ValueError) as error:
            return f"{setting.name} cannot be set: {error}"
        if found == setting.counts:
            return ""
        return f"{setting.name} was set to {setting.counts:g} and reads back {found:g}"

    async def undo(self) -> list[str]:
        """Write back what was there before `configure`, the last first; returns what could not be restored."""
        failures: list[str] = []
        while self._before:
            setting, before = self._before.pop()
            try:
                await self._write(setting, before)
            except (ModbusFailed, ValueError) as error:
                failures.append(f"{setting.name} was not restored: {error}")
        return failures

    async def _read(self, setting: Setting) -> float:
        block, unit = setting.register, self.unit
        deadline_s = _now_s() + REQUEST_TIMEOUT_S
        return block.decode(
            await self._connection.read(unit.read_function, unit.address, block.address, block.count, deadline_s)
        )[0]

    async def _write(self, setting: Setting, counts: float) -> None:
        block = setting.register
        deadline_s = _now_s() + REQUEST_TIMEOUT_S
        await self._connection.write(self.unit.address, block.address, block.encode([counts]), deadline_s)

    async def leave(self) -> None:
        """Tell a unit that was commanded to rest, and restore its settings: nobody will feed its watchdog any more.

        Where it does not obey, or was lost, its watchdog is left as it is, and fires.
        """
        if self._task is not None and not self._task.done():
            await asyncio.wait([self._task])  # it may carry the last command
        unit = self.unit
        lost, commanded = unit.dropped, unit.commanded
        unit.silence()
        if lost or not self._before:
            self._before.clear()
            return
        try:
            if commanded:
                await self._rest()
            for k in range(len(unit.trust.groups)):
                if reasons := await unit.trust.judge(k, self._connection, _now_s() + LEAVE_TIMEOUT_S):
                    raise ModbusFailed("; ".join(reasons))
            failures = await self.undo()
            if commanded and not failures:
                await self._rest()  # a watchdog that was changed counts from the next command: only now it is off
        except (ModbusFailed, ValueError) as error:
            failures = [f"{unit.name}: left with its watchdog on: {error}"]
            self._before.clear()
        for failure in failures:
            self._discard(failure)

    async def _rest(self) -> None:
        await self._transact(self.unit.plan.read_write, self.unit.rest_payloads(), _now_s() + LEAVE_TIMEOUT_S)

    # the cycle

    def begin(self, now_s: float) -> bool:
        """Send what this cycle asks and commands; whether the answer is worth waiting for."""
        self._numbers = None
        payloads = self.unit.take_payloads()
        if self._task is not None and not self._task.done():
            return False
        self.unit.standing.wrote = False
        if not self._connection.connected:
            self._reconnect(now_s)
            return False
        self._sent_s, self._open = now_s, True
        patience_s = EXCHANGE_SHARE * self._period_s if self._connection.answers else MUTE_S
        self._task = asyncio.create_task(self._exchange(payloads, now_s + patience_s))
        return self._unanswered < ANSWERS_ALLOWED  # who is absent is asked, and not waited for

    async def _exchange(self, payloads: Payloads | None, deadline_s: float) -> None:
        answers = self._connection.answers
        try:
            numbers = await self._ask(payloads, deadline_s)
            self._unanswered = 0
            if self._open:
                self._numbers = numbers
            else:
                self._discard(f"{self.unit.name}: an answer after its cycle")
        except ModbusTimeout as error:
            self._unanswered += 1
            self._health.last_error = f"{self.unit.name}: {error}"
        except (ModbusFailed, ValueError) as error:
            self._unanswered = 0
            self._discard(f"{self.unit.name}: {error}")
        finally:
            self._on_done(self)
        if self._connection.answers > answers:
            self._mute = 0
            self._pause_s = FIRST_PAUSE_S
            return
        self._mute += 1
        if self._mute * self._period_s >= MUTE_S or not answers:
            self._connection.close()

    async def _ask(self, payloads: Payloads | None, deadline_s: float) -> list[list[float]]:
        """One transaction: the numbers of every device. Raises ModbusFailed or ValueError."""
        unit, standing = self.unit, self.unit.standing
        if not unit.identity.complete:
            if reasons := await unit.identity.go_on(self._connection, deadline_s):
                standing.doubt = "not proven: " + "; ".join(reasons)
                raise ModbusFailed(standing.doubt)
            standing.doubt = ""
        if standing.active and not unit.dropped and not unit.kept_settings.complete:
            unit.distrust(await unit.kept_settings.go_on(self._connection, deadline_s))
        if payloads is None or not unit.may_write():
            return await self._transact(unit.plan.read_only, [], deadline_s)
        standing.wrote = unit.commanded = True
        return await self._transact(unit.plan.read_write, payloads, deadline_s)

    async def _transact(self, requests: list[Request], payloads: Payloads, deadline_s: float) -> list[list[float]]:
        connection, unit = self._connection, self.unit
        answers: list[list[int]] = []
        for k, request in enumerate(requests):
            if request.read is None:
                assert request.write is not None
                await connection.write(unit.address, request.write[0], payloads[k], deadline_s)
            elif request.write is None:
                answers.append(await connection.read(unit.read_function, unit.address, *request.read, deadline_s))
            else:
                address = request.write[0]
                answers.append(
                    await connection.read_write(unit.address, *request.read, address, payloads[k], deadline_s)
                )
        return unit.plan.decode(answers)

    def end(self, inputs: Inputs) -> None:
        """Close the cycle: what has come counts."""
        self._open = False
        for trouble in self.unit.fill(inputs, self._numbers, self._sent_s):
            self._health.last_error = trouble
        self._health.timeouts += self._numbers is None

    # the connection

    def _reconnect(self, now_s: float) -> None:
        if now_s >= self._retry_s and (self._connecting is None or self._connecting.done()):
            self._retry_s = now_s + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
            self.unit.connection_lost()
            self._connecting = asyncio.create_task(self._connect_again())

    async def _connect_again(self) -> None:
        if await self.connect():
            self._health.reconnects += 1
        else:
            self._health.last_error = f"{self.unit.name}: no connection to {self.where}"

    def _in_words(self, error: ModbusFailed) -> str:
        return f"{self.unit.name}: unit {self.unit.address} at {self.where}: {error}"

    def _discard(self, reason: str) -> None:
        self._health.malformed += 1
        self._health.last_error = reason

    async def close(self) -> None:
        """Drop the connection. Idempotent."""
        self.unit.silence()
        await _cancel(self._task)
        await _cancel(self._connecting)
        self._task = self._connecting = None
        self._connection.close()


def _now_s() -> float:
    return asyncio.get_running_loop().time()


async def _cancel(task: asyncio.Task[None] | None) -> None:
    if task is not None:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

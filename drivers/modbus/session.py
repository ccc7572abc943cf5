"""One unit on a connection of its own: its transaction each cycle, its proofs, its reconnection.

A unit has a connection to itself so that one that is dead, slow or lies cannot delay or damage what another says. A
request that is still running when the next cycle begins is not doubled: that cycle's samples are lost, and counted. A
connection on which nothing answers any more is dropped, with all that waits in it, and a lost one is made again
beside the cycle, with growing pauses; the first request on it is sent alone.

Where there is nothing to prove and one request is enough, as in nearly every cycle, it leaves at once. Everything else
takes a task: proofs, several requests, and what is asked beside the cycle.
"""

import asyncio
from collections.abc import Callable

from drivers.modbus.client import ModbusConnection, ModbusFailed, ModbusTimeout
from drivers.modbus.device import ANSWERS_ALLOWED
from drivers.modbus.looks import Looks
from drivers.modbus.plan import Request
from drivers.modbus.proof import unit_not_read
from drivers.modbus.registers import SerialNumber
from drivers.modbus.settings import REQUEST_TIMEOUT_S, SettingsWriter
from drivers.modbus.unit import Payloads, Unit
from gateway.core.finding import Finding, finding
from gateway.core.signals import Inputs, LinkHealth
from gateway.tasks.cleanup import end, finish_all
from gateway.wording.catalogue import sentence, sentences

EXCHANGE_SHARE = 0.8  #: of a period; what has not come by then leaves room for the next request
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
        self.settings = SettingsWriter(unit, self._connection)
        self._period_s = period_s
        self._health = health
        self._on_done = on_done
        self._task: asyncio.Task[None] | None = None
        self._judged = False  #: the settings that it reads were proven before
        self._answers = 0  #: on the connection before this exchange
        self._deadline_s = 0.0  #: of this exchange
        self._open = False  #: the cycle in which the exchange began still takes its answer
        self._sent_s = 0.0
        self._numbers: list[list[float]] | None = None  #: of this cycle
        self._unanswered = 0  #: requests in a row that ended without an answer
        self._mute = 0  #: exchanges in a row without any answer
        self._connecting: asyncio.Task[None] | None = None
        self._retry_s = float("-inf")
        self._pause_s = FIRST_PAUSE_S
        self._checked_on = 0  #: number of the connection on which the unit was checked
        self._looks = Looks(unit, period_s)
        self.serials: dict[str, str] = {}  #: by device, as they were read last; one that tells none has no entry

    @property
    def where(self) -> str:
        return self._connection.where

    async def connect(self) -> bool:
        """Try once."""
        self._mute = 0
        if self._connection.number:
            self.unit.connection_lost()
        return await self._connection.connect()

    # proving the unit

    async def ensure_connected(self) -> bool:
        if self._connecting is not None:
            await end(self._connecting)
        if self._connection.connected:
            return True
        if self._task is not None:
            await end(self._task)  # it would take the new connection for its own
        return await self.connect()

    async def check(self) -> list[Finding]:
        """What speaks against the unit before anything is written. Reads only."""
        unit, reasons = self.unit, list[Finding]()
        unit.identity.void()
        if self._checked_on != self._connection.number:
            self.settings.forget()  # what was written, and not undone, may have been another device's
        self._checked_on = self._connection.number
        try:
            for proof in (unit.identity, unit.trust):
                for k in range(len(proof.groups)):
                    reasons += await proof.judge(k, self._connection, _now_s() + REQUEST_TIMEOUT_S)
                    if reasons and proof is unit.identity and k == 0:
                        return reasons  # another device: what else it says means nothing
        except ModbusTimeout as error:
            return [*reasons, unit_not_read(unit.name, unit.address, self._connection, error)]
        reasons = reasons or await self._read_serials() or self.lost_since_check()
        if not reasons:
            unit.identity.confirm()
            unit.standing.doubt = ()
        return reasons

    async def _read_serials(self) -> list[Finding]:
        """Devices of one unit that name the same registers share them. What speaks against the unit."""
        unit, connection, told = self.unit, self._connection, dict[SerialNumber, str]()
        for device in unit.devices:
            serial = device.proofs.serial
            if serial is None or serial in told:
                continue
            deadline_s = _now_s() + REQUEST_TIMEOUT_S
            try:
                read = await connection.read(unit.read_function, unit.address, serial.address, serial.count, deadline_s)
                told[serial] = serial.decode(read)
            except (ModbusFailed, ValueError) as error:
                error = ModbusFailed(f"serial number, register {serial.printed}: {error}")
                return [unit_not_read(device.name, unit.address, connection, error)]
        numbered = [(d, told[s]) for d in unit.devices if (s := d.proofs.serial) is not None and told[s]]
        self.serials = {name: number for device, number in numbered for name in device.name.split(", ")}
        return []

    def lost_since_check(self) -> list[Finding]:
        """What speaks against a unit that may be another, or was restarted, since it was checked."""
        if self._connection.connected and self._connection.number == self._checked_on:
            return []
        return [finding("connection-lost-meanwhile", device=self.unit.name)]

    def activate(self) -> None:
        """Its settings are proven: from now on it is commanded."""
        self.unit.activate()
        self._looks.begin(_now_s())

    async def leave(self) -> None:
        """Tell a unit that was commanded to rest, and restore its settings: nobody will feed its watchdog any more.

        Where it does not obey, or was lost, its watchdog is left as it is, and fires. Every request has a deadline.
        """
        unit = self.unit
        unit.silence()
        # Either may carry the last command; the end of a request may begin a look, so that the task comes second.
        await self._connection.until_free()
        if self._task is not None and not self._task.done():
            await asyncio.wait([self._task])
        lost, commanded = unit.was_lost, unit.owes_rest
        unit.was_lost = unit.owes_rest = False
        if lost or not self.settings.written:
            self.settings.forget()
            return
        try:
            if commanded:
                await self._rest()
            for k in range(len(unit.trust.groups)):
                if reasons := await unit.trust.judge(k, self._connection, _now_s() + LEAVE_TIMEOUT_S):
                    raise ModbusFailed(sentences(reasons))
            failures = [sentence(failure) for failure in await self.settings.undo()]
            if commanded and not failures:
                await self._rest()  # a watchdog that was changed counts from the next command: only now it is off
        except (ModbusFailed, ValueError) as error:
            failures = [f"{unit.name}: left with its watchdog on: {error}"]
            self.settings.forget()
        for failure in failures:
            self._discard(failure)

    async def _rest(self) -> None:
        self.unit.require_proven()
        await self._transact(self.unit.plan.read_write, self.unit.rest_payloads(), _now_s() + LEAVE_TIMEOUT_S)

    # the cycle

    def begin(self, now_s: float) -> bool:
        """Send what this cycle asks and commands; whether the answer is worth waiting for."""
        self._numbers = None
        payloads = self.unit.take_payloads()
        if self._connection.under_way or (self._task is not None and not self._task.done()):
            return False
        self.unit.standing.wrote = False
        if not self._connection.connected:
            self._reconnect(now_s)
            return False
        self._sent_s, self._open = now_s, True
        self._answers = self._connection.answers
        self._deadline_s = now_s + (EXCHANGE_SHARE * self._period_s if self._answers else MUTE_S)
        if not self._begin_at_once(payloads):
            self._task = asyncio.create_task(self._exchange(payloads))
        return self._unanswered < ANSWERS_ALLOWED  # who is absent is asked, and not waited for

    def _begin_at_once(self, payloads: Payloads | None) -> bool:
        """Whether all of this exchange is one request that has left."""
        unit = self.unit
        writes = payloads is not None and unit.may_write()
        request = unit.writes_at_once if writes else unit.reads_at_once
        if request is None or not unit.settled:
            return False
        data = request.encode(payloads[0] if writes and payloads else ())
        begun = self._connection.begin(unit.address, data, request.registers_read, self._deadline_s, self._take_answer)
        if begun:
            self._judged = unit.standing.active
            unit.standing.wrote = writes
            unit.commanded |= writes
        return begun

    def _take_answer(self, answer: bytes | ModbusFailed) -> None:
        outcome: list[list[float]] | Exception
        if isinstance(answer, bytes):
            try:
                numbers = self.unit.plan.decode_bytes((answer,))
                outcome = self.unit.take_settings(numbers, judged=self._judged and self.unit.standing.active)
            except ValueError as error:
                outcome = error.with_traceback(None)  # which holds this frame, which holds the error
        else:
            outcome = answer
        self._conclude(outcome)
        if (until_s := self._time_to_look()) is not None:
            self._task = asyncio.create_task(self._look(until_s))

    async def _exchange(self, payloads: Payloads | None) -> None:
        try:
            outcome = await self._ask(payloads, self._deadline_s)
        except (ModbusFailed, ValueError) as error:
            outcome = error.with_traceback(None)  # as above
        except BaseException:
            self._on_done(self)
            raise
        self._conclude(outcome)
        if (until_s := self._time_to_look()) is not None:
            await self._look(until_s)

    def _conclude(self, outcome: list[list[float]] | Exception) -> None:
        """The exchange has ended: with the numbers of every device, or without."""
        if isinstance(outcome, ModbusTimeout):
            self._unanswered += 1
            self._health.last_error = f"{self.unit.name}: {outcome}"
        elif isinstance(outcome, Exception):
            self._unanswered = 0
            self._discard(f"{self.unit.name}: {outcome}")
        elif self._open:
            self._unanswered = 0
            self._numbers = outcome
        else:
            self._unanswered = 0
            self._discard(f"{self.unit.name}: an answer after its cycle")
        self._on_done(self)
        if self._connection.answers > self._answers:
            self._mute = 0
            self._pause_s = FIRST_PAUSE_S
            return
        self._mute += 1
        if self._mute * self._period_s >= MUTE_S or not self._answers:
            self._connection.close()

    async def _ask(self, payloads: Payloads | None, deadline_s: float) -> list[list[float]]:
        """One transaction: the numbers of every device. Raises ModbusFailed or ValueError."""
        unit, standing = self.unit, self.unit.standing
        if not unit.identity.complete:
            if reasons := await unit.identity.go_on(self._connection, deadline_s):
                standing.doubt = reasons
                raise ModbusFailed(f"not proven: {sentences(reasons)}")
            standing.doubt = ()
        if standing.active and not unit.dropped and not unit.kept_settings.complete:
            unit.distrust(await unit.kept_settings.go_on(self._connection, deadline_s))
        active = standing.active  # what is read now was sent after the settings were
        if (rest := unit.take_rest()) is not None:
            numbers = await self._transact(unit.plan.read_write, rest, deadline_s)
        elif payloads is None or not unit.may_write() or self._old():
            numbers = await self._transact(unit.plan.read_only, [], deadline_s)
        else:
            standing.wrote = unit.commanded = True
            numbers = await self._transact(unit.plan.read_write, payloads, deadline_s, unit.may_write)
        return unit.take_settings(numbers, judged=active and standing.active)

    def _old(self) -> bool:
        """Whether the command of this exchange is over: the proofs before it took longer than its period."""
        return _now_s() >= self._sent_s + self._period_s

    def _time_to_look(self) -> float | None:
        """Until when a setting may be read that no cycle reads, where that is due and something was answered."""
        return None if self._mute else self._looks.until_s(_now_s(), self._sent_s, self._deadline_s)

    async def _look(self, until_s: float) -> None:
        unit = self.unit
        group = self._looks.next_group(_now_s())
        try:
            kept = not await unit.unseen_settings.judge(group, self._connection, until_s)
        except ModbusTimeout:
            kept = False
        if not kept and unit.standing.active:
            unit.doubt_settings()

    async def _transact(
        self,
        requests: list[Request],
        payloads: Payloads,
        deadline_s: float,
        may_write: Callable[[], bool] = lambda: True,
    ) -> list[list[float]]:
        """Raises ModbusFailed, also where there is something to write left and it may not be written any more."""
        connection, unit = self._connection, self.unit
        answers: list[list[int]] = []
        for k, request in enumerate(requests):
            if request.write is not None and not may_write():
                raise ModbusFailed("silent before all of its command was written")
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
            self._connecting = asyncio.create_task(self._connect_again())

    async def _connect_again(self) -> None:
        try:
            connected = await self.connect()
        except Exception as error:  # told, and tried again like any other
            self._health.last_error = f"{self.unit.name}: {self.where}: {type(error).__name__}: {error}"
            return
        if connected:
            self._health.reconnects += 1
        else:
            self._health.last_error = f"{self.unit.name}: no connection to {self.where}"

    def _discard(self, reason: str) -> None:
        self._health.malformed += 1
        self._health.last_error = reason

    async def close(self) -> None:
        """Drop the connection. Idempotent; no cancellation cuts it."""
        self.unit.silence()
        try:
            await finish_all(end(task) for task in (self._task, self._connecting) if task is not None)
        finally:
            self._task = self._connecting = None
            self._connection.close()


def _now_s() -> float:
    return asyncio.get_running_loop().time()

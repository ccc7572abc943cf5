"""Load-cell amplifiers and the line PLC behind one Modbus TCP address, behind the driver port.

A cycle's requests leave with `trigger`, one after the other on the one connection, and what has come by the deadline
counts. A request that is still running at the next `trigger` is not doubled: that cycle's samples are lost, and
counted. A connection on which nothing answers any more is dropped, with all that waits in it, and a lost one is made
again beside the cycle, with growing pauses; the first request on it is sent alone.
"""

import asyncio

from drivers.modbus.amplifier import Amplifier
from drivers.modbus.client import ModbusConnection, ModbusFailed, ModbusTimeout
from drivers.modbus.plc import Plc
from drivers.port import PrepareRefused
from gateway.core.signals import Inputs, LinkHealth, Outputs

EXCHANGE_SHARE = 0.8  #: of a period; what has not come by then leaves room for the next request
PREPARE_TIMEOUT_S = 0.5  #: per device
MUTE_S = 0.3  #: without any answer, until the connection is dropped
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0  #: between attempts to connect
ANSWERS_ALLOWED = 3  #: cycles in a row without an answer until a device counts as absent

Device = Amplifier | Plc


class ModbusLink:
    """A `drivers.port.Link` for the devices at one host and port."""

    def __init__(self, name: str, host: str, port: int, devices: list[Device], period_s: float) -> None:
        self.name = name
        self.health = LinkHealth()
        self._devices = devices
        self._plcs = [device for device in devices if isinstance(device, Plc)]
        self._connection = ModbusConnection(host, port)
        self._period_s = period_s
        self._task: asyncio.Task[None] | None = None
        self._open_s: float | None = None  #: the cycle whose answers still count, by its time
        self._complete = asyncio.Event()  #: every device that is not absent has answered
        self._sent_s = 0.0
        self._mute = 0  #: exchanges in a row without any answer
        self._connecting: asyncio.Task[None] | None = None
        self._retry_s = float("-inf")
        self._pause_s = FIRST_PAUSE_S

    async def open(self) -> None:
        """Connect. Raises OSError with what to do; the link may be used all the same, and goes on trying then."""
        if not await self._connect():
            raise OSError(
                f"bus {self.name}: no connection to {self._connection.where}; "
                "check host and port, and that the device is switched on"
            )

    async def prepare(self) -> None:
        """Check every device; set and prove the PLC's command watchdog. Raises PrepareRefused with every reason."""
        self.silence()
        await _cancel(self._connecting)
        if not self._connection.connected:
            await _cancel(self._task)  # it would take the new connection for its own
        if not self._connection.connected and not await self._connect():
            raise PrepareRefused([f"{d.name}: no connection to {self._connection.where}" for d in self._devices])
        reasons: list[str] = []
        for device in self._devices:
            deadline_s = asyncio.get_running_loop().time() + PREPARE_TIMEOUT_S
            reasons += await device.prepare(self._connection, deadline_s)
        if reasons:
            raise PrepareRefused(reasons)
        for plc in self._plcs:
            plc.active = True

    def silence(self) -> None:
        """Nothing is written from now on; reading goes on."""
        for plc in self._plcs:
            plc.silence()

    async def release(self) -> None:
        """The PLC's watchdog does not run while transport is off: nothing is left to say."""
        self.silence()

    def trigger(self, now_s: float) -> None:
        """Send the requests of this cycle."""
        for device in self._devices:
            device.answer = None
        if self._task is not None and not self._task.done():
            return
        if not self._connection.connected:
            self._reconnect(now_s)
            return
        self._sent_s = self._open_s = now_s
        self._complete.clear()
        patience_s = EXCHANGE_SHARE * self._period_s if self._connection.answers else MUTE_S
        self._task = asyncio.create_task(self._exchange(now_s, now_s + patience_s))

    async def _exchange(self, sent_s: float, deadline_s: float) -> None:
        answers = self._connection.answers
        # Who did not answer is asked last, and not waited for once absent: a dead unit costs the others nothing.
        for device in sorted(self._devices, key=lambda device: device.unanswered):
            if device.unanswered >= ANSWERS_ALLOWED:
                self._complete.set()
            try:
                answer = await device.exchange(self._connection, deadline_s)
                if self._open_s == sent_s:
                    device.answer = answer
                else:
                    self._discard(f"{device.name}: an answer after its cycle")
                device.unanswered = 0
            except ModbusTimeout as error:
                device.unanswered += 1
                self.health.last_error = f"{device.name}: {error}"
                break  # there is no time left in which another could answer
            except (ModbusFailed, ValueError) as error:
                device.unanswered = 0
                self._discard(f"{device.name}: {error}")
        self._complete.set()
        if self._connection.answers > answers:
            self._mute = 0
            self._pause_s = FIRST_PAUSE_S
            return
        self._mute += 1
        if self._mute * self._period_s >= MUTE_S or not answers:
            self._connection.close()

    async def collect(self, inputs: Inputs, deadline_s: float) -> None:
        """The answers that have come by `deadline_s`."""
        if self._open_s is not None and not self._complete.is_set():
            try:
                async with asyncio.timeout_at(deadline_s):
                    await self._complete.wait()
            except TimeoutError:
                pass
        self._open_s = None
        absent: list[str] = []
        for device in self._devices:
            for trouble in device.fill(inputs, self._sent_s):
                self.health.last_error = trouble
            self.health.timeouts += device.missed > 0
            if device.missed >= ANSWERS_ALLOWED:
                absent.append(device.name)
        self.health.absent = absent

    def write(self, outputs: Outputs) -> None:
        """What the next transaction with the PLC writes."""
        for plc in self._plcs:
            if plc.active:
                try:
                    plc.command(outputs)
                except ValueError as error:
                    self._discard(f"{plc.name}: {error}")

    def _reconnect(self, now_s: float) -> None:
        if now_s >= self._retry_s and (self._connecting is None or self._connecting.done()):
            self._retry_s = now_s + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
            for device in self._devices:
                device.connection_lost()
            self._connecting = asyncio.create_task(self._connect_again())

    async def _connect_again(self) -> None:
        if await self._connect():
            self.health.reconnects += 1
        else:
            self.health.last_error = f"no connection to {self._connection.where}"

    async def _connect(self) -> bool:
        self._mute = 0
        return await self._connection.connect()

    def _discard(self, reason: str) -> None:
        self.health.malformed += 1
        self.health.last_error = reason

    async def close(self) -> None:
        """Drop the connection. Idempotent."""
        self.silence()
        await _cancel(self._task)
        await _cancel(self._connecting)
        self._task = self._connecting = None
        self._connection.close()
        await asyncio.sleep(0)  # lets the transport release its socket


async def _cancel(task: asyncio.Task[None] | None) -> None:
    if task is not None:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

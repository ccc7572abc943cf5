"""The line PLC on Modbus: one transaction a cycle that writes the command and reads the status.

The command carries a life counter that moves with every cycle; the PLC's own watchdog ramps the line down when it
stops. The PLC's echo of it is watched the same way: an interface that still answers for a dead PLC is found by it.
"""

from math import floor, isfinite

from drivers.life import LifeCounter
from drivers.modbus.client import ModbusConnection, ModbusFailed
from drivers.modbus.maps import PlcMap, TimeRegister
from drivers.modbus.proof import Proof
from drivers.modbus.registers import RegisterBlock
from drivers.scaling import si_per_count
from gateway.core.line import LinePlc
from gateway.core.signals import Inputs, Outputs, Quality

_AT_REST = (0, 0)


class Plc:
    def __init__(self, device: PlcMap, plc: LinePlc, watchdog_s: float) -> None:
        self.name = plc.name
        self.unit = plc.address
        self.missed = 0  #: cycles in a row without an answer
        self.unanswered = 0  #: requests in a row that ended without one
        self.active = False  #: the link is not silent
        self.answer: list[float] | None = None  #: of this cycle
        self._device = device
        self._watchdog_s = watchdog_s
        base, order = device.address_base, device.word_order
        read, write = device.read, device.write
        self._read_speed_scale = si_per_count(read.speed.unit, read.speed.scale)
        self._write_speed_scale = si_per_count(write.speed.unit, write.speed.scale)
        entries = (read.status, read.speed, read.life_echo)
        self._read = RegisterBlock([(entry.address - base, entry.type) for entry in entries], order)
        entries = (write.command, write.speed, write.life)
        self._write = RegisterBlock([(entry.address - base, entry.type) for entry in entries], order)
        self._id = RegisterBlock([(device.device_id.address - base, device.device_id.type)], order)
        self._watchdog = RegisterBlock([(device.watchdog.address - base, device.watchdog.type)], order)
        #: Of device and command watchdog on this connection. Without it the PLC is not written to.
        self._proof = Proof(
            plc.name,
            plc.address,
            device.read_function,
            [(self._id, self._against_identity), (self._watchdog, self._against_watchdog)],
        )
        self._life = LifeCounter()
        self._command: tuple[int, float] | None = _AT_REST  #: command word and speed; None: cannot be commanded
        self._doubts: list[str] = []  #: why it is not proven

    def _may_write(self) -> bool:
        return self.active and self._proof.complete and self._command is not None

    def silence(self) -> None:
        """Nothing is written from now on, and nothing of the last command is left."""
        self.active = False
        self._command = _AT_REST
        self._life.forget()

    def command(self, outputs: Outputs) -> None:
        """What the next transaction writes. Raises ValueError; nothing is written then, and the life counter stops."""
        self._command = None
        write = self._device.write
        speed_m_per_s = outputs.speed_request_m_per_s
        if not isfinite(speed_m_per_s):
            raise ValueError(f"speed request {speed_m_per_s} is not finite")
        counts = speed_m_per_s / self._write_speed_scale
        low, high = write.speed.range
        if not low <= counts * write.speed.scale <= high:
            raise ValueError(f"speed request {speed_m_per_s} m/s is outside [{low:g}, {high:g}] {write.speed.unit}")
        run = outputs.run != write.run.inverted
        self._command = (run << write.run.bit, counts if write.speed.type == "f32" else round(counts))

    async def exchange(self, connection: ModbusConnection, deadline_s: float) -> list[float]:
        """Write and read in one transaction when active, only read when silent. Raises ModbusFailed or ValueError."""
        read = self._read
        if self.active:
            self._doubts = await self._proof.go_on(connection, deadline_s)
        if self._may_write():
            assert self._command is not None
            word, speed = self._command
            payload = self._write.encode((word, speed, self._life.next()))
            registers = await connection.read_write(
                self.unit, read.address, read.count, self._write.address, payload, deadline_s
            )
        else:
            function = self._device.read_function
            registers = await connection.read(function, self.unit, read.address, read.count, deadline_s)
        return read.decode(registers)

    def fill(self, inputs: Inputs, time_s: float) -> list[str]:
        """Status and v0 into `inputs`; returns what was wrong. Without an answer they are missed."""
        answer, plc = self.answer, inputs.plc
        if answer is None:
            self.missed += 1
            self._miss(inputs)
            return []
        self.missed = 0
        if self._life.stands_still(answer[2], moving=self._may_write()):
            self._miss(inputs)
            return [f"{self.name}: answers, but its echo of the life counter stands still"]
        read, status = self._device.read, int(answer[0])
        # A PLC that can be read but not told to stop is not there for the loop; its v0 is true all the same.
        mute = self.active and not self._may_write()
        plc.quality, plc.time_s = Quality.STALE if mute else Quality.GOOD, time_s
        plc.permissive = read.permissive.is_set(status)
        plc.emergency_stop = read.emergency_stop.is_set(status)
        plc.running = read.running.is_set(status)
        troubles = [f"{self.name}: its command watchdog has tripped"] if read.watchdog_tripped.is_set(status) else []
        if mute:
            troubles.append("; ".join(self._doubts) or f"{self.name}: its command was refused")
            troubles[-1] += "; it is not written to"
        low, high = read.speed.range
        if low <= answer[1] * read.speed.scale <= high:
            inputs.unwind_speed.put(0, answer[1] * self._read_speed_scale, time_s)
        else:
            inputs.unwind_speed.reject(0)
            troubles.append(f"{self.name}: speed {answer[1]:g} is outside [{low:g}, {high:g}] {read.speed.unit}")
        return troubles

    def _miss(self, inputs: Inputs) -> None:
        inputs.unwind_speed.miss(0)
        if inputs.plc.quality != Quality.MISSING:
            inputs.plc.quality = Quality.STALE

    def connection_lost(self) -> None:
        """A PLC that was restarted has lost its watchdog: it is not written to before that is read back."""
        self._proof.void()

    async def prepare(self, connection: ModbusConnection, deadline_s: float) -> list[str]:
        """Check the device, set its command watchdog and read it back; undone when that fails."""
        self._proof.void()
        try:
            if reasons := self._against_identity(await self._read_one(self._id, connection, deadline_s)):
                return reasons
            counts = watchdog_counts(self._device.watchdog, self._watchdog_s)
            before = await self._read_one(self._watchdog, connection, deadline_s)
            try:
                await connection.write(self.unit, self._watchdog.address, self._watchdog.encode([counts]), deadline_s)
                found = await self._read_one(self._watchdog, connection, deadline_s)
                if found == counts:
                    self._proof.confirm()
                    return []
                reason = f"its command watchdog was set to {counts} and reads back {found:g}"
            except ModbusFailed as error:
                reason = f"its command watchdog cannot be set: {error}"
            await connection.write(self.unit, self._watchdog.address, self._watchdog.encode([before]), deadline_s)
            return [f"{self.name}: {reason}"]
        except (ModbusFailed, ValueError) as error:
            return [f"{self.name}: unit {self.unit} at {connection.where}: {error}"]

    def _against_identity(self, found: float) -> list[str]:
        wanted = self._device.device_id.value
        return [] if found == wanted else [f"{self.name}: device id {int(found):#x}, the map says {wanted:#x}"]

    def _against_watchdog(self, found: float) -> list[str]:
        counts = watchdog_counts(self._device.watchdog, self._watchdog_s)
        return (
            []
            if found == counts
            else [f"{self.name}: its command watchdog reads {found:g}, {counts} was set; arm again"]
        )

    async def _read_one(self, block: RegisterBlock, connection: ModbusConnection, deadline_s: float) -> float:
        function = self._device.read_function
        return block.decode(await connection.read(function, self.unit, block.address, block.count, deadline_s))[0]


def watchdog_counts(watchdog: TimeRegister, watchdog_s: float) -> int:
    """The value of the watchdog register: at most the time asked for. Raises ValueError when the PLC cannot do it."""
    counts = floor(watchdog_s / si_per_count(watchdog.unit, watchdog.scale) + 1e-9)
    low, high = watchdog.range
    if counts < 1 or not low <= counts * watchdog.scale <= high:
        raise ValueError(
            f"limits.watchdog_s = {watchdog_s} s is outside what the PLC can do ({low:g} to {high:g} {watchdog.unit})"
        )
    return counts

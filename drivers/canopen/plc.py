"""The line PLC as a node of the bus: one receive PDO a cycle with the command, one transmit PDO with the status.

The command carries a life counter that moves with every cycle; the PLC's own watchdog ramps the line down when it
stops. The PLC's echo of it is watched the same way: a CAN controller that still answers for a dead PLC is found by it.
While the link is silent the status is asked for by SDO, and nothing is written.
"""

from math import isfinite
from typing import NamedTuple

from drivers.canopen.configure import plc_expected, plc_steps, watchdog_step
from drivers.canopen.map_plc import PlcMap
from drivers.canopen.pdo import MalformedPdo, PdoLayout
from drivers.canopen.prepare import check_fixed, check_identity
from drivers.canopen.sdo import SdoBus
from drivers.canopen.station import Station
from drivers.canopen.transaction import Step, read_number
from drivers.life import LifeCounter
from drivers.scaling import si_per_count
from gateway.core.finding import Finding, finding
from gateway.core.line import LinePlc
from gateway.core.signals import Inputs, Outputs, Quality
from gateway.wording.catalogue import sentence


class _Status(NamedTuple):
    word: int
    speed: float  #: of the unwinder, in counts
    echo: int


class PlcNode:
    """Raises ValueError when the line asks for a watchdog that it cannot do."""

    def __init__(self, device: PlcMap, plc: LinePlc, watchdog_s: float) -> None:
        self.station = Station(
            plc.name, plc.address, device.heartbeat, watchdog=device.watchdog, classes=device.emergency
        )
        self.identity = device.identity
        self._device = device
        self._steps = plc_steps(device, plc.address, watchdog_s)
        self.watchdog = watchdog_step(device.watchdog, watchdog_s)
        self.defies, self.shows_torque = None, False  # its echo and its watchdog answer for it
        self._read_scale = si_per_count(device.read.speed.unit, device.read.speed.scale)
        self._write_scale = si_per_count(device.write.speed.unit, device.write.speed.scale)
        self._transmit = PdoLayout(device.objects_of(device.transmit_pdo))
        self._receive = PdoLayout(device.objects_of(device.receive_pdo))
        names = device.transmit_pdo.objects
        self._status_at, self._speed_at, self._echo_at = (
            names.index(name) for name in ("status", "speed", "life_echo")
        )
        self.answers = (device.transmit_pdo.cob_id + plc.address,)
        self._receive_cob_id = device.receive_pdo.cob_id + plc.address
        self._life = LifeCounter()
        self._fresh: _Status | None = None  #: not used yet
        self._read_s = 0.0  #: when the last reading by SDO was asked for
        self._commanded = False  #: the last cycle had a command for it
        self._refusal: Finding | None = None  #: why it had none
        self._runs = False  #: transport is asked for
        self._boot_ups = -1  #: of the station, when it was last found to be what its map says

    # the cycle

    def begin_sync(self) -> None:
        self.station.begin_sync()
        self._fresh = None

    def on_answer(self, cob_id: int, data: bytes | bytearray) -> None:
        """The TPDO of the present SYNC. Raises MalformedPdo for a second one or a wrong length."""
        if self._fresh is not None:
            raise MalformedPdo("a second answer to one SYNC")
        self._fresh = self._decode(data)
        self.station.on_frame()

    def check_answer(self, cob_id: int, data: bytes | bytearray) -> None:
        """Raises MalformedPdo."""
        self._decode(data)

    def _decode(self, data: bytes | bytearray) -> _Status:
        fields = self._transmit.decode(data)
        return _Status(int(fields[self._status_at]), fields[self._speed_at], int(fields[self._echo_at]))

    def absent(self, now_s: float) -> bool:
        return self.station.absent(now_s, self._runs)

    def trouble(self, now_s: float) -> Finding | None:
        return self.station.trouble(now_s, self._runs)

    def fill(self, inputs: Inputs, now_s: float, *, active: bool) -> list[str]:
        """Status and v0. A PLC that can be read but not told to stop is not there for the loop."""
        status = self._fresh
        if not active:
            self._fresh = None  # a reading counts once
        if status is None or self.absent(now_s):
            self._miss(inputs)
            return []
        if self._life.stands_still(status.echo, moving=active and self._commanded and self._is_fed()):
            self._miss(inputs)
            return [f"{self.station.name}: answers, but its echo of the life counter stands still"]
        time_s = now_s if active else self._read_s
        doubt = self.station.distrust or self.station.emergency or (self._refusal if active else None)
        troubles = [sentence(doubt)] if doubt else []
        plc, read, word = inputs.plc, self._device.read, status.word
        plc.quality, plc.time_s = Quality.STALE if doubt else Quality.GOOD, time_s
        plc.permissive = read.permissive.is_set(word)
        plc.emergency_stop = read.emergency_stop.is_set(word)
        plc.running = read.running.is_set(word)
        plc.local = read.local is not None and read.local.is_set(word)
        plc.tripped = read.watchdog_tripped.is_set(word)
        if plc.tripped:
            troubles.append(f"{self.station.name}: its command watchdog has tripped")
        return troubles + self._fill_speed(inputs, status.speed, time_s)

    def _is_fed(self) -> bool:
        return not self.station.dropped and not self.station.withheld

    def _fill_speed(self, inputs: Inputs, counts: float, time_s: float) -> list[str]:
        speed = self._device.read.speed
        low, high = speed.range
        if low <= counts * speed.scale <= high:
            inputs.unwind_speed.put(0, counts * self._read_scale, time_s)
            return []
        inputs.unwind_speed.reject(0)
        return [f"{self.station.name}: speed {counts:g} is outside [{low:g}, {high:g}] {speed.unit}"]

    def _miss(self, inputs: Inputs) -> None:
        inputs.unwind_speed.miss(0)
        if inputs.plc.quality != Quality.MISSING:
            inputs.plc.quality = Quality.STALE

    def command(self, outputs: Outputs, now_s: float) -> tuple[int, bytes] | None:
        """Its RPDO, with the next life. None for a PLC that was restarted: its watchdog is gone.

        Raises ValueError; nothing is sent then, and the life counter stops.
        """
        self._commanded, self._runs, self._refusal = False, outputs.run, None
        if self.station.distrust:
            return None
        try:
            numbers = self._numbers(outputs)
            numbers["life"] = self._life.next()
            payload = self._receive.encode([numbers[name] for name in self._device.receive_pdo.objects])
        except ValueError as error:
            self._refusal = finding("command-refused", device=self.station.name, error=str(error))
            raise
        self._commanded = True
        return self._receive_cob_id, payload

    def _numbers(self, outputs: Outputs) -> dict[str, float]:
        """Command word and speed in counts. Raises ValueError."""
        write, speed_m_per_s = self._device.write, outputs.speed_request_m_per_s
        if not isfinite(speed_m_per_s):
            raise ValueError(f"speed request {speed_m_per_s} is not finite")
        counts = speed_m_per_s / self._write_scale
        low, high = write.speed.range
        if not low <= counts * write.speed.scale <= high:
            raise ValueError(f"speed request {speed_m_per_s} m/s is outside [{low:g}, {high:g}] {write.speed.unit}")
        command = write.run.word(outputs.run)
        if write.warning is not None:
            command |= write.warning.word(outputs.warning)
        return {"command": command, "speed": counts if write.speed.type == "f32" else round(counts)}

    # by SDO

    def reading_due(self, now_s: float, *, active: bool) -> bool:
        return not active

    async def read(self, sdo: SdoBus, now_s: float) -> list[Finding]:
        """Status and v0 while there is no SYNC. Raises SdoFailed."""
        node, read = self.station.node, self._device.read
        boot_ups = self.station.boot_ups
        if self._boot_ups != boot_ups:
            if reasons := await check_identity(sdo, self.station, self.identity):
                return reasons
            self._boot_ups = boot_ups
        word = int(await read_number(sdo, node, read.status))
        speed = await read_number(sdo, node, read.speed)
        self._fresh = _Status(word, speed, int(await read_number(sdo, node, read.life_echo)))
        self._read_s = now_s
        return []

    async def check(self, sdo: SdoBus) -> list[Finding]:
        """That its fixed objects are those of its map. Raises SdoFailed."""
        return await check_fixed(sdo, self.station, plc_expected(self._device, self.station.node))

    def steps(self) -> list[Step]:
        return self._steps

    def release_steps(self) -> list[Step]:
        return []

    async def confirm_stopped(self, sdo: SdoBus) -> bool:
        """Its watchdog is its own life counter's; no other waits for it."""
        return True

    def forget(self) -> None:
        self.station.forget()
        self._fresh = None
        self._commanded, self._runs, self._refusal = False, False, None
        self._life.forget()

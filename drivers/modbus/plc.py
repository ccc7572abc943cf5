"""The line PLC on Modbus: what is read of it and written to it each cycle, and what its answers mean. No I/O.

The command carries a life counter that moves with every cycle; the PLC's own watchdog ramps the line down when it
stops. The PLC's echo of it is watched the same way: an interface that still answers for a dead PLC is found by it.
"""

from collections.abc import Sequence
from math import isfinite

from drivers.life import LifeCounter
from drivers.modbus.device import (
    WATCHDOG_OFF,
    Proofs,
    Setting,
    Standing,
    identity_check,
    register_block,
)
from drivers.modbus.maps import PlcMap
from drivers.modbus.plan import Wish
from drivers.modbus.registers import SerialNumber
from drivers.scaling import si_per_count, watchdog_counts
from gateway.core.line import LinePlc
from gateway.core.signals import Inputs, Outputs, Quality


class Plc:
    """Raises ValueError when the line asks for a watchdog that it cannot do."""

    gives_torque = disobeys = False

    def __init__(self, device: PlcMap, plc: LinePlc, watchdog_s: float) -> None:
        self.name = plc.name
        self._device = device
        read, write = device.read, device.write
        self._read_speed_scale = si_per_count(read.speed.unit, read.speed.scale)
        self._write_speed_scale = si_per_count(write.speed.unit, write.speed.scale)
        entries = (write.command, write.speed, write.life)
        self._write = register_block(entries, device)
        entries = (read.status, read.speed, read.life_echo)
        fields = [(entry.address - device.address_base, entry.type) for entry in entries]
        self.wish = Wish(self.name, fields, device.word_order, (self._write.address, self._write.count))
        counts = watchdog_counts(device.watchdog, watchdog_s)
        watchdog = register_block([device.watchdog], device)
        self.proofs = Proofs(
            [identity_check(self.name, device.device_id, device)],
            settings=[Setting(self.name, "watchdog", watchdog, counts, WATCHDOG_OFF)],
            serial=SerialNumber.of(device),
        )
        self._life = LifeCounter()

    def command(self, outputs: Outputs) -> list[int]:
        """See `Device.command`. After a ValueError the life counter stands still: the PLC's watchdog decides."""
        speed_m_per_s = outputs.speed_request_m_per_s
        if not isfinite(speed_m_per_s):
            raise ValueError(f"speed request {speed_m_per_s} is not finite")
        write = self._device.write
        counts = speed_m_per_s / self._write_speed_scale
        low, high = write.speed.range
        if not low <= counts * write.speed.scale <= high:
            raise ValueError(f"speed request {speed_m_per_s} m/s is outside [{low:g}, {high:g}] {write.speed.unit}")
        return self._encode(outputs.run, outputs.warning, counts)

    def rest(self) -> list[int]:
        return self._encode(False, False, 0.0)

    def _encode(self, run: bool, warning: bool, speed_counts: float) -> list[int]:
        write = self._device.write
        word = write.run.word(run)
        if write.warning is not None:
            word |= write.warning.word(warning)
        speed = speed_counts if write.speed.type == "f32" else round(speed_counts)
        return self._write.encode((word, speed, self._life.next()))

    def fill(self, inputs: Inputs, numbers: Sequence[float] | None, standing: Standing, time_s: float) -> list[str]:
        """Status and v0 into `inputs`; returns what was wrong. Without an answer they are missed."""
        if numbers is None:
            self._miss(inputs)
            return []
        status, speed, echo = int(numbers[0]), numbers[1], numbers[2]
        if self._life.stands_still(echo, moving=standing.wrote):
            self._miss(inputs)
            return [f"{self.name}: answers, but its echo of the life counter stands still"]
        read, plc = self._device.read, inputs.plc
        # A PLC that can be read but not told to stop is not there for the loop; its v0 is true all the same.
        mute = standing.distrust or standing.refused
        plc.quality, plc.time_s = Quality.STALE if mute else Quality.GOOD, time_s
        plc.permissive = read.permissive.is_set(status)
        plc.emergency_stop = read.emergency_stop.is_set(status)
        plc.running = read.running.is_set(status)
        plc.local = read.local is not None and read.local.is_set(status)
        plc.tripped = read.watchdog_tripped.is_set(status)
        troubles = [f"{self.name}: its command watchdog has tripped"] if plc.tripped else []
        low, high = read.speed.range
        if low <= speed * read.speed.scale <= high:
            inputs.unwind_speed.put(0, speed * self._read_speed_scale, time_s)
        else:
            inputs.unwind_speed.reject(0)
            troubles.append(f"{self.name}: speed {speed:g} is outside [{low:g}, {high:g}] {read.speed.unit}")
        return troubles

    def _miss(self, inputs: Inputs) -> None:
        inputs.unwind_speed.miss(0)
        if inputs.plc.quality != Quality.MISSING:
            inputs.plc.quality = Quality.STALE

    def forget(self) -> None:
        self._life.forget()

"""The line PLC on OPC UA: what is told to it and asked of it each cycle, and what of it may be believed. No I/O.

The command carries a life counter that moves with every cycle; the PLC's own watchdog ramps the line down when it
stops. The PLC's echo of it is watched the same way: a server that still answers for a dead PLC is found by it. So a PLC
that is not relied on is not written to, except when its watchdog is found to be another than was set: silence would
leave it running then, and it is told to stop, without a life counter.
"""

from math import isfinite

from drivers.life import LifeCounter
from drivers.opcua.maps import PlcMap
from drivers.opcua.nodes import DeviceNodes, NodeTable, Reading, to_type
from drivers.opcua.proof import ANSWERS_ALLOWED, Proof, Watchdog, not_read
from drivers.opcua.status import describe, is_done
from drivers.scaling import si_per_count
from gateway.core.finding import Finding, finding
from gateway.core.line import LinePlc
from gateway.core.signals import Inputs, Outputs, Quality
from gateway.wording.catalogue import sentence, sentences


class Plc:
    """`refusal` is why it is not written to until the next `prepare`, None while there is no reason."""

    def __init__(self, device: PlcMap, plc: LinePlc, watchdog_s: float, table: NodeTable) -> None:
        self.name = plc.name
        self.missed = ANSWERS_ALLOWED  #: cycles in a row without an answer; nothing was heard yet
        self.active = False  #: the link is not silent
        self.refusal: Finding | None = None
        self._device = device
        nodes = DeviceNodes(table, device.namespace, plc.address)
        self.watchdog = Watchdog(device.watchdog, watchdog_s, nodes)
        self.proof = Proof(plc.name, device.identity, self.watchdog, nodes)
        self.serial = nodes.serial(device.serial)  #: its node
        self.prepare_reads = self.proof.nodes
        read, write = device.read, device.write
        self._read_m_per_s_per_count = si_per_count(read.speed.unit, read.speed.scale)
        self._write_m_per_s_per_count = si_per_count(write.speed.unit, write.speed.scale)
        self._flags = (read.permissive, read.emergency_stop, read.running, read.watchdog_tripped)
        if read.local is not None:
            self._flags = (*self._flags, read.local)
        self.reads = tuple(nodes.place(entry, entry.type) for entry in (*self._flags, read.speed, read.life_echo))
        self._command_nodes = (
            nodes.place(write.run, "bool"),
            nodes.place(write.speed, write.speed.type),
            nodes.place(write.life, write.life.type),
        )
        self._warning_nodes = () if write.warning is None else (nodes.place(write.warning, "bool"),)
        self._life = LifeCounter()
        self._command: tuple[float, float] | None = None  #: run and speed (counts) of this cycle
        self._warning: tuple[float, ...] = ()  #: of this cycle, where the PLC has the output
        self._unsaid = ""  #: why there is no command
        self._wrote = False  #: in this cycle, with a life counter
        self._runs = False  #: as it said last

    def _may_write(self) -> bool:
        return self.active and self.proof.proven and not self.refusal

    def command(self, outputs: Outputs) -> None:
        """What the next write says. Raises ValueError; nothing is written then, and the life counter stops."""
        self._command, self._unsaid = None, "its command cannot be said"
        write = self._device.write
        speed_m_per_s = outputs.speed_request_m_per_s
        if not isfinite(speed_m_per_s):
            raise ValueError(f"speed request {speed_m_per_s} is not finite")
        counts = speed_m_per_s / self._write_m_per_s_per_count
        low, high = write.speed.range
        if not low <= counts * write.speed.scale <= high:
            raise ValueError(f"speed request {speed_m_per_s} m/s is outside [{low:g}, {high:g}] {write.speed.unit}")
        if write.warning is not None:
            self._warning = (float(outputs.warning != write.warning.inverted),)
        self._command = (float(outputs.run != write.run.inverted), to_type(counts, write.speed.type))
        self._unsaid = ""

    def take_writes(self) -> list[tuple[int, float]]:
        """The command that was handed over for this cycle, once."""
        command, self._command = self._command, None
        self._wrote = command is not None and self._may_write()
        if self.active and self.proof.unguarded and self._runs and not self.refusal:
            return list(zip(self._command_nodes[:2], (float(self._device.write.run.inverted), 0.0), strict=True))
        if command is None or not self._wrote:
            return []
        nodes = (*self._command_nodes, *self._warning_nodes)
        return list(zip(nodes, (*command, self._life.next(), *self._warning), strict=True))

    def on_written(self, statuses: tuple[int, ...]) -> str:
        """What became of the command; returns what was wrong."""
        refused = [describe(status) for status in statuses if not is_done(status)]
        if not refused:
            return ""
        self.refusal = finding("command-refused", device=self.name, error=", ".join(dict.fromkeys(refused)))
        return sentence(self.refusal)

    def connection_lost(self) -> None:
        """A PLC that was restarted has lost its watchdog: it is not written to before that is read back."""
        self.proof.void()

    def activate(self) -> None:
        """`prepare` has proven it."""
        self.active = True
        self.missed = 0
        self.proof.confirm()

    def forget(self) -> None:
        """Silence: nothing of the last command is left."""
        self.active = False
        self.refusal, self._unsaid = None, ""
        self._command = None
        self._life.forget()

    def against(self, readings: tuple[Reading, ...]) -> list[Finding]:
        """What `prepare_reads` say against commanding it."""
        identity, watchdog = readings
        if reasons := self.proof.against_identity(identity):
            return reasons
        return [] if watchdog.good else [not_read(self.name, "watchdog", watchdog)]

    def fill(self, inputs: Inputs, time_s: float, readings: tuple[Reading, ...] | None) -> list[str]:
        """Status and v0 into `inputs`; returns what was wrong. Without an answer they are missed."""
        if readings is None:
            self.missed += 1
            self._miss(inputs)
            return []
        self.missed = 0
        if not self.proof.known:
            self._miss(inputs)
            return [sentence(doubt) for doubt in self.proof.doubts]
        flags, (speed, echo) = readings[: len(self._flags)], readings[len(self._flags) :]
        if echo.good and self._life.stands_still(echo.value, moving=self._wrote):
            self._miss(inputs)
            return [f"{self.name}: answers, but its echo of the life counter stands still"]
        troubles = self._fill_status(inputs, time_s, flags, echo)
        trouble = self._fill_speed(inputs, time_s, speed)
        return [*troubles, trouble] if trouble else troubles

    def _fill_status(self, inputs: Inputs, time_s: float, flags: tuple[Reading, ...], echo: Reading) -> list[str]:
        plc = inputs.plc
        bad = next((reading for reading in (*flags, echo) if not reading.good), None)
        if bad is not None:
            plc.quality = Quality.BAD
            return [f"{self.name}: status: {bad.trouble}"]
        # A PLC that can be read but not told to stop is not there for the loop; its v0 is true all the same.
        mute = self.active and (self._unsaid != "" or not self._may_write())
        plc.quality, plc.time_s = Quality.STALE if mute else Quality.GOOD, time_s
        said = [entry.is_set(reading.value) for entry, reading in zip(self._flags, flags, strict=True)]
        plc.permissive, plc.emergency_stop, plc.running, tripped, *local = said
        plc.local = any(local)
        plc.tripped = tripped
        self._runs = plc.running
        troubles = [f"{self.name}: its command watchdog has tripped"] if tripped else []
        if mute:
            unsaid = f"{self.name}: {self._unsaid or 'it has yet to prove itself'}"
            why = sentences(self.proof.doubts) or (sentence(self.refusal) if self.refusal else unsaid)
            told = "told to stop" if self.proof.unguarded and not self.refusal else "not written to"
            troubles.append(f"{why}; it is {told}")
        return troubles

    def _fill_speed(self, inputs: Inputs, time_s: float, speed: Reading) -> str:
        entry = self._device.read.speed
        low, high = entry.range
        if not speed.good:
            inputs.unwind_speed.reject(0)
            return f"{self.name}: speed: {speed.trouble}"
        if not low <= speed.value * entry.scale <= high:  # NaN and infinity, too
            inputs.unwind_speed.reject(0)
            return f"{self.name}: speed {speed.value:g} is outside [{low:g}, {high:g}] {entry.unit}"
        inputs.unwind_speed.put(0, speed.value * self._read_m_per_s_per_count, time_s)
        return ""

    def _miss(self, inputs: Inputs) -> None:
        inputs.unwind_speed.miss(0)
        if inputs.plc.quality != Quality.MISSING:
            inputs.plc.quality = Quality.STALE

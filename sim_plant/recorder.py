"""The independent witness at the drives: what was commanded, what really acted, what the web did, what was unsafe.

It sees the simulated devices from inside and nothing of the gateway. In memory for stepped time; into a folder
(`Recorder.to_folder`) for a process that may be killed at any moment. What counts as unsafe is defined in `judge`.
"""

from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import numpy as np

from sim_plant.judge import UNSAFE, Finding, Judge, Kind, Tolerance, wire_tolerance
from sim_plant.physics import STEP_S, STEPS_PER_S, FloatArray
from sim_plant.recording import Event, Recording, RecordingWriter, read_recording, recording_of
from sim_plant.world import World

__all__ = ["Recorder", "read_recording"]

FLUSH_AFTER_S = 0.2
_BLOCK = 1024  #: rows of trace that are gathered before they are stored
_ROUTINE = {"command", "plc_command", "torque", "torques"}  #: kinds of event that may wait; others are flushed at once
_TOLD = {"command", "nmt", "quick stop"}  #: causes of a state change that are somebody's will

_Later = Callable[[Callable[[], None]], object]


class Recorder:
    """Watches a world from its creation on. All times given to it are world time in seconds."""

    def __init__(
        self,
        world: World,
        tolerance: Tolerance | None = None,
        *,
        writer: RecordingWriter | None = None,
        monotonic_start_s: float = 0.0,
        time_scale: float = 1.0,
    ) -> None:
        """Records in memory, or with a writer to its folder.

        `tolerance` is that of the wire unless told otherwise (`judge.EXACT` where there is none). World time 0 is
        `monotonic_start_s` on CLOCK_MONOTONIC, and runs `time_scale` times as fast.
        """
        self.events: list[Event] = []  #: what happened, in memory; empty when it goes to a folder
        self._world = world
        self._judge = Judge(world.n, world.plant.recorder, tolerance or wire_tolerance(world.plant))
        self._writer = writer
        self._later: _Later | None = None
        self._waiting: deque[Callable[[], None]] = deque()
        self._settling = False
        self._monotonic_start_s = monotonic_start_s
        self._time_scale = time_scale
        self._last_step = self._flushed_at_step = world.steps
        self._blocks: list[tuple[int, FloatArray]] = []
        self._block = np.empty((_BLOCK, 3 * world.n + 1))
        self._block_first = world.steps + 1
        self._filled = 0
        self._torque_nm = np.zeros(world.n)
        self._states = ["SWITCH_ON_DISABLED"] * world.n
        world.on_rows = self._rows

    @classmethod
    def to_folder(
        cls,
        folder: Path | str,
        world: World,
        monotonic_start_s: float,
        time_scale: float = 1.0,
        tolerance: Tolerance | None = None,
    ) -> Self:
        """Records into a new folder, in the format of `recording`; the rest as for the constructor.

        Raises FileExistsError when the folder already holds a recording.
        """
        plant = world.plant
        header = {"plant": plant.name, "spans": plant.spans, "seed": world.seed, "time_scale": time_scale}
        header |= {"monotonic_start_s": monotonic_start_s, "limits": plant.recorder.model_dump()}
        writer = RecordingWriter(Path(folder), header, plant.spans)
        return cls(world, tolerance, writer=writer, monotonic_start_s=monotonic_start_s, time_scale=time_scale)

    def defer(self, later: _Later) -> None:
        """What is told every cycle is dealt with by a call that is handed to `later`, as `call_soon` of an event loop.

        Devices answer first, then: what the recording holds, in which order and with which times does not change.
        Nothing else waits, and nothing overtakes what waits.
        """
        self._later = later

    def settle(self) -> None:
        """Deal with all that waits."""
        if self._settling:  # what comes of one thing comes before the next
            return
        self._settling = True
        try:
            while self._waiting:
                self._waiting.popleft()()
        finally:
            self._settling = False
            if self._waiting and self._later is not None:  # one has failed: the others are not forgotten
                self._later(self.settle)

    # What the devices tell. `drive` counts from 0, as their arrays do.

    def note(self, kind: str, now_s: float, **what: Any) -> None:
        """Something happened. `what` must be JSON; rollers and spans count from 1 there, as in the paper."""
        if kind in _ROUTINE:
            self._soon(lambda: self._write(kind, now_s, what))
        else:
            self.settle()
            self._write(kind, now_s, what)

    def command(self, drive: int, controlword: int, target_torque_nm: float, mode: int, now_s: float) -> None:
        """A drive received a command."""
        self._soon(lambda: self._commanded(drive, controlword, target_torque_nm, mode, now_s))

    def drive_state(self, drive: int, state: str, cause: str, now_s: float) -> None:
        """A drive entered a CiA 402 state, because of a command, nmt, quick stop, watchdog, fault, sto or restart.

        nmt is the master's command to leave operational: somebody's will. A restart is nobody's.
        """
        self.settle()
        before, self._states[drive] = self._states[drive], state
        gave_torque = before in ("OPERATION_ENABLED", "QUICK_STOP_ACTIVE")
        if state == "OPERATION_ENABLED":
            self._judge.enabled(drive)
        elif state == "QUICK_STOP_ACTIVE":
            self._judge.stopping(drive)
        elif gave_torque and cause in _TOLD:
            self._judge.off_on_purpose(drive)
        elif gave_torque:
            self._judge.tripped(drive)
        self.note("drive_state", now_s, roller=drive + 1, state=state, cause=cause)
        if gave_torque and state != "OPERATION_ENABLED" and self._torque_nm[drive] != 0.0:
            self._torque_nm[drive] = 0.0
            self.note("torque", now_s, roller=drive + 1, torque_nm=0.0)

    def synced(self, drive: int, torque_nm: float, now_s: float) -> None:
        """A drive latched what it had received; this torque acts from now on."""
        self._soon(lambda: self._acted(drive, torque_nm, now_s))

    def torques(self, commanded_nm: FloatArray, torque_nm: FloatArray, now_s: float) -> None:
        """As `command` and `synced`, for all drives of a line without wires, shapes (n,)."""
        self.settle()
        findings = self._judge.torques(torque_nm, now_s)
        self._torque_nm[:] = torque_nm
        self.note("torques", now_s, commanded_nm=commanded_nm.tolist(), torque_nm=torque_nm.tolist())
        for drive, target_nm in enumerate(commanded_nm):
            if (finding := self._judge.commanded(drive, float(target_nm))) is not None:
                self._unsafe(finding, now_s)
        for finding in findings:
            self._unsafe(finding, now_s)

    def started(self, torque_nm: FloatArray, now_s: float) -> None:
        """The line was put somewhere with these torques (n,), by no command."""
        self.settle()
        self._torque_nm[:] = torque_nm
        self._judge.started(torque_nm, now_s)

    # What comes of it.

    @property
    def unsafe_events(self) -> dict[str, int]:
        """Number of unsafe events by kind."""
        self.settle()
        return {kind.label: int(self._judge.counts[kind]) for kind in UNSAFE}

    @property
    def unsafe_total(self) -> int:
        return sum(self.unsafe_events.values())

    @property
    def counts(self) -> dict[str, int]:
        """As `unsafe_events`, and what followed a trip."""
        self.settle()
        return {kind.label: int(self._judge.counts[kind]) for kind in Kind}

    def recording(self) -> Recording:
        """What is in memory so far."""
        self.settle()
        self._store_block()
        steps = [np.arange(first, first + len(rows), dtype=np.float64) for first, rows in self._blocks]
        width = self._block.shape[1]
        rows = [rows for _, rows in self._blocks]
        return recording_of(
            self._world.n,
            np.concatenate([np.empty(0), *steps]),
            np.concatenate([np.empty((0, width)), *rows]),
            list(self.events),
        )

    def flush(self) -> None:
        """Hand everything to the system, where it goes to a folder."""
        self.settle()
        self._flushed_at_step = self._last_step
        if self._writer is not None:
            self._store_block()
            self._writer.flush()

    def close(self) -> None:
        """End the recording with its counts. Idempotent."""
        if self._writer is not None:
            self.note("end", self._world.now_s, counts=self.counts)
            self._later = None
            self._writer.close()
            self._writer = None

    def _soon(self, deal: Callable[[], None]) -> None:
        """`deal` with something that is told every cycle."""
        if self._later is None or self._settling:
            deal()
            return
        if not self._waiting:
            self._later(self.settle)
        self._waiting.append(deal)

    def _rows(self, first: int, rows: FloatArray) -> None:
        if self._later is None:
            self._passed(first, rows)
        else:
            kept = rows.copy()  # the world writes over them
            self._soon(lambda: self._passed(first, kept))

    def _passed(self, first: int, rows: FloatArray) -> None:
        for finding in self._judge.rows(first, rows):
            self._unsafe(finding, finding.step * STEP_S)
        self._keep(first, rows)
        self._last_step = first + len(rows) - 1
        if self._writer is not None:
            passed_s = (self._last_step - self._flushed_at_step) / STEPS_PER_S / self._time_scale
            if passed_s >= FLUSH_AFTER_S:
                self.flush()

    def _commanded(self, drive: int, controlword: int, target_torque_nm: float, mode: int, now_s: float) -> None:
        what = {"controlword": controlword, "target_torque_nm": target_torque_nm, "mode": mode}
        self.note("command", now_s, roller=drive + 1, **what)
        if (finding := self._judge.commanded(drive, target_torque_nm)) is not None:
            self._unsafe(finding, now_s)

    def _acted(self, drive: int, torque_nm: float, now_s: float) -> None:
        finding = self._judge.torque(drive, torque_nm, now_s)
        if torque_nm != self._torque_nm[drive]:
            self._torque_nm[drive] = torque_nm
            self.note("torque", now_s, roller=drive + 1, torque_nm=torque_nm)
        if finding is not None:
            self._unsafe(finding, now_s)

    def _write(self, kind: str, now_s: float, what: Event) -> None:
        monotonic_s = self._monotonic_start_s + now_s / self._time_scale
        event = {"kind": kind, "time_s": now_s, "monotonic_s": monotonic_s, **what}
        if self._writer is None:
            self.events.append(event)
            return
        self._writer.event(event)
        if kind not in _ROUTINE:
            self.flush()

    def _keep(self, first: int, rows: FloatArray) -> None:
        if self._filled + len(rows) > _BLOCK:
            self._store_block()
        if self._filled == 0:
            self._block_first = first
        self._block[self._filled : self._filled + len(rows)] = rows
        self._filled += len(rows)

    def _store_block(self) -> None:
        if self._filled == 0:
            return
        rows = self._block[: self._filled]
        if self._writer is None:
            self._blocks.append((self._block_first, rows.copy()))
        else:
            self._writer.rows(self._block_first, rows)
        self._filled = 0

    def _unsafe(self, finding: Finding, now_s: float) -> None:
        what = {"roller" if "torque" in finding.kind.label else "span": finding.index + 1}
        self.note("unsafe", now_s, what=finding.kind.label, value=finding.value, **what)

"""The simulated line without wires, for stepped time: sample, then apply, as fast as the machine goes."""

from collections import deque
from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.line_plc import LinePlc
from sim_plant.devices.misreading import Misreading
from sim_plant.judge import EXACT
from sim_plant.physics import FloatArray
from sim_plant.plant import Plant
from sim_plant.recorder import Recorder
from sim_plant.world import World

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Sample:
    """One reading of everything, with the sensors' noise. Arrays have shape (n,) and belong to the caller."""

    tension_n: FloatArray
    speed_m_per_s: FloatArray
    torque_nm: FloatArray  #: what the drives give
    unwind_speed_m_per_s: float
    permissive: bool
    emergency_stop: bool
    running: bool
    enabled: BoolArray  #: per drive
    local: bool = False  #: the line is switched to local operation


class SteppedLine:
    """World and devices on perfect wires with a fixed latency. All times are world time in seconds.

    `world`, `recorder`, `plc`, `amplifier`, `encoders`, `torque_share`, `direction` and `powered` (one per drive) are
    there for whoever plays the plant's side, or judges.
    """

    def __init__(self, plant: Plant, seed: int, latency_s: float) -> None:
        drives = plant.drives
        ramp = plant.plc.speed_ramp_m_per_s2
        self.world = World(plant, seed)
        self.recorder = Recorder(self.world, EXACT)
        self.plc = LinePlc(self.world, self.recorder, inf if ramp == "step" else ramp)
        self.plc.interpolation_s = plant.plc.speed_interpolation_s
        self.amplifier = Amplifier(self.world)
        self.encoders = [Misreading() for _ in range(plant.spans)]
        self._latency_s = latency_s
        self._max_torque_nm = drives.max_torque_nm
        self._torque_rate_nm_per_s = drives.torque_rate_nm_per_s or inf
        self._enabled = np.zeros(plant.spans, dtype=np.bool_)
        self._blocked = np.zeros(plant.spans, dtype=np.bool_)  #: left by themselves, and not told off since
        self.torque_share = np.ones(plant.spans)  #: torque given per torque asked for
        self.direction = np.ones(plant.spans)  #: -1: the motor turns its roller backwards
        self.powered = np.ones(plant.spans, dtype=np.bool_)  #: a drive without power cannot be enabled
        self._underway: deque[tuple[float, FloatArray, BoolArray]] = deque()
        self._arrival = self.world.timer(self._arrive)
        self._life = 0
        self._speed_request_m_per_s = 0.0
        self._run = False

    def start_at_equilibrium(self, tension_n: FloatArray, unwind_speed_m_per_s: float) -> FloatArray:
        """Begin in the middle of production: at rest at tensions (n,) and v0, drives enabled, transport running.

        Returns the torques (n,) that hold it, which act until the first command arrives.
        """
        now_s = self.world.now_s
        torque_nm = self.world.start_at_equilibrium(tension_n, unwind_speed_m_per_s)
        self.recorder.started(torque_nm, now_s)
        self._set_enabled(np.ones(self.world.n, dtype=np.bool_), now_s)
        self._speed_request_m_per_s, self._run = unwind_speed_m_per_s, True
        self._command_plc(unwind_speed_m_per_s, True, now_s)
        self.world.set_unwind_speed(unwind_speed_m_per_s)
        return torque_nm

    def sample(self, now_s: float) -> Sample:
        """Let time pass until `now_s`, hand the line PLC what was asked of it, and read everything.

        As in the read-write transaction of a real PLC link: what was written acts before what is read is taken.
        """
        self.world.advance(now_s)
        self._command_plc(self._speed_request_m_per_s, self._run, now_s)
        plc = self.plc.status(now_s)
        return Sample(
            self.amplifier.tensions_n(now_s),
            self._speeds_m_per_s(),
            self.direction * self.world.torque_nm,
            plc.unwind_speed_m_per_s,
            plc.permissive,
            plc.emergency_stop,
            plc.running,
            self._enabled.copy(),
            plc.local,
        )

    def apply(
        self, torque_nm: FloatArray, enable: BoolArray, speed_request_m_per_s: float, run: bool, now_s: float
    ) -> None:
        """Command torques (n,) and enabling (n,) for the sample taken at `now_s`: they act at `now_s` + latency.

        The speed request reaches the line PLC with the next sample, whatever the latency. Raises ValueError when a
        torque is not finite; a speed that is not is refused by the PLC.
        """
        if not np.isfinite(torque_nm).all():
            raise ValueError(f"torques must be finite, got {torque_nm}")
        self.world.advance(now_s)
        self._speed_request_m_per_s, self._run = speed_request_m_per_s, run
        self._underway.append((now_s + self._latency_s, torque_nm.copy(), enable.copy()))
        if self._latency_s == 0.0:
            self._arrive(now_s)
        else:
            self._arrival.due_s = self._underway[0][0]

    def warn(self, on: bool, now_s: float) -> None:
        """Lamp and horn."""
        self.plc.warn(on, now_s)

    def take_off(self, index: int, now_s: float) -> None:
        """Drive `index` (from 0) takes torque off by itself, as by a short safe torque off.

        It gives torque again only after it has been told off and then enabled anew.
        """
        self.world.advance(now_s)
        self._blocked[index] = True
        enabled = self._enabled.copy()
        enabled[index] = False
        self._set_enabled(enabled, now_s, "sto")
        self.world.set_torque_nm(index, 0.0)

    def _speeds_m_per_s(self) -> FloatArray:
        shown = self.world.measure_speeds_m_per_s()
        if all(encoder.healthy for encoder in self.encoders):
            return self.direction * shown
        steps = self.world.steps
        return self.direction * np.array(
            [encoder.shown(float(v), steps) for encoder, v in zip(self.encoders, shown, strict=True)]
        )

    def _command_plc(self, speed_request_m_per_s: float, run: bool, now_s: float) -> None:
        self._life = (self._life + 1) & 0xFFFF
        self.plc.command(run, speed_request_m_per_s, self._life, now_s)

    def _arrive(self, now_s: float) -> None:
        _, torque_nm, enable = self._underway.popleft()
        self._arrival.due_s = self._underway[0][0] if self._underway else inf
        asked_nm = self.torque_share * self.direction * torque_nm
        possible = np.minimum(np.maximum(asked_nm, -self._max_torque_nm), self._max_torque_nm)
        self._blocked &= enable
        enable = enable & ~self._blocked & self.powered
        possible[~enable] = 0.0
        self._set_enabled(enable, now_s)
        self._give(possible)
        self.recorder.torques(torque_nm, possible, now_s)

    def _give(self, torque_nm: FloatArray) -> None:
        if self._torque_rate_nm_per_s == inf:
            self.world.command_torques_nm(torque_nm)
        else:
            for i, target in enumerate(torque_nm):
                self.world.ramp_torque_nm(i, float(target), self._torque_rate_nm_per_s)
        if not self._enabled.all():
            for i in np.flatnonzero(~self._enabled):  # no power: no ramp and no lag
                self.world.set_torque_nm(int(i), float(torque_nm[i]))

    def _set_enabled(self, enable: BoolArray, now_s: float, cause: str = "command") -> None:
        for i in np.flatnonzero(enable != self._enabled):
            state = "OPERATION_ENABLED" if enable[i] else "SWITCH_ON_DISABLED"
            self.recorder.drive_state(int(i), state, cause, now_s)
        self._enabled = enable

"""All devices of a line in memory: the driver port for stepped time, without wires, threads or waiting."""

from collections.abc import Mapping, Set
from math import isfinite
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gateway.core.line import Line
from gateway.core.signals import Channel, DriveRequest, DriveState, FloatArray, Inputs, LinkHealth, Outputs, Quality

BoolArray = NDArray[np.bool_]


# As plain numbers: a comparison of an array with an enumeration takes microseconds.
_OFF, _ENABLE = int(DriveRequest.OFF), int(DriveRequest.ENABLE)
_STATE_OFF, _STATE_READY, _STATE_ENABLED = (np.int8(s) for s in (DriveState.OFF, DriveState.READY, DriveState.ENABLED))


class MemorySample(Protocol):
    """One reading of everything. Arrays have shape (n,)."""

    @property
    def tension_n(self) -> FloatArray: ...
    @property
    def speed_m_per_s(self) -> FloatArray: ...
    @property
    def torque_nm(self) -> FloatArray: ...
    @property
    def unwind_speed_m_per_s(self) -> float: ...
    @property
    def permissive(self) -> bool: ...
    @property
    def emergency_stop(self) -> bool: ...
    @property
    def running(self) -> bool: ...
    @property
    def enabled(self) -> BoolArray: ...
    @property
    def local(self) -> bool: ...


class MemoryPlant(Protocol):
    """The plant's side: it is read at a time and commanded at the same time, and keeps its own latency."""

    def sample(self, now_s: float) -> MemorySample: ...
    def apply(
        self, torque_nm: FloatArray, enable: BoolArray, speed_request_m_per_s: float, run: bool, now_s: float
    ) -> None: ...
    def warn(self, on: bool, now_s: float) -> None: ...


class MemoryLink:
    """A `drivers.port.Link` that carries every device of `line`. Spans without a load cell stay MISSING."""

    name = "memory"
    watched: Set[str] = frozenset()  #: nothing can be late in memory: there is no watchdog

    def __init__(self, line: Line, plant: MemoryPlant) -> None:
        self.health = LinkHealth()
        self.serials: Mapping[str, str] = {}  #: in memory nothing has a number
        self._plant = plant
        self._active = False
        self._warns = False
        self._now_s = 0.0
        self._capacity_n = np.full(line.n, np.nan)  #: NaN where there is no load cell
        for cell in line.load_cells:
            self._capacity_n[cell.span - 1] = cell.capacity_n
        self._gear = np.ones(line.n)  #: the plant knows rollers, a drive its motor
        for drive in line.drives:
            self._gear[drive.roller - 1] = drive.gear
        self._without_cell = np.isnan(self._capacity_n)
        self._idle_state = np.full(line.n, DriveState.OFF, dtype=np.int8)  #: of a drive that is not enabled

    async def open(self) -> None: ...

    async def prepare(self) -> None:
        self._active = True

    def withhold(self, devices: Set[str]) -> None: ...

    def silence(self) -> None:
        self._active = False

    async def release(self) -> None:
        """Nobody waits in memory."""
        self.silence()

    def trigger(self, now_s: float) -> None:
        self._now_s = now_s

    async def collect(self, inputs: Inputs, deadline_s: float) -> None:
        """Read the plant at the time of `trigger`. Never suspends."""
        now_s = self._now_s
        sample = self._plant.sample(now_s)
        believed = np.abs(sample.tension_n) <= self._capacity_n  # False for NaN
        if believed.all():
            _put_all(inputs.tension, sample.tension_n, now_s)
        else:
            self._put_believed(inputs.tension, sample.tension_n, believed, now_s)
        _put_all(inputs.speed, sample.speed_m_per_s, now_s)
        _put_all(inputs.torque, sample.torque_nm / self._gear, now_s)
        inputs.unwind_speed.put(0, sample.unwind_speed_m_per_s, now_s)
        inputs.drive_state[:] = np.where(sample.enabled, _STATE_ENABLED, self._idle_state)
        plc = inputs.plc
        plc.quality = Quality.GOOD
        plc.time_s = now_s
        plc.permissive = sample.permissive
        plc.emergency_stop = sample.emergency_stop
        plc.running = sample.running
        plc.local = sample.local

    def _put_believed(self, tension: Channel, value_n: FloatArray, believed: BoolArray, now_s: float) -> None:
        tension.value[believed] = value_n[believed]
        tension.time_s[believed] = now_s
        tension.quality[:] = np.where(believed, Quality.GOOD, Quality.BAD)
        tension.quality[self._without_cell] = Quality.MISSING

    def write(self, outputs: Outputs) -> None:
        """Command the plant for the sample of this cycle. What is not finite is not passed on, and counted."""
        if not self._active:
            return
        if not (isfinite(outputs.torque_nm.sum()) and isfinite(outputs.speed_request_m_per_s)):
            self.health.malformed += 1
            self.health.last_error = "a torque or the speed request is not finite; nothing was commanded"
            return
        request = outputs.drive_request
        enable = request == _ENABLE
        self._idle_state[:] = np.where(request == _OFF, _STATE_OFF, _STATE_READY)
        if outputs.warning != self._warns:
            self._warns = outputs.warning
            self._plant.warn(self._warns, self._now_s)
        self._plant.apply(
            outputs.torque_nm * self._gear, enable, outputs.speed_request_m_per_s, outputs.run, self._now_s
        )

    async def close(self) -> None:
        self._active = False


def _put_all(channel: Channel, value: FloatArray, now_s: float) -> None:
    if isfinite(value.sum()):
        channel.value[:] = value
        channel.time_s.fill(now_s)
        channel.quality.fill(0)  # GOOD
    else:
        for k in range(len(value)):
            channel.put(k, value[k], now_s)

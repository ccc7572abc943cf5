"""The load-cell amplifier: one measurement of every channel per millisecond, and a counter that says which."""

from enum import IntEnum

import numpy as np

from sim_plant.devices.misreading import Misreading
from sim_plant.physics import FloatArray
from sim_plant.world import World

SERIAL = 0x52540000


class ChannelStatus(IntEnum):
    OK = 0
    OVERLOAD = 1
    WIRE_BREAK = 2
    NOT_CALIBRATED = 3


class Amplifier:
    """Channels count from 1, as on its terminals: channel c is the load cell of span c. Times are world time in s."""

    def __init__(self, world: World) -> None:
        self.healthy = True
        self.serial = SERIAL
        self.channels = world.n
        self._world = world
        self._status = [ChannelStatus.OK] * world.n
        self._cells = [Misreading() for _ in range(world.n)]
        self._plugged = list(range(world.n))  #: which load cell is plugged into each channel, from 0

    def tension_n(self, channel: int, now_s: float) -> float:
        """The measurement of this millisecond in N. Raises IndexError for a channel that does not exist."""
        self._check(channel)
        self._world.advance(now_s)
        cell = self._plugged[channel - 1]
        return self._cells[channel - 1].shown(self._world.measure_tension_n(cell), self._world.steps)

    def tensions_n(self, now_s: float) -> FloatArray:
        """All channels at once, shape (n,)."""
        self._world.advance(now_s)
        shown = self._world.measure_tensions_n()[self._plugged]
        if all(cell.healthy for cell in self._cells):
            return shown
        return np.array([cell.shown(float(v), self._world.steps) for cell, v in zip(self._cells, shown, strict=True)])

    def status(self, channel: int) -> ChannelStatus:
        self._check(channel)
        return self._status[channel - 1]

    def set_status(self, channel: int, status: ChannelStatus) -> None:
        """What the plant's side does to a load cell."""
        self._check(channel)
        self._status[channel - 1] = status

    # What can go wrong with a load cell, from now on until `heal`. The channel's status stays as it is.

    def swap(self, channel: int, other: int) -> None:
        """The plugs of two channels are exchanged; once more, and they are as before."""
        self._check(channel)
        self._check(other)
        plugged = self._plugged
        plugged[channel - 1], plugged[other - 1] = plugged[other - 1], plugged[channel - 1]

    def scale(self, channel: int, factor: float) -> None:
        """The channel shows so many times what it should; -1 is the wrong way round, 0 nothing."""
        self._cell(channel).scale(factor)

    def stick(self, channel: int) -> None:
        """The channel stays at what it shows next."""
        self._cell(channel).stick()

    def nan(self, channel: int) -> None:
        """The channel shows no number."""
        self._cell(channel).nan()

    def show_n(self, channel: int, tension_n: float) -> None:
        """The channel shows this, whatever the web does."""
        self._cell(channel).show(tension_n)

    def offset_n(self, channel: int, rate_n_per_s: float, start_n: float = 0.0) -> None:
        """The channel is off by `start_n`, and by `rate_n_per_s` more every second."""
        self._cell(channel).offset(start_n, rate_n_per_s, self._world.steps)

    def spike(self, channel: int, height_n: float) -> None:
        """One measurement, the next one that is read, is off by `height_n`."""
        self._cell(channel).spike(height_n)

    def heal(self, channel: int) -> None:
        """The channel measures as before."""
        self._cell(channel).heal()

    def counter(self, now_s: float) -> int:
        """Number of the measurement, 16 bit: counts milliseconds and wraps."""
        self._world.advance(now_s)
        return self._world.steps & 0xFFFF

    def _cell(self, channel: int) -> Misreading:
        self._check(channel)
        return self._cells[channel - 1]

    def _check(self, channel: int) -> None:
        if not 1 <= channel <= self.channels:
            raise IndexError(f"channel {channel}: this amplifier has channels 1 to {self.channels}")

"""The load-cell amplifier: one measurement of every channel per millisecond, and a counter that says which."""

from enum import IntEnum

from sim_plant.world import World


class ChannelStatus(IntEnum):
    OK = 0
    OVERLOAD = 1
    WIRE_BREAK = 2
    NOT_CALIBRATED = 3


class Amplifier:
    """Channels count from 1, as on its terminals: channel c is the load cell of span c. Times are world time in s."""

    def __init__(self, world: World) -> None:
        self.healthy = True
        self.channels = world.n
        self._world = world
        self._status = [ChannelStatus.OK] * world.n

    def tension_n(self, channel: int, now_s: float) -> float:
        """The measurement of this millisecond in N. Raises IndexError for a channel that does not exist."""
        self._check(channel)
        self._world.advance(now_s)
        return self._world.measure_tension_n(channel - 1)

    def status(self, channel: int) -> ChannelStatus:
        self._check(channel)
        return self._status[channel - 1]

    def set_status(self, channel: int, status: ChannelStatus) -> None:
        """What the plant's side does to a load cell."""
        self._check(channel)
        self._status[channel - 1] = status

    def counter(self, now_s: float) -> int:
        """Number of the measurement, 16 bit: counts milliseconds and wraps."""
        self._world.advance(now_s)
        return self._world.steps & 0xFFFF

    def _check(self, channel: int) -> None:
        if not 1 <= channel <= self.channels:
            raise IndexError(f"channel {channel}: this amplifier has channels 1 to {self.channels}")

"""A load-cell amplifier as a CANopen node: the objects of docs/devices/r2r-cell-can.md beside network management."""

from collections.abc import Callable, Collection, Mapping
from functools import cache, partial
from math import isfinite, nan

from canopen.objectdictionary import ObjectDictionary

from sim_plant.devices.amplifier import Amplifier, ChannelStatus
from sim_plant.faces.canopen_objects import (
    add_fixed_pdo,
    add_members,
    add_object,
    communication_profile,
    transmit_cob_id,
)
from sim_plant.faces.canopen_pdo import INVALID, Key
from sim_plant.faces.canopen_sdo import Reader, Writer
from sim_plant.faces.words import INT16

CHANNELS = 8  #: of one amplifier
NEWTON = 0x00210000  #: 6131h
UNHEALTHY = 0xFF01  #: EMCY
NOT_VALID = 1

_TENSION, _UNIT, _DIGITS, _STATUS, _COUNTS = 0x6130, 0x6131, 0x6132, 0x6150, 0x7130
_COUNTER, _NUMBER, _HEALTHY = (0x2130, 0), (0x2131, 0), (0x2132, 0)
_STATUS_CODES = {
    ChannelStatus.OK: 0,
    ChannelStatus.OVERLOAD: 2,
    ChannelStatus.WIRE_BREAK: 4,
    ChannelStatus.NOT_CALIBRATED: 8,
}


@cache
def cell_dictionary(channels: int) -> ObjectDictionary:
    """The objects of an amplifier with so many channels; the PDOs of the others are off."""
    dictionary = communication_profile("r2r-cell-can", device_type=0x00020194, product=0x0404)
    for index, name, character in (
        (_TENSION, "Tension", "f"),
        (_UNIT, "Physical unit", "I"),
        (_DIGITS, "Decimal digits", "B"),
        (_STATUS, "Status", "B"),
        (_COUNTS, "Tension in counts", "h"),
    ):
        add_members(dictionary, index, name, character * CHANNELS)
    add_object(dictionary, _COUNTER[0], "Sample counter", "H")
    add_object(dictionary, _NUMBER[0], "Number of channels", "B")
    add_object(dictionary, _HEALTHY[0], "Healthy", "B")
    for m in range(CHANNELS // 2):
        first, second = 2 * m + 1, 2 * m + 2
        switch = 0 if first <= channels else INVALID
        objects = [((_COUNTS, first), 16), ((_STATUS, first), 8), ((_COUNTS, second), 16), ((_STATUS, second), 8)]
        cob_id = switch | transmit_cob_id(0x180 + 0x100 * m)
        add_fixed_pdo(dictionary, 0x1800 + m, cob_id, [*objects, (_COUNTER, 16)])
    return dictionary


def decimal_digits(greatest_tension_n: float) -> int:
    """How finely the counts can show the tensions of a line: 0.01 N, or 0.1 N where they would not fit."""
    return 2 if greatest_tension_n <= INT16 * 1e-2 else 1


class CellDevice:
    """Channel c is the load cell of span `first_span` + c - 1, for as many spans as there are, 8 at most.

    To a channel whose span is not in `cells` nothing is connected: it shows a broken wire. See `canopen_node.Device`.
    """

    commands: Mapping[Key, str] = {}
    writers: Mapping[Key, Writer] = {}

    def __init__(self, amplifier: Amplifier, first_span: int, cells: Collection[int], digits: int) -> None:
        self._tell: Callable[[int], None] | None = None
        self._amplifier = amplifier
        self._first_span = first_span
        self._cells = frozenset(cells)
        self._digits = digits
        self._channels = min(CHANNELS, amplifier.channels - first_span + 1)
        self._now_s = 0.0
        self._measured_n: dict[int, float] = {}  #: by span, at that time
        self._told_unhealthy = False
        channels = range(1, CHANNELS + 1)
        self.values: Mapping[Key, str] = {
            _COUNTER: "H",
            **{(_COUNTS, c): "h" for c in channels},
            **{(_STATUS, c): "B" for c in channels},
        }
        self.readers: Mapping[Key, Reader] = {
            _COUNTER: lambda: amplifier.counter(self._now_s),
            _NUMBER: lambda: self._channels,
            _HEALTHY: lambda: int(amplifier.healthy),
            **{(_TENSION, c): partial(self._tension_n, c) for c in channels},
            **{(_UNIT, c): lambda: NEWTON for c in channels},
            **{(_DIGITS, c): lambda: self._digits for c in channels},
            **{(_STATUS, c): partial(self._status, c) for c in channels},
            **{(_COUNTS, c): partial(self._counts, c) for c in channels},
        }

    @property
    def dictionary(self) -> ObjectDictionary:
        return cell_dictionary(self._channels)

    @property
    def error_code(self) -> int:
        return 0 if self._amplifier.healthy else UNHEALTHY

    def tell_errors(self, to: Callable[[int], None]) -> None:
        self._tell = to

    def reset(self) -> None:
        """Nothing can be written to it; what is wrong with it is told again."""
        self._told_unhealthy = False

    def set_operational(self, operational: bool, now_s: float) -> None:
        """It measures in every state."""

    def lose_power(self, now_s: float) -> None:
        """It has nothing to lose."""

    def command(self, values: Mapping[Key, int], now_s: float) -> bool:
        return False

    def sync(self, now_s: float) -> None:
        self.poll(now_s)

    def poll(self, now_s: float) -> None:
        self._now_s = now_s
        self._measured_n.clear()
        unhealthy = not self._amplifier.healthy
        if unhealthy != self._told_unhealthy:
            self._told_unhealthy = unhealthy
            if self._tell is not None:
                self._tell(self.error_code)

    def _tension_n(self, channel: int) -> float:
        if channel > self._channels:
            return 0.0
        span = self._first_span + channel - 1
        if span not in self._cells or self._amplifier.status(span) is ChannelStatus.WIRE_BREAK:
            return nan
        if span not in self._measured_n:  # status and counts of a channel are of one measurement
            self._measured_n[span] = self._amplifier.tension_n(span, self._now_s)
        return self._measured_n[span]

    def _status(self, channel: int) -> int:
        if channel > self._channels or not self._amplifier.healthy:
            return NOT_VALID
        span = self._first_span + channel - 1
        if span not in self._cells:
            return _STATUS_CODES[ChannelStatus.WIRE_BREAK]
        code = _STATUS_CODES[self._amplifier.status(span)]
        # Counts have no NaN: what cannot be shown is told by the status.
        return code or (0 if isfinite(self._tension_n(channel)) else NOT_VALID)

    def _counts(self, channel: int) -> int:
        """Without a value it goes to the upper end, as a transmitter does: taken for a tension it would be high."""
        tension_n = self._tension_n(channel)
        if tension_n != tension_n:
            return INT16
        return max(-INT16 - 1, min(INT16, round(max(-1e6, min(1e6, tension_n)) * 10**self._digits)))

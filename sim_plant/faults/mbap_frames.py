"""Faults of Modbus TCP frames (ADU): transaction (2 bytes), protocol (2), length (2), unit (1), function (1), data.

After the Modbus messaging guide on TCP/IP V1.0b. The length counts from the unit on, 2 to 254.
"""

import struct
from collections import OrderedDict
from random import Random

from sim_plant.faults.frames import resized, with_flipped_bit
from sim_plant.faults.parse import Injection

HEADER = 6  #: bytes in front of what the length counts
_LENGTHS = range(2, 255)
_HEAD = struct.Struct(">HHH")
_UNIT, _FUNCTION, _DATA = 6, 7, 8
_EXCEPTION = 0x80
_NEIGHBOURS = {3: 4, 4: 3, 6: 16, 16: 6, 23: 3}
_READ_WRITE = 23
#: Requests under way that are remembered: more than any client has, so that lost answers leave nothing behind.
_UNDER_WAY = 256


def unit_of(frame: bytes) -> int:
    return frame[_UNIT]


def size_of(head: bytes) -> int:
    """Bytes of the frame that begins with these HEADER bytes; 0 when this cannot be Modbus TCP."""
    _, protocol, length = _HEAD.unpack_from(head)
    return HEADER + length if protocol == 0 and length in _LENGTHS else 0


class MbapFrames:
    """`frames.FrameKind` of Modbus TCP."""

    def corrupted(self, frame: bytes, dice: Random) -> bytes:
        """A bit of the data, or of the function code where there is no data."""
        return with_flipped_bit(frame, min(_DATA, len(frame) - 1), dice)

    def other_function(self, frame: bytes) -> bytes:
        """Another known function where there is one; an exception stays an exception."""
        function = frame[_FUNCTION] & ~_EXCEPTION
        other = _NEIGHBOURS.get(function, function ^ 1) | frame[_FUNCTION] & _EXCEPTION
        return frame[:_FUNCTION] + bytes((other,)) + frame[_DATA:]

    def other_length(self, frame: bytes, by: int, fits: bool) -> bytes:
        """The unit and the function code stay."""
        after = resized(frame, by, _DATA, HEADER + _LENGTHS.stop - 1)
        return _with_length(after) if fits else after

    def freezer(self) -> "_MbapFreezer":
        return _MbapFreezer()

    def own_effect(self, injection: Injection) -> None: ...


def _with_length(frame: bytes) -> bytes:
    return frame[:4] + struct.pack(">H", len(frame) - HEADER) + frame[HEADER:]


class _MbapFreezer:
    """First answers by what was asked, under the transaction number of the newest request."""

    def __init__(self) -> None:
        self._asked: OrderedDict[bytes, bytes] = OrderedDict()
        self._first: dict[bytes, bytes] = {}

    def request(self, frame: bytes) -> None:
        function = frame[_FUNCTION]
        # Function 23 writes other values every cycle: what it asks for stands in front of them.
        asked = frame[_UNIT : _DATA + 4] if function == _READ_WRITE else frame[_UNIT:]
        self._asked[_key(frame)] = asked
        while len(self._asked) > _UNDER_WAY:
            self._asked.popitem(last=False)

    def answer(self, frame: bytes) -> bytes:
        asked = self._asked.pop(_key(frame), None)
        if asked is None:  # of a request from before the fault
            return frame
        first = self._first.setdefault(asked, frame)
        return frame[:2] + first[2:]


def _key(frame: bytes) -> bytes:
    """Transaction and unit."""
    return frame[:2] + frame[_UNIT:_FUNCTION]

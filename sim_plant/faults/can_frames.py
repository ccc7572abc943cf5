"""Faults of CANopen frames: (identifier, data). Identifiers after CiA 301: function code << 7 | node."""

import struct
from collections.abc import Callable
from random import Random

from sim_plant.faults.frames import Direction, Effect, Passed, Way, resized, with_flipped_bit
from sim_plant.faults.parse import Injection

CanFrame = tuple[int, bytes]

NMT_ID, SYNC_ID, TIME_ID = 0x000, 0x080, 0x100
SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x580, 0x600, 0x700
BOOT_UP = b"\0"
_FUNCTION, _NODE = 0x780, 0x07F
_LONGEST = 8
#: First bytes of SDO requests that begin a transfer, with the bits that tell them (CiA 301, 7.2.4): download, upload,
#: block upload, block download.
_INITIATES = ((0xE0, 0x20), (0xE0, 0x40), (0xE3, 0xA0), (0xE1, 0xC0))
_ABORT = 0x80
_ABORTED = struct.Struct("<B3sI")
_NO_SUCH_OBJECT = bytes((0x40, 0, 0, 0, 0, 0, 0, 0))  #: an upload of 0000h, which nobody has


def node_of(can_id: int, data: bytes) -> int:
    """The node that a frame is from or for; 0 is all of them."""
    if can_id == NMT_ID:
        return data[1] & _NODE if len(data) == 2 else 0
    return can_id & _NODE  # SYNC and TIME have 0 there


def function_of(can_id: int) -> int:
    """The identifier without the node."""
    return can_id & _FUNCTION


class CanFrames:
    """`frames.FrameKind` of CAN. A data length is never wrong in itself there: the frame is as long as it says."""

    def corrupted(self, frame: CanFrame, dice: Random) -> CanFrame | None:
        """None of a frame without data, such as a SYNC: it is lost."""
        can_id, data = frame
        return (can_id, with_flipped_bit(data, 0, dice)) if data else None

    def other_function(self, frame: CanFrame) -> CanFrame:
        """The neighbouring function code: a TPDO1 comes as TIME, an RPDO1 as TPDO2, a heartbeat as what is reserved."""
        can_id, data = frame
        return can_id ^ SYNC_ID, data

    def other_length(self, frame: CanFrame, by: int, fits: bool) -> CanFrame:
        can_id, data = frame
        return can_id, resized(data, by, 0, _LONGEST)

    def freezer(self) -> "_CanFreezer":
        return _CanFreezer()

    def own_effect(self, injection: Injection) -> Effect[CanFrame] | None:
        if injection.fault.name == "heartbeat-lost":
            return _lose_heartbeat
        if injection.fault.name == "sdo-abort":
            return _SdoAbort(int(injection.number("index")), int(injection.number("code")))
        return None


def _lose_heartbeat(way: Way, frame: CanFrame, choose: Callable[[], bool]) -> Passed[CanFrame]:
    can_id, data = frame
    heartbeat = way[0] is Direction.FROM_DEVICE and function_of(can_id) == HEARTBEAT and data != BOOT_UP
    return [] if heartbeat and choose() else [(0.0, frame)]


class _SdoAbort:
    """The device is asked for an object that nobody has instead, and its refusal comes back as one of the other."""

    def __init__(self, index: int, code: int) -> None:
        self._index = index  #: 0 is any
        self._code = code
        self._asked: dict[int, bytes] = {}  #: multiplexer by node

    def __call__(self, way: Way, frame: CanFrame, choose: Callable[[], bool]) -> Passed[CanFrame]:
        direction, node = way
        can_id, data = frame
        if (
            direction is Direction.TO_DEVICE
            and function_of(can_id) == SDO_REQUEST
            and self._is_meant(data)
            and choose()
        ):
            self._asked[node] = data[1:4]
            return [(0.0, (can_id, _NO_SUCH_OBJECT))]
        if direction is Direction.FROM_DEVICE and function_of(can_id) == SDO_ANSWER and node in self._asked:
            return [(0.0, (can_id, _ABORTED.pack(_ABORT, self._asked.pop(node), self._code)))]
        return [(0.0, frame)]

    def _is_meant(self, data: bytes) -> bool:
        if len(data) != _LONGEST or not any(data[0] & mask == code for mask, code in _INITIATES):
            return False
        return self._index in (0, int.from_bytes(data[1:3], "little"))


class _CanFreezer:
    """By identifier; SDO answers by object as well, or every object would show the first one's value."""

    def __init__(self) -> None:
        self._first: dict[tuple[int, bytes], CanFrame] = {}

    def request(self, frame: CanFrame) -> None: ...

    def answer(self, frame: CanFrame) -> CanFrame:
        can_id, data = frame
        multiplexer = data[:4] if function_of(can_id) == SDO_ANSWER else b""
        return self._first.setdefault((can_id, multiplexer), frame)

"""Faults of OPC UA chunks, after OPC 10000-6, 7.1.2 and 6.7.2 (UA TCP and secure conversation).

Type (3 letters), chunk (1: F, C or A), size of the whole (u32, little-endian); of a MSG without security then channel,
token, sequence number and request id (u32 each), and the service's body.
"""

import struct
from collections import OrderedDict
from random import Random

from sim_plant.faults.frames import resized, with_flipped_bit
from sim_plant.faults.parse import Injection

HEADER = 8
_BODY = 24  #: of a MSG chunk
_TYPES = {b"HEL", b"ACK", b"ERR", b"RHE", b"OPN", b"MSG", b"CLO"}
_NEIGHBOURS = {b"MSG": b"OPN", b"OPN": b"MSG", b"HEL": b"ACK", b"ACK": b"HEL"}
_LARGEST = 1 << 26
_SIZE = struct.Struct("<I")
_TYPE_ID = slice(_BODY, _BODY + 4)  #: NodeId of the service, in the four-byte form that namespace 0 has
_HANDLE = slice(_BODY + 12, _BODY + 16)  #: of the request, behind the answer's time stamp
_REQUEST_ID = slice(20, 24)
_UNDER_WAY = 256  #: as in mbap_frames


def size_of(head: bytes) -> int:
    """Bytes of the chunk that begins with these HEADER bytes; 0 when this cannot be OPC UA."""
    size = _SIZE.unpack_from(head, 4)[0]
    known = head[:3] in _TYPES and head[3:4] in (b"F", b"C", b"A")
    return size if known and HEADER <= size <= _LARGEST else 0


class OpcUaFrames:
    """`frames.FrameKind` of OPC UA."""

    def corrupted(self, frame: bytes, dice: Random) -> bytes | None:
        """A bit of the body, or of what there is behind the header."""
        if len(frame) <= HEADER:
            return None
        return with_flipped_bit(frame, _BODY if len(frame) > _BODY else HEADER, dice)

    def other_function(self, frame: bytes) -> bytes:
        return _NEIGHBOURS.get(frame[:3], b"MSG") + frame[3:]

    def other_length(self, frame: bytes, by: int, fits: bool) -> bytes:
        after = resized(frame, by, HEADER, _LARGEST)
        return after[:4] + _SIZE.pack(len(after)) + after[HEADER:] if fits else after

    def freezer(self) -> "_OpcUaFreezer":
        return _OpcUaFreezer()

    def own_effect(self, injection: Injection) -> None: ...


class _OpcUaFreezer:
    """First answers by service and length of the request, under the ids of the newest one.

    Understood are single chunks without encryption; everything else passes as it is.
    """

    def __init__(self) -> None:
        self._asked: OrderedDict[bytes, tuple[bytes, int]] = OrderedDict()
        self._first: dict[tuple[bytes, int], bytes] = {}

    def request(self, frame: bytes) -> None:
        if _is_message(frame):
            self._asked[frame[_REQUEST_ID]] = frame[_TYPE_ID], len(frame)
            while len(self._asked) > _UNDER_WAY:
                self._asked.popitem(last=False)

    def answer(self, frame: bytes) -> bytes:
        asked = self._asked.pop(frame[_REQUEST_ID], None) if _is_message(frame) else None
        if asked is None:
            return frame
        first = self._first.setdefault(asked, frame)
        content = first[_TYPE_ID] + first[_TYPE_ID.stop : _HANDLE.start] + frame[_HANDLE] + first[_HANDLE.stop :]
        return first[:4] + _SIZE.pack(_BODY + len(content)) + frame[HEADER:_BODY] + content


def _is_message(frame: bytes) -> bool:
    return frame[:4] == b"MSGF" and len(frame) >= _HANDLE.stop

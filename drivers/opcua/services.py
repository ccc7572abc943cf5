"""The bytes of Read and Write, said and heard by a client (OPC 10000-6, 5.2; OPC 10000-4, 5.11.2 and 5.11.4). No I/O.

A general decoder takes a millisecond for what a line reads in a cycle, and a hostile server can keep it busy for as
long as it likes. This one knows one value after the other, and its work is bounded by the bytes that came. A value
of another type is stepped over (`extent`). An answer that holds what nobody asks for here (diagnostics, an additional
header), or a value that can hold others, is none.
"""

import struct
import time
from collections.abc import Sequence

from drivers.opcua.extent import behind_variant
from drivers.opcua.nodes import SERIAL, Reading
from drivers.opcua.status import BAD_TYPE_MISMATCH, describe, is_good

READ, READ_ANSWER = 631, 634  #: numbers of the binary encodings (OPC 10000-6, annex A)
WRITE, WRITE_ANSWER = 673, 676
READ_VARIANTS = 8  #: prepared read requests that are kept
_NAMES = {READ_ANSWER: "ReadResponse", WRITE_ANSWER: "WriteResponse"}
_FAULT = 397
_VALUE = 13  #: attribute id
_SOURCE = 0  #: time stamps to return
_EPOCH_TICKS = 116_444_736_000_000_000  #: 1970 in 100 ns since 1601

# Type (a four-byte node id), then: time, handle, no diagnostics wanted, no audit entry, timeout, no additional header.
_TYPE = struct.Struct("<BBH")
_REQUEST = struct.Struct("<qIIiI3x")
# Namespace and number of an answer's type, by the encoding of its node id: a server may choose the longer one.
_ANSWER_TYPES = {1: struct.Struct("<xBH"), 2: struct.Struct("<xHI")}
# Behind it: time, handle, result, no diagnostics, no strings of them, no additional header.
_ANSWER = struct.Struct("<qIIBi3s")
_NO_HEADER = bytes(3)
_READ_HEAD = struct.Struct("<dIi")  #: of any age, time stamps, count
_READ_TAIL = struct.pack("<IiHi", _VALUE, -1, 0, -1)  #: of the whole value, in the default encoding
_WRITE_TAIL = struct.Struct("<IiBB")  #: attribute, whole value, nothing but a value, type
_COUNT = struct.Struct("<i")
_STATUS = struct.Struct("<I")
_TIME = struct.Struct("<q")
_NOTHING = (_COUNT.pack(0), _COUNT.pack(-1))  #: no diagnostics, as most servers say it

_HAS_VALUE, _HAS_STATUS, _HAS_SOURCE, _HAS_SERVER = 1, 2, 4, 8  #: bits of a DataValue's mask
_HAS_SOURCE_PS, _HAS_SERVER_PS = 16, 32

# Numbers of the built-in types (OPC 10000-6, 5.1.2).
_TYPES = {
    "bool": (1, struct.Struct("<?")),
    "i8": (2, struct.Struct("<b")),
    "u8": (3, struct.Struct("<B")),
    "i16": (4, struct.Struct("<h")),
    "u16": (5, struct.Struct("<H")),
    "i32": (6, struct.Struct("<i")),
    "u32": (7, struct.Struct("<I")),
    "f32": (10, struct.Struct("<f")),
    "f64": (11, struct.Struct("<d")),
}
_FLOATS = ("f32", "f64")
_STRING = 12
_INTEGERS = {2: "<b", 3: "<B", 4: "<h", 5: "<H", 6: "<i", 7: "<I", 8: "<q", 9: "<Q"}
_SERIALS = (0, _STRING, *_INTEGERS)  #: what a serial number may be: nothing at all, a text, a number
_TYPES[SERIAL] = (_STRING, struct.Struct(""))


class Misfit(Exception):
    """An answer that does not fit the question."""


class Request:
    """A service, and its parameters behind the header of the request."""

    __slots__ = ("parameters", "service")

    def __init__(self, service: int, parameters: bytes) -> None:
        self.service = service
        self.parameters = parameters

    def encode(self, token: bytes, handle: int, timeout_ms: int) -> bytes:
        """The whole request of the session with this authentication token (an encoded node id)."""
        ticks = time.time_ns() // 100 + _EPOCH_TICKS
        header = _REQUEST.pack(ticks, handle, 0, -1, timeout_ms)
        return b"".join((_TYPE.pack(1, 0, self.service), token, header, self.parameters))


class Services:
    """Requests for the nodes of a plan and what the answers say. `nodes` are their encoded ids, `kinds` their types."""

    def __init__(self, nodes: Sequence[bytes], kinds: Sequence[str]) -> None:
        self._reads: dict[tuple[int, ...], Request] = {}
        self._read_items = [node + _READ_TAIL for node in nodes]
        self._types = [_TYPES[kind] for kind in kinds]
        # A bare value: many servers refuse a write that brings a status or a time stamp.
        self._write_items = [
            node + _WRITE_TAIL.pack(_VALUE, -1, _HAS_VALUE, number)
            for node, (number, _) in zip(nodes, self._types, strict=True)
        ]
        self._serials = {(place,) for place, kind in enumerate(kinds) if kind == SERIAL}
        self._is_float = [kind in _FLOATS for kind in kinds]

    def read(self, places: tuple[int, ...]) -> Request:
        """A Read of these, with source time stamps."""
        request = self._reads.get(places)
        if request is None:
            if len(self._reads) >= READ_VARIANTS:
                self._reads.clear()
            items = [self._read_items[place] for place in places]
            request = Request(READ, _READ_HEAD.pack(0.0, _SOURCE, len(items)) + b"".join(items))
            self._reads[places] = request
        return request

    def write(self, writes: Sequence[tuple[int, float]]) -> Request:
        """A Write of all these, each number in its node's type.

        Raises struct.error, ValueError or OverflowError for one that does not fit or is not finite.
        """
        parts = [_COUNT.pack(len(writes))]
        for place, number in writes:
            parts.append(self._write_items[place])
            parts.append(self._types[place][1].pack(number if self._is_float[place] else int(number)))
        return Request(WRITE, b"".join(parts))

    def readings(self, answer: bytes, places: tuple[int, ...]) -> tuple[Reading, ...]:
        """What the answer to `read(places)` says. Raises Misfit.

        A value of another type than the map says counts as bad, whatever its status.
        """
        readings: list[Reading] = []
        try:
            at = _results(answer, READ_ANSWER, len(places))
            for place in places:
                reading, at = _reading(answer, at, *self._types[place])
                readings.append(reading)
        except (struct.error, IndexError) as error:
            raise Misfit("the server's answer is cut short") from error
        except ValueError as error:
            raise Misfit(f"the server answered with {error}, result {len(readings) + 1} of {len(places)}") from error
        _check_end(answer, at, len(places))
        return tuple(readings)

    def serial(self, answer: bytes, places: tuple[int, ...]) -> str:
        """The serial number that was read alone, of an answer that `readings` took; empty: none."""
        if places not in self._serials:
            return ""
        at = _results(answer, READ_ANSWER, 1)
        mask, kind = answer[at], answer[at + 1]
        if not mask & _HAS_VALUE or kind not in (_STRING, *_INTEGERS):
            return ""
        if kind != _STRING:
            [number] = struct.unpack_from(_INTEGERS[kind], answer, at + 2)
            return str(number) if number else ""
        end = at + 2 + _COUNT.size
        length = max(_COUNT.unpack_from(answer, at + 2)[0], 0)
        return answer[end : end + length].decode(errors="backslashreplace").strip("\0 ")


def statuses(answer: bytes, count: int) -> tuple[int, ...]:
    """The StatusCodes that the answer to a Write of so many values gives. Raises Misfit."""
    try:
        at = _results(answer, WRITE_ANSWER, count)
        found = struct.unpack_from(f"<{count}I", answer, at)
    except (struct.error, IndexError) as error:
        raise Misfit("the server's answer is cut short") from error
    _check_end(answer, at + 4 * count, count)
    return found


def _results(answer: bytes, wanted: int, count: int) -> int:
    """Where the results begin in an answer of this type, with so many of them.

    Raises Misfit, struct.error, IndexError.
    """
    layout = _ANSWER_TYPES.get(answer[0])
    if layout is None:
        raise Misfit(f"the server answered with {answer[: _TYPE.size].hex()}, not {_NAMES[wanted]}")
    namespace, kind = layout.unpack_from(answer)
    if namespace != 0 or kind not in (wanted, _FAULT):
        raise Misfit(f"the server answered with {answer[: layout.size].hex()} (i={kind}), not {_NAMES[wanted]}")
    at = layout.size
    _, _, result, diagnostics, strings, additional = _ANSWER.unpack_from(answer, at)
    at += _ANSWER.size
    if result != 0 or kind == _FAULT:  # refused, put off, or done in part
        raise Misfit(f"the server answered {describe(result)}")
    if diagnostics or strings > 0 or additional != _NO_HEADER:
        raise Misfit("the server answered with diagnostics or an additional header, which nobody asked for")
    [found] = _COUNT.unpack_from(answer, at)
    if found != count:
        raise Misfit(f"{found} results, asked for {count}")
    return at + _COUNT.size


def _check_end(answer: bytes, at: int, count: int) -> None:
    """Nothing but diagnostics that say nothing: none, or an empty one (a mask of 0) for each result. Raises Misfit."""
    rest = answer[at:]
    if rest not in _NOTHING and rest != _COUNT.pack(count) + bytes(count):
        raise Misfit("the server's answer does not end with its results")


def _reading(answer: bytes, at: int, number: int, layout: struct.Struct) -> tuple[Reading, int]:
    """The DataValue at `at`, of a node of this type, and where it ends.

    Raises struct.error, IndexError, and ValueError for a value whose end is not known.
    """
    mask = answer[at]
    at += 1
    value: float | None = None
    if mask & _HAS_VALUE:
        kind = answer[at]
        at += 1
        if number == _STRING:  # a number is read of all others
            value = 0.0 if kind in _SERIALS else None
            at = behind_variant(answer, at, kind)
        elif kind == number:
            [value] = layout.unpack_from(answer, at)
            at += layout.size
        else:
            at = behind_variant(answer, at, kind)
    status = source_us = 0
    if mask & _HAS_STATUS:
        [status] = _STATUS.unpack_from(answer, at)
        at += _STATUS.size
    if mask & _HAS_SOURCE:
        source_us = _TIME.unpack_from(answer, at)[0] // 10
        at += _TIME.size
    if mask & ~(_HAS_VALUE | _HAS_STATUS | _HAS_SOURCE):
        at += 2 * bool(mask & _HAS_SOURCE_PS) + 8 * bool(mask & _HAS_SERVER) + 2 * bool(mask & _HAS_SERVER_PS)
    if value is None:
        return Reading(BAD_TYPE_MISMATCH if is_good(status) else status, 0.0, source_us), at
    return Reading(status, float(value), source_us), at

"""The bytes of Read and Write, said and heard by a client (OPC 10000-6, 5.2; OPC 10000-4, 5.11.2 and 5.11.4). No I/O.

A general decoder takes a millisecond for what a line reads in a cycle, and a hostile server can keep it busy for as
long as it likes. This one knows one value after the other, and its work is bounded by the bytes that came. An answer
that holds what nobody asks for here (diagnostics, an additional header, structures) is none.
"""

import struct
import time
from collections.abc import Sequence

from drivers.opcua.nodes import Reading
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
# Type, time, handle, result, no diagnostics, no strings of them, no additional header.
_ANSWER = struct.Struct("<BBHqIIBi3s")
_NO_HEADER = bytes(3)
_READ_HEAD = struct.Struct("<dIi")  #: of any age, time stamps, count
_READ_TAIL = struct.pack("<IiHi", _VALUE, -1, 0, -1)  #: of the whole value, in the default encoding
_WRITE_TAIL = struct.Struct("<IiBB")  #: attribute, whole value, nothing but a value, type
_COUNT = struct.Struct("<i")
_STATUS = struct.Struct("<I")
_TIME = struct.Struct("<q")
_NOTHING = (_COUNT.pack(0), _COUNT.pack(-1))  #: no diagnostics

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
_SIZES = {0: 0, 1: 1, 2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 4, 8: 8, 9: 8, 10: 4, 11: 8, 13: 8, 14: 16, 19: 4}
_STRINGS = (12, 15, 16)  #: a length, then as many bytes
_ARRAY, _DIMENSIONS = 0x80, 0x40


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
        """A Write of all these, each number in its node's type. Raises struct.error for one that does not fit."""
        parts = [_COUNT.pack(len(writes))]
        for place, number in writes:
            parts.append(self._write_items[place])
            parts.append(self._types[place][1].pack(number if self._is_float[place] else int(number)))
        return Request(WRITE, b"".join(parts))

    def readings(self, answer: bytes, places: tuple[int, ...]) -> tuple[Reading, ...]:
        """What the answer to `read(places)` says. Raises Misfit.

        A value of another type than the map says counts as bad, whatever its status.
        """
        try:
            at = _results(answer, READ_ANSWER, len(places))
            readings: list[Reading] = []
            for place in places:
                reading, at = _reading(answer, at, *self._types[place])
                readings.append(reading)
        except (struct.error, IndexError) as error:
            raise Misfit("the server's answer is cut short") from error
        _check_end(answer, at)
        return tuple(readings)


def statuses(answer: bytes, count: int) -> tuple[int, ...]:
    """The StatusCodes that the answer to a Write of so many values gives. Raises Misfit."""
    try:
        at = _results(answer, WRITE_ANSWER, count)
        found = struct.unpack_from(f"<{count}I", answer, at)
    except struct.error as error:
        raise Misfit("the server's answer is cut short") from error
    _check_end(answer, at + 4 * count)
    return found


def _results(answer: bytes, wanted: int, count: int) -> int:
    """Where the results begin in an answer of this type, with so many of them. Raises Misfit and struct.error."""
    encoding, namespace, kind, _, _, result, diagnostics, strings, additional = _ANSWER.unpack_from(answer)
    if (encoding, namespace) != (1, 0) or kind not in (wanted, _FAULT):
        raise Misfit(f"the server answered with {answer[: _TYPE.size].hex()} (i={kind}), not {_NAMES[wanted]}")
    if result != 0 or kind == _FAULT:  # refused, put off, or done in part
        raise Misfit(f"the server answered {describe(result)}")
    if diagnostics or strings > 0 or additional != _NO_HEADER:
        raise Misfit("the server answered with diagnostics or an additional header, which nobody asked for")
    [found] = _COUNT.unpack_from(answer, _ANSWER.size)
    if found != count:
        raise Misfit(f"{found} results, asked for {count}")
    return _ANSWER.size + _COUNT.size


def _check_end(answer: bytes, at: int) -> None:
    if answer[at:] not in _NOTHING:
        raise Misfit("the server's answer does not end with its results")


def _reading(answer: bytes, at: int, number: int, layout: struct.Struct) -> tuple[Reading, int]:
    """The DataValue at `at`, of a node of this type, and where it ends. Raises Misfit, struct.error, IndexError."""
    mask = answer[at]
    at += 1
    value: float | None = None
    if mask & _HAS_VALUE:
        kind = answer[at]
        at += 1
        if kind == number:
            [value] = layout.unpack_from(answer, at)
            at += layout.size
        else:
            at = _behind(answer, at, kind)
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


def _behind(answer: bytes, at: int, kind: int) -> int:
    """Where a Variant of another type ends. Raises Misfit for one that has no simple length, and struct.error."""
    number, count = kind & ~(_ARRAY | _DIMENSIONS), 1
    if kind & _ARRAY:
        [count] = _COUNT.unpack_from(answer, at)
        at += _COUNT.size
    if number in _STRINGS:
        for _ in range(count):
            at = _behind_counted(answer, at, 1)
    elif number in _SIZES:
        at += max(count, 0) * _SIZES[number]
    else:
        raise Misfit(f"the server answered with a value of the built-in type {number}")
    return _behind_counted(answer, at, _COUNT.size) if kind & _DIMENSIONS else at


def _behind_counted(answer: bytes, at: int, size: int) -> int:
    """Where something ends that says how many times `size` bytes it has; -1 is none. Raises struct.error."""
    return at + _COUNT.size + max(_COUNT.unpack_from(answer, at)[0], 0) * size

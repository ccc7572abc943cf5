"""The bytes of Read and Write for the variables of `opcua_nodes`, without objects in between.

A gateway reads dozens of variables hundreds of times a second, and a general OPC UA stack takes a millisecond for it.
What is not a plain request for these variables is nothing for this codec: it says None, and the stack does it.
Layouts: OPC UA part 6, 5.2 (binary encoding); part 4, 5.11.2 (Read), 5.11.4 (Write).
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from sim_plant.faces.opcua_nodes import Device, Kind, Scalar, Status, Variable

VALUE = 13  #: attribute id
MAX_NODES = 1000  #: of one request

_READ_RESPONSE = 634
_WRITE_RESPONSE = 676
_SOURCE, _SERVER, _BOTH = 0, 1, 2  #: time stamps to return
_HAS_VALUE, _HAS_STATUS, _HAS_SOURCE, _HAS_SERVER = 1, 2, 4, 8  #: bits of a DataValue's mask
_HAS_SOURCE_PS, _HAS_SERVER_PS = 16, 32
_NO_STRING = (-1, 0)
_NOTHING = struct.pack("<i", 0)

# TypeId (four-byte numeric), time, request handle, result, no diagnostics, no string table, no additional header.
_RESPONSE_HEADER = struct.Struct("<BBHqIIBi3x")
_READ_HEADER = struct.Struct("<dii")
_STRING_NODE = struct.Struct("<BHi")
_READ_TAIL = struct.Struct("<IiHi")  #: attribute, index range, data encoding (a qualified name)
_WRITE_TAIL = struct.Struct("<IiBB")  #: attribute, index range, mask of the value, type of the variant
_COUNT = struct.Struct("<i")
_STATUS = struct.Struct("<I")
_VALUES = {
    int(Kind.BOOLEAN): struct.Struct("<?"),
    int(Kind.UINT16): struct.Struct("<H"),
    int(Kind.UINT32): struct.Struct("<I"),
    int(Kind.DOUBLE): struct.Struct("<d"),
}
_TIME = struct.Struct("<q")


# Of a request, behind the session's token: time, handle, diagnostics, audit entry; then timeout, additional header.
_REQUEST_HEAD = struct.Struct("<qIIi")
_REQUEST_TAIL = struct.Struct("<I3s")
_NO_HEADER = bytes(3)
_NODE_SIZES = {0: 2, 1: 4, 2: 7, 4: 19}  #: by encoding of a node id: two bytes, four bytes, numeric, GUID
_COUNTED_NODES = (3, 5)  #: strings, byte strings


class Header(NamedTuple):
    """Of a request: its handle, and where its parameters begin."""

    handle: int
    end: int


@dataclass(frozen=True, slots=True)
class ReadPlan:
    """What one Read asks for. Clients ask for the same again and again, so it is worth keeping."""

    variables: tuple[Variable, ...]
    devices: tuple[Device, ...]  #: behind the variables, each once
    stamps: int  #: mask of the time stamps that are wanted


class WrittenValue(NamedTuple):
    """A value as it came: `kind` is the number of its data type."""

    variable: Variable
    kind: int
    value: Scalar


def parse_header(message: bytes, at: int) -> Header | None:
    """The header of a request, behind the type of the service. None unless it is a plain one."""
    try:
        size = _NODE_SIZES.get(message[at])
        if message[at] in _COUNTED_NODES:
            size = _STRING_NODE.size + _STRING_NODE.unpack_from(message, at)[2]
        if size is None or size < 0:
            return None
        at += size
        _, handle, _, audit = _REQUEST_HEAD.unpack_from(message, at)
        at += _REQUEST_HEAD.size + max(audit, 0)
        _, additional = _REQUEST_TAIL.unpack_from(message, at)
    except (struct.error, IndexError):
        return None
    return Header(handle, at + _REQUEST_TAIL.size) if additional == _NO_HEADER else None


def plan_read(body: bytes, variables: Mapping[str, Variable], namespace: int) -> ReadPlan | None:
    """The plan of a ReadRequest's body behind its header. None unless it is a plain one for `variables`."""
    try:
        _, stamps, count = _READ_HEADER.unpack_from(body)
        if count > MAX_NODES:
            return None
        at = _READ_HEADER.size
        wanted: list[Variable] = []
        for _ in range(count):
            variable, at = _take_node(body, at, variables, namespace)
            attribute, index_range, encoding_namespace, encoding = _READ_TAIL.unpack_from(body, at)
            at += _READ_TAIL.size
            if variable is None or variable.kind is Kind.STRING or attribute != VALUE:
                return None
            if index_range not in _NO_STRING or encoding not in _NO_STRING or encoding_namespace:
                return None
            wanted.append(variable)
    except struct.error:
        return None
    if not wanted or at != len(body) or not _SOURCE <= stamps <= _BOTH + 1:
        return None
    devices = tuple({variable.device: None for variable in wanted})
    return ReadPlan(tuple(wanted), devices, stamp_mask(stamps))


def stamp_mask(stamps: int) -> int:
    """Mask of a DataValue for TimestampsToReturn: source, server, both or neither."""
    return _HAS_SOURCE * (stamps in (_SOURCE, _BOTH)) | _HAS_SERVER * (stamps in (_SERVER, _BOTH))


def parse_write(body: bytes, variables: Mapping[str, Variable], namespace: int) -> list[WrittenValue] | None:
    """The values of a WriteRequest's body behind its header. None unless they are plain ones for `variables`."""
    written: list[WrittenValue] = []
    try:
        [count] = _COUNT.unpack_from(body)
        if count > MAX_NODES:
            return None
        at = _COUNT.size
        for _ in range(count):
            variable, at = _take_node(body, at, variables, namespace)
            attribute, index_range, mask, kind = _WRITE_TAIL.unpack_from(body, at)
            at += _WRITE_TAIL.size
            layout = _VALUES.get(kind)  # arrays have other numbers
            if variable is None or attribute != VALUE or index_range not in _NO_STRING or layout is None:
                return None
            [value] = layout.unpack_from(body, at)
            written.append(WrittenValue(variable, kind, value))
            rest = _behind_value(body, at + layout.size, mask)
            if rest is None:
                return None
            at = rest
    except struct.error:
        return None
    return written if written and at == len(body) else None


def encode_read(plan: ReadPlan, handle: int, ticks: int) -> bytes:
    """The whole response. `ticks` is the time of the values, in 100 ns since 1601 (UTC)."""
    stamp = _TIME.pack(ticks) * (plan.stamps.bit_count())
    parts = [_response_header(_READ_RESPONSE, handle, ticks), _COUNT.pack(len(plan.variables))]
    parts += [_data_value(variable, plan.stamps, stamp) for variable in plan.variables]
    parts.append(_NOTHING)
    return b"".join(parts)


def encode_write(statuses: Sequence[int], handle: int, ticks: int) -> bytes:
    """The whole response."""
    results = struct.pack(f"<i{len(statuses)}I", len(statuses), *statuses)
    return _response_header(_WRITE_RESPONSE, handle, ticks) + results + _NOTHING


def _response_header(type_id: int, handle: int, ticks: int) -> bytes:
    return _RESPONSE_HEADER.pack(1, 0, type_id, ticks, handle, 0, 0, 0)


def _data_value(variable: Variable, stamps: int, stamp: bytes) -> bytes:
    status, kind = variable.status(), variable.kind
    if status is Status.GOOD:
        return bytes((_HAS_VALUE | stamps, kind)) + _VALUES[kind].pack(variable.read()) + stamp
    if status.is_bad:
        return bytes((_HAS_STATUS | stamps,)) + _STATUS.pack(status) + stamp
    value = _VALUES[kind].pack(variable.read())
    return bytes((_HAS_VALUE | _HAS_STATUS | stamps, kind)) + value + _STATUS.pack(status) + stamp


def _take_node(body: bytes, at: int, variables: Mapping[str, Variable], namespace: int) -> tuple[Variable | None, int]:
    """The variable that a node id names, and where the node id ends. Without a variable the place means nothing."""
    encoding, index, length = _STRING_NODE.unpack_from(body, at)
    if encoding != 3 or index != namespace or length < 0:
        return None, at
    begin = at + _STRING_NODE.size
    return variables.get(body[begin : begin + length].decode("utf-8", "replace")), begin + length


def _behind_value(body: bytes, at: int, mask: int) -> int | None:
    """Where a DataValue ends whose value ends at `at`. None when it is more than a good value with time stamps."""
    if not mask & _HAS_VALUE or mask > 63:
        return None
    if mask & _HAS_STATUS:
        [status] = _STATUS.unpack_from(body, at)
        if status:
            return None
        at += _STATUS.size
    at += 8 * bool(mask & _HAS_SOURCE) + 2 * bool(mask & _HAS_SOURCE_PS)
    return at + 8 * bool(mask & _HAS_SERVER) + 2 * bool(mask & _HAS_SERVER_PS)

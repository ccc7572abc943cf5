"""Where a value ends that nobody can use: of another type than the map says (OPC 10000-6, 5.2.2). No I/O.

What stands behind it in an answer is found all the same, so that a node of a wrong type costs no other one its value.
Every step takes at least a byte: the work is bounded by the bytes that came.
"""

import struct
from collections.abc import Callable

_COUNT = struct.Struct("<i")
_NUMBER, _ARRAY, _DIMENSIONS = 0x3F, 0x80, 0x40  #: bits of a Variant's encoding byte
_NODE_ID, _NAMESPACE_URI, _SERVER_INDEX = 0x3F, 0x80, 0x40  #: bits of a node id's encoding byte
_LOCALE, _TEXT = 0x01, 0x02  #: bits of a LocalizedText's mask

# Bytes of the built-in types with a fixed length, by number (OPC 10000-6, 5.1.2).
_SIZES = {0: 0, 1: 1, 2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 4, 8: 8, 9: 8, 10: 4, 11: 8, 13: 8, 14: 16, 19: 4}
_NODE_ID_SIZES = {0: 2, 1: 4, 2: 7, 4: 19}  #: bytes with the encoding: two-byte, four-byte, numeric, GUID
_NODE_ID_STRINGS = (3, 5)
_NO_BODY, _BODIES = 0, (1, 2)  #: encodings of an ExtensionObject


def behind_variant(answer: bytes, at: int, kind: int) -> int:
    """Where the Variant ends whose encoding byte, `kind`, stands before `at`.

    Raises ValueError for one that can hold others (Variant, DataValue, DiagnosticInfo) or is none, struct.error and
    IndexError for one that is cut short; where its last bytes are missing, the end is behind the answer's.
    """
    number, count = kind & _NUMBER, 1
    if kind & _ARRAY:
        [count] = _COUNT.unpack_from(answer, at)
        at += _COUNT.size
    if number in _SIZES:
        at += max(count, 0) * _SIZES[number]
    elif number in _STEPS:
        step = _STEPS[number]
        for _ in range(count):
            at = step(answer, at)
    else:
        raise ValueError(f"a value of the built-in type {number}")
    return _behind_counted(answer, at, _COUNT.size) if kind & _DIMENSIONS else at


def _behind_counted(answer: bytes, at: int, size: int) -> int:
    """Of something that says how many times `size` bytes it has; -1 is none."""
    return at + _COUNT.size + max(_COUNT.unpack_from(answer, at)[0], 0) * size


def _behind_string(answer: bytes, at: int) -> int:
    return _behind_counted(answer, at, 1)


def _behind_node_id(answer: bytes, at: int) -> int:
    """Of a NodeId or an ExpandedNodeId."""
    encoding = answer[at]
    form = encoding & _NODE_ID
    if form in _NODE_ID_SIZES:
        at += _NODE_ID_SIZES[form]
    elif form in _NODE_ID_STRINGS:
        at = _behind_string(answer, at + 3)  # encoding and namespace
    else:
        raise ValueError(f"a node id with the encoding {encoding:#04x}")
    if encoding & _NAMESPACE_URI:
        at = _behind_string(answer, at)
    return at + 4 * bool(encoding & _SERVER_INDEX)


def _behind_qualified_name(answer: bytes, at: int) -> int:
    return _behind_string(answer, at + 2)  # namespace


def _behind_localized_text(answer: bytes, at: int) -> int:
    mask = answer[at]
    at += 1
    for bit in (_LOCALE, _TEXT):
        if mask & bit:
            at = _behind_string(answer, at)
    return at


def _behind_extension_object(answer: bytes, at: int) -> int:
    at = _behind_node_id(answer, at)
    encoding = answer[at]
    if encoding in _BODIES:
        return _behind_string(answer, at + 1)
    if encoding != _NO_BODY:
        raise ValueError(f"an ExtensionObject with the encoding {encoding}")
    return at + 1


_Step = Callable[[bytes, int], int]
_STEPS: dict[int, _Step] = {
    **dict.fromkeys((12, 15, 16), _behind_string),  # String, ByteString, XmlElement
    **dict.fromkeys(range(26, 32), _behind_string),  # not assigned yet: to be taken for ByteStrings
    **dict.fromkeys((17, 18), _behind_node_id),
    20: _behind_qualified_name,
    21: _behind_localized_text,
    22: _behind_extension_object,
}

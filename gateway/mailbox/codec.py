"""The envelope: one message between two processes as one datagram. Pure, no I/O.

octet 0      version
octet 1      kind
octets 2-9   id, u64 little-endian; 0 for PUBLISH
octet 10     length t of the topic's name, 1 .. 64
then         the topic's name (ASCII), then the payload
"""

import struct
from enum import IntEnum
from typing import NamedTuple

from gateway.mailbox.port import MAX_PAYLOAD

VERSION = 1
MAX_TOPIC = 64
MAX_ID = 2**64 - 1
_HEADER = struct.Struct("<BBQB")
MAX_DATAGRAM = _HEADER.size + MAX_TOPIC + MAX_PAYLOAD


class Kind(IntEnum):
    PUBLISH = 1
    REQUEST = 2
    ANSWER = 3
    ERROR = 4  #: the payload says why, as UTF-8


class Envelope(NamedTuple):
    kind: Kind
    topic: str
    id: int  #: matches an answer to its request
    payload: bytes


class MalformedEnvelope(Exception):
    """Bytes that are no envelope; the text says why."""


_KINDS = {int(kind): kind for kind in Kind}


def encode(envelope: Envelope) -> bytes:
    """The datagram of `envelope`. Raises MalformedEnvelope for what no receiver would take."""
    kind, name, number, payload = envelope
    topic = name.encode()
    if not 1 <= len(topic) <= MAX_TOPIC or not name.isascii():
        raise MalformedEnvelope(f"a topic's name has 1 to {MAX_TOPIC} ASCII characters, this one is {name!r}")
    if not 0 <= number <= MAX_ID:
        raise MalformedEnvelope(f"id {number} is outside 0 .. 2^64-1")
    if len(payload) > MAX_PAYLOAD:
        raise MalformedEnvelope(f"{name}: {len(payload)} bytes of payload, at most {MAX_PAYLOAD} are allowed")
    return _HEADER.pack(VERSION, kind, number, len(topic)) + topic + payload


def decode(datagram: bytes) -> Envelope:
    """The envelope in `datagram`. Raises MalformedEnvelope."""
    if len(datagram) < _HEADER.size:
        raise MalformedEnvelope(f"{len(datagram)} bytes are shorter than a header of {_HEADER.size}")
    version, kind, number, topic_length = _HEADER.unpack_from(datagram)
    if version != VERSION:
        raise MalformedEnvelope(f"version {version}, this program speaks {VERSION}")
    if kind not in _KINDS:
        raise MalformedEnvelope(f"kind {kind}, known are {', '.join(map(str, _KINDS))}")
    start = _HEADER.size + topic_length
    topic = datagram[_HEADER.size : start]
    if not 1 <= topic_length <= MAX_TOPIC or len(topic) != topic_length or not topic.isascii():
        raise MalformedEnvelope(f"the topic's name is {topic!r} of {topic_length} bytes")
    payload = datagram[start:]
    if len(payload) > MAX_PAYLOAD:
        raise MalformedEnvelope(f"{len(payload)} bytes of payload, at most {MAX_PAYLOAD} are allowed")
    return Envelope(_KINDS[kind], topic.decode("ascii"), number, payload)

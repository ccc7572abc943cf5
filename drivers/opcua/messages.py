"""What link and engine say to each other, and how it looks on the socket between two processes. No I/O.

One question, one answer, both small and of a known size. A question carries its time limits (monotonic, the same
clock in all processes of a machine): a command that comes late, from a process that was stopped, is not written.
"""

import json
import struct
from enum import IntEnum
from typing import NamedTuple

from drivers.opcua.nodes import Node, Reading

MAX_MESSAGE = 1 << 16  #: bytes; a socket pair carries three times as much in one piece
MAX_PLAN = 1 << 18  #: bytes
MAX_TEXT = 300  #: bytes
READY = 0  #: the number of the one message that answers nothing: the engine is there

_QUESTION = struct.Struct("<QQdd?HH")
_WRITE = struct.Struct("<Hd")
_ANSWER = struct.Struct("<QBQHH")
_READING = struct.Struct("<Idq")


class Plan(NamedTuple):
    """All that an engine must know: server, security, nodes. Files are paths, empty with security "none"."""

    endpoint: str
    security: str
    certificate: str
    private_key: str
    server_certificate: str
    nodes: list[Node]

    def to_json(self) -> bytes:
        """For another process."""
        return json.dumps(self).encode()

    @classmethod
    def from_json(cls, text: bytes) -> "Plan":
        """What `to_json` made."""
        plan = cls(*json.loads(text))
        return plan._replace(nodes=[Node(*node) for node in plan.nodes])


class Question(NamedTuple):
    """Write these and read those; nodes are places in the plan. Both are sent at once, in this order, and a server may
    do them in any: what has to be read after a write is another question.

    Nothing is written on another connection than `connection`, nor from `write_by_s` on: what was true of the
    devices may not be any more. `patient`: without a connection, wait for one.
    """

    number: int
    connection: int
    write_by_s: float
    deadline_s: float  #: it is answered by then, whatever has come
    patient: bool
    writes: tuple[tuple[int, float], ...]
    reads: tuple[int, ...]


class Outcome(IntEnum):
    DONE = 0
    NO_CONNECTION = 1  #: nothing was sent
    OTHER_CONNECTION = 2  #: nothing was written, nothing read: connected anew since
    TOO_LATE = 3  #: nothing was written, nothing read: the command had expired
    FAILED = 4  #: no usable answer from the server; the connection was dropped


class Answer(NamedTuple):
    """`connection` counts connections, over all engines of a link. `written` are StatusCodes, in order of the writes.

    Without DONE there may be `written`, when the read failed after it; there are no readings then. `text` says why, or
    is the serial number that was asked for: numbers alone are readings.
    """

    number: int
    outcome: Outcome
    connection: int
    written: tuple[int, ...] = ()
    readings: tuple[Reading, ...] = ()
    text: str = ""


def encode_question(question: Question) -> bytes:
    """Raises ValueError when it is too long."""
    number, connection, write_by_s, deadline_s, patient, writes, reads = question
    head = _QUESTION.pack(number, connection, write_by_s, deadline_s, patient, len(writes), len(reads))
    body = b"".join([_WRITE.pack(*write) for write in writes])
    return _bounded(head + body + struct.pack(f"<{len(reads)}H", *reads))


def decode_question(message: bytes) -> Question:
    """Raises ValueError for anything that is no question."""
    try:
        number, connection, write_by_s, deadline_s, patient, writes, reads = _QUESTION.unpack_from(message)
        at = _QUESTION.size + writes * _WRITE.size
        if len(message) != at + 2 * reads:
            raise ValueError(f"{at + 2 * reads} wanted")
        written = tuple(_WRITE.iter_unpack(message[_QUESTION.size : at]))
        read = struct.unpack(f"<{reads}H", message[at:])
    except (struct.error, ValueError) as error:
        raise ValueError(f"{len(message)} bytes are no question: {error}") from error
    return Question(number, connection, write_by_s, deadline_s, patient, written, read)


def encode_answer(answer: Answer) -> bytes:
    """Raises ValueError when it is too long. A text is cut."""
    written, readings = answer.written, answer.readings
    head = _ANSWER.pack(answer.number, answer.outcome, answer.connection, len(written), len(readings))
    body = struct.pack(f"<{len(written)}I", *written) + b"".join([_READING.pack(*reading) for reading in readings])
    return _bounded(head + body + answer.text.encode()[:MAX_TEXT])


def decode_answer(message: bytes) -> Answer:
    """Raises ValueError for anything that is no answer."""
    try:
        number, outcome, connection, writes, reads = _ANSWER.unpack_from(message)
        at = _ANSWER.size + 4 * writes
        end = at + _READING.size * reads
        written = struct.unpack(f"<{writes}I", message[_ANSWER.size : at])
        if end > len(message):
            raise ValueError(f"{len(message)} bytes, {end} or more wanted")
        readings = tuple(map(Reading._make, _READING.iter_unpack(message[at:end])))
        text = message[end:].decode(errors="replace")
        return Answer(number, Outcome(outcome), connection, written, readings, text)
    except (struct.error, ValueError) as error:
        raise ValueError(f"{len(message)} bytes are no answer: {error}") from error


def _bounded(message: bytes) -> bytes:
    if len(message) > MAX_MESSAGE:
        raise ValueError(f"{len(message)} bytes; at most {MAX_MESSAGE} fit one message")
    return message

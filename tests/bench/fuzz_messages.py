"""Fuzz targets between our own processes: telemetry, the mailbox, and the questions and answers of OPC UA workers."""

import struct
from math import isnan
from random import Random

import numpy as np

from drivers.opcua.messages import Answer, Outcome, Question, decode_answer, decode_question, encode_answer
from drivers.opcua.messages import encode_question as encode_asked
from drivers.opcua.nodes import Reading
from gateway.core.telemetry import Frame, MalformedFrame, pack, unpack
from gateway.mailbox.codec import Envelope, Kind, MalformedEnvelope, decode, encode
from tests.bench.fuzz_canopen import ACCEPTED, REFUSED

SPANS = 6
MAX_PAYLOAD = 1 << 16


class Telemetry:
    """A header of 44 bytes with version 2 and the number of spans, five float32 and two bytes for each span."""

    name = "telemetry frame"
    _head = struct.Struct("<HHIdffIffBBBBBHB")

    def valid(self, dice: Random) -> bytes:
        values = np.array([dice.uniform(-100.0, 100.0) for _ in range(SPANS)])
        octets = np.zeros(SPANS, np.int8)
        return pack(
            Frame(
                dice.getrandbits(32),
                dice.uniform(0, 1e6),
                4e-5,
                6e-4,
                0,
                0.1,
                0.1,
                dice.randrange(5),
                dice.randrange(10),
                False,
                True,
                False,
                0,
                0,
                values,
                values,
                values,
                values,
                values,
                octets,
                octets,
            )  # fmt: skip
        )

    def check(self, data: bytes) -> str:
        head = self._head.unpack_from(data) if len(data) >= self._head.size else None
        sound = head is not None and head[0] == 3 and len(data) == self._head.size + head[1] * 22
        try:
            frame = unpack(data)
        except MalformedFrame:
            assert not sound, "a sound frame was refused"
            return REFUSED
        assert sound and head is not None, "a frame of a wrong version or length was accepted"
        n = head[1]
        assert frame.sequence == head[2] and frame.missed == head[6] and frame.state == head[9]
        assert frame.time_s == head[3] or isnan(head[3])
        floats = struct.unpack_from(f"<{5 * n}f", data, self._head.size)
        found = np.concatenate(
            [frame.tension_n, frame.tension_setpoint_n, frame.speed_m_per_s, frame.torque_nm, frame.torque_actual_nm]
        )
        assert np.array_equal(found, np.array(floats), equal_nan=True)
        assert bytes(frame.drive_state) == data[len(data) - n :]
        return ACCEPTED


class Mail:
    """Version 1, kind 1 to 4, u64 id, length of the topic (1 to 64), ASCII topic, payload."""

    name = "mailbox envelope"

    def valid(self, dice: Random) -> bytes:
        kind = dice.choice(list(Kind))
        return encode(Envelope(kind, "loop/telemetry", dice.getrandbits(64), dice.randbytes(dice.randrange(40))))

    def check(self, data: bytes) -> str:
        size = data[10] if len(data) > 10 else 0
        topic = data[11 : 11 + size]
        sound = (
            len(data) > 10 and data[0] == 1 and 1 <= data[1] <= 4 and 1 <= size <= 64 and len(topic) == size
            and max(topic) < 128
        )  # fmt: skip
        try:
            envelope = decode(data)
        except MalformedEnvelope:
            assert not sound, "a sound envelope was refused"
            return REFUSED
        assert sound, "what is no envelope was accepted"
        assert (int(envelope.kind), envelope.id) == (data[1], int.from_bytes(data[2:10], "little"))
        assert envelope.topic.encode() == topic and envelope.payload == data[11 + size :]
        return ACCEPTED


class OpcUaAnswer:
    """u64 number, u8 outcome, u64 connection, two u16 counts, u32 statuses, (u32, f64, i64) readings, text."""

    name = "opcua worker answer"

    def valid(self, dice: Random) -> bytes:
        written = tuple(dice.choice((0, 0x80740000)) for _ in range(dice.randrange(4)))
        readings = tuple(Reading(0, dice.uniform(-100.0, 100.0)) for _ in range(dice.randrange(6)))
        return encode_answer(Answer(dice.getrandbits(40), dice.choice(list(Outcome)), 1, written, readings, "why"))

    def check(self, data: bytes) -> str:
        wanted = self._wanted(data)
        try:
            answer = decode_answer(data)
        except ValueError:
            assert wanted is None, "a sound answer was refused"
            return REFUSED
        assert wanted is not None, "what is no answer was accepted"
        number, outcome, connection, written, readings, text = wanted
        assert (answer.number, int(answer.outcome), answer.connection, answer.written) == (
            number, outcome, connection, written,
        )  # fmt: skip
        found = b"".join(struct.pack("<Idq", *reading) for reading in answer.readings)
        assert found == readings or b"\x7f" in readings or b"\xff" in readings  # a NaN need not keep its bits
        assert len(found) == len(readings) and answer.text == text.decode(errors="replace")
        return ACCEPTED

    def _wanted(self, data: bytes) -> tuple[int, int, int, tuple[int, ...], bytes, bytes] | None:
        if len(data) < 21:
            return None
        number, outcome, connection, writes, reads = struct.unpack_from("<QBQHH", data)
        readings_at, text_at = 21 + 4 * writes, 21 + 4 * writes + 20 * reads
        if outcome > 4 or text_at > len(data):
            return None
        written = struct.unpack_from(f"<{writes}I", data, 21)
        return number, outcome, connection, written, data[readings_at:text_at], data[text_at:]


class OpcUaQuestion:
    """u64 number, u64 connection, two f64 times, u8 patient, two u16 counts, (u16, f64) writes, u16 reads."""

    name = "opcua worker question"

    def valid(self, dice: Random) -> bytes:
        writes = tuple((dice.randrange(99), dice.uniform(-60.0, 60.0)) for _ in range(dice.randrange(4)))
        reads = tuple(dice.randrange(99) for _ in range(dice.randrange(9)))
        return encode_asked(Question(dice.getrandbits(40), 1, 12.5, 13.0, dice.random() < 0.5, writes, reads))

    def check(self, data: bytes) -> str:
        writes, reads = struct.unpack_from("<HH", data, 33) if len(data) >= 37 else (0, 0)
        sound = len(data) == 37 + 10 * writes + 2 * reads
        try:
            question = decode_question(data)
        except ValueError:
            assert not sound, "a sound question was refused"
            return REFUSED
        assert sound, "what is no question was accepted"
        assert question.number == int.from_bytes(data[:8], "little")
        assert len(question.writes) == writes and len(question.reads) == reads
        assert question.reads == struct.unpack_from(f"<{reads}H", data, 37 + 10 * writes)
        assert all(
            struct.unpack_from("<H", data, 37 + 10 * k)[0] == place for k, (place, _) in enumerate(question.writes)
        )
        return ACCEPTED

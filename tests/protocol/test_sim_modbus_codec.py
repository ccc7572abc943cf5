"""The Modbus codec of the simulated line against the specification's own numbers, and against any bytes at all."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_plant.faces.modbus_codec import Frame, NotModbus, Refused, answer, encode_frame, parse_request, take_frames

WORD = st.integers(0, 0xFFFF)
FRAMES = st.builds(Frame, WORD, st.integers(0, 255), st.binary(min_size=1, max_size=253))


class Memory:
    """A unit with 200 registers that can all be read and written."""

    functions = frozenset({3, 4, 6, 16, 23})

    def __init__(self) -> None:
        self.words = [0] * 200

    def check_read(self, address: int, count: int) -> None:
        if address + count > len(self.words):
            raise Refused(2)

    def read(self, address: int, count: int, now_s: float) -> bytes:
        self.check_read(address, count)
        return struct.pack(f">{count}H", *self.words[address : address + count])

    def write(self, address: int, values: tuple[int, ...], now_s: float) -> None:
        if address + len(values) > len(self.words):
            raise Refused(2)
        self.words[address : address + len(values)] = values


@given(st.lists(FRAMES, max_size=6), st.data())
def test_frames_survive_any_segmentation(frames: list[Frame], data: st.DataObject) -> None:
    stream = b"".join(encode_frame(frame) for frame in frames)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    buffer, taken = bytearray(), []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        buffer += stream[begin:end]
        taken += take_frames(buffer)
    assert taken == frames
    assert not buffer


@given(st.binary(max_size=600))
def test_any_bytes_are_frames_or_not_modbus(garbage: bytes) -> None:
    buffer = bytearray(garbage)
    try:
        frames = take_frames(buffer)
    except NotModbus:
        return
    assert b"".join(map(encode_frame, frames)) + buffer == garbage
    assert len(buffer) < 7 + 253


@given(st.binary(min_size=1, max_size=253))
def test_any_request_gets_an_answer_that_fits(pdu: bytes) -> None:
    reply = answer(pdu, Memory(), 0.0)
    assert 2 <= len(reply) <= 253
    assert reply[0] in (pdu[0], pdu[0] | 0x80)
    if reply[0] & 0x80:
        assert len(reply) == 2 and 1 <= reply[1] <= 4


@given(st.integers(0, 100), st.lists(WORD, min_size=1, max_size=100))
def test_what_is_written_is_read(address: int, values: list[int]) -> None:
    count = len(values)
    words = struct.pack(f">{count}H", *values)
    memory = Memory()
    written = struct.pack(">BHHB", 16, address, count, 2 * count) + words
    assert answer(written, memory, 0.0) == struct.pack(">BHH", 16, address, count)
    assert answer(struct.pack(">BHH", 3, address, count), memory, 0.0) == bytes((3, 2 * count)) + words
    both = struct.pack(">BHHHHB", 23, address, count, address, count, 2 * count) + words
    assert answer(both, Memory(), 0.0) == bytes((23, 2 * count)) + words  # written before it is read


# The examples of the Modbus application protocol V1.1b3, sections 6.3, 6.6, 6.12 and 6.17.
def test_the_examples_of_the_specification() -> None:
    memory = Memory()
    memory.words[107:110] = [555, 0, 100]
    assert answer(bytes.fromhex("03 006B 0003"), memory, 0.0) == bytes.fromhex("03 06 022B 0000 0064")
    assert answer(bytes.fromhex("06 0001 0003"), memory, 0.0) == bytes.fromhex("06 0001 0003")
    assert answer(bytes.fromhex("10 0001 0002 04 000A 0102"), memory, 0.0) == bytes.fromhex("10 0001 0002")
    assert memory.words[1:3] == [0x000A, 0x0102]
    memory.words[3:9] = [0x00FE, 0x0ACD, 0x0001, 0x0003, 0x000D, 0x00FF]
    request = bytes.fromhex("17 0003 0006 000E 0003 06 00FF 00FF 00FF")
    assert answer(request, memory, 0.0) == bytes.fromhex("17 0C 00FE 0ACD 0001 0003 000D 00FF")
    assert memory.words[14:17] == [0xFF] * 3


@pytest.mark.parametrize(
    ("request_hex", "code"),
    [
        ("01 0000 0001", 1),  # a function that exists, but not here
        ("83 0000 0001", 1),
        ("03 0000 0000", 3),
        ("03 0000 007E", 3),  # 126
        ("03 0000", 3),  # too short
        ("03 0000 0001 00", 3),  # too long
        ("03 FFFF 0002", 2),  # over the end of the address space
        ("03 00C8 0001", 2),  # behind the last register
        ("10 0000 0001 04 0000 0000", 3),  # count and size disagree
        ("10 0000 0001 02 00", 3),
        ("10 0000 0000 00", 3),
        ("17 0000 0000 0000 0001 02 0000", 3),
        ("17 0000 0001 0000 0000 00", 3),
        ("17 00C8 0001 0000 0001 02 0000", 2),
    ],
)
def test_refusals(request_hex: str, code: int) -> None:
    pdu = bytes.fromhex(request_hex)
    memory = Memory()
    assert answer(pdu, memory, 0.0) == bytes((pdu[0] | 0x80, code))
    assert not any(memory.words)


def test_longest_counts_are_allowed() -> None:
    assert parse_request(struct.pack(">BHH", 4, 0, 125)).read_count == 125
    assert len(parse_request(struct.pack(">BHHB", 16, 0, 123, 246) + bytes(246)).values) == 123
    assert len(parse_request(struct.pack(">BHHHHB", 23, 0, 125, 0, 121, 242) + bytes(242)).values) == 121
    for pdu in (
        struct.pack(">BHHB", 16, 0, 124, 248) + bytes(248),
        struct.pack(">BHHHHB", 23, 0, 1, 0, 122, 244) + bytes(244),
    ):
        with pytest.raises(Refused) as refusal:
            parse_request(pdu)
        assert refusal.value.code == 3


@pytest.mark.parametrize("head", ["0001 0001 0006 01", "0001 0000 0001 01", "0001 0000 00FF 01", "4745 5420 2F20 48"])
def test_what_cannot_be_modbus(head: str) -> None:
    with pytest.raises(NotModbus):
        take_frames(bytearray.fromhex(head))

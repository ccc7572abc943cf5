"""The codecs against bytes worked out by hand, and by round trip."""

import struct
from math import inf, nan, pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.maps import DriveMap
from drivers.canopen.pdo import MalformedPdo, PdoCodec, mapping_entries
from drivers.device_map import MAPS, load_map
from drivers.modbus.registers import RegisterBlock, spans

CIA402 = load_map(MAPS / "cia402-torque.toml")
assert isinstance(CIA402, DriveMap)
CODEC = PdoCodec(CIA402, rated_torque_nm=80.0, radius_m=0.04)


def with_speed(unit: str, scale: float) -> DriveMap:
    assert isinstance(CIA402, DriveMap)
    speed = CIA402.objects.speed.model_copy(update={"unit": unit, "scale": scale})
    return CIA402.model_copy(update={"objects": CIA402.objects.model_copy(update={"speed": speed})})


def test_mapping_is_index_sub_and_bits() -> None:
    assert isinstance(CIA402, DriveMap)
    assert mapping_entries(CIA402.objects_of(CIA402.receive_pdo)) == [0x60400010, 0x60710010, 0x60600008]
    assert mapping_entries(CIA402.objects_of(CIA402.transmit_pdo)) == [0x60410010, 0x606C0020, 0x60770010]


def test_transmit_pdo_by_hand() -> None:
    # 6041h = 1237h; 606Ch = -100 000 um/s = FFFE7960h; 6077h = 550 per mille = 0226h; low byte first.
    sample = CODEC.decode(bytes.fromhex("3712 6079FEFF 2602"))
    assert sample.statusword == 0x1237
    assert sample.speed_m_per_s == pytest.approx(-0.1)
    assert sample.torque_nm == pytest.approx(44.0)
    assert sample.safe_torque_off is None


def test_receive_pdo_by_hand() -> None:
    assert CODEC.encode(0x000F, 44.0) == bytes.fromhex("0F00 2602 0A")
    assert CODEC.encode(0x0006, -0.04) == bytes.fromhex("0600 0000 0A"), "half a per mille rounds to the even one"
    assert CODEC.encode(0x0006, -0.08) == bytes.fromhex("0600 FFFF 0A")


@given(st.integers(0, 0xFFFF), st.integers(-(2**31), 2**31 - 1), st.integers(-(2**15), 2**15 - 1))
def test_transmit_pdo_round_trip(statusword: int, speed: int, torque: int) -> None:
    sample = CODEC.decode(struct.pack("<Hih", statusword, speed, torque))
    assert sample.statusword == statusword
    assert round(sample.speed_m_per_s * 1e6) == speed
    assert CODEC.encode(0, sample.torque_nm)[2:4] == struct.pack("<h", torque)


@given(st.binary(max_size=64).filter(lambda data: len(data) != 8))
def test_a_wrong_length_is_refused(data: bytes) -> None:
    with pytest.raises(MalformedPdo):
        CODEC.decode(data)


@given(st.floats().filter(lambda torque: not -32768.5 < torque / 0.08 < 32767.5))
def test_a_torque_that_does_not_fit_is_refused(torque_nm: float) -> None:
    with pytest.raises(ValueError, match="torque"):
        CODEC.encode(0x0F, torque_nm)


@pytest.mark.parametrize(
    ("unit", "scale", "counts", "speed_m_per_s"),
    [
        ("um/s", 1.0, 100_000, 0.1),
        ("m/min", 0.001, 6_000, 0.1),
        ("rad/s", 0.01, 250, 0.1),  # 2.5 rad/s at 0.04 m
        ("rpm", 0.1, 600, 60 * 2 * pi / 60 * 0.04),
        ("mrpm", 1.0, 60_000, 60 * 2 * pi / 60 * 0.04),
    ],
)
def test_a_speed_becomes_web_speed(unit: str, scale: float, counts: int, speed_m_per_s: float) -> None:
    codec = PdoCodec(with_speed(unit, scale), rated_torque_nm=80.0, radius_m=0.04)
    assert codec.decode(struct.pack("<Hih", 0, counts, 0)).speed_m_per_s == pytest.approx(speed_m_per_s)


# Registers

FIELDS = [(2, "u16"), (3, "i16"), (5, "f32"), (7, "i32"), (9, "u32")]
# 12.5 is 41480000h, -100 000 is FFFE7960h, 305 419 896 is 12345678h.
HIGH_FIRST = [0x0001, 0xFFFF, 0, 0x4148, 0x0000, 0xFFFE, 0x7960, 0x1234, 0x5678]
LOW_FIRST = [0x0001, 0xFFFF, 0, 0x0000, 0x4148, 0x7960, 0xFFFE, 0x5678, 0x1234]
NUMBERS = [1, -1, 12.5, -100_000, 0x12345678]


@pytest.mark.parametrize(("order", "registers"), [("high-first", HIGH_FIRST), ("low-first", LOW_FIRST)])
def test_registers_by_hand(order: str, registers: list[int]) -> None:
    block = RegisterBlock(FIELDS, order)
    assert (block.address, block.count) == (2, 9)
    assert block.decode(registers) == NUMBERS
    assert block.encode(NUMBERS) == registers


def test_numbers_keep_the_order_in_which_they_were_asked_for() -> None:
    block = RegisterBlock([(11, "i32"), (10, "u16")], "high-first")
    assert block.decode([7, 0, 9]) == [9, 7]
    assert block.encode([9, 7]) == [7, 0, 9]


LIMITS = {"u16": (0, 2**16 - 1), "i16": (-(2**15), 2**15 - 1), "u32": (0, 2**32 - 1), "i32": (-(2**31), 2**31 - 1)}


@st.composite
def blocks(draw: st.DrawFn) -> tuple[list[tuple[int, str]], list[float]]:
    fields: list[tuple[int, str]] = []
    numbers: list[float] = []
    at = draw(st.integers(0, 100))
    for kind in draw(st.lists(st.sampled_from([*LIMITS, "f32"]), min_size=1, max_size=12)):
        fields.append((at, kind))
        finite = st.floats(allow_nan=False, allow_infinity=False, width=32)
        numbers.append(draw(finite if kind == "f32" else st.integers(*LIMITS[kind])))
        at += (1 if kind.endswith("16") else 2) + draw(st.integers(0, 3))
    order = draw(st.permutations(range(len(fields))))
    return [fields[k] for k in order], [numbers[k] for k in order]


@given(blocks(), st.sampled_from(["high-first", "low-first"]))
def test_registers_round_trip(block: tuple[list[tuple[int, str]], list[float]], order: str) -> None:
    fields, numbers = block
    codec = RegisterBlock(fields, order)
    registers = codec.encode(numbers)
    assert all(0 <= register <= 0xFFFF for register in registers)
    assert codec.decode(registers) == numbers


@given(st.lists(st.integers(0, 0xFFFF), max_size=20).filter(lambda registers: len(registers) != 9))
def test_a_wrong_count_is_refused(registers: list[int]) -> None:
    with pytest.raises(ValueError, match="asked for 9"):
        RegisterBlock(FIELDS, "high-first").decode(registers)


@pytest.mark.parametrize(
    ("place", "number"),
    [(0, 65536), (0, -1), (1, 32768), (2, nan), (2, inf), (2, 1e39), (3, 2**31), (4, -1), (4, 2**32)],
)
def test_a_number_that_does_not_fit_is_refused(place: int, number: float) -> None:
    numbers: list[float] = [*NUMBERS]
    numbers[place] = number
    with pytest.raises(ValueError, match=r"\["):
        RegisterBlock(FIELDS, "high-first").encode(numbers)


@given(blocks())
def test_spans_hold_every_field_once_and_fit_a_request(block: tuple[list[tuple[int, str]], list[float]]) -> None:
    fields = [(address * 20, kind) for address, kind in block[0]]
    groups = spans(fields)
    assert sorted(k for group in groups for k in group) == list(range(len(fields)))
    assert all(RegisterBlock([fields[k] for k in group], "high-first").count <= 125 for group in groups)

import tracemalloc
import zlib
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gateway.core.telemetry import frame_dtype
from gateway.supervisor.blobs import DamagedBlob, pack_column, pack_times, unpack_column, unpack_times

shapes = hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=40)


@given(st.sampled_from(["<f4", "<u4", "<u2", "u1", "i1", "<i8"]).flatmap(lambda kind: hnp.arrays(kind, shapes)))
def test_every_column_comes_back_bit_for_bit(values: np.ndarray) -> None:
    samples, channels = values.shape
    found = unpack_column(pack_column(values), values.dtype.str, samples, channels)
    assert found.dtype == values.dtype
    assert found.tobytes() == values.tobytes()  # NaN and its payload, minus zero, denormals


@given(hnp.arrays("<f8", st.integers(1, 60), elements=st.floats(width=64)))
def test_every_time_comes_back_bit_for_bit(time_s: np.ndarray) -> None:
    assert unpack_times(pack_times(time_s), len(time_s)).tobytes() == time_s.tobytes()


def test_a_field_of_a_table_of_frames_need_not_be_contiguous() -> None:
    rng = np.random.default_rng(3)
    table = np.frombuffer(rng.bytes(100 * frame_dtype(6).itemsize), frame_dtype(6))
    found = unpack_column(pack_column(table["torque_nm"]), "<f4", 100, 6)
    assert found.tobytes() == table["torque_nm"].tobytes()


def test_the_due_times_of_a_loop_take_next_to_nothing() -> None:
    time_s = np.array([86_400.123 + k * 0.01 for k in range(1000)])
    assert len(pack_times(time_s)) < 0.3 * len(time_s)  # bytes, of 8 a time


def test_readings_with_sensor_noise_take_less_than_two_thirds_of_their_size() -> None:
    rng = np.random.default_rng(1)
    tension_n = (20.0 + 0.1 * rng.standard_normal((1000, 6))).astype("<f4")
    assert len(pack_column(tension_n)) < 0.67 * tension_n.nbytes


@pytest.mark.parametrize(
    "damage",
    [
        lambda packed: packed[:-1],
        lambda packed: packed[: len(packed) // 2],
        lambda packed: b"",
        lambda packed: packed[:20] + bytes([packed[20] ^ 0x10]) + packed[21:],
        lambda packed: zlib.compress(bytes(10)),
    ],
)
def test_damage_is_noticed(damage: Callable[[bytes], bytes]) -> None:
    values = np.random.default_rng(2).standard_normal((200, 3)).astype("<f4")
    with pytest.raises(DamagedBlob):
        unpack_column(damage(pack_column(values)), "<f4", 200, 3)


@given(st.binary(max_size=100))
def test_any_bytes_unpack_or_are_damaged(packed: bytes) -> None:
    try:
        found = unpack_column(packed, "<f4", 2, 3)
    except DamagedBlob:
        return
    assert found.shape == (2, 3)


def test_a_bomb_is_not_unpacked() -> None:
    bomb = zlib.compress(bytes(50_000_000))
    tracemalloc.start()
    try:
        with pytest.raises(DamagedBlob):
            unpack_column(bomb, "<f4", 200, 3)
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()

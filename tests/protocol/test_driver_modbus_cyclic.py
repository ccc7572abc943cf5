"""The request of a cycle as bytes, against pymodbus; and that it shares its connection with other requests in turn."""

import asyncio
import struct
from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    ReadWriteMultipleRegistersRequest,
)

from drivers.modbus.client import ModbusConnection, ModbusFailed, ModbusTimeout
from drivers.modbus.cyclic import CyclicRequest, only
from drivers.modbus.plan import Request
from tests.protocol.driver_support import Registers, frame, until

READ = struct.pack(">BHH", 3, 1, 4)  #: four registers of the PLC
Body = Callable[[ModbusConnection, Registers, list[bytes | ModbusFailed]], Awaitable[None]]

registers = st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=121)


@given(st.integers(0, 0xFFFF), st.integers(1, 125), st.integers(0, 0xFFFF), registers)
def test_the_bytes_are_those_of_pymodbus(address: int, count: int, write_address: int, values: list[int]) -> None:
    both = CyclicRequest(Request((address, count), (write_address, len(values))), 3)
    theirs = ReadWriteMultipleRegistersRequest(
        read_address=address, read_count=count, write_address=write_address, write_registers=values
    )
    assert both.encode(values) == b"\x17" + theirs.encode() and both.registers_read == count
    for function, request in ((3, ReadHoldingRegistersRequest), (4, ReadInputRegistersRequest)):
        reads = CyclicRequest(Request((address, count), None), function)
        assert reads.encode(()) == bytes((function,)) + request(address=address, count=count).encode()


def test_a_transaction_of_several_requests_is_none() -> None:
    read, write = (0, 4), (10, 2)
    assert only([Request(read, write)], 3) is not None
    assert only([Request(read, None), Request(read, None)], 3) is None
    assert only([Request(None, write)], 3) is None and only([], 3) is None


def bench(body: Body) -> None:
    async def run() -> None:
        async with Registers() as peer:
            connection = ModbusConnection("127.0.0.1", peer.port)
            assert await connection.connect()
            try:
                await body(connection, peer, [])
            finally:
                connection.close()

    asyncio.run(run())


def soon() -> float:
    return asyncio.get_running_loop().time() + 5.0


def test_other_requests_wait_for_the_end_of_one_of_a_cycle_and_it_for_theirs() -> None:
    async def body(connection: ModbusConnection, peer: Registers, ended: list[bytes | ModbusFailed]) -> None:
        assert connection.begin(2, READ, 4, soon(), ended.append)
        reading = asyncio.create_task(connection.read(3, 2, 0, 1, soon()))
        await asyncio.sleep(0)
        assert not connection.begin(2, READ, 4, soon(), ended.append), "one is under way"
        assert await reading == [0x5202]
        assert ended == [struct.pack(">4H", *peer.plc[1:5])]
        assert [pdu for _, pdu in peer.requests] == [READ, struct.pack(">BHH", 3, 0, 1)]
        assert connection.begin(2, READ, 4, soon(), ended.append)
        await connection.until_free()
        assert len(ended) == 2 and connection.answers == 3

    bench(body)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (b"\x03\x06" + bytes(6), "6 bytes of registers, asked for 8"),
        (b"\x03\x08" + bytes(10), "10 bytes of registers, asked for 8"),
        (b"\x03\x0a" + bytes(8), "8 bytes of registers, asked for 8"),
        (b"\x04\x08" + bytes(8), "answer of function 4 to function 3"),
        (b"\x83\x02", "exception 2 to function 3"),
        (b"\x7f\x00", "answer of function 127 to function 3"),
    ],
)
def test_an_answer_that_does_not_fit_is_refused(answer: bytes, said: str) -> None:
    async def body(connection: ModbusConnection, peer: Registers, ended: list[bytes | ModbusFailed]) -> None:
        async def script(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            return [frame(head, unit, answer)]

        peer.script = script
        assert connection.begin(2, READ, 4, soon(), ended.append)
        await connection.until_free()
        await until(lambda: bool(ended))
        (found,) = ended
        assert isinstance(found, ModbusFailed) and said in str(found)
        assert found.exception_code == (2 if "exception" in said else None)
        assert connection.connected

    bench(body)


def wanted(data: bytes) -> bytes | None:
    """The four registers in the first frame for transaction 1 of unit 2; None where there is none that fits."""
    while len(data) > 7:
        transaction, protocol, length, unit = struct.unpack_from(">HHHB", data)
        pdu, data = data[7 : 6 + length], data[6 + length :]
        if protocol or length < 2 or len(pdu) != length - 1:
            return None
        if unit == 2 and transaction in (0, 1):
            return pdu[2:] if transaction and len(pdu) == 10 and pdu[:2] == b"\x03\x08" else None
    return None


headed = st.builds(
    lambda transaction, protocol, unit, surplus, pdu: (
        struct.pack(">HHHB", transaction, protocol, len(pdu) + 1 + surplus, unit) + pdu
    ),
    st.sampled_from([1, 1, 1, 0, 2]),
    st.sampled_from([0, 0, 0, 1]),
    st.sampled_from([2, 2, 2, 3]),
    st.sampled_from([0, 0, 0, 1, -1]),
    st.one_of(
        st.binary(max_size=20).map(lambda data: b"\x03" + data),
        st.binary(min_size=8, max_size=8).map(b"\x03\x08".__add__),
    ),
)


@given(st.one_of(st.lists(headed, max_size=4).map(b"".join), st.binary(max_size=40)), st.integers(0, 40))
def test_whatever_comes_only_what_fits_is_taken(data: bytes, cut: int) -> None:
    ended: list[bytes | ModbusFailed] = []

    async def run() -> None:
        connection: Any = ModbusConnection("127.0.0.1", 1)
        context = SimpleNamespace(
            recv_buffer=b"", getNextTID=lambda: 1, send=lambda data: None, callback_data=None, transport=None
        )
        connection._client = SimpleNamespace(connected=True, ctx=context, close=lambda: None)  # noqa: SLF001
        connection._receive_with(connection._client)  # noqa: SLF001
        assert connection.begin(2, READ, 4, soon(), ended.append)
        received = b""
        for piece in (data[:cut], data[cut:]):  # as pymodbus keeps what is left
            if piece and not ended:
                received += piece
                received = received[context.callback_data(received) :]
        connection.close()

    asyncio.run(run())
    taken = [found for found in ended if isinstance(found, bytes)]
    assert taken == ([] if (right := wanted(data)) is None else [right])


def test_only_the_answer_to_this_request_of_this_unit_is_taken() -> None:
    """Others before it, in pieces, and one behind it."""

    async def body(connection: ModbusConnection, peer: Registers, ended: list[bytes | ModbusFailed]) -> None:
        right = b"\x03\x08" + bytes(range(8))

        async def script(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            other = struct.pack(">H", struct.unpack(">H", head)[0] + 1000)
            whole = frame(other, unit, b"\x03\x08" + bytes(8)) + frame(head, 7, right) + frame(head, unit, right)
            return [whole[:5], whole[5:-3], whole[-3:], frame(head, unit, b"\x03\x08" + bytes(8))]

        peer.script = script
        for k in range(3):
            assert connection.begin(2, READ, 4, soon(), ended.append)
            await until(lambda: len(ended) == k + 1)  # noqa: B023 (awaited here)
        assert ended == [bytes(range(8))] * 3

    bench(body)


@pytest.mark.parametrize("half", [b"", b"\0\x01\0\0\0\x0b\x02", b"\0\x01\0\x09\0\x0b\x02\x03\x08" + bytes(8)])
def test_without_an_answer_it_ends_in_time_and_half_a_frame_ends_the_connection(half: bytes) -> None:
    async def body(connection: ModbusConnection, peer: Registers, ended: list[bytes | ModbusFailed]) -> None:
        sent = asyncio.Event()

        async def script(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            sent.set()
            return [half] if half else []

        peer.script = script
        assert connection.begin(2, READ, 4, asyncio.get_running_loop().time() + 0.2, ended.append)
        await sent.wait()
        await connection.until_free()
        (found,) = ended
        assert isinstance(found, ModbusTimeout) and connection.connected == (not half)
        assert connection.begin(2, READ, 4, soon(), ended.append) == (not half)

    bench(body)


def test_a_connection_that_is_closed_ends_what_waits_and_tells_nobody() -> None:
    async def body(connection: ModbusConnection, peer: Registers, ended: list[bytes | ModbusFailed]) -> None:
        async def script(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            return []

        peer.script = script
        assert connection.begin(2, READ, 4, soon(), ended.append)
        reading = asyncio.create_task(connection.read(3, 2, 0, 1, soon()))
        await asyncio.sleep(0)
        assert await connection.connect()
        with pytest.raises(ModbusTimeout, match="connection lost"):
            await reading
        assert not ended
        await until(lambda: bool(peer.requests))
        assert [pdu for _, pdu in peer.requests] in ([READ], []), "nothing of it is asked on the new connection"

    bench(body)

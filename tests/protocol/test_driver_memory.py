"""How much room the drivers ask for to receive a cycle's few bytes, and what a missed deadline leaves behind."""

import asyncio
import gc
import socket
import threading
import time
import tracemalloc
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest

from drivers.modbus.client import ModbusConnection, ModbusFailed
from drivers.modbus.link import ModbusLink
from drivers.opcua.link import OpcUaLink
from drivers.opcua.messages import Answer, Outcome, Plan, Question
from drivers.opcua.process import ProcessChannel
from drivers.receive_buffer import ReceiveBuffer
from gateway.core.signals import Inputs
from tests.protocol.driver_support import Registers, cycle, frame, until
from tests.protocol.modbus_support import bench as modbus_bench

CYCLES = 20
FEW_BYTES = 16_384  #: what a handful of cycles may need at once; asyncio alone asks for 262,144 a receipt
READ = b"\x03\x00\x01\x00\x04"  #: function 3, four registers from 1
FRAME = 12  #: octets of such a request
REGISTERS = bytes(range(8))


class Room:
    """What Python has asked for at once, in bytes over what it held before."""

    most_bytes = 0


@contextmanager
def room() -> Iterator[Room]:
    found = Room()
    tracemalloc.start()
    try:
        before_bytes, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        yield found
        found.most_bytes = tracemalloc.get_traced_memory()[1] - before_bytes
    finally:
        tracemalloc.stop()


def run(story: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(story())


class Noted(asyncio.Protocol):
    """Notes what a transport tells it."""

    def __init__(self) -> None:
        self.data: list[bytes] = []
        self.ends: list[str] = []

    def data_received(self, data: bytes) -> None:
        self.data.append(data)

    def eof_received(self) -> bool:
        self.ends.append("eof")
        return False

    def connection_lost(self, exc: Exception | None) -> None:
        self.ends.append("lost")


def test_what_arrives_by_way_of_a_buffer_is_what_was_sent() -> None:
    async def story() -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            transport, noted = await asyncio.get_running_loop().create_connection(Noted, sock=ours)
            transport.set_protocol(ReceiveBuffer(noted, 8))
            theirs.sendall(b"twenty bytes and two.")
            theirs.shutdown(socket.SHUT_WR)
            await until(lambda: "lost" in noted.ends)
        assert b"".join(noted.data) == b"twenty bytes and two." and max(map(len, noted.data)) <= 8
        assert noted.ends == ["eof", "lost"]

    run(story)


@pytest.fixture
def device() -> Iterator[int]:
    """A Modbus device that gives the same registers whatever it is asked; its port. Needs no event loop."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=_answer, args=(server,))
        thread.start()
        yield server.getsockname()[1]
        thread.join()


def _answer(server: socket.socket) -> None:
    peer, _ = server.accept()
    with peer, suppress(ConnectionResetError):  # which is how the connection is closed
        while request := peer.recv(FRAME, socket.MSG_WAITALL):
            peer.sendall(request[:4] + bytes((0, 3 + len(REGISTERS))) + request[6:8] + bytes((8,)) + REGISTERS)


def test_a_modbus_cycle_asks_for_little_room(device: int) -> None:
    async def story() -> None:
        connection = ModbusConnection("127.0.0.1", device)
        assert await connection.connect()
        ended: list[bytes | ModbusFailed] = []
        await _read(connection, ended)
        with room() as found:
            for _ in range(CYCLES):
                await _read(connection, ended)
        connection.close()
        assert ended == [REGISTERS] * (CYCLES + 1)
        assert found.most_bytes < FEW_BYTES

    run(story)


async def _read(connection: ModbusConnection, ended: list[bytes | ModbusFailed]) -> None:
    many = len(ended) + 1
    assert connection.begin(1, READ, 4, asyncio.get_running_loop().time() + 5.0, ended.append)
    await until(lambda: len(ended) == many)


@pytest.mark.wires
def test_an_opcua_cycle_asks_for_little_room() -> None:
    """On the loop's side: the worker, which has nobody to connect to, says so each time."""

    async def story() -> None:
        with socket.socket() as unused:
            unused.bind(("127.0.0.1", 0))  # nobody listens there
            plan = Plan(f"opc.tcp://127.0.0.1:{unused.getsockname()[1]}", "none", "", "", "", [])
            channel = ProcessChannel(plan, None, 60)
            answers: list[Answer] = []
            try:
                channel.start(answers.append, lambda why: None)
                await channel.up.wait()
                await _ask(channel, answers)
                with room() as found:
                    for _ in range(CYCLES):
                        await _ask(channel, answers)
            finally:
                await channel.close()
        assert {answer.outcome for answer in answers} == {Outcome.NO_CONNECTION}
        assert found.most_bytes < FEW_BYTES

    run(story)


async def _ask(channel: ProcessChannel, answers: list[Answer]) -> None:
    number = len(answers) + 1
    deadline_s = asyncio.get_running_loop().time() + 5.0
    assert channel.ask(Question(number, 0, deadline_s, deadline_s, False, (), ()))
    await until(lambda: len(answers) == number)


@contextmanager
def garbage() -> Iterator[list[object]]:
    """What only a collection of cycles finds of the time within; complete after it."""
    found: list[object] = []
    gc.collect()
    gc.disable()
    try:
        yield found
        gc.set_debug(gc.DEBUG_SAVEALL)
        gc.collect()
        found += gc.garbage
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()


def test_an_exchange_that_fails_leaves_no_garbage() -> None:
    """The error must not stay in a frame that it went through: it holds that frame. It comes each cycle."""

    async def body(link: ModbusLink, peer: Registers) -> None:
        async def mute(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            return []

        async def refuse(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
            return [frame(head, unit, bytes((pdu[0] | 0x80, 2)))]

        inputs = Inputs(2)
        peer.script = mute
        while not link.health.reconnects:
            await cycle(link, inputs)
            await asyncio.sleep(0)  # a cycle without a connection waits for nothing
        peer.script = refuse  # what proves the devices on a new connection: exchanges of several requests
        await cycle(link, inputs)
        with garbage() as found:
            refused = link.health.malformed
            while link.health.malformed < refused + CYCLES:
                await cycle(link, inputs)
                await asyncio.sleep(0)
        assert not [one for one in found if isinstance(one, ModbusFailed)]

    modbus_bench(body)


class Mute:
    """A `drivers.opcua.channel.Channel` that takes questions and answers none."""

    def __init__(self) -> None:
        self.up = asyncio.Event()
        self.asked = 0

    def start(self, on_answer: Callable[[Answer], None], on_lost: Callable[[str], None]) -> None: ...

    def tend(self, now_s: float) -> None: ...

    def give_up(self, why: str) -> None: ...

    def ask(self, question: Question) -> bool:
        self.asked += 1
        return True

    async def close(self) -> None: ...


def test_a_cycle_of_opcua_that_is_not_answered_ends_at_its_deadline_and_leaves_no_garbage() -> None:
    async def story() -> None:
        channel, inputs = Mute(), Inputs(2)
        link = OpcUaLink("server", "opc.tcp://127.0.0.1:1", [], channel, 0.01)
        loop = asyncio.get_running_loop()
        with garbage() as found:
            link.trigger(loop.time())
            deadline_s = loop.time() + 0.01
            await link.collect(inputs, deadline_s)
            assert channel.asked == 1 and loop.time() >= deadline_s - loop_resolution_s()
        assert not found

    run(story)


def loop_resolution_s() -> float:
    """How much too early a timer of an event loop may be."""
    return time.get_clock_info("monotonic").resolution + 1e-3

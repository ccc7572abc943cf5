"""The proxy in front of servers that are not ours: transparent without faults, and frame by frame with them."""

import asyncio
import struct
from collections.abc import Awaitable, Callable

import pytest
from asyncua import Client, Server, ua
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from sim_plant.faults.mbap_frames import MbapFrames
from sim_plant.faults.opcua_frames import OpcUaFrames
from sim_plant.faults.parse import parse_fault
from sim_plant.faults.proxy import MODBUS_TCP, OPC_UA, TcpProxy
from sim_plant.faults.wire_faults import WireFaults

HOST = "127.0.0.1"
Reader, Writer = asyncio.StreamReader, asyncio.StreamWriter


def mbap(transaction: int, pdu: bytes, unit: int = 1) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


async def echo(reader: Reader, writer: Writer) -> None:
    """A device that answers with what it hears."""
    while data := await reader.read(65536):
        writer.write(data)
    writer.close()


class Rig:
    """A device of the test's own, the proxy in front of it, and a client."""

    def __init__(self, serve: Callable[[Reader, Writer], Awaitable[None]] = echo) -> None:
        self.faults = WireFaults(MbapFrames())
        self._serve = serve

    async def __aenter__(self) -> "Rig":
        self.server = await asyncio.start_server(self._serve, HOST, 0)
        self.proxy = TcpProxy(self.faults, MODBUS_TCP, HOST, self.server.sockets[0].getsockname()[1])
        self.port = await self.proxy.open(HOST, 0)
        self.reader, self.writer = await asyncio.open_connection(HOST, self.port)
        return self

    async def __aexit__(self, *error: object) -> None:
        self.writer.close()
        await self.proxy.close()
        self.server.close()
        await self.server.wait_closed()

    def begin(self, text: str) -> int:
        injection = parse_fault(text)
        return self.faults.begin(injection, injection.target.number)

    async def exchange(self, frame: bytes) -> bytes:
        self.writer.write(frame)
        return await self.reader.readexactly(len(frame))


def run(test: Callable[[Rig], Awaitable[None]], rig: Rig | None = None) -> None:
    async def whole() -> None:
        async with rig or Rig() as there:
            await test(there)

    asyncio.run(whole())


def test_frames_pass_in_whatever_segments_they_come():
    async def test(rig: Rig) -> None:
        frames = b"".join(mbap(k, b"\3" + bytes(k)) for k in range(200))
        for piece in (frames[k : k + 37] for k in range(0, len(frames), 37)):
            rig.writer.write(piece)
            await rig.writer.drain()
        assert await rig.reader.readexactly(len(frames)) == frames

    run(test)


@pytest.mark.parametrize("stream", [b"GET / HTTP/1.1\r\n\r\n", mbap(1, b"\3") + b"\0\1\0\0\xff\xff\1\3", bytes(100)])
def test_what_is_no_modbus_passes_too(stream):
    async def test(rig: Rig) -> None:
        assert await rig.exchange(stream) == stream
        assert await rig.exchange(b"more") == b"more"

    run(test)


def test_a_half_closed_connection_delivers_what_is_under_way_and_ends():
    async def test(rig: Rig) -> None:
        rig.writer.write(mbap(1, b"\3abc") + b"\0\2\0")  # the second frame never becomes whole
        rig.writer.write_eof()
        assert await rig.reader.read() == mbap(1, b"\3abc") + b"\0\2\0"

    run(test)


def test_a_large_answer_waits_for_a_client_that_does_not_read():
    size = 20_000_000

    async def talk(reader: Reader, writer: Writer) -> None:
        await reader.readexactly(1)
        writer.write(b"\xff" * size)
        await writer.drain()
        writer.close()

    async def test(rig: Rig) -> None:
        rig.writer.write(b"\xff" * 8)
        assert len(await rig.reader.read(-1)) == size

    run(test, Rig(talk))


def test_a_device_that_closes_closes_the_client():
    async def close(reader: Reader, writer: Writer) -> None:
        await reader.readexactly(8)
        writer.write(mbap(1, b"\3"))
        writer.close()

    async def test(rig: Rig) -> None:
        rig.writer.write(mbap(1, b"\3"))
        assert await rig.reader.read() == mbap(1, b"\3")

    run(test, Rig(close))


def test_a_device_that_is_not_there_closes_the_client():
    async def test(rig: Rig) -> None:
        rig.server.close()
        reader, writer = await asyncio.open_connection(HOST, rig.port)
        assert await reader.read() == b""
        writer.close()

    run(test)


def test_faults_act_frame_by_frame_and_end():
    async def test(rig: Rig) -> None:
        number = rig.begin("modbus-tcp drop count=1 direction=to-device")
        assert await exchange_after_loss(rig) == mbap(2, b"\4")
        rig.faults.end(number)
        number = rig.begin("modbus-tcp 1 duplicate direction=from-device")
        rig.writer.write(mbap(3, b"\4"))
        assert await rig.reader.readexactly(16) == mbap(3, b"\4") * 2
        assert await rig.exchange(mbap(4, b"\4", unit=2)) == mbap(4, b"\4", unit=2)
        rig.faults.end(number)
        assert await rig.exchange(mbap(5, b"\4")) == mbap(5, b"\4")

    async def exchange_after_loss(rig: Rig) -> bytes:
        rig.writer.write(mbap(1, b"\4"))
        return await rig.exchange(mbap(2, b"\4"))

    run(test)


def test_late_frames_are_overtaken_and_come():
    async def test(rig: Rig) -> None:
        rig.begin("modbus-tcp delay delay_s=0.05 count=1")
        rig.writer.write(mbap(1, b"\4") + mbap(2, b"\4"))
        assert await rig.reader.readexactly(16) == mbap(2, b"\4") + mbap(1, b"\4")

    run(test)


def test_disconnected_connections_break_and_new_ones_are_refused_until_it_ends():
    async def test(rig: Rig) -> None:
        assert await rig.exchange(mbap(1, b"\4")) == mbap(1, b"\4")
        number = rig.begin("modbus-tcp disconnect")
        assert await rig.reader.read() == b""
        reader, writer = await asyncio.open_connection(HOST, rig.port)
        assert await reader.read() == b""
        writer.close()
        rig.faults.end(number)
        rig.writer.close()
        rig.reader, rig.writer = await asyncio.open_connection(HOST, rig.port)
        assert await rig.exchange(mbap(1, b"\4")) == mbap(1, b"\4")

    run(test)


def test_pymodbus_through_the_proxy():
    async def test() -> None:
        device = SimDevice(1, simdata=[SimData(0, values=[17, 4], datatype=DataType.REGISTERS)])
        server = ModbusTcpServer([device], address=(HOST, 0))
        await server.serve_forever(background=True)
        assert server.transport is not None
        faults = WireFaults(MbapFrames())
        proxy = TcpProxy(faults, MODBUS_TCP, HOST, server.transport.sockets[0].getsockname()[1])
        client = AsyncModbusTcpClient(HOST, port=await proxy.open(HOST, 0), retries=0, timeout=1.0)
        try:
            assert await client.connect()
            assert (await client.read_holding_registers(0, count=2, device_id=1)).registers == [17, 4]
            faults.begin(parse_fault("modbus-tcp freeze"), None)
            assert (await client.read_holding_registers(0, count=2, device_id=1)).registers == [17, 4]
            await client.write_register(0, 99, device_id=1)
            assert (await client.read_holding_registers(0, count=2, device_id=1)).registers == [17, 4]
            assert (await client.read_holding_registers(0, count=1, device_id=1)).registers == [99]
        finally:
            client.close()
            await proxy.close()
            await server.shutdown()

    asyncio.run(test())


def test_asyncua_through_the_proxy():
    async def test() -> None:
        server = Server()
        await server.init()
        server.set_endpoint(f"opc.tcp://{HOST}:0/")
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        node = await server.nodes.objects.add_variable(ua.NodeId("Speed", 2), "Speed", 1.5)
        await server.start()
        assert server.bserver is not None and server.bserver._server is not None  # noqa: SLF001
        device_port = server.bserver._server.sockets[0].getsockname()[1]  # noqa: SLF001
        faults = WireFaults(OpcUaFrames())
        proxy = TcpProxy(faults, OPC_UA, HOST, device_port)
        port = await proxy.open(HOST, 0)
        try:
            async with Client(f"opc.tcp://{HOST}:{port}/", timeout=2.0, watchdog_intervall=1e6) as client:
                speed = client.get_node(ua.NodeId("Speed", 2))
                assert await speed.read_value() == 1.5
                number = faults.begin(parse_fault("opcua freeze"), None)
                assert await speed.read_value() == 1.5
                await node.write_value(2.5)
                assert await speed.read_value() == 1.5  # old values again
                faults.end(number)
                assert await speed.read_value() == 2.5
        finally:
            await proxy.close()
            await server.stop()

    asyncio.run(test())

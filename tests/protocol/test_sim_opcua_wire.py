"""The OPC UA face of the simulated line against peers that are no good clients, and the bytes of its short way."""

import asyncio
import gc
import struct
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime

import pytest
from asyncua import Client, ua
from asyncua.common.utils import Buffer, NotEnoughData
from asyncua.ua.ua_binary import struct_from_binary, struct_to_binary, variant_from_binary
from hypothesis import given
from hypothesis import strategies as st

from sim_plant.faces.opcua import OpcUaFace
from sim_plant.faces.opcua_codec import MAX_NODES, encode_read, encode_write, parse_write, plan_read
from sim_plant.faces.opcua_nodes import Kind, Scalar, Status, Variable
from sim_plant.faces.opcua_sockets import MAX_CHUNK, MAX_MESSAGE
from sim_plant.faces.opcua_stack import MAX_CONNECTIONS

V = ua.VariantType
HELLO = struct.pack("<4sIIIIIIi", b"HELF", 32, 0, 65536, 65536, 0, 0, -1)
TOO_LARGE = 0x80800000  # BadTcpMessageTooLarge

PLAIN = [kind for kind in Kind if kind is not Kind.STRING]  #: the stack answers for texts


class _Bare:
    """A device that takes everything and shows what it was given."""

    name = "Bare"

    def __init__(self) -> None:
        self.values: dict[str, Scalar] = {kind.name: kind.zero for kind in PLAIN}
        self.status = Status.GOOD

    def variables(self) -> list[Variable]:
        def reader(kind: Kind) -> Callable[[], Scalar]:
            return lambda: self.values[kind.name]

        return [
            Variable(self, kind.name, kind, reader(kind), accepts=lambda _: True, status=lambda: self.status)
            for kind in PLAIN
        ]

    def sample(self, now_s: float) -> None: ...

    def apply(self, written: object, now_s: float) -> None: ...


BARE = _Bare()
VARIABLES = {variable.node_name: variable for variable in BARE.variables()}
VALUES = {
    Kind.BOOLEAN: st.booleans(),
    Kind.UINT16: st.integers(0, 0xFFFF),
    Kind.UINT32: st.integers(0, 0xFFFFFFFF),
    Kind.DOUBLE: st.floats(allow_nan=False),
}
written = st.sampled_from(list(VALUES)).flatmap(lambda kind: st.tuples(st.just(kind), VALUES[kind]))
stamp = st.none() | st.just(datetime(2024, 1, 1, tzinfo=UTC))


def read_body(names: list[str], stamps: ua.TimestampsToReturn = ua.TimestampsToReturn.Source) -> bytes:
    nodes = [ua.ReadValueId(ua.NodeId(name, 2), ua.AttributeIds.Value) for name in names]
    return struct_to_binary(ua.ReadParameters(TimestampsToReturn=stamps, NodesToRead=nodes))


def write_body(values: list[tuple[Kind, Scalar]], source: datetime | None, server: datetime | None) -> bytes:
    nodes = []
    for kind, value in values:
        data = ua.DataValue(ua.Variant(value, V(kind)), SourceTimestamp=source, ServerTimestamp=server)
        nodes.append(ua.WriteValue(ua.NodeId(f"Bare.{kind.name}", 2), ua.AttributeIds.Value, None, data))
    return struct_to_binary(ua.WriteParameters(NodesToWrite=nodes))


@given(st.lists(written, min_size=1, max_size=8), stamp, stamp)
def test_written_values_are_read_from_the_bytes(
    values: list[tuple[Kind, Scalar]], source: datetime | None, server: datetime | None
) -> None:
    found = parse_write(write_body(values, source, server), VARIABLES, 2)
    assert found is not None
    assert [(w.variable.kind, w.kind, w.value) for w in found] == [(kind, kind, value) for kind, value in values]


@given(
    st.fixed_dictionaries(VALUES),
    st.lists(st.sampled_from(list(VARIABLES)), min_size=1),
    st.sampled_from(list(ua.TimestampsToReturn)[:4]),
    st.sampled_from([Status.GOOD, Status.UNCERTAIN_SENSOR_NOT_ACCURATE, Status.BAD_SENSOR_FAILURE]),
    st.integers(0, 0xFFFFFFFF),
)
def test_the_response_is_what_a_client_decodes(
    values: dict[Kind, Scalar], names: list[str], stamps: ua.TimestampsToReturn, status: Status, handle: int
) -> None:
    BARE.values = {kind.name: value for kind, value in values.items()}
    BARE.status = status
    plan = plan_read(read_body(names, stamps), VARIABLES, 2)
    assert plan is not None and [v.node_name for v in plan.variables] == names
    moment = datetime(2024, 2, 29, 12, tzinfo=UTC)
    response = struct_from_binary(ua.ReadResponse, Buffer(encode_read(plan, handle, ua.datetime_to_win_epoch(moment))))
    assert response.TypeId == ua.NodeId(ua.ObjectIds.ReadResponse_Encoding_DefaultBinary)
    assert response.ResponseHeader.RequestHandle == handle and response.ResponseHeader.Timestamp == moment
    both = ua.TimestampsToReturn.Both
    for name, data in zip(names, response.Results, strict=True):
        kind = VARIABLES[name].kind
        # asyncua shows a status that was left out, which is a good one, as none.
        assert (data.StatusCode.value if data.StatusCode else 0) == status
        shown = None if status.is_bad else ua.Variant(values[kind], V(kind))
        assert data.Value == shown or (shown is None and data.Value.Value is None)
        assert data.SourceTimestamp == (moment if stamps in (ua.TimestampsToReturn.Source, both) else None)
        assert data.ServerTimestamp == (moment if stamps in (ua.TimestampsToReturn.Server, both) else None)


def test_the_answer_to_a_write() -> None:
    encoded = encode_write([Status.GOOD, Status.BAD_OUT_OF_RANGE], 7, 0)
    response = struct_from_binary(ua.WriteResponse, Buffer(encoded))
    assert response.TypeId == ua.NodeId(ua.ObjectIds.WriteResponse_Encoding_DefaultBinary)
    assert [status.value for status in response.Results] == [0, ua.StatusCodes.BadOutOfRange]


@given(st.data())
def test_no_bytes_break_the_short_way(data: st.DataObject) -> None:
    good = data.draw(
        st.sampled_from([read_body(list(VARIABLES)), write_body([(k, k.zero) for k in PLAIN], None, None)])
    )
    body = bytearray(good)
    for _ in range(data.draw(st.integers(1, 6))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(body[: data.draw(st.integers(0, len(body)))])
    plan = plan_read(cut, VARIABLES, 2)
    assert plan is None or all(variable in VARIABLES.values() for variable in plan.variables)
    for value in parse_write(cut, VARIABLES, 2) or ():
        assert value.variable in VARIABLES.values()


def test_what_is_not_plain_is_left_to_the_stack() -> None:
    ids = ua.AttributeIds
    node = ua.NodeId("Bare.DOUBLE", 2)
    data = ua.DataValue(ua.Variant(1.0, V.Double))
    for item in (
        ua.ReadValueId(ua.NodeId("Bare.DOUBLE", 1), ids.Value),
        ua.ReadValueId(ua.NodeId("Bare.FLOAT", 2), ids.Value),
        ua.ReadValueId(ua.NodeId(2258), ids.Value),
        ua.ReadValueId(node, ids.DataType),
        ua.ReadValueId(node, ids.Value, IndexRange="0:1"),
        ua.ReadValueId(node, ids.Value, DataEncoding=ua.QualifiedName("Default Binary", 0)),
    ):
        assert plan_read(struct_to_binary(ua.ReadParameters(NodesToRead=[item])), VARIABLES, 2) is None
    for item in (
        ua.WriteValue(node, ids.DisplayName, None, data),
        ua.WriteValue(node, ids.Value, "0", data),
        ua.WriteValue(node, ids.Value, None, ua.DataValue(ua.Variant([1.0], V.Double))),
        ua.WriteValue(node, ids.Value, None, ua.DataValue(ua.Variant(1.0, V.Double), ua.StatusCode(0x80000000))),
        ua.WriteValue(node, ids.Value, None, ua.DataValue(ua.Variant("1"))),
    ):
        assert parse_write(struct_to_binary(ua.WriteParameters(NodesToWrite=[item])), VARIABLES, 2) is None
    assert plan_read(read_body([]), VARIABLES, 2) is None
    assert plan_read(read_body(["Bare.DOUBLE"] * (MAX_NODES + 1)), VARIABLES, 2) is None


class Target:
    """A face without devices on a port of its own."""

    def __init__(self) -> None:
        self.face = OpcUaFace({}, None, (), None, lambda: 0.0)
        self.port = 0

    @property
    def url(self) -> str:
        return f"opc.tcp://127.0.0.1:{self.port}/"

    async def stream(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection("127.0.0.1", self.port)

    async def greeted(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await self.stream()
        writer.write(HELLO)
        acknowledge = await reader.readexactly(28)
        assert acknowledge[:4] == b"ACKF"
        _, receive, send, message, chunks = struct.unpack("<5I", acknowledge[8:])
        assert max(receive, send) <= MAX_CHUNK and (message, chunks) == (MAX_MESSAGE, 4)
        return reader, writer

    async def serves(self) -> None:
        async with Client(self.url, timeout=5) as client:
            assert await client.get_namespace_index("urn:r2rgate:devices") == 2


def on_target(test: Callable[[Target], Awaitable[None]]) -> None:
    async def run() -> None:
        target = Target()
        target.port = await target.face.open("127.0.0.1", 0)
        try:
            async with asyncio.timeout(30):
                await test(target)
        finally:
            await target.face.close()
            assert asyncio.all_tasks() == {asyncio.current_task()}

    gc.freeze()
    try:
        asyncio.run(run())
    finally:
        gc.unfreeze()


async def ended(reader: asyncio.StreamReader) -> bytes:
    """What still comes before the other side closes."""
    try:
        return await reader.read()
    except ConnectionResetError:
        return b""


@pytest.mark.parametrize("size", [MAX_CHUNK + 1, 0x7FFFFFFF, 0xFFFFFFFF])
def test_a_message_that_says_it_is_too_large_is_refused_before_it_comes(size: int) -> None:
    async def test(target: Target) -> None:
        for reader, writer in (await target.stream(), await target.greeted()):
            writer.write(struct.pack("<4sII", b"MSGF", size, 0))  # and not a byte more
            told = await ended(reader)
            assert told[:4] == b"ERRF" and struct.unpack("<I", told[8:12]) == (TOO_LARGE,)
            writer.close()
        assert target.face.malformed == 2
        await target.serves()

    on_target(test)


GARBAGE = (
    b"GET / HTTP/1.1\r\n\r\n",
    bytes(64),
    b"MSGF" + struct.pack("<II", 8, 0),  # shorter than its own header
    b"XYZF" + struct.pack("<I8x", 16),
)


@pytest.mark.parametrize("garbage", GARBAGE)
def test_garbage_closes_its_own_connection_only(garbage: bytes) -> None:
    async def test(target: Target) -> None:
        async with Client(target.url, timeout=5) as bystander:
            reader, writer = await target.stream()
            writer.write(garbage)
            await ended(reader)
            writer.close()
            assert target.face.malformed == 1
            assert await bystander.get_namespace_index("urn:r2rgate:devices") == 2

    on_target(test)


def test_a_message_of_too_many_bytes_ends_the_connection() -> None:
    async def test(target: Target) -> None:
        client = Client(target.url, timeout=5)
        await client.connect()
        large = ua.DataValue(ua.Variant(bytes(2 * MAX_MESSAGE), V.ByteString))
        with pytest.raises((ConnectionError, ua.UaError, asyncio.TimeoutError)):
            await client.uaclient.write_attributes([ua.NodeId("Axis1.Life", 2)], [large], ua.AttributeIds.Value)
        await client.disconnect()
        assert target.face.malformed == 1
        await target.serves()

    on_target(test)


def test_values_that_would_not_end_are_refused() -> None:
    """A million nulls take six bytes on the wire, and a minute to decode without a bound."""

    async def test(target: Target) -> None:
        async with Client(target.url, timeout=5) as client:
            nulls = ua.DataValue(ua.Variant([None] * 1_000_000, V.Null))
            with pytest.raises(ua.uaerrors.BadDecodingError):
                await client.uaclient.write_attributes([ua.NodeId("Axis1.Life", 2)], [nulls], ua.AttributeIds.Value)
            assert target.face.malformed == 1
            with pytest.raises(ua.UaError, match="nulls"):
                variant_from_binary(Buffer(b"\x80\xff\xff\xff\x7f"))
            with pytest.raises(NotEnoughData):
                variant_from_binary(Buffer(b"\x0c\xfc\xff\xff\xff"))  # a string of -4 bytes
            assert variant_from_binary(Buffer(b"\x80\x02\x00\x00\x00")).Value == [None, None]

    on_target(test)


def test_no_service_without_a_secure_channel() -> None:
    async def test(target: Target) -> None:
        reader, writer = await target.greeted()
        body = struct_to_binary(ua.CreateSessionRequest())
        # Channel 0, token 0, sequence number and request id 1: as if a channel had been opened.
        writer.write(struct.pack("<4sIIIII", b"MSGF", 24 + len(body), 0, 0, 1, 1) + body)
        answer = await reader.readexactly(24)
        fault = struct_from_binary(ua.ServiceFault, Buffer(await reader.readexactly(answer[4] - 24)))
        assert fault.ResponseHeader.ServiceResult.value == ua.StatusCodes.BadServiceUnsupported
        writer.close()
        await writer.wait_closed()

    on_target(test)


def test_requests_of_too_many_nodes_are_refused() -> None:
    async def test(target: Target) -> None:
        async with Client(target.url, timeout=5) as client:
            many = [ua.NodeId(2258)] * (MAX_NODES + 1)
            with pytest.raises(ua.uaerrors.BadTooManyOperations):
                await client.uaclient.read_attributes(many, ua.AttributeIds.Value)
            with pytest.raises(ua.uaerrors.BadTooManyOperations):
                await client.uaclient.browse(
                    ua.BrowseParameters(NodesToBrowse=[ua.BrowseDescription(NodeId=node) for node in many])
                )
            assert len(await client.uaclient.read_attributes(many[1:], ua.AttributeIds.Value)) == MAX_NODES
            assert target.face.malformed == 0

    on_target(test)


def test_connections_are_limited() -> None:
    async def test(target: Target) -> None:
        streams = [await target.greeted() for _ in range(MAX_CONNECTIONS)]
        reader, writer = await target.stream()
        assert await ended(reader) == b""
        writer.close()
        for _, other in streams:
            other.close()
            await other.wait_closed()
        await target.serves()

    on_target(test)


def test_clients_that_die_keep_nobody_out() -> None:
    async def test(target: Target) -> None:
        for _ in range(MAX_CONNECTIONS + 1):
            client = Client(target.url, timeout=5)
            await client.connect()
            await client.create_subscription(1000, object())
            client.disconnect_socket()  # the session is not closed
            await client.disconnect()
            for task in asyncio.all_tasks():  # the client forgets its own when its socket has died
                if task.get_coro().__qualname__.startswith("UaSession."):
                    task.cancel()
        await target.serves()

    on_target(test)


def test_a_request_may_come_byte_by_byte() -> None:
    async def test(target: Target) -> None:
        reader, writer = await target.stream()
        for byte in HELLO:
            writer.write(bytes((byte,)))
            await writer.drain()
            await asyncio.sleep(0)
        assert (await reader.readexactly(28))[:4] == b"ACKF"
        writer.close()
        await writer.wait_closed()

    on_target(test)


def test_sessions_live_ten_seconds_without_a_word() -> None:
    async def test(target: Target) -> None:
        client = Client(target.url, timeout=5)
        client.session_timeout = 3_600_000
        async with client:
            assert client.session_timeout <= 10_000

    on_target(test)

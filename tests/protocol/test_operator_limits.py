"""What clients may have of the OPC UA server at most: hostile bytes, too much of anything, and clients that die."""

import asyncio
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from asyncua import Client, ua

from gateway.operator.opcua import limits
from tests.protocol.operator_support import PASSWORD, bench

CODES = ua.StatusCodes


def run(story):
    asyncio.run(asyncio.wait_for(story(), 60.0))


def bomb(count: int = 50_000_000) -> ua.Variant:
    """A few bytes that say: so many nulls."""
    return ua.Variant(range(count), ua.VariantType.Null, is_array=True)


async def plain(b) -> Client:
    """A channel without security, as everybody may open."""
    client = Client(b.url, timeout=10.0)
    await client.connect_socket()
    await client.send_hello()
    await client.open_secure_channel()
    return client


def connections(b) -> list:
    return b.opcua.server.bserver.clients


async def answered(b) -> None:
    """The server serves somebody else."""
    async with b.connected("vera") as client:
        assert (await b.read(client, "Line.Limits.TensionMax")).StatusCode.is_good()


async def nothing_left(b) -> None:
    """Of sessions and subscriptions; the test's time limit ends what never comes."""
    while b.sessions() or b.opcua.server.iserver.subscription_service.subscriptions:  # noqa: ASYNC110
        await asyncio.sleep(0.01)


def test_an_array_of_nulls_is_not_unpacked_from_strangers_nor_from_users():
    async def story():
        async with bench(spans=1) as b:
            client = await plain(b)
            request = ua.GetEndpointsRequest()
            request.RequestHeader.AdditionalHeader = ua.LiteralOperand(Value=bomb())
            with pytest.raises((ConnectionError, ua.UaError)):
                await client.uaclient.protocol.send_request(request)
            client.disconnect_socket()
            async with b.connected("otto") as user:
                request = ua.CallMethodRequest(b.id("Line"), b.id("Line.Rollback"), [bomb()])
                with pytest.raises(ua.uaerrors.BadDecodingError):
                    await user.uaclient.call([request])
            await answered(b)
            assert b.gateway.heard == []

    run(story)


async def ends_with(b, payload: bytes) -> int:
    """The code of the error message with which the server ends a connection that says so; 0: without one."""
    reader, writer = await asyncio.open_connection("127.0.0.1", b.opcua.server.port)
    writer.write(payload)
    try:
        told = await reader.read()
    except ConnectionError:
        told = b""
    finally:
        writer.close()
    return struct.unpack_from("<I", told, 8)[0] if told[:4] == b"ERRF" else 0


def test_bytes_that_are_no_opc_ua_end_their_connection_and_no_other():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            assert await ends_with(b, b"OPNF" + struct.pack("<I", 50_000_000)) == CODES.BadTcpMessageTooLarge
            for payload in (
                b"GET / HTTP/1.1\r\n\r\n" + bytes(64), b"OPNF" + struct.pack("<I", 12) + bytes(4),
                b"MSGF" + struct.pack("<IIIII", 24, 1, 1, 1, 1), b"HELF" + struct.pack("<II", 8, 0) + bytes(40),
            ):  # fmt: skip
                await ends_with(b, payload)
            assert (await b.read(client, "Line.Limits.TensionMax")).StatusCode.is_good()
            await answered(b)

    run(story)


def hello(receive: int, send: int) -> bytes:
    """`receive`, `send`: the largest chunk that the client takes and sends."""
    return b"HELF" + struct.pack("<IIIIIIi", 32, 0, receive, send, 0, 0, -1)


@pytest.mark.parametrize(("receive", "send"), [(0, 0), (25, 65_535), (65_535, 25), (8191, 8192)])
def test_a_client_that_takes_or_sends_crumbs_is_refused(receive, send):
    async def story():
        async with bench(spans=1) as b:
            assert await ends_with(b, hello(receive, send)) == CODES.BadTcpNotEnoughResources
            await answered(b)

    run(story)


def test_a_client_with_the_least_buffers_that_there_may_be_is_heard():
    async def story():
        async with bench(spans=1) as b:
            reader, writer = await asyncio.open_connection("127.0.0.1", b.opcua.server.port)
            writer.write(hello(8192, 8192))
            assert (await reader.readexactly(28))[:4] == b"ACKF"
            writer.close()

    run(story)


def test_a_connection_that_does_not_finish_closing_is_ended(monkeypatch):
    """Its client reads none of what is still to be sent to it, and holds a place as long as it likes."""
    monkeypatch.setattr(limits, "LOGIN_S", 600.0)

    async def story():
        async with bench(spans=1) as b:
            reader, writer = await asyncio.open_connection("127.0.0.1", b.opcua.server.port, limit=1)
            while not connections(b):  # noqa: ASYNC110
                await asyncio.sleep(0.01)
            (held,) = connections(b)
            held.transport.write(bytes(30_000_000))  # more than the kernel takes
            held.transport.close()
            for _ in range(20):
                await asyncio.sleep(0)
            assert connections(b) == [held]
            b.opcua.server.end_strangers()
            while connections(b):  # noqa: ASYNC110
                await asyncio.sleep(0.01)
            writer.transport.abort()

    run(story)


def test_a_client_that_asks_much_at_once_waits_its_turn():
    """Its forty questions are on their way before the other's one, which is answered among them."""

    async def story():
        async with bench(spans=1) as b, b.connected("vera") as greedy, b.connected("otto") as other:
            many = ua.ReadParameters(NodesToRead=[ua.ReadValueId(ua.NodeId(2258), ua.AttributeIds.Value)] * 100)
            asked = [asyncio.create_task(greedy.uaclient.read(many)) for _ in range(40)]
            while not any(task.done() for task in asked):  # noqa: ASYNC110 (the other has to be heard amid them)
                await asyncio.sleep(0)
            await b.read(other, "Line.Limits.TensionMax")
            left = sum(not task.done() for task in asked)
            await asyncio.gather(*asked)
            assert left > 20

    run(story)


def test_a_message_of_too_many_chunks_is_refused():
    async def story():
        async with bench(spans=1) as b:
            client = await b.client("otto")
            await client.connect()
            long = ua.Variant("x" * (limits.MAX_MESSAGE + 1), ua.VariantType.String)
            request = ua.CallMethodRequest(b.id("Line"), b.id("Line.Rollback"), [long])
            with pytest.raises((ConnectionError, ua.UaError, asyncio.TimeoutError)):
                await client.uaclient.call([request])
            client.disconnect_socket()
            await answered(b)
            assert b.gateway.heard == []

    run(story)


def test_there_are_no_more_sessions_than_the_lines_file_lets_be():
    async def story():
        async with bench(spans=1, sessions_max=1) as b:
            async with b.connected("vera"):
                with pytest.raises(ua.uaerrors.BadTooManySessions):
                    async with await b.client("otto"):
                        pass
            await answered(b)

    run(story)


def test_connections_that_never_log_in_are_few_and_short(monkeypatch):
    monkeypatch.setattr(limits, "LOGIN_S", 0.3)

    async def story():
        async with bench(spans=1, sessions_max=1) as b:
            most = 1 + limits.MORE_CONNECTIONS
            opened = [await asyncio.open_connection("127.0.0.1", b.opcua.server.port) for _ in range(most + 3)]
            ended = [await reader.read() for reader, _ in opened]  # all come to an end, by the server
            assert ended == [b""] * len(opened)
            for _, writer in opened:
                writer.close()
            await answered(b)

    run(story)


def test_too_much_in_one_request_is_refused():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            assert (
                limits.MAX_READ
                == await client.get_node(
                    ua.ObjectIds.Server_ServerCapabilities_OperationLimits_MaxNodesPerRead
                ).read_value()
            )
            one = ua.ReadValueId(ua.NodeId(2258), ua.AttributeIds.Value)
            asked = [
                client.uaclient.read(ua.ReadParameters(NodesToRead=[one] * (limits.MAX_READ + 1))),
                client.uaclient.browse(ua.BrowseParameters(
                    NodesToBrowse=[ua.BrowseDescription()] * (limits.MAX_BROWSE + 1))),
                client.uaclient.call([ua.CallMethodRequest(b.id("Line"), b.id("Line.Stop"), [])]
                                     * (limits.MAX_CALLS + 1)),
            ]  # fmt: skip
            for request in asked:
                with pytest.raises(ua.uaerrors.BadTooManyOperations):
                    await request

    run(story)


def test_subscriptions_are_bounded_in_speed_number_and_length(monkeypatch):
    monkeypatch.setattr(limits, "SUBSCRIPTIONS_EACH", 2)

    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            subscription = await client.create_subscription(0, None)
            held = b.opcua.server.iserver.subscription_service.subscriptions[subscription.subscription_id]
            assert held.data.RevisedPublishingInterval == limits.PUBLISHING_MS[0]
            item = ua.MonitoredItemCreateRequest()
            item.ItemToMonitor.NodeId, item.RequestedParameters.QueueSize = b.id("Line.Spans.1.Tension"), 10_000_000
            item.ItemToMonitor.AttributeId = ua.AttributeIds.Value
            params = ua.CreateMonitoredItemsParameters(SubscriptionId=subscription.subscription_id)
            params.ItemsToCreate = [item]
            (made,) = await client.uaclient.create_monitored_items(params)
            assert made.RevisedQueueSize == limits.MAX_QUEUE
            params.ItemsToCreate = [item] * limits.MAX_MONITORED
            with pytest.raises(ua.uaerrors.BadTooManyMonitoredItems):
                await client.uaclient.create_monitored_items(params)
            another = await client.create_subscription(100, None)
            params.SubscriptionId = another.subscription_id  # all of a session count together
            with pytest.raises(ua.uaerrors.BadTooManyMonitoredItems):
                await client.uaclient.create_monitored_items(params)
            with pytest.raises(ua.uaerrors.BadTooManySubscriptions):
                await client.create_subscription(100, None)
            held = b.opcua.server.iserver.subscription_service.subscriptions[another.subscription_id]
            assert held._no_acks_limit == limits.MAX_UNACKNOWLEDGED == 20  # noqa: SLF001 (nothing tells it)
            async with b.connected("otto") as other:  # others have theirs
                await other.create_subscription(100, None)

    run(story)


def test_of_a_client_that_is_killed_in_mid_subscription_nothing_stays():
    async def story():
        async with bench(spans=1) as b:
            client = await b.client("vera")
            await client.connect()
            subscription = await client.create_subscription(50, None)
            await subscription.subscribe_data_change(client.get_node(b.id("Line.Spans.1.Tension")))
            client.uaclient.protocol.transport.abort()
            await nothing_left(b)
            client.disconnect_socket()
            await answered(b)

    run(story)


def test_of_a_client_that_falls_silent_nothing_stays_either(monkeypatch):
    monkeypatch.setattr(limits, "SESSION_TIMEOUT_MS", (100, 300))

    async def story():
        async with bench(spans=1) as b:
            client = await b.client("vera")
            await client.connect_socket()
            await client.send_hello()
            await client.open_secure_channel()
            await client.create_session()
            await client.activate_session(username="vera", password="three old rollers")
            await client.uaclient.create_subscription(
                ua.CreateSubscriptionParameters(RequestedPublishingInterval=50.0, PublishingEnabled=True), print
            )
            client.uaclient.protocol.transport.pause_reading()  # as one that was stopped
            await nothing_left(b)
            client.disconnect_socket()

    run(story)


@asynccontextmanager
async def from_elsewhere(b) -> AsyncIterator[None]:
    """Clients reach the server from another address."""

    async def taken(reader, writer):
        onward = await asyncio.open_connection("127.0.0.1", b.opcua.server.port, local_addr=("127.0.0.2", 0))
        await asyncio.gather(passed_on(reader, onward[1]), passed_on(onward[0], writer))

    async def passed_on(reader, writer):
        try:
            while data := await reader.read(65536):
                writer.write(data)
        except ConnectionError:
            pass
        writer.close()

    server = await asyncio.start_server(taken, "127.0.0.1", 0)
    b.port = server.sockets[0].getsockname()[1]
    try:
        yield
    finally:
        b.port = None
        server.close()


def test_who_floods_keeps_nobody_out_neither_from_elsewhere_nor_from_there():
    async def story():
        async with bench(spans=1, sessions_max=3) as b, b.connected("vera") as before:
            flood = []

            async def more():
                flood.append(await asyncio.open_connection("127.0.0.1", b.opcua.server.port))

            for _ in range(10 * limits.MORE_CONNECTIONS):
                await more()
            assert (await b.read(before, "Line.Limits.TensionMax")).StatusCode.is_good()
            async with from_elsewhere(b):
                client = await b.client("otto")
                await client.connect()
                for _ in range(3 * limits.MORE_CONNECTIONS):
                    await more()
                assert (await b.read(client, "Line.Limits.TensionMax")).StatusCode.is_good()
                await client.disconnect()
            client = await b.client("otto")  # the oldest that says nothing gives way to it
            await client.connect_socket()
            await client.send_hello()
            await client.open_secure_channel()
            for _ in range(3 * limits.MORE_CONNECTIONS):
                await more()
            await client.create_session()
            await client.activate_session(username="otto", password=PASSWORD)
            assert (await b.read(client, "Line.Limits.TensionMax")).StatusCode.is_good()
            await client.disconnect()
            for _, writer in flood:
                writer.close()

    run(story)


@pytest.mark.parametrize("most", [2, 4])
def test_one_address_does_not_get_all_sessions(most):
    async def story():
        async with bench(spans=1, sessions_max=most) as b:
            held = [await b.client("otto") for _ in range(most - 1)]
            for one in held:
                await one.connect()
            with pytest.raises(ua.uaerrors.BadTooManySessions):
                async with await b.client("otto"):
                    pass
            async with from_elsewhere(b), b.connected("vera"):
                assert b.sessions() == most
            for one in held:
                await one.disconnect()

    run(story)


def test_a_session_to_which_nobody_logs_in_does_not_stay_whatever_was_there_before(monkeypatch):
    async def story():
        async with bench(spans=1) as b:
            client = await b.client("otto")
            await client.connect()
            monkeypatch.setattr(limits, "LOGIN_S", 0.0)
            b.opcua.server.end_strangers()
            assert (await b.read(client, "Line.Limits.TensionMax")).StatusCode.is_good()  # who is in may stay
            try:
                await client.create_session()  # in place of the first, and nobody logs in to it
            except (ConnectionError, ua.UaError):
                pass  # out already
            await nothing_left(b)
            client.disconnect_socket()

    run(story)

"""How requests leave a session: on asyncua's client with a transport that only keeps what it is given. No server."""

import asyncio
from typing import Any, cast

import pytest
from asyncua import ua
from asyncua.client.client import Client
from asyncua.client.ua_client import UASocketProtocol
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import header_from_binary, struct_from_binary

from drivers.opcua.services import Request, Services
from drivers.opcua.session import LAST_NUMBER, Session


class KeptTransport:
    def __init__(self) -> None:
        self.writes: list[bytes] = []

    def write(self, data: bytes) -> None:
        self.writes.append(data)


def opened() -> tuple[Session, KeptTransport]:
    client = Client("opc.tcp://127.0.0.1:1")
    protocol, transport = UASocketProtocol(), KeptTransport()
    protocol.connection_made(cast(asyncio.Transport, transport))
    client.uaclient.protocol = protocol
    return Session(client, []), transport


def requests() -> list[Request]:
    services = Services([b"\x00\x01"], ["u16"])
    return [services.write([(0, 7.0)]), services.read((0,))]


def next_request(sent: Buffer, kind: type) -> Any:
    header = header_from_binary(sent)
    assert (header.MessageType, header.ChunkType) == (ua.MessageType.SecureMessage, ua.ChunkType.Single)
    body = sent.read(header.body_size)[12:]  # behind token, sequence number and request number
    return struct_from_binary(kind, Buffer(body))


def test_write_and_read_are_one_write_of_two_messages_in_this_order() -> None:
    """Two would be two packets: the server answers the first, and the second waits for the next turn of the loop."""

    async def scene() -> None:
        session, transport = opened()
        answers = session.ask(requests())
        [sent] = transport.writes
        rest = Buffer(sent)
        write, read = next_request(rest, ua.WriteRequest), next_request(rest, ua.ReadRequest)
        assert len(rest) == 0
        assert write.Parameters.NodesToWrite[0].Value.Value.Value == 7
        assert read.Parameters.NodesToRead[0].NodeId == ua.NodeId(1, 0)
        assert write.RequestHeader.RequestHandle != read.RequestHeader.RequestHandle
        assert len(answers) == 2 and not any(answer.done() for answer in answers)

    asyncio.run(scene())


def test_nothing_is_asked_on_a_connection_that_is_lost() -> None:
    async def scene() -> None:
        session, transport = opened()
        protocol: Any = session._client.uaclient.protocol  # noqa: SLF001
        protocol.connection_lost(None)
        with pytest.raises(ConnectionError, match="connection lost"):
            session.ask(requests())
        assert transport.writes == []

    asyncio.run(scene())


def test_request_numbers_and_handles_begin_again_after_the_last_and_are_never_0() -> None:
    async def scene() -> None:
        session, transport = opened()
        protocol: Any = session._client.uaclient.protocol  # noqa: SLF001
        protocol._request_id = protocol._request_handle = LAST_NUMBER - 1  # noqa: SLF001
        answers = session.ask(requests()) + session.ask(requests())
        rest = Buffer(b"".join(transport.writes))
        numbers, handles = [], []
        for kind in 2 * [ua.WriteRequest, ua.ReadRequest]:
            header = header_from_binary(rest)
            sent = rest.read(header.body_size)
            numbers.append(int.from_bytes(sent[8:12], "little"))
            handles.append(struct_from_binary(kind, Buffer(sent[12:])).RequestHeader.RequestHandle)
        assert numbers == handles == [LAST_NUMBER, 1, 2, 3]
        assert len(answers) == 4 and set(protocol._callbackmap) == set(numbers)  # noqa: SLF001

    asyncio.run(scene())

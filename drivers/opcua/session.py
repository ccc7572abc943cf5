"""A connection to a server with its channel and session, and requests on it, by asyncua's client.

asyncua connects, secures and cuts messages into chunks. What the messages say is known elsewhere (`services`); when to
connect again is decided there, too, and nothing is subscribed to.
"""

import asyncio
import logging
import re
import socket
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from asyncua import ua
from asyncua.client.client import Client
from asyncua.client.ua_client import UaClientState
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import load_certificate
from asyncua.ua.ua_binary import nodeid_to_binary
from cryptography import x509

from drivers.opcua.messages import Plan
from drivers.opcua.nodes import Node
from drivers.opcua.services import Misfit, Request
from gateway.tasks.cleanup import finish

CONNECT_TIMEOUT_S = 2.0  #: per request while connecting
CLOSE_TIMEOUT_S = 0.5
SESSION_TIMEOUT_MS = 30_000  #: how long a server keeps the session of an engine that was killed
_NO_PROBES_S = 1e9  #: asyncua's own health check reads beside the cycle: the cycle itself is the check
#: Numbers have 32 bits. asyncua counts on from ours for what it sends itself, and does not wrap: room is left for that.
LAST_NUMBER = 2**32 - 1 - 2**16
_TIMEOUT_HINT_MS = int(1e3 * CONNECT_TIMEOUT_S)

# What goes wrong is told in answers and counted in the link's health; it does not belong on the terminal as well.
logging.getLogger("asyncua").addHandler(logging.NullHandler())


def next_number(number: int) -> int:
    """The request number or handle that follows: after `LAST_NUMBER` it is 1 again, and it is never 0."""
    return number + 1 if 0 < number < LAST_NUMBER else 1


class Session:
    """A session that has been opened. `nodes` are the encoded ids of the plan's nodes on this server."""

    def __init__(self, client: Client, nodes: list[bytes]) -> None:
        self.nodes = nodes
        self._client = client
        protocol = client.uaclient.protocol
        if protocol is None:
            raise ConnectionError("connection lost")
        self._token = nodeid_to_binary(protocol.authentication_token)

    @classmethod
    async def open(cls, plan: Plan) -> "Session":
        """Connect. Raises whatever asyncua does, on bytes that are no answer also what Python does."""
        client = Client(plan.endpoint, timeout=CONNECT_TIMEOUT_S, watchdog_intervall=_NO_PROBES_S)
        client.name = client.description = "r2rgate"
        client.session_timeout = SESSION_TIMEOUT_MS
        try:
            await _secure(client, plan)
            await client.connect()
            return cls(client, _node_ids(plan.nodes, await client.get_namespace_array()))
        except BaseException as error:
            if isinstance(error, asyncio.CancelledError):
                _reset(client)  # nobody waits for a server now
            await _disconnect(client)
            raise

    @property
    def is_open(self) -> bool:
        return self._client.uaclient.state is UaClientState.CONNECTED

    def ask(self, requests: Sequence[Request]) -> list[asyncio.Future[Any]]:
        """Send all of them, in one piece. The answers are bytes-like, in no certain order. Raises ConnectionError."""
        protocol: Any = self._client.uaclient.protocol
        if protocol is None or protocol.transport is None:
            raise ConnectionError("connection lost")
        protocol.revolve_security_token()
        answers: list[asyncio.Future[Any]] = []
        messages: list[bytes] = []
        # asyncua's own way to send takes a tree of objects for each request, and one write.
        for request in requests:
            protocol._request_handle = next_number(protocol._request_handle)  # noqa: SLF001
            protocol._request_id = next_number(protocol._request_id)  # noqa: SLF001
            number = protocol._request_id  # noqa: SLF001
            body = request.encode(self._token, protocol._request_handle, _TIMEOUT_HINT_MS)  # noqa: SLF001
            messages.append(protocol._connection.message_to_binary(body, request_id=number))  # noqa: SLF001
            answer: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
            protocol._callbackmap[number] = answer  # noqa: SLF001
            answers.append(answer)
        protocol.transport.write(b"".join(messages))
        return answers

    def abort(self) -> None:
        """Drop the connection at once, and with it what the server has not taken yet."""
        _reset(self._client)

    async def drop(self) -> None:
        """As `abort`, and tidy up."""
        _reset(self._client)
        await _disconnect(self._client)

    async def close(self) -> None:
        """End the session in order, as far as the server takes part."""
        await _disconnect(self._client)


def _node_ids(nodes: list[Node], served: list[str]) -> list[bytes]:
    """Encoded. Raises Misfit for a namespace that the server does not have."""
    for namespace in {node.namespace for node in nodes} - set(served):
        raise Misfit(f"the server has no namespace {namespace!r}; it has {', '.join(map(repr, served))}")
    return [nodeid_to_binary(_node_id(node, served.index(node.namespace))) for node in nodes]


def _node_id(node: Node, namespace: int) -> ua.NodeId:
    numeric = re.fullmatch(r"i=(\d+)", node.identifier)
    identifier = ua.Int32(numeric[1]) if numeric else ua.String(node.identifier)
    return ua.NodeId(identifier, ua.Int16(namespace))


async def _secure(client: Client, plan: Plan) -> None:
    """What the line's file asks for, or nothing is connected at all: asyncua keeps to the policy that it is given.

    The server's certificate comes from a file: one that the server shows would be anybody's.
    """
    if plan.security == "none":
        return
    if plan.security != "Basic256Sha256" or not all((plan.certificate, plan.private_key, plan.server_certificate)):
        raise ValueError(f"security {plan.security!r} without certificates of both sides; nothing was sent")
    certificate = await load_certificate(Path(plan.certificate))
    client.application_uri = _application_uri(certificate) or client.application_uri
    await client.set_security(
        SecurityPolicyBasic256Sha256,
        Path(plan.certificate),
        Path(plan.private_key),
        server_certificate=plan.server_certificate,
        mode=ua.MessageSecurityMode.SignAndEncrypt,
    )


def _application_uri(certificate: x509.Certificate) -> str:
    """Servers compare it with what the client says of itself."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ""
    return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), "")


def _reset(client: Client) -> None:
    """Drop the connection at once, and with it what the other side has not taken yet."""
    protocol = client.uaclient.protocol
    if protocol is not None and protocol.transport is not None:
        tcp = protocol.transport.get_extra_info("socket")
        tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        protocol.transport.abort()


async def _disconnect(client: Client) -> None:
    """Tidy up what asyncua has started for a client; it only waits for a server that is still connected.

    No cancellation cuts it: asyncua's own tasks would go on.
    """
    await finish(_tidy_up(client))


async def _tidy_up(client: Client) -> None:
    await asyncio.sleep(0)  # lets an aborted transport tell the client
    try:
        async with asyncio.timeout(CLOSE_TIMEOUT_S):
            await client.disconnect()
    except TimeoutError:
        _reset(client)

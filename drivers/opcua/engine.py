"""The one file that knows asyncua: a session with a server that answers questions, one at a time.

asyncua is asked for requests and answers only: when to connect again is decided here, nothing is subscribed to, and
what an answer says is believed only when it fits the question. Any answer that does not, and any that does not come
in time, ends the connection: it is reset, so that requests that a stopped server has not taken yet do not come to
life when it goes on.
"""

import asyncio
import logging
import re
import socket
import struct
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from asyncua import ua
from asyncua.client.client import Client
from asyncua.client.ua_client import UaClientState
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import load_certificate
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.object_ids import ObjectIds
from asyncua.ua.ua_binary import struct_from_binary
from cryptography import x509

from drivers.opcua.messages import Answer, Outcome, Plan, Question
from drivers.opcua.nodes import Node, Reading
from drivers.opcua.status import BAD_TYPE_MISMATCH, describe, is_good

CONNECT_TIMEOUT_S = 2.0  #: per request while connecting
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0  #: between attempts to connect
CLOSE_TIMEOUT_S = 0.5
SESSION_TIMEOUT_MS = 30_000  #: how long a server keeps the session of an engine that was killed
READ_VARIANTS = 8  #: prepared read requests that are kept
_EPOCH, _MICROSECOND = datetime(1601, 1, 1, tzinfo=UTC), timedelta(microseconds=1)
_NO_PROBES_S = 1e9  #: asyncua's own health check reads beside the cycle: the cycle itself is the check

_TYPES = {
    "bool": ua.VariantType.Boolean,
    "u8": ua.VariantType.Byte,
    "i8": ua.VariantType.SByte,
    "u16": ua.VariantType.UInt16,
    "i16": ua.VariantType.Int16,
    "u32": ua.VariantType.UInt32,
    "i32": ua.VariantType.Int32,
    "f32": ua.VariantType.Float,
    "f64": ua.VariantType.Double,
}
_READ_ANSWER = ua.NodeId(ua.Int32(ObjectIds.ReadResponse_Encoding_DefaultBinary))
_WRITE_ANSWER = ua.NodeId(ua.Int32(ObjectIds.WriteResponse_Encoding_DefaultBinary))

# What goes wrong is told in answers and counted in the link's health; it does not belong on the terminal as well.
logging.getLogger("asyncua").addHandler(logging.NullHandler())


class NotConnected(Exception):
    """There is no session; the text says why."""


class Misfit(Exception):
    """An answer that does not fit the question."""


class Engine:
    """`generation` counts the engines of a link: connection numbers of different engines never coincide."""

    def __init__(self, plan: Plan, generation: int) -> None:
        self._plan = plan
        self._connection = generation << 32
        self._client: Client | None = None
        self._node_ids: list[ua.NodeId] = []
        self._reads: dict[tuple[int, ...], ua.ReadParameters] = {}
        self._connecting: asyncio.Task[None] | None = None
        self._retry_s = float("-inf")
        self._pause_s = FIRST_PAUSE_S
        self._why = "not connected yet"

    async def answer(self, question: Question) -> Answer:
        """Ask the server. Returns by the question's deadline, with a reason when there is nothing else."""
        loop = asyncio.get_running_loop()
        try:
            await self._need_connection(question)
        except NotConnected as error:
            return Answer(question.number, Outcome.NO_CONNECTION, self._connection, text=str(error))
        if question.writes and question.connection != self._connection:
            return Answer(question.number, Outcome.OTHER_CONNECTION, self._connection, text="connected anew")
        if loop.time() >= (question.write_by_s if question.writes else question.deadline_s):
            return Answer(question.number, Outcome.TOO_LATE, self._connection, text="the command came too late")
        written: tuple[int, ...] = ()
        try:
            async with asyncio.timeout_at(question.deadline_s):
                if question.writes:
                    written = await self._write(question.writes)
                readings = await self._read(question.reads) if question.reads else ()
        except TimeoutError:
            why = "no answer in time"
        # asyncua's decoder raises whatever Python does on bytes that are no answer, from struct.error to MemoryError.
        except Exception as error:
            why = _in_words(error)
        else:
            self._pause_s = FIRST_PAUSE_S
            return Answer(question.number, Outcome.DONE, self._connection, written, readings)
        await self._drop(why)
        return Answer(question.number, Outcome.FAILED, self._connection, written, text=why)

    async def close(self) -> None:
        """End the session in order, as far as the server takes part. Idempotent."""
        if self._connecting is not None:
            self._connecting.cancel()
            await asyncio.gather(self._connecting, return_exceptions=True)
        client, self._client = self._client, None
        if client is not None:
            await _disconnect(client)

    def abandon(self) -> None:
        """Drop everything at once, from outside of a coroutine."""
        if self._connecting is not None:
            self._connecting.cancel()
        if self._client is not None:
            _reset(self._client)
            self._client = None

    # the connection

    async def _need_connection(self, question: Question) -> None:
        """Raises NotConnected, after an attempt has begun where the time has come for one."""
        if self._client is not None and self._client.state is not UaClientState.CONNECTED:
            await self._drop("the server closed the connection")
        if self._client is not None:
            return
        now_s = asyncio.get_running_loop().time()
        if self._connecting is None and (question.patient or now_s >= self._retry_s):
            self._retry_s = now_s + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
            self._connecting = asyncio.create_task(self._connect())
        if question.patient and self._connecting is not None:
            await asyncio.wait([self._connecting], timeout=max(0.0, question.deadline_s - now_s))
        if self._client is None:
            raise NotConnected(self._why)

    async def _connect(self) -> None:
        """One attempt. The outcome is in `_client` and `_why`."""
        client = Client(self._plan.endpoint, timeout=CONNECT_TIMEOUT_S, watchdog_intervall=_NO_PROBES_S)
        client.name = client.description = "r2rgate"
        client.session_timeout = SESSION_TIMEOUT_MS
        try:
            await _secure(client, self._plan)
            await client.connect()
            self._node_ids = _node_ids(self._plan.nodes, await client.get_namespace_array())
        except asyncio.CancelledError:
            _reset(client)
            raise
        except Exception as error:  # see `answer`
            self._why = _in_words(error)
            await _disconnect(client)
        else:
            self._reads.clear()
            self._connection += 1
            self._client = client
        finally:
            self._connecting = None

    async def _drop(self, why: str) -> None:
        self._why = why
        client, self._client = self._client, None
        if client is not None:
            _reset(client)
            await _disconnect(client)

    # services

    async def _write(self, writes: Sequence[tuple[int, float]]) -> tuple[int, ...]:
        request = ua.WriteRequest()
        request.Parameters.NodesToWrite = [
            ua.WriteValue(self._node_ids[place], AttributeIds.Value, Value=_data_value(number, self._kind(place)))
            for place, number in writes
        ]
        response = await self._ask(request, ua.WriteResponse, _WRITE_ANSWER, len(writes))
        return tuple(status.value for status in response.Results)

    async def _read(self, places: tuple[int, ...]) -> tuple[Reading, ...]:
        request = ua.ReadRequest()
        request.Parameters = self._read_parameters(places)
        response = await self._ask(request, ua.ReadResponse, _READ_ANSWER, len(places))
        return tuple(_reading(value, self._kind(place)) for place, value in zip(places, response.Results, strict=True))

    def _read_parameters(self, places: tuple[int, ...]) -> ua.ReadParameters:
        parameters = self._reads.get(places)
        if parameters is None:
            if len(self._reads) >= READ_VARIANTS:
                self._reads.clear()
            parameters = ua.ReadParameters()
            parameters.TimestampsToReturn = ua.TimestampsToReturn.Source
            parameters.NodesToRead = [ua.ReadValueId(self._node_ids[place], AttributeIds.Value) for place in places]
            self._reads[places] = parameters
        return parameters

    async def _ask(self, request: Any, answer: type[Any], type_id: ua.NodeId, count: int) -> Any:
        """One service call. Raises Misfit, and whatever asyncua does."""
        protocol = self._client.uaclient.protocol if self._client is not None else None
        if protocol is None:
            raise NotConnected("connection lost")
        response = struct_from_binary(answer, await protocol.send_request(request))
        if response.TypeId != type_id:  # asyncua would take any message for the one it waits for
            raise Misfit(f"the server answered with {response.TypeId.to_string()}, not {answer.__name__}")
        result = response.ResponseHeader.ServiceResult
        result.check()
        if result.value != 0:  # put off, or done in part
            raise Misfit(f"the server answered {describe(result.value)}")
        if len(response.Results) != count:
            raise Misfit(f"{len(response.Results)} results, asked for {count}")
        return response

    def _kind(self, place: int) -> str:
        return self._plan.nodes[place].type


def _data_value(number: float, kind: str) -> ua.DataValue:
    """A bare value: many servers refuse a write that brings a status or a time stamp."""
    value = number if kind in ("f32", "f64") else bool(number) if kind == "bool" else int(number)
    return ua.DataValue(ua.Variant(value, _TYPES[kind]), StatusCode=None)


def _reading(value: ua.DataValue, kind: str) -> Reading:
    """A value of another type than the map says counts as bad, whatever its status."""
    status = 0 if value.StatusCode is None else value.StatusCode.value
    stamp = value.SourceTimestamp
    source_us = 0 if stamp is None else _microseconds(stamp)
    variant = value.Value
    if variant is None or variant.VariantType is not _TYPES[kind] or variant.is_array or variant.Value is None:
        return Reading(BAD_TYPE_MISMATCH if is_good(status) else status, 0.0, source_us)
    return Reading(status, float(variant.Value), source_us)


def _microseconds(stamp: datetime) -> int:
    return (stamp - _EPOCH) // _MICROSECOND


def _node_ids(nodes: list[Node], served: list[str]) -> list[ua.NodeId]:
    """Raises Misfit for a namespace that the server does not have."""
    for namespace in {node.namespace for node in nodes} - set(served):
        raise Misfit(f"the server has no namespace {namespace!r}; it has {', '.join(map(repr, served))}")
    return [_node_id(node, served.index(node.namespace)) for node in nodes]


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
    """Tidy up what asyncua has started for a client; it only waits for a server that is still connected."""
    await asyncio.sleep(0)  # lets an aborted transport tell the client
    try:
        async with asyncio.timeout(CLOSE_TIMEOUT_S):
            await client.disconnect()
    except TimeoutError:
        _reset(client)


def _in_words(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__

"""What an OPC UA server offers: endpoints, namespaces, variables. Reads only: Browse and Read, nothing else.

A session is opened without security, anonymously, where the server offers that; otherwise its endpoints are all that
can be told.
"""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.client.client import Client

from drivers.inspection import Progress
from drivers.opcua.engine import Engine
from drivers.opcua.maps import OpcUaMap
from drivers.opcua.messages import Outcome, Plan, Question
from drivers.opcua.nodes import Node
from drivers.opcua.status import describe
from gateway.tasks.cleanup import finish

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

TIMEOUT_S = 4.0
MOST_VARIABLES = 200
_MOST_BROWSED = 2_000  #: nodes
_READ_AT_ONCE = 50  #: nodes; many servers take no more
_MOST_CHANNELS = 60
_NO_PROBES_S = 1e9
_LONGEST_VALUE = 40
_BUILD_INFO = {"product": 2261, "maker": 2263, "version": 2264}  #: i= of Server.ServerStatus.BuildInfo


@dataclass(frozen=True, slots=True)
class Endpoint:
    url: str
    policy: str
    mode: str
    tokens: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Variable:
    """`path` from the node that was browsed; `value` cut to a line."""

    node: str
    path: str
    data_type: str
    value: str
    status: str


@dataclass(frozen=True, slots=True)
class MapFit:
    """A map whose device id was found, at address 1; `channels` those of 1 to 60 that have it."""

    name: str
    channels: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class OpcUaScan:
    """`not_browsed` is why nothing but endpoints is known; `more` says that the variables are not all."""

    endpoint: str
    endpoints: tuple[Endpoint, ...]
    not_browsed: str = ""
    server: Mapping[str, str] | None = None
    namespaces: tuple[str, ...] = ()
    variables: tuple[Variable, ...] = ()
    more: bool = False
    maps: tuple[MapFit, ...] = ()


class ScanFailed(Exception):
    """The server is not there or does not answer as one; the text says why."""


async def scan(
    endpoint: str, under: str, maps: Mapping[str, OpcUaMap], progress: Progress, most: int = MOST_VARIABLES
) -> OpcUaScan:
    """Endpoints, and the first `most` variables below the node `under` ("" for the Objects folder).

    Raises ScanFailed.
    """
    progress(f"asking {endpoint} for its endpoints")
    endpoints = await _endpoints(endpoint)
    open_ones = [e for e in endpoints if e.policy == "None" and "Anonymous" in e.tokens]
    if not open_ones:
        return OpcUaScan(endpoint, endpoints, "it offers no anonymous session without security")
    client = _client(endpoint)
    try:
        try:
            async with asyncio.timeout(TIMEOUT_S):
                await client.connect()
        except Exception as error:  # asyncua raises whatever Python does on bytes that are no answer
            return OpcUaScan(endpoint, endpoints, f"no session: {_in_words(error)}")
        async with asyncio.timeout(10 * TIMEOUT_S):
            namespaces = tuple(str(uri) for uri in await client.get_namespace_array())
            found, more = await _browse(client, under or "i=85", most, progress)
            variables = await _read(client, found, progress)
            server = await _build_info(client)
    except TimeoutError as error:
        raise ScanFailed("it took too long to answer; browse less with --under NODE") from error
    except Exception as error:  # see above
        raise ScanFailed(_in_words(error)) from error
    finally:
        await _disconnect(client)
    fits = await _fitting(endpoint, namespaces, maps)
    return OpcUaScan(endpoint, endpoints, "", server, namespaces, variables, more, fits)


def is_node_id(text: str) -> bool:
    """Whether it names a node: ns=2;s=Name, i=85."""
    try:
        ua.NodeId.from_string(text)
    except (ValueError, ua.UaError):
        return False
    return True


async def _endpoints(endpoint: str) -> tuple[Endpoint, ...]:
    try:
        async with asyncio.timeout(TIMEOUT_S):
            described = await _client(endpoint).connect_and_get_server_endpoints()
    except TimeoutError as error:
        raise ScanFailed(f"no answer within {TIMEOUT_S:g} s") from error
    except Exception as error:  # see `scan`
        raise ScanFailed(_in_words(error)) from error
    return tuple(
        Endpoint(
            str(found.EndpointUrl),
            str(found.SecurityPolicyUri).rpartition("#")[2],
            ua.MessageSecurityMode(found.SecurityMode).name.rstrip("_"),
            tuple(sorted({ua.UserTokenType(token.TokenType).name for token in found.UserIdentityTokens})),
        )
        for found in described
    )


async def _browse(client: Client, under: str, most: int, progress: Progress) -> tuple[list[tuple[Any, str]], bool]:
    """Variables below a node with their paths, breadth first, and whether there are more.

    From the Objects folder on, what is of the standard itself (namespace 0: the server's own state) is left out.
    """
    found: list[tuple[Any, str]] = []
    waiting: list[tuple[Any, str]] = [(ua.NodeId.from_string(under), "")]
    seen = {waiting[0][0]}
    browsed = 0
    from_objects = waiting[0][0] == ua.NodeId(ua.ObjectIds.ObjectsFolder)
    wanted = ua.NodeClass.Object | ua.NodeClass.Variable
    while waiting and browsed < _MOST_BROWSED and len(found) <= most:
        node, path = waiting.pop(0)
        browsed += 1
        if browsed % 20 == 0:
            progress(f"browsed {browsed} nodes, {len(found)} variables")
        for child in await client.get_node(node).get_children_descriptions(nodeclassmask=wanted):
            if child.NodeId in seen or (from_objects and child.NodeId.NamespaceIndex == 0):
                continue
            seen.add(child.NodeId)
            name = f"{path}/{child.BrowseName.Name}" if path else str(child.BrowseName.Name)
            waiting.append((child.NodeId, name))
            if child.NodeClass == ua.NodeClass.Variable:
                found.append((child.NodeId, name))
    return found[:most], len(found) > most or bool(waiting)


async def _read(client: Client, found: list[tuple[Any, str]], progress: Progress) -> tuple[Variable, ...]:
    variables: list[Variable] = []
    for start in range(0, len(found), _READ_AT_ONCE):
        progress(f"read {start} of {len(found)} variables")
        part = found[start : start + _READ_AT_ONCE]
        values = await client.read_attributes([client.get_node(node) for node, _ in part], ua.AttributeIds.Value)
        variables += [_variable(node, path, value) for (node, path), value in zip(part, values, strict=True)]
    return tuple(variables)


def _variable(node: Any, path: str, value: Any) -> Variable:
    status = 0 if value.StatusCode is None else value.StatusCode.value
    variant = value.Value
    kind, text = "", ""
    if variant is not None and variant.Value is not None:
        kind = variant.VariantType.name + ("[]" if variant.is_array else "")
        text = f"{len(variant.Value)} elements" if variant.is_array else str(variant.Value)
    text = text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."
    return Variable(node.to_string(), path, kind, text, "Good" if status == 0 else describe(status))


async def _build_info(client: Client) -> dict[str, str]:
    nodes = [client.get_node(ua.NodeId(number)) for number in _BUILD_INFO.values()]
    values = await client.read_attributes(nodes, ua.AttributeIds.Value)
    texts = [str(value.Value.Value) if value.Value is not None and value.Value.Value else "" for value in values]
    return dict(zip(_BUILD_INFO, texts, strict=True))


async def _fitting(endpoint: str, namespaces: tuple[str, ...], maps: Mapping[str, OpcUaMap]) -> tuple[MapFit, ...]:
    """Asked as the driver asks: a device id of another type is none. Raises ScanFailed, also for an answer that the
    driver does not take."""
    of_server = {name: device for name, device in maps.items() if device.namespace in namespaces}
    nodes: list[Node] = []
    asked: list[tuple[str, int]] = []
    for name, device in of_server.items():
        identity = device.identity
        for channel in range(1, _MOST_CHANNELS + 1 if "{channel}" in identity.node else 2):
            nodes.append(Node(device.namespace, identity.identifier(1, channel), identity.type))
            asked.append((name, channel))
    if not nodes:
        return ()
    engine = Engine(Plan(endpoint, "none", "", "", "", nodes), 0)
    hits: dict[str, list[int]] = {}
    try:
        for start in range(0, len(nodes), _READ_AT_ONCE):
            places = tuple(range(start, min(start + _READ_AT_ONCE, len(nodes))))
            deadline_s = asyncio.get_running_loop().time() + TIMEOUT_S
            answer = await engine.answer(Question(start, 0, 0.0, deadline_s, patient=True, writes=(), reads=places))
            if answer.outcome is not Outcome.DONE:
                raise ScanFailed(answer.text)
            for place, reading in zip(places, answer.readings, strict=True):
                name, channel = asked[place]
                if reading.good and reading.value == of_server[name].identity.value:
                    hits.setdefault(name, []).append(channel)
    finally:
        await engine.close()
    return tuple(MapFit(name, tuple(channels)) for name, channels in hits.items())


def _client(endpoint: str) -> Client:
    client = Client(endpoint, timeout=TIMEOUT_S, watchdog_intervall=_NO_PROBES_S)
    client.name = client.description = "r2rgate scan"
    return client


async def _disconnect(client: Client) -> None:
    """No cancellation cuts it."""
    await finish(_disconnect_in_time(client))


async def _disconnect_in_time(client: Client) -> None:
    try:
        async with asyncio.timeout(1.0):
            await client.disconnect()
    except TimeoutError:  # it will notice by its own time-out
        client.disconnect_socket()


def _in_words(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__

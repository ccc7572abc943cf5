"""Models of companion specifications in the server, from files as they are published.

A model comes with all it requires or not at all. Nothing of it can be written or called, and no code is made of it.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.server.server import Server

from gateway.operator.opcua.nodeset_files import Folder, NodeSet, NotUsable, too_old

CORE = "http://opcfoundation.org/UA/"

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

_NODE_SET = "{http://opcfoundation.org/UA/2011/03/UANodeSet.xsd}"


class NodeSets:
    def __init__(self, server: Server, folder: Folder) -> None:
        self._server = server
        self._folder = folder
        self._types: dict[str, Mapping[str, Any]] = {}  #: of models that are in: object types by name
        self._failed: dict[str, str] = {}
        self._dates: dict[str, str] = {}
        self._taken: frozenset[str] = frozenset()  #: namespaces that were there before

    async def begin(self) -> None:
        uris = await self._server.get_namespace_array()
        self._taken = frozenset(uris)
        core = await self._server.nodes.namespaces.get_child(ua.QualifiedName(CORE, 0))
        published = await (await core.get_child("0:NamespacePublicationDate")).read_value()
        self._dates[CORE] = published.date().isoformat()

    async def types(self, uri: str) -> Mapping[str, Any]:
        """Node ids of the model's object types, by name. Raises NotUsable."""
        await self._need(uri, ())
        return self._types[uri]

    async def number(self, uri: str) -> int:
        """Of its namespace."""
        return await self._server.get_namespace_index(uri)

    async def _need(self, uri: str, for_whom: tuple[str, ...]) -> None:
        """Raises NotUsable."""
        if uri in self._dates:
            return
        if uri not in self._failed:
            try:
                await self._bring(uri, for_whom)
                return
            except NotUsable as problem:
                self._failed[uri] = str(problem)
        raise NotUsable(self._failed[uri])

    async def _bring(self, uri: str, for_whom: tuple[str, ...]) -> None:
        node_set = self._folder.node_sets.get(uri)
        if node_set is None:
            raise NotUsable(f"no file there holds the model {uri}")
        if uri in self._taken or uri in for_whom:
            raise NotUsable(f"{node_set.path} cannot be brought in: {uri} is this server's own, or requires itself")
        for one in node_set.requires:
            await self._need(one.uri, (*for_whom, uri))
        for lack in too_old(node_set, self._dates):
            raise NotUsable(f"{node_set.path} requires {lack}")
        self._types[uri] = await _imported(self._server, node_set, self._taken)
        self._dates[uri] = node_set.model.published


async def _imported(server: Server, node_set: NodeSet, taken: frozenset[str]) -> Mapping[str, Any]:
    """Raises NotUsable, and leaves nothing of it then."""
    data = node_set.read()
    try:
        _check_namespaces(data, node_set, taken)
        # Of definitions asyncua would make Python code, and run it. It takes bytes, though it declares a text.
        nodes = await server.import_xml(xmlstring=data, auto_load_definitions=False)  # type: ignore[arg-type]
        return await _harmless(server, nodes)
    except NotUsable:
        raise
    except Exception as error:  # whatever asyncua makes of what is no sound node set
        await _remove(server, node_set.model.uri)
        raise NotUsable(f"{node_set.path} cannot be brought in: {type(error).__name__}: {error!s:.200}") from error


def _check_namespaces(data: bytes, node_set: NodeSet, taken: frozenset[str]) -> None:
    """All nodes are the model's own, and none is about this server's. Raises NotUsable, and what the parser raises."""
    root = ET.fromstring(data)
    uris = [one.text for one in root.iterfind(f"{_NODE_SET}NamespaceUris/{_NODE_SET}Uri")]
    known = uris[1:] if uris[:1] == [CORE] else uris
    if node_set.model.uri not in known:
        raise NotUsable(f"{node_set.path} does not list its own namespace, {node_set.model.uri}")
    if others := taken & set(known):
        raise NotUsable(f"{node_set.path} is about {', '.join(others)}, which is this server's own")
    own = f"ns={known.index(node_set.model.uri) + 1};"
    for node in root:
        node_id = node.get("NodeId", own)
        if not node_id.startswith(own):
            raise NotUsable(f"{node_set.path} has the node {node_id[:80]!r}; allowed: its own namespace, {own[:-1]}")


async def _harmless(server: Server, nodes: list[Any]) -> Mapping[str, Any]:
    """Nothing can be written or called. Returns the object types by name."""
    space, types = server.iserver.aspace, dict[str, Any]()
    for node_id in nodes:
        if node_id not in space:  # asyncua lists encodings that it has left out, too
            continue
        kind = _read(space, node_id, ua.AttributeIds.NodeClass)
        if kind == ua.NodeClass.Variable:
            for attribute in (ua.AttributeIds.AccessLevel, ua.AttributeIds.UserAccessLevel):
                await _set(server, node_id, attribute, ua.Variant(ua.AccessLevel.CurrentRead.mask, ua.VariantType.Byte))
        elif kind == ua.NodeClass.Method:
            server.iserver.isession.add_method_callback(node_id, _not_executable)
            for attribute in (ua.AttributeIds.Executable, ua.AttributeIds.UserExecutable):
                await _set(server, node_id, attribute, ua.Variant(False, ua.VariantType.Boolean))
        elif kind == ua.NodeClass.ObjectType:
            types[_read(space, node_id, ua.AttributeIds.BrowseName).Name] = node_id
    return types


async def _not_executable(_parent: Any, *_arguments: Any) -> Any:
    return ua.CallMethodResult(StatusCode=ua.StatusCode(ua.StatusCodes.BadNotExecutable))


async def _set(server: Server, node_id: Any, attribute: Any, value: Any) -> None:
    await server.write_attribute_value(node_id, ua.DataValue(value), attribute)


def _read(space: Any, node_id: Any, attribute: Any) -> Any:
    return space.read_attribute_value(node_id, attribute).Value.Value


async def _remove(server: Server, uri: str) -> None:
    """What an import that failed has left."""
    uris = await server.get_namespace_array()
    if uri not in uris:
        return
    number, space = uris.index(uri), server.iserver.aspace
    for node_id in list(space.keys()):
        if node_id.NamespaceIndex == number:
            del space[node_id]
            continue
        references = space[node_id].references
        references[:] = [one for one in references if one.NodeId.NamespaceIndex != number]

"""Objects of companion types: what a type declares as mandatory, and of the optional what is known here.

Methods are never among them: what people may have done goes through the line's own.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.server.server import Server

from gateway.operator.opcua.nodeset_files import NotUsable
from gateway.operator.opcua.space import NO_DATA, WAITING, Space

DEEPEST = 8  #: levels below a type

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

_MANDATORY = ua.NodeId(ua.ObjectIds.ModellingRule_Mandatory)
_OPTIONAL = ua.NodeId(ua.ObjectIds.ModellingRule_Optional)
_CLASSES = (ua.NodeClass.Object, ua.NodeClass.Variable)
_EMPTY = {ua.ObjectIds.String: "", ua.ObjectIds.LocalizedText: ua.LocalizedText()}  #: what stands for: not known


@dataclass(frozen=True)
class Declared:
    """A node below a type, as it is declared there."""

    path: str  #: from the type, as AnalogSignal.EURange
    reference: Any  #: from what is above
    name: Any
    node_class: Any
    kind: Any  #: its type
    data_type: Any  #: of a variable
    value: Any  #: of a variable; None: left open


async def declared(server: Server, type_id: Any, known: Iterable[str]) -> list[Declared]:
    """What an instance has below it, each after what it is below. `known`: paths of the optional ones that it has.

    Raises NotUsable where one of `known` is not declared, or there is no end.
    """
    wanted = frozenset(known)
    found = await _below(server, await _lineage(server, type_id), wanted, "")
    if missing := wanted - {one.path for one in found}:
        raise NotUsable(f"the type {type_id.to_string()} does not declare {', '.join(sorted(missing))}")
    return found


async def make_object(space: Space, path: str, above: Any, reference: int, kind: Any, name: Any) -> None:
    """`path` below the node `above`, of the type `kind`: a number of the core, or a NodeId."""
    item = ua.AddNodesItem(
        ParentNodeId=above, ReferenceTypeId=ua.NodeId(reference), RequestedNewNodeId=space.id(path), BrowseName=name,
        NodeClass=ua.NodeClass.Object, TypeDefinition=ua.NodeId(kind) if isinstance(kind, int) else kind,
        NodeAttributes=ua.ObjectAttributes(DisplayName=ua.LocalizedText(name.Name), WriteMask=0, UserWriteMask=0),
    )  # fmt: skip
    (result,) = await space.server.iserver.isession.add_nodes([item])
    result.StatusCode.check()


async def make(space: Space, above: str, rows: Sequence[Declared], values: Mapping[str, Any]) -> None:
    """`rows` below the object `above`. `values`: a Variant by path, or the path of an own variable that it follows."""
    for row in rows:
        path, parent = f"{above}.{row.path}", f"{above}.{row.path}".rpartition(".")[0]
        item = ua.AddNodesItem(
            ParentNodeId=space.id(parent), ReferenceTypeId=row.reference, RequestedNewNodeId=space.id(path),
            BrowseName=row.name, NodeClass=row.node_class, TypeDefinition=row.kind,
        )  # fmt: skip
        said = {"DisplayName": ua.LocalizedText(row.name.Name), "WriteMask": 0, "UserWriteMask": 0}
        value = values.get(row.path)
        if row.node_class == ua.NodeClass.Object:
            item.NodeAttributes = ua.ObjectAttributes(**said)
        else:
            item.NodeAttributes = _variable(said, row, value)
        (result,) = await space.server.iserver.isession.add_nodes([item])
        result.StatusCode.check()
        if row.node_class == ua.NodeClass.Variable:
            await _begin(space, path, item.NodeAttributes.Value, value)


def _variable(said: dict[str, Any], row: Declared, value: Any) -> Any:
    """A number of any kind is a Double here; what is not known is empty."""
    number = row.data_type == ua.NodeId(ua.ObjectIds.Number)
    data_type = ua.NodeId(ua.ObjectIds.Double) if number else row.data_type
    held = row.value if value is None or isinstance(value, str) else value
    if held is None and not isinstance(value, str) and data_type.Identifier in _EMPTY and not data_type.NamespaceIndex:
        held = ua.Variant(_EMPTY[data_type.Identifier])
    return ua.VariableAttributes(
        **said, Value=held or ua.Variant(None), DataType=data_type,
        ValueRank=ua.ValueRank.OneDimension if held is not None and held.is_array else ua.ValueRank.Scalar,
        AccessLevel=ua.AccessLevel.CurrentRead.mask, UserAccessLevel=ua.AccessLevel.CurrentRead.mask,
        MinimumSamplingInterval=100.0, Historizing=False,
    )  # fmt: skip


async def _begin(space: Space, path: str, held: Any, value: Any) -> None:
    """A variable without a value says why."""
    follows = isinstance(value, str)
    if follows:
        space.also(value, space.id(path))
    if follows or held.Value is None:
        code = ua.StatusCode(WAITING if follows else NO_DATA)
        await space.server.write_attribute_value(space.id(path), ua.DataValue(ua.Variant(None), StatusCode=code))


async def _lineage(server: Server, type_id: Any) -> list[Any]:
    """A type, its interfaces, and the same of what it is a subtype of."""
    found = [type_id]
    for node_id in found:
        for reference, direction in (
            (ua.ObjectIds.HasInterface, ua.BrowseDirection.Forward),
            (ua.ObjectIds.HasSubtype, ua.BrowseDirection.Inverse),
        ):
            more = await server.get_node(node_id).get_references(reference, direction, includesubtypes=False)
            found += [one.NodeId for one in more if one.NodeId not in found]
    return found


async def _below(server: Server, origins: Sequence[Any], wanted: frozenset[str], above: str) -> list[Declared]:
    if above.count(".") >= DEEPEST:
        raise NotUsable(f"{above[:80]} and so on has more than {DEEPEST} levels")
    found: dict[tuple[int, str], list[Declared]] = {}
    for origin in origins:
        for one in await server.get_node(origin).get_references(
            ua.ObjectIds.Aggregates, ua.BrowseDirection.Forward, includesubtypes=True
        ):
            name, path = (one.BrowseName.NamespaceIndex, one.BrowseName.Name), f"{above}{one.BrowseName.Name}"
            if one.NodeClass not in _CLASSES or name in found or not await _is_in(server, one, path, wanted):
                continue
            more = [one.NodeId, *await _lineage(server, one.TypeDefinition)]
            found[name] = [await _of(server, one, path), *await _below(server, more, wanted, f"{path}.")]
    return [one for branch in found.values() for one in branch]


async def _is_in(server: Server, one: Any, path: str, wanted: frozenset[str]) -> bool:
    rules = await server.get_node(one.NodeId).get_references(ua.ObjectIds.HasModellingRule)
    ids = [rule.NodeId for rule in rules]
    return _MANDATORY in ids or (_OPTIONAL in ids and path in wanted)


async def _of(server: Server, one: Any, path: str) -> Declared:
    data_type = value = None
    if one.NodeClass == ua.NodeClass.Variable:
        node = server.get_node(one.NodeId)
        data_type = await node.read_data_type()
        told = await node.read_data_value(raise_on_bad_status=False)
        value = told.Value if told.Value is not None and told.Value.Value is not None else None
    return Declared(path, one.ReferenceTypeId, one.BrowseName, one.NodeClass, one.TypeDefinition, data_type, value)

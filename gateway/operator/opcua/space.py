"""The address space: nodes with names that stay the same, and values that say how good they are.

A node is known by its path, which is the text of its NodeId: `Line.Spans.1.Tension`. All can be read, none written.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.common.manage_nodes import delete_nodes
from asyncua.server.server import Server

from gateway.operator.opcua.units import Unit

NAMESPACE = "urn:r2rgate:line"  #: of all nodes and types of a line

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

BOOLEAN, UINT32, DOUBLE, STRING = (
    ua.VariantType.Boolean, ua.VariantType.UInt32, ua.VariantType.Double, ua.VariantType.String,
)  # fmt: skip
GOOD: int = ua.StatusCodes.Good
UNCERTAIN: int = ua.StatusCodes.Uncertain
WAITING: int = ua.StatusCodes.BadWaitingForInitialData
LAST_USABLE: int = ua.StatusCodes.UncertainLastUsableValue
NO_COMMUNICATION: int = ua.StatusCodes.BadNoCommunication
NO_DATA: int = ua.StatusCodes.BadNoData

Scalar = bool | int | float | str
Value = Scalar | Sequence[Scalar] | None


@dataclass(frozen=True)
class Row:
    """A variable of an object."""

    name: str
    kind: Any  #: of the variant
    tells: str
    unit: Unit | None = None
    normal: tuple[float, float] | None = None  #: EURange, in the unit; with a unit only
    array: bool = False
    history: bool = False


class Space:
    def __init__(self, server: Server, namespace: int) -> None:
        self.server = server
        self.namespace = namespace
        self._session = server.iserver.isession
        self._rows: dict[str, Row] = {}
        self._told: dict[str, tuple[Any, int]] = {}
        self._also: dict[str, list[Any]] = {}

    def id(self, path: str) -> Any:
        return ua.NodeId(path, self.namespace)

    async def type(self, name: str, tells: str, rows: Sequence[Row]) -> str:
        """An object type of that name with `rows`. Returns its path."""
        path = f"Types.{name}"
        parent = ua.NodeId(ua.ObjectIds.BaseObjectType)
        await self._add(path, name, parent, ua.ObjectIds.HasSubtype, ua.NodeClass.ObjectType, None,
                        ua.ObjectTypeAttributes(**_said(name, tells)))  # fmt: skip
        for row in rows:
            await self._variable(f"{path}.{row.name}", self.id(path), row)
            node = self.server.get_node(self.id(f"{path}.{row.name}"))
            await node.set_modelling_rule(True)
        return path

    async def object(self, path: str, parent: str, tells: str, type_path: str = "") -> None:
        """`parent`: a path, or nothing for the folder of all objects."""
        name = path.rpartition(".")[2]
        above = self.id(parent) if parent else ua.NodeId(ua.ObjectIds.ObjectsFolder)
        kind = self.id(type_path) if type_path else ua.NodeId(ua.ObjectIds.FolderType)
        reference = ua.ObjectIds.HasComponent if parent else ua.ObjectIds.Organizes
        attributes = ua.ObjectAttributes(**_said(name, tells))
        await self._add(path, name, above, reference, ua.NodeClass.Object, kind, attributes)

    async def variables(self, parent: str, rows: Sequence[Row]) -> None:
        """Their values are waited for."""
        for row in rows:
            path = f"{parent}.{row.name}"
            await self._variable(path, self.id(parent), row)
            self._rows[path] = row
            await self.tell(path, None, None, WAITING)

    async def tell(self, path: str, value: Value, wall_s: float | None, code: int = GOOD) -> None:
        """A value as of a Unix time, None: now. Without a value `code` must be bad. What has not changed is left."""
        told = (None if value is None else value if isinstance(value, str | bool | int | float) else tuple(value), code)
        if self._told.get(path) == told:
            return
        row = self._rows[path]
        held = list(told[0]) if isinstance(told[0], tuple) else told[0]
        when = datetime.now(UTC) if wall_s is None else datetime.fromtimestamp(wall_s, UTC)
        variant = ua.Variant(None) if held is None else ua.Variant(held, row.kind, is_array=row.array)
        found = ua.DataValue(variant, StatusCode=ua.StatusCode(code), SourceTimestamp=when)
        for node_id in (self.id(path), *self._also.get(path, ())):
            await self.server.write_attribute_value(node_id, found)
        self._told[path] = told  # not before all have it: what has failed is tried again

    def also(self, path: str, node_id: Any) -> None:
        """Another node that has whatever `path` is told from now on."""
        self._also.setdefault(path, []).append(node_id)

    async def still(self, path: str, code: int) -> None:
        """The last value, which is no longer sure."""
        value, _ = self._told[path]
        await self.tell(path, value, None, code if value is not None or code >= 0x80000000 else NO_COMMUNICATION)

    async def remove(self, path: str) -> None:
        """An object and all below it. To what is below nothing refers from elsewhere: asyncua need not look for it in
        all nodes, which takes milliseconds for each."""
        top = self.server.get_node(self.id(path))
        await delete_nodes(self._session, await top.get_children(), recursive=True, delete_target_references=False)
        await delete_nodes(self._session, [top])
        for held in (self._rows, self._told):
            for one in [one for one in held if one.startswith(f"{path}.")]:
                del held[one]

    async def _variable(self, path: str, parent: Any, row: Row) -> None:
        access = ua.AccessLevel.CurrentRead.mask | (ua.AccessLevel.HistoryRead.mask if row.history else 0)
        kind = ua.ObjectIds.BaseDataVariableType if row.unit is None else ua.ObjectIds.AnalogItemType
        attributes = ua.VariableAttributes(
            **_said(row.name, row.tells), Value=ua.Variant(None), DataType=ua.NodeId(row.kind.value),
            ValueRank=ua.ValueRank.OneDimension if row.array else ua.ValueRank.Scalar,
            ArrayDimensions=[0] if row.array else None, AccessLevel=access, UserAccessLevel=access,
            MinimumSamplingInterval=100.0, Historizing=row.history,
        )  # fmt: skip
        reference = ua.ObjectIds.HasComponent
        await self._add(path, row.name, parent, reference, ua.NodeClass.Variable, ua.NodeId(kind), attributes)
        if row.unit is not None:
            low, high = row.normal or (0.0, 0.0)
            await self._property(path, "EngineeringUnits", row.unit.information(), ua.ObjectIds.EUInformation)
            await self._property(path, "EURange", ua.Range(low, high), ua.ObjectIds.Range)

    async def _property(self, path: str, name: str, value: Any, data_type: int) -> None:
        attributes = ua.VariableAttributes(
            **_said(name, ""), Value=ua.Variant(value, ua.VariantType.ExtensionObject), DataType=ua.NodeId(data_type),
            ValueRank=ua.ValueRank.Scalar, ArrayDimensions=None, AccessLevel=ua.AccessLevel.CurrentRead.mask,
            UserAccessLevel=ua.AccessLevel.CurrentRead.mask, Historizing=False,
        )  # fmt: skip
        kind = ua.NodeId(ua.ObjectIds.PropertyType)
        await self._add(f"{path}.{name}", ua.QualifiedName(name, 0), self.id(path), ua.ObjectIds.HasProperty,
                        ua.NodeClass.Variable, kind, attributes)  # fmt: skip

    async def _add(
        self, path: str, name: Any, parent: Any, reference: int, node_class: Any, kind: Any, attributes: Any
    ) -> None:
        qualified = name if isinstance(name, ua.QualifiedName) else ua.QualifiedName(name, self.namespace)
        item = ua.AddNodesItem(
            ParentNodeId=parent, ReferenceTypeId=ua.NodeId(reference), RequestedNewNodeId=self.id(path),
            BrowseName=qualified, NodeClass=node_class, NodeAttributes=attributes,
        )  # fmt: skip
        if kind is not None:
            item.TypeDefinition = kind
        (result,) = await self._session.add_nodes([item])
        result.StatusCode.check()


def _said(name: str, tells: str) -> dict[str, Any]:
    return {
        "DisplayName": ua.LocalizedText(name), "Description": ua.LocalizedText(tells), "WriteMask": 0,
        "UserWriteMask": 0,
    }  # fmt: skip

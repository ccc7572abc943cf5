"""The line as a PackML machine (OPC 30050): the state machines of its type, told from the phase that the loop is in.

A standstill is told only where it is measured. What PackML counts in packages, and its modes, nobody knows of a web.
"""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, NamedTuple

from asyncua import ua as asyncua_ua

from gateway.core.line import Line
from gateway.core.states import Phase
from gateway.core.status import GatewayStatus
from gateway.operator.opcua.instances import declared, make, make_object
from gateway.operator.opcua.line_nodes import ROOT
from gateway.operator.opcua.nodeset_files import NotUsable
from gateway.operator.opcua.nodesets import NodeSets
from gateway.operator.opcua.space import GOOD, NO_DATA, WAITING, Space

PACKML = "http://opcfoundation.org/UA/PackML/"
OBJECTS = 72  #: the folder of all PackML machines, in its namespace
PATH = "PackML"
BASE = f"{PATH}.BaseStateMachine"
MACHINE = f"{BASE}.MachineState"
EXECUTE = f"{MACHINE}.ExecuteState"

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

_TYPES = {
    BASE: "PackMLBaseStateMachineType", MACHINE: "PackMLMachineStateMachineType",
    EXECUTE: "PackMLExecuteStateMachineType",
}  # fmt: skip


class States(NamedTuple):
    """Of the three machines, one inside the other. Empty: it is not active."""

    base: str
    machine: str = ""
    execute: str = ""


_RUNNING = {
    Phase.ARMING: "Resetting", Phase.READY: "Idle", Phase.WARNING: "Starting",
    Phase.ENABLING: "Starting", Phase.TENSIONING: "Starting", Phase.RUNNING: "Execute",
    Phase.PROVING: "Starting",
    Phase.DRILLING: "Resetting",
}  # fmt: skip


#: Names of states that are told, by machine.
_TOLD = (
    {"Cleared", "Aborting", "Aborted"}, {"Running", "Stopping", "Stopped"}, {*_RUNNING.values(), "Holding", "Held"},
)  # fmt: skip


def states_of(status: GatewayStatus) -> States | None:
    """None: nobody commands the machine, so nobody knows."""
    phase = Phase.__members__.get(status.loop.phase)
    match phase:
        case None | Phase.SILENT:
            return None
        case Phase.HOLDING:
            return States("Cleared", "Running", "Held" if status.loop.standstill else "Holding")
        case Phase.SLOWING | Phase.BRAKING | Phase.UNLOADING | Phase.OFF:
            stands = phase is Phase.OFF and status.loop.standstill
            if status.loop.by_person:
                return States("Cleared", "Stopped" if stands else "Stopping")
            return States("Aborted" if stands else "Aborting")
        case _:
            return States("Cleared", "Running", _RUNNING[phase])


async def make_packml(space: Space, line: Line, sets: NodeSets) -> "PackMl":
    """Raises NotUsable where something is not declared; nothing is made then."""
    types, number = await sets.types(PACKML), await sets.number(PACKML)
    if missing := {"PackMLBaseObjectType", *_TYPES.values()} - types.keys():
        raise NotUsable(f"its model has no {', '.join(sorted(missing))}")
    rows = await declared(space.server, types["PackMLBaseObjectType"], ())
    names = {row.path for row in rows}
    wanted = {f"{path.removeprefix(f'{PATH}.')}.CurrentState" for path in _TYPES}
    if lacking := wanted - names:
        raise NotUsable(f"PackMLBaseObjectType does not declare {', '.join(sorted(lacking))}")
    ids = {path: await _states(space, types[name]) for path, name in _TYPES.items()}
    for path, told in zip(_TYPES, _TOLD, strict=True):
        if unknown := told - ids[path].keys():
            raise NotUsable(f"{_TYPES[path]} has no state {', '.join(sorted(unknown))}")
    folder = ua.NodeId(OBJECTS, number)
    if folder not in space.server.iserver.aspace:
        raise NotUsable(f"the model {PACKML} has no folder PackMLObjects, i={OBJECTS}")
    await make_object(space, PATH, folder, ua.ObjectIds.Organizes, types["PackMLBaseObjectType"],
                      ua.QualifiedName(line.line, space.namespace))  # fmt: skip
    await space.server.get_node(space.id(PATH)).add_reference(space.id(ROOT), ua.ObjectIds.Organizes)
    await make(space, PATH, rows, {})
    made = PackMl(space, ids, {path for path in _TYPES if f"{path}.CurrentState.Id".removeprefix(f"{PATH}.") in names})
    await made.unsure(WAITING)
    return made


async def _states(space: Space, type_id: Any) -> Mapping[str, Any]:
    """Of a type of state machines: node ids by name."""
    children = await space.server.get_node(type_id).get_references(
        ua.ObjectIds.HasComponent, ua.BrowseDirection.Forward, ua.NodeClass.Object
    )
    kinds = (ua.ObjectIds.StateType, ua.ObjectIds.InitialStateType)
    return {
        one.BrowseName.Name: one.NodeId for one in children if one.TypeDefinition in [ua.NodeId(kind) for kind in kinds]
    }


class PackMl:
    """Its states, as they change."""

    def __init__(self, space: Space, ids: Mapping[str, Mapping[str, Any]], with_id: set[str]) -> None:
        """`ids`: node ids of states by machine and name; `with_id`: machines that tell the node id of theirs, too."""
        self._space = space
        self._ids = ids
        self._with_id = with_id
        self._told: dict[str, tuple[str, int]] = {}

    async def show(self, status: GatewayStatus) -> None:
        found = states_of(status)
        if found is None:
            await self.unsure(NO_DATA)
            return
        for path, name in zip(_TYPES, found, strict=True):
            await self._tell(path, name, GOOD if name else ua.StatusCodes.BadStateNotActive, status.wall_s)

    async def unsure(self, code: int) -> None:
        """No state is known, and why."""
        for path in _TYPES:
            await self._tell(path, "", code, None)

    async def _tell(self, path: str, name: str, code: int, wall_s: float | None) -> None:
        if self._told.get(path) == (name, code):
            return
        when = datetime.now(UTC) if wall_s is None else datetime.fromtimestamp(wall_s, UTC)
        values = {f"{path}.CurrentState": ua.Variant(ua.LocalizedText(name, "en")) if name else ua.Variant(None)}
        if path in self._with_id:
            values[f"{path}.CurrentState.Id"] = ua.Variant(self._ids[path].get(name) if name else None)
        for node, value in values.items():
            found = ua.DataValue(value, StatusCode=ua.StatusCode(code), SourceTimestamp=when)
            await self._space.server.write_attribute_value(self._space.id(node), found)
        self._told[path] = name, code  # not before all have it: what has failed is tried again

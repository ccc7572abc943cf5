"""The line as companion specifications have it, where their node sets are at hand: a machine with its identification,
each tension as a process value, and its state as PackML's. It stands beside the line's own nodes, tells the same, and
takes nothing.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from asyncua import ua as asyncua_ua

from gateway.core.line import Line
from gateway.core.line_limits import tension_band_n
from gateway.operator.opcua.instances import declared, make, make_object
from gateway.operator.opcua.line_nodes import ROOT
from gateway.operator.opcua.nodeset_files import NotUsable, look_into
from gateway.operator.opcua.nodesets import NodeSets
from gateway.operator.opcua.packml import PACKML, PackMl, make_packml
from gateway.operator.opcua.space import DOUBLE, STRING, Space
from gateway.operator.opcua.units import NEWTON

DI = "http://opcfoundation.org/UA/DI/"
MACHINERY = "http://opcfoundation.org/UA/Machinery/"
PROCESS_VALUES = "http://opcfoundation.org/UA/Machinery/ProcessValues/"
MACHINE = "Machine"  #: path of the line as a machine
PROCESS = f"{MACHINE}.Monitoring.Process"
MACHINES = 1001  #: the folder of all machines, in Machinery's namespace

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

_KNOWN = ("Location", "ComponentName")
_SIGNAL, _SETPOINT = "AnalogSignal", "ProcessValueSetpoint"
_LIMITS = (f"{_SIGNAL}.LowLimit", f"{_SIGNAL}.HighLimit")


async def make_companion(space: Space, line: Line, tell: Callable[[str], None]) -> PackMl | None:
    """What cannot be made is left out and told. Returns what tells PackML's states, where the folder has its model."""
    if line.operator.nodesets is None:
        return None
    folder = look_into(Path(line.operator.nodesets))
    for problem in folder.problems:
        tell(f"companion types: {problem}")
    sets = NodeSets(space.server, folder)
    await sets.begin()
    for part, lost in (
        (_machine, "the line is not among Machinery's machines; own types only"),
        (_process_values, "the tensions are no process values; own types only for them"),
    ):
        try:
            await part(space, line, sets)
        except Exception as problem:  # whatever asyncua makes of types that are not as they should be
            tell(f"{lost}: {_why(problem)}")
            break
    if PACKML not in folder.node_sets:
        return None
    try:
        return await make_packml(space, line, sets)
    except Exception as problem:  # as above
        tell(f"the line is no PackML machine; own types only for its state: {_why(problem)}")
        return None


async def _machine(space: Space, line: Line, sets: NodeSets) -> None:
    """Raises NotUsable, and nothing is made then."""
    types = await sets.types(MACHINERY)
    di, machinery = await sets.number(DI), await sets.number(MACHINERY)
    identification = await declared(space.server, _type(types, "MachineIdentificationType"), _KNOWN)
    machines = ua.NodeId(MACHINES, machinery)
    if machines not in space.server.iserver.aspace:
        raise NotUsable(f"the model {MACHINERY} has no folder Machines, i={MACHINES}")
    await make_object(space, MACHINE, machines, ua.ObjectIds.Organizes, ua.ObjectIds.BaseObjectType,
                      ua.QualifiedName(line.line, space.namespace))  # fmt: skip
    await space.server.get_node(space.id(MACHINE)).add_reference(space.id(ROOT), ua.ObjectIds.Organizes)
    path = f"{MACHINE}.Identification"
    await make_object(space, path, space.id(MACHINE), ua.ObjectIds.HasAddIn, types["MachineIdentificationType"],
                      ua.QualifiedName("Identification", di))  # fmt: skip
    location, name = ua.Variant(line.site, STRING), ua.Variant(ua.LocalizedText(line.line))
    await make(space, path, identification, {"Location": location, "ComponentName": name})


async def _process_values(space: Space, line: Line, sets: NodeSets) -> None:
    """Raises NotUsable, and nothing is made then."""
    kind = _type(await sets.types(PROCESS_VALUES), "ProcessValueType")
    rows = await declared(space.server, kind, (*_LIMITS, _SETPOINT))
    machinery = await sets.number(MACHINERY)
    monitoring = (await sets.types(MACHINERY)).get("MonitoringType", ua.ObjectIds.FolderType)
    above, path = space.id(MACHINE), f"{MACHINE}.Monitoring"
    await make_object(space, path, above, ua.ObjectIds.HasAddIn, monitoring, ua.QualifiedName("Monitoring", machinery))
    await make_object(space, PROCESS, space.id(path), ua.ObjectIds.HasComponent, ua.ObjectIds.FolderType,
                      ua.QualifiedName("Process", machinery))  # fmt: skip
    for number, span in enumerate(line.spans, 1):
        if span.control == "tension":
            path = f"{PROCESS}.{number}"
            name = ua.QualifiedName(f"Tension{number}", space.namespace)
            await make_object(space, path, space.id(PROCESS), ua.ObjectIds.HasComponent, kind, name)
            await make(space, path, rows, _of_span(line, number))


def _of_span(line: Line, number: int) -> dict[str, Any]:
    """Values of a process value by path."""
    span, (low, high) = f"{ROOT}.Spans.{number}", tension_band_n(line, number)
    values: dict[str, Any] = {
        "SignalTag": ua.Variant(line.spans[number - 1].name, STRING),
        _SIGNAL: f"{span}.Tension", _SETPOINT: f"{span}.Setpoint",
    }  # fmt: skip
    values |= {path: ua.Variant(limit, DOUBLE) for path, limit in zip(_LIMITS, (low, high), strict=True)}
    for path in (_SIGNAL, _SETPOINT, *_LIMITS):
        values[f"{path}.EngineeringUnits"] = ua.Variant(NEWTON.information(), ua.VariantType.ExtensionObject)
        values[f"{path}.EURange"] = ua.Variant(ua.Range(low, high), ua.VariantType.ExtensionObject)
    return values


def _why(problem: Exception) -> str:
    return str(problem) if isinstance(problem, NotUsable) else f"{type(problem).__name__}: {problem!s:.200}"


def _type(types: Mapping[str, Any], name: str) -> Any:
    """Raises NotUsable."""
    if name not in types:
        raise NotUsable(f"its model has no {name}")
    return types[name]

"""The loader of device maps: everything a link must know of a device type, as data.

One TOML file a device type in `drivers/maps`. Strict: unknown keys, wrong types, units of the wrong quantity,
fields that overlap and PDOs that do not fit a frame are refused, all at once, each with file, line, key, what is
allowed and the nearest valid thing; a map that is refused takes nothing from the others. What a map may say stands
with its protocol: `drivers/*/maps.py`.
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from drivers.canopen import maps as canopen
from drivers.map_errors import MapRefused, Reason, reasons_of, shown
from drivers.map_fields import MAPS
from drivers.modbus import maps as modbus
from drivers.opcua import maps as opcua
from gateway.core.line_problem import Problem, printable
from gateway.core.nearest import is_typo, nearest
from gateway.core.toml_places import Path as Place
from gateway.core.toml_places import line_of, places
from gateway.core.toml_syntax import syntax_problem
from gateway.files import NotText, read_text

__all__ = ["MAPS", "MODELS", "DeviceMap", "MapRefused", "Maps", "load_map", "load_maps", "map_names"]

MOST_MAPS, MOST_BYTES, MOST_REASONS = 1000, 1_000_000, 40

DeviceMap = (
    canopen.DriveMap
    | canopen.LoadCellMap
    | canopen.PlcMap
    | modbus.DriveMap
    | modbus.LoadCellMap
    | modbus.PlcMap
    | opcua.DriveMap
    | opcua.LoadCellMap
    | opcua.PlcMap
)
#: What a map of a protocol and role must be.
MODELS: dict[tuple[str, str], type[DeviceMap]] = {
    ("canopen", "drive"): canopen.DriveMap,
    ("canopen", "load-cell"): canopen.LoadCellMap,
    ("canopen", "line-plc"): canopen.PlcMap,
    ("modbus-tcp", "drive"): modbus.DriveMap,
    ("modbus-tcp", "load-cell"): modbus.LoadCellMap,
    ("modbus-tcp", "line-plc"): modbus.PlcMap,
    ("opcua", "drive"): opcua.DriveMap,
    ("opcua", "load-cell"): opcua.LoadCellMap,
    ("opcua", "line-plc"): opcua.PlcMap,
}


@dataclass(frozen=True)
class Maps:
    """The device types of a folder: one that has mistakes takes nothing from the others."""

    usable: Mapping[str, DeviceMap]
    unusable: Mapping[str, Sequence[Problem]]  #: by name


def map_names(folder: Path = MAPS) -> list[str]:
    """The names that `map` may have in a line's file, whether or not each map can be used.

    Raises MapRefused where the folder cannot be listed.
    """
    try:
        return sorted(path.stem for path in folder.iterdir() if path.suffix == ".toml" and path.name != ".toml")
    except OSError as error:
        wrong = f"the folder of the device maps cannot be listed: {error.strerror}"
        raise MapRefused([Problem(str(folder), 1, "", "", wrong)]) from error


def load_maps(folder: Path = MAPS) -> Maps:
    """Every map of `folder`, and why some cannot be used. Raises nothing: without the folder there are none."""
    usable, unusable = dict[str, DeviceMap](), dict[str, Sequence[Problem]]()
    try:
        names = map_names(folder)
    except MapRefused as refused:
        return Maps({}, {folder.name: refused.problems})
    for name in names[:MOST_MAPS]:
        try:
            usable[name] = load_map(folder / f"{name}.toml")
        except MapRefused as refused:
            unusable[name] = refused.problems
    for name in names[MOST_MAPS:]:
        wrong = f"is not read: of a folder only the first {MOST_MAPS} maps are"
        unusable[name] = [Problem(f"{printable(name)}.toml", 1, "", "", wrong)]
    return Maps(usable, unusable)


def load_map(path: Path) -> DeviceMap:
    """The device map in `path`. Raises MapRefused with every reason, whatever is there."""
    name = printable(path.name)
    try:
        text = read_text(path, MOST_BYTES).replace("\r\n", "\n")
    except NotText as error:
        raise MapRefused([Problem(name, error.line, "", "", "is not UTF-8 here: save the file as UTF-8")]) from error
    except OSError as error:
        raise MapRefused([Problem(name, 1, "", "", f"cannot be read: {error.strerror}")]) from error
    try:
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise MapRefused([syntax_problem(error, text, name)]) from error
    return _validated(document, _lines_of(text), name)


def _validated(document: dict[str, Any], where: dict[Place, int], name: str) -> DeviceMap:
    protocol, role = document.get("protocol"), document.get("role")
    model = MODELS.get((protocol, role)) if isinstance(protocol, str) and isinstance(role, str) else None
    if model is None:
        raise MapRefused([_no_such_kind(document, where, name)])
    try:
        return model.model_validate(document)
    except ValidationError as refusal:
        found = [reason for error in refusal.errors() for reason in reasons_of(model, error)]
    except RecursionError:
        found = [Reason((), "brackets are nested too deeply to be read")]
    if (more := len(found) - MOST_REASONS) > 0:
        found = [*found[:MOST_REASONS], Reason((), f"and {more} more mistakes")]
    raise MapRefused([Problem(name, line_of(where, reason.path), "", "", reason.words) for reason in found])


def _no_such_kind(document: dict[str, Any], where: dict[Place, int], name: str) -> Problem:
    """What is wrong with protocol and role, by which it is told what the rest must be."""
    protocols, roles = dict.fromkeys(p for p, _ in MODELS), dict.fromkeys(r for _, r in MODELS)
    for key, allowed in (("protocol", protocols), ("role", roles)):
        if key not in document:
            mistyped = next((known for known in document if is_typo(known, key)), "")
            wrong = f"{key}: is missing" + (f", and {printable(mistyped)!r} is no key" if mistyped else "")
            near = repr(key) if mistyped else ""
            return Problem(name, line_of(where, (mistyped,)), "", "", wrong, ", ".join(map(repr, allowed)), near)
    protocol, role = document["protocol"], document["role"]
    line = line_of(where, ("role" if protocol in list(protocols) else "protocol",))
    near = nearest(str(protocol)[:80], protocols), nearest(str(role)[:80], roles)
    meant = f"protocol = {near[0]!r} with role = {near[1]!r}" if all(near) else ""
    allowed = ", ".join(f"protocol = {p!r} with role = {r!r}" for p, r in MODELS)
    wrong = f"protocol {shown(protocol)} with role {shown(role)} is unknown"
    return Problem(name, line, "", "", wrong, allowed, meant)


def _lines_of(text: str) -> dict[Place, int]:
    """The line of every key; of a document that is too odd for that none, and line 1 is told."""
    try:
        return places(text)
    except (ValueError, IndexError, RecursionError):
        return {}

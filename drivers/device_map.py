"""The loader of device maps: everything a link must know of a device type, as data.

One TOML file a device type in `drivers/maps`. Strict: unknown keys, wrong types, units of the wrong quantity,
fields that overlap and PDOs that do not fit a frame are refused, all at once, each with file, key, what is
allowed and the nearest valid thing. What a map may say stands with its protocol: `drivers/*/maps.py`.
"""

import tomllib
from pathlib import Path

from pydantic import ValidationError

from drivers.canopen import maps as canopen
from drivers.map_errors import MapRefused, reasons_of
from drivers.map_fields import MAPS
from drivers.modbus import maps as modbus
from drivers.opcua import maps as opcua

__all__ = ["MAPS", "MODELS", "DeviceMap", "MapRefused", "load_map", "map_names"]

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


def map_names(folder: Path = MAPS) -> list[str]:
    """The names that `map` may have in a line's file."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def load_map(path: Path) -> DeviceMap:
    """The device map in `path`. Raises MapRefused with every reason."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise MapRefused([f"{path.name}: cannot be read: {error}"]) from error
    kind = (str(document.get("protocol")), str(document.get("role")))
    model = MODELS.get(kind)
    if model is None:
        allowed = ", ".join(f"protocol = {p!r} with role = {r!r}" for p, r in MODELS)
        raise MapRefused([f"{path.name}: protocol {kind[0]!r} with role {kind[1]!r} is unknown; allowed: {allowed}"])
    try:
        return model.model_validate(document)
    except ValidationError as refusal:
        reasons = [line for error in refusal.errors() for line in reasons_of(model, error)]
        raise MapRefused([f"{path.name}: {reason}" for reason in reasons]) from refusal

"""Maps of CANopen devices: what a file in `drivers/maps` may say of them, a module a role."""

from drivers.canopen.map_cell import LoadCellMap
from drivers.canopen.map_drive import DriveMap
from drivers.canopen.map_parts import CanMap
from drivers.canopen.map_plc import PlcMap

__all__ = ["CanMap", "DriveMap", "LoadCellMap", "PlcMap"]

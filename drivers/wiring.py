"""A device of a line with its bus and its device type: what each protocol's builder makes links of."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.device_map import DeviceMap
from drivers.port import Link
from gateway.core.line import Bus, Drive, Line, LinePlc, LoadCell


@dataclass(frozen=True)
class Wired:
    """Looked up and found to fit: the map is for this kind of device and speaks the protocol of the bus."""

    item: Drive | LoadCell | LinePlc
    bus: Bus
    device: DeviceMap


#: The links of one protocol for its devices, in the order of the line's file, and why there cannot be some.
Builder = Callable[[Line, Sequence[Wired]], tuple[list[Link], list[str]]]

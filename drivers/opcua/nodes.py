"""The nodes that a link reads and writes, counted, and the numbers in them. No I/O.

Every number travels between link and engine as a float: it holds all types that a map may name exactly.
"""

from math import isfinite
from typing import NamedTuple

from drivers.opcua.maps import NodeRef
from drivers.opcua.status import describe, is_good

_LIMITS = {
    "bool": (0, 1),
    "u8": (0, 0xFF),
    "i8": (-0x80, 0x7F),
    "u16": (0, 0xFFFF),
    "i16": (-0x8000, 0x7FFF),
    "u32": (0, 0xFFFFFFFF),
    "i32": (-0x80000000, 0x7FFFFFFF),
}
SERIAL = "serial"  #: in place of a type: of a node that is read as text
_LARGEST_F32 = 3.4028234663852886e38


class Node(NamedTuple):
    """`namespace` is a URI, `identifier` a name or i=NUMBER, `type` a type of a map, or SERIAL."""

    namespace: str
    identifier: str
    type: str


class Reading(NamedTuple):
    """What a read said of one node: an OPC UA StatusCode and, where that is not bad, its value.

    `source_us` is the source time stamp in microseconds since 1601 (UTC), 0 where the server gives none.
    """

    status: int
    value: float
    source_us: int = 0

    @property
    def good(self) -> bool:
        return is_good(self.status)

    @property
    def trouble(self) -> str:
        """Why it must not be used; empty where it may."""
        return "" if self.good else describe(self.status)


class NodeTable:
    """The nodes of one server; everything else names them by their place in `nodes`."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._places: dict[Node, int] = {}

    def place(self, node: Node) -> int:
        """Where it stands; added when it is new."""
        if node not in self._places:
            self._places[node] = len(self.nodes)
            self.nodes.append(node)
        return self._places[node]


class DeviceNodes:
    """Places the nodes of one device: its map's namespace, its address and channel."""

    def __init__(self, table: NodeTable, namespace: str, address: int, channel: int = 1) -> None:
        self._table = table
        self._namespace = namespace
        self._address, self._channel = address, channel

    def place(self, entry: NodeRef, kind: str, channel: int | None = None) -> int:
        """Where the node of a map's entry stands. Raises ValueError for an identifier that cannot be."""
        identifier = entry.identifier(self._address, self._channel if channel is None else channel)
        return self._table.place(Node(self._namespace, identifier, kind))

    def serial(self, entry: NodeRef | None) -> int | None:
        """Where the node of a serial number stands. None: the map names none."""
        return None if entry is None else self.place(entry, SERIAL)


def to_type(number: float, kind: str) -> float:
    """`number` as a node of type `kind` can hold it: whole where the type is.

    Raises ValueError for a number that is not finite or does not fit.
    """
    if not isfinite(number):
        raise ValueError(f"{number} is not finite")
    if kind in _LIMITS:
        low, high = _LIMITS[kind]
        whole = round(number)
        if not low <= whole <= high:
            raise ValueError(f"{number:g} does not fit a {kind} ({low} to {high})")
        return float(whole)
    if kind == "f32" and abs(number) > _LARGEST_F32:
        raise ValueError(f"{number:g} does not fit a f32")
    return number

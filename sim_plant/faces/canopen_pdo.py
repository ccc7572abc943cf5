"""One PDO of a node as CiA 301 has it: COB-ID and mapping, what may be written to them, and the bytes.

No I/O. A write that the node does not support raises canopen's SdoAbortedError with the code that the SDO
server answers, and nothing has changed then.
"""

import struct
from collections.abc import Mapping, Sequence

from canopen.sdo.exceptions import SdoAbortedError

NOT_MAPPABLE = 0x06040041
PDO_TOO_LONG = 0x06040042
OUT_OF_RANGE = 0x06090030
WRONG_STATE = 0x08000022

INVALID = 1 << 31  #: the PDO does not exist
NO_RTR = 1 << 30  #: no remote request on it; no node of these kinds answers one, whatever the bit says
MAX_ENTRIES = 8
SYNCHRONOUS = 1  #: transmission type: acts, or is sent, with every SYNC
_CAN_ID = 0x7FF
#: CAN identifiers that CiA 301 keeps for other services, by their first and last.
_RESERVED = ((0x000, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x7FF))

_BITS = {"b": 8, "B": 8, "h": 16, "H": 16, "i": 32, "I": 32}

Key = tuple[int, int]  #: index and sub-index of an object


class Pdo:
    """A PDO over the objects of `mappable` (to struct format characters).

    `fields` are the objects in the frame, `layout` packs and unpacks them. While the PDO is not valid it is neither
    sent nor taken.
    """

    def __init__(self, mappable: Mapping[Key, str], cob_id: int, entries: Sequence[int], count: int) -> None:
        self._mappable = dict(mappable)
        self._default = (cob_id, [*entries, *[0] * (MAX_ENTRIES - len(entries))], count)
        self.reset()

    def reset(self) -> None:
        """Back to the COB-ID and the mapping that it was made with."""
        self.cob_id, entries, count = self._default
        self.entries = list(entries)
        self._map(count)

    @property
    def valid(self) -> bool:
        return not self.cob_id & INVALID

    @property
    def can_id(self) -> int:
        return self.cob_id & _CAN_ID

    def write_cob_id(self, value: int) -> None:
        """Sub-index 1 of the communication parameters. The identifier changes only by way of "not valid"."""
        can_id = value & _CAN_ID
        if value & ~(INVALID | NO_RTR) != can_id or any(low <= can_id <= high for low, high in _RESERVED):
            raise SdoAbortedError(OUT_OF_RANGE)
        if self.valid and not value & INVALID and can_id != self.can_id:
            raise SdoAbortedError(WRONG_STATE)
        self.cob_id = value

    def write_switch(self, value: int) -> None:
        """As `write_cob_id`, of a PDO that can be put on and off, and no more."""
        if value & ~(INVALID | NO_RTR) != self._default[0] & _CAN_ID:
            raise SdoAbortedError(OUT_OF_RANGE)
        self.cob_id = value

    def write_transmission_type(self, value: int) -> None:
        """Sub-index 2 of the communication parameters. The nodes know only 1, with every SYNC."""
        if value != SYNCHRONOUS:
            raise SdoAbortedError(OUT_OF_RANGE)

    def write_mapping(self, subindex: int, value: int) -> None:
        """The mapping parameters: sub-index 0 the number of objects, 1 to 8 the objects.

        Only while the PDO is not valid; the objects only while their number is 0.
        """
        if self.valid or (subindex and self.count):
            raise SdoAbortedError(WRONG_STATE)
        if subindex:
            if value:  # 0 empties the entry
                self._format(value)
            self.entries[subindex - 1] = value
        elif value > MAX_ENTRIES:
            raise SdoAbortedError(OUT_OF_RANGE)
        else:
            self._map(value)

    def _map(self, count: int) -> None:
        formats = [self._format(entry) for entry in self.entries[:count]]
        layout = struct.Struct("<" + "".join(formats))
        if layout.size > 8:
            raise SdoAbortedError(PDO_TOO_LONG)
        self.layout = layout
        self.fields: tuple[Key, ...] = tuple(_key(entry) for entry in self.entries[:count])
        self.count = count

    def _format(self, entry: int) -> str:
        """The format character of a mapping entry: index, sub-index and length in bits."""
        character = self._mappable.get(_key(entry))
        if character is None or entry & 0xFF != _BITS[character]:
            raise SdoAbortedError(NOT_MAPPABLE)
        return character


def _key(entry: int) -> Key:
    return entry >> 16, entry >> 8 & 0xFF

"""What an emergency message (CiA 301, 7.2.7) means: a fault, or a warning of a device that goes on. No I/O.

The map of a device names codes whose class is known. Of all others the device's own word decides: a drive's statusword
says whether it is in fault; a device without one says by bit 0 of its error register, generic error, which has to be
set in every error (CiA 301, 7.5.2.2).
"""

from enum import Enum, auto
from typing import NamedTuple

from canopen.emcy import EmcyError

from drivers.canopen.map_parts import EmergencyClasses
from gateway.core.finding import Finding, finding

GENERIC_ERROR = 0x01  #: bit of the error register


class EmergencyClass(Enum):
    FAULT = auto()
    WARNING = auto()
    AS_STATUSWORD = auto()  #: a fault if the statusword says so


class Emergency(NamedTuple):
    code: int
    register: int
    data: bytes = b""

    def of(self, device: str) -> Finding:
        """With what the profile says of its code."""
        meaning = EmcyError(self.code, self.register, self.data, 0.0).get_desc() or "?"
        message = {"error_code": self.code, "meaning": meaning, "register": self.register}
        return finding("emergency-message", device=device, **message)

    @property
    def number(self) -> int:
        """Code and register in one, as `Inputs.drive_warning` has them."""
        return self.register << 16 | self.code


def class_of(emergency: Emergency, classes: EmergencyClasses, *, has_statusword: bool) -> EmergencyClass:
    """The class of a message of a device with these classes in its map. The code that names it closest decides."""
    closest = {
        cls: max((_closeness(emergency.code, entry) for entry in codes), default=0)
        for cls, codes in ((EmergencyClass.FAULT, classes.faults), (EmergencyClass.WARNING, classes.warnings))
    }
    nearest = max(closest, key=lambda cls: closest[cls])  # of two that are as close the first: a fault
    if closest[nearest]:
        return nearest
    if has_statusword:
        return EmergencyClass.AS_STATUSWORD
    return EmergencyClass.FAULT if emergency.register & GENERIC_ERROR else EmergencyClass.WARNING


def _closeness(code: int, entry: int) -> int:
    """How closely an entry names a code: 3 the code itself, 2 its group (4200h), 1 its class (4000h), 0 not at all."""
    if code == entry:
        return 3
    if not entry & 0x00FF and code >> 8 == entry >> 8:
        return 2
    return int(not entry & 0x0FFF and code >> 12 == entry >> 12)

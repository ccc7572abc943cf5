"""Process data: bytes of a PDO to numbers and back, as a map says, and for a drive to SI. No I/O.

Objects follow one another in mapping order, little-endian, without gaps (CiA 301, 7.4.7).
"""

import struct
from collections.abc import Sequence
from math import isfinite
from typing import Any, NamedTuple

from drivers.canopen.map_drive import DriveMap
from drivers.canopen.map_parts import CanObject
from drivers.map_rules import BYTES
from drivers.scaling import speed_per_count, torque_per_count

_CODE = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i", "f32": "f"}


class MalformedPdo(ValueError):
    """A frame that is not the PDO that was mapped; the text says why."""


class DriveSample(NamedTuple):
    """What a drive says at a SYNC."""

    statusword: int
    speed_m_per_s: float
    torque_nm: float
    safe_torque_off: bool | None  #: None: not in this PDO
    mode: int | None = None  #: of operation, as displayed; None: not in this PDO


def mapping_entries(objects: Sequence[CanObject]) -> list[int]:
    """The values of the mapping record: index, sub-index and length in bits of each object."""
    return [entry.index << 16 | entry.sub << 8 | 8 * BYTES[entry.type] for entry in objects]


def type_code(kind: str) -> str:
    """The struct code of an object's type, little-endian: how SDO carries it, too."""
    return "<" + _CODE[kind]


class PdoLayout:
    """The numbers of one PDO in mapping order."""

    def __init__(self, objects: Sequence[CanObject]) -> None:
        self._struct = struct.Struct("<" + "".join(_CODE[entry.type] for entry in objects))

    def decode(self, data: bytes | bytearray) -> tuple[Any, ...]:
        """Raises MalformedPdo for a wrong length."""
        if len(data) != self._struct.size:
            raise MalformedPdo(f"{len(data)} bytes, the mapped PDO has {self._struct.size}")
        return self._struct.unpack(data)

    def encode(self, numbers: Sequence[float]) -> bytes:
        """Raises ValueError for a number that does not fit its object."""
        try:
            return self._struct.pack(*numbers)
        except (struct.error, OverflowError) as error:
            raise ValueError(str(error)) from error


class PdoCodec:
    """Both PDOs of one drive: its map, its rated torque (Nm) and its roller's nominal radius (m)."""

    def __init__(self, device: DriveMap, rated_torque_nm: float, radius_m: float) -> None:
        objects = device.objects
        self._speed_scale = speed_per_count(objects.speed.unit, objects.speed.scale, radius_m)
        self._torque_scale = torque_per_count(objects.torque.unit, objects.torque.scale, rated_torque_nm)
        target = objects.target_torque
        self._counts_per_nm = 1.0 / torque_per_count(target.unit, target.scale, rated_torque_nm)
        self._whole_counts = target.type != "f32"
        self._transmit = PdoLayout(device.objects_of(device.transmit_pdo))
        names = device.transmit_pdo.objects
        self._statusword_at = names.index("statusword")
        self._speed_at = names.index("speed")
        self._torque_at = names.index("torque")
        self._sto = objects.safe_torque_off if "safe_torque_off" in names else None
        self._sto_at = names.index("safe_torque_off") if self._sto else 0
        self._mode_at = names.index("mode_displayed") if "mode_displayed" in names else None
        self._receive = PdoLayout(device.objects_of(device.receive_pdo))
        names = device.receive_pdo.objects
        self._command = [device.cyclic_torque_mode if name == "mode" else 0 for name in names]
        self._controlword_at = names.index("controlword")
        self._target_at = names.index("target_torque")

    def decode(self, data: bytes | bytearray) -> DriveSample:
        """The sample in a transmit PDO. Raises MalformedPdo for a wrong length or a number that is not finite."""
        fields = self._transmit.decode(data)
        speed = fields[self._speed_at] * self._speed_scale
        torque = fields[self._torque_at] * self._torque_scale
        if not (isfinite(speed) and isfinite(torque)):
            raise MalformedPdo(f"speed {speed} or torque {torque} is not finite")
        sto = None if self._sto is None else self._sto.is_set(fields[self._sto_at])
        mode = None if self._mode_at is None else fields[self._mode_at]
        return DriveSample(fields[self._statusword_at], speed, torque, sto, mode)

    def encode(self, controlword: int, torque_nm: float) -> bytes:
        """The receive PDO. Raises ValueError for a torque that is not finite or does not fit the object."""
        if not isfinite(torque_nm):
            raise ValueError(f"torque {torque_nm} is not finite")
        counts = torque_nm * self._counts_per_nm
        command: list[float] = [*self._command]
        command[self._controlword_at] = controlword
        try:
            command[self._target_at] = round(counts) if self._whole_counts else counts
            return self._receive.encode(command)
        except (ValueError, OverflowError) as error:
            raise ValueError(f"torque {torque_nm} Nm does not fit the target torque object: {error}") from error

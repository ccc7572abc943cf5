"""What `prepare` writes to a drive, as data, and the transaction that writes it, reads it back, or undoes it."""

import struct
from dataclasses import dataclass
from math import floor

from drivers.canopen.maps import CanObject, DriveMap, Pdo, TimeObject
from drivers.canopen.pdo import mapping_entries, type_code
from drivers.canopen.sdo import SdoBus, SdoFailed, SdoSilent
from drivers.map_rules import BYTES
from drivers.scaling import si_per_count, torque_per_count

_PDO_INVALID = 1 << 31
_NO_REMOTE_REQUEST = 1 << 30  #: a bit of a COB-ID that is the device's own business
_SYNCHRONOUS = 1  #: acts on every SYNC


@dataclass(frozen=True, slots=True)
class Step:
    """One object to write. `keep` are bits of the present value that stay as they are."""

    index: int
    sub: int
    type: str
    value: int | float
    keep: int = 0

    @property
    def name(self) -> str:
        return f"object {self.index:04X}h sub {self.sub}"

    def bytes_after(self, present: bytes) -> bytes:
        value = self.value
        if self.keep:
            value = int(value) | int.from_bytes(present, "little") & self.keep
        return struct.pack(type_code(self.type), value)


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """What a line asks of one drive."""

    node: int
    rated_torque_nm: float
    torque_limit_nm: float
    watchdog_s: float


def watchdog_counts(watchdog: TimeObject, watchdog_s: float) -> int:
    """The value of the watchdog object: at most the time asked for. Raises ValueError when the drive cannot do it."""
    counts = floor(watchdog_s / si_per_count(watchdog.unit, watchdog.scale) + 1e-9)
    low, high = watchdog.range
    if counts < 1 or not low <= counts * watchdog.scale <= high:
        raise ValueError(
            f"limits.watchdog_s = {watchdog_s} s is outside what the drive can do ({low:g} to {high:g} {watchdog.unit})"
        )
    return counts


def torque_limit_counts(device: DriveMap, settings: DriveSettings) -> int:
    """The value of the max torque object: at most the line's limit. Raises ValueError when it does not fit."""
    entry = device.objects.max_torque
    nm_per_count = torque_per_count(entry.unit, entry.scale, settings.rated_torque_nm)
    counts = floor(settings.torque_limit_nm / nm_per_count + 1e-9)
    try:
        struct.pack(type_code(entry.type), counts)
    except struct.error as error:
        raise ValueError(
            f"limits.torque_nm = {settings.torque_limit_nm} Nm does not fit object {entry.index:04X}h: {error}"
        ) from error
    return counts


def drive_steps(device: DriveMap, settings: DriveSettings) -> list[Step]:
    """Everything to write, in order: both PDOs off, mapping and parameters, both PDOs on. Raises ValueError."""
    receive, transmit = device.receive_pdo, device.transmit_pdo
    steps = [_pdo_off(receive, settings.node), _pdo_off(transmit, settings.node)]
    steps += _mapping_steps(device, receive) + _mapping_steps(device, transmit)
    objects = device.objects
    steps.append(_write(objects.mode, device.cyclic_torque_mode))
    if objects.max_torque.writable:
        steps.append(_write(objects.max_torque, torque_limit_counts(device, settings)))
    steps.append(_write(device.heartbeat, round(device.heartbeat.value / device.heartbeat.scale)))
    steps.append(_write(device.watchdog, watchdog_counts(device.watchdog, settings.watchdog_s)))
    steps += [_pdo_on(receive, settings.node), _pdo_on(transmit, settings.node)]
    return steps


def _write(entry: CanObject, value: int) -> Step:
    return Step(entry.index, entry.sub, entry.type, value)


def _pdo_off(pdo: Pdo, node: int) -> Step:
    return Step(pdo.communication, 1, "u32", _PDO_INVALID | pdo.cob_id + node, keep=_NO_REMOTE_REQUEST)


def _pdo_on(pdo: Pdo, node: int) -> Step:
    return Step(pdo.communication, 1, "u32", pdo.cob_id + node, keep=_NO_REMOTE_REQUEST)


def _mapping_steps(device: DriveMap, pdo: Pdo) -> list[Step]:
    entries = mapping_entries(device, pdo)
    steps = [Step(pdo.communication, 2, "u8", _SYNCHRONOUS), Step(pdo.mapping, 0, "u8", 0)]
    steps += [Step(pdo.mapping, sub, "u32", entry) for sub, entry in enumerate(entries, 1)]
    steps.append(Step(pdo.mapping, 0, "u8", len(entries)))
    return steps


class Transaction:
    """Writes to one node that can be taken back. Undone in reverse, each object gets what it had before its step,
    so that a PDO mapping passes through the same legal states backwards."""

    def __init__(self, sdo: SdoBus, node: int) -> None:
        self._sdo = sdo
        self._node = node
        self._before: list[tuple[Step, bytes]] = []

    async def run(self, steps: list[Step]) -> None:
        """Write every step, then read back what must stand in the end. Raises SdoFailed at the first that fails."""
        final: dict[tuple[int, int], tuple[Step, bytes]] = {}
        for step in steps:
            present = await self._sdo.upload(self._node, step.index, step.sub, BYTES[step.type])
            wanted = step.bytes_after(present)
            try:
                await self._sdo.download(self._node, step.index, step.sub, wanted)
            except SdoSilent:
                self._before.append((step, present))  # it may have been written all the same
                raise
            self._before.append((step, present))
            final[step.index, step.sub] = (step, wanted)
        for step, wanted in final.values():
            found = await self._sdo.upload(self._node, step.index, step.sub, len(wanted))
            if found != wanted:
                raise SdoFailed(f"{step.name}: written {wanted.hex()}, read back {found.hex()} (bytes, low first)")

    async def undo(self) -> list[str]:
        """Write back what was there before; returns what could not be restored. A node that is silent is left."""
        failures: list[str] = []
        while self._before:
            step, present = self._before.pop()
            try:
                await self._sdo.download(self._node, step.index, step.sub, present)
            except SdoSilent as error:
                self._before.clear()
                failures.append(f"{error}; the rest could not be restored")
            except SdoFailed as error:
                failures.append(f"not restored: {error}")
        return failures

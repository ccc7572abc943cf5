"""What is written to a node and what is only compared, as data; and the transaction that writes, reads back, undoes."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.canopen.map_parts import CanObject, Pdo
from drivers.canopen.pdo import mapping_entries, type_code
from drivers.canopen.sdo import SdoBus, SdoFailed, SdoSilent
from drivers.canopen.station import Station
from drivers.map_rules import BYTES
from gateway.core.finding import Finding, finding

_PDO_INVALID = 1 << 31
_NO_REMOTE_REQUEST = 1 << 30  #: a bit of a COB-ID that is the device's own business
_SYNCHRONOUS = 1  #: acts on every SYNC


def place(index: int, sub: int) -> str:
    return f"object {index:04X}h sub {sub}"


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
        return place(self.index, self.sub)

    def bytes_after(self, present: bytes) -> bytes:
        value = self.value
        if self.keep:
            value = int(value) | int.from_bytes(present, "little") & self.keep
        return struct.pack(type_code(self.type), value)


@dataclass(frozen=True, slots=True)
class Expected:
    """One object that must have a value already. `ignore` are bits that do not matter."""

    index: int
    sub: int
    type: str
    value: int
    ignore: int = 0


def pdo_off(pdo: Pdo, node: int) -> Step:
    return Step(pdo.communication, 1, "u32", _PDO_INVALID | pdo.cob_id + node, keep=_NO_REMOTE_REQUEST)


def pdo_on(pdo: Pdo, node: int) -> Step:
    return Step(pdo.communication, 1, "u32", pdo.cob_id + node, keep=_NO_REMOTE_REQUEST)


def mapping_steps(pdo: Pdo, objects: Sequence[CanObject]) -> list[Step]:
    """Transmission with every SYNC, and the mapping; for a PDO that is off."""
    entries = mapping_entries(objects)
    steps = [Step(pdo.communication, 2, "u8", _SYNCHRONOUS), Step(pdo.mapping, 0, "u8", 0)]
    steps += [Step(pdo.mapping, sub, "u32", entry) for sub, entry in enumerate(entries, 1)]
    return [*steps, Step(pdo.mapping, 0, "u8", len(entries))]


def expected_pdo(pdo: Pdo, objects: Sequence[CanObject], node: int) -> list[Expected]:
    """What a PDO with a fixed mapping must be: on, its COB-ID, with every SYNC, these objects."""
    entries = mapping_entries(objects)
    expected = [Expected(pdo.communication, 1, "u32", pdo.cob_id + node, ignore=_NO_REMOTE_REQUEST)]
    expected.append(Expected(pdo.communication, 2, "u8", _SYNCHRONOUS))
    expected.append(Expected(pdo.mapping, 0, "u8", len(entries)))
    return expected + [Expected(pdo.mapping, sub, "u32", entry) for sub, entry in enumerate(entries, 1)]


async def read_number(sdo: SdoBus, node: int, entry: CanObject | Expected) -> int | float:
    """The raw number in an object. Raises SdoFailed, also for a length that is not that of its type."""
    data = await sdo.upload(node, entry.index, entry.sub, BYTES[entry.type])
    try:
        return struct.unpack(type_code(entry.type), data)[0]
    except struct.error as error:
        raise SdoFailed(f"{place(entry.index, entry.sub)}: {len(data)} bytes are no {entry.type}") from error


async def differences(sdo: SdoBus, node: int, expected: Sequence[Expected]) -> list[tuple[str, int, int]]:
    """What a node has otherwise than its map says: place, found, wanted. Reads only. Raises SdoFailed."""
    different: list[tuple[str, int, int]] = []
    for entry in expected:
        found = int(await read_number(sdo, node, entry))
        if (found ^ entry.value) & ~entry.ignore:
            different.append((place(entry.index, entry.sub), found, entry.value))
    return different


class Transaction:
    """Writes to one node that can be taken back. Undone in reverse, each object gets what it had before its step,
    so that a PDO mapping passes through the same legal states backwards."""

    def __init__(self, sdo: SdoBus, station: Station) -> None:
        self._sdo = sdo
        self._name, self._node = station.name, station.node
        self._before: list[tuple[Step, bytes]] = []

    async def run(self, steps: list[Step]) -> list[Finding]:
        """Write every step, then read back what must stand in the end; what does not. Raises SdoFailed at the first
        that fails."""
        final: dict[tuple[int, int], tuple[Step, bytes]] = {}
        for step in steps:
            present = await self._sdo.upload(self._node, step.index, step.sub, BYTES[step.type])
            wanted = step.bytes_after(present)
            # Noted before: whatever becomes of the transfer, and of this task, it may have been written.
            self._before.append((step, present))
            try:
                await self._sdo.download(self._node, step.index, step.sub, wanted)
            except SdoSilent:
                raise
            except SdoFailed:
                self._before.pop()  # it has said that it did not take it
                raise
            final[step.index, step.sub] = (step, wanted)
        reasons: list[Finding] = []
        for step, wanted in final.values():
            found = await self._sdo.upload(self._node, step.index, step.sub, len(wanted))
            if found != wanted:
                counts = set_and_found(wanted, found)
                reasons.append(finding("object-reads-back", device=self._name, object=step.name, **counts))
        return reasons

    async def undo(self) -> list[Finding]:
        """Write back what was there before; returns what could not be restored. A node that is silent is left."""
        failures: list[Finding] = []
        while self._before:
            step, present = self._before[-1]
            try:
                await self._sdo.download(self._node, step.index, step.sub, present)
            except SdoSilent as error:
                left = {"objects": len(self._before), "error": str(error)}
                self._before.clear()
                failures.append(finding("node-not-restored", device=self._name, **left))
                break
            except SdoFailed as error:
                failures.append(finding("object-not-restored", device=self._name, error=str(error)))
            self._before.pop()  # not before: cut here, it is written back by the next call
        return failures


def set_and_found(wanted: bytes, found: bytes) -> dict[str, int]:
    """Of an object, as parameters of a finding."""
    return {"set_counts": int.from_bytes(wanted, "little"), "found_counts": int.from_bytes(found, "little")}

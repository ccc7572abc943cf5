"""Whether the drives of a bus may be trusted with torque: there, the right ones, off, configured, watchdogs proven."""

import struct

from drivers.canopen.configure import Transaction, drive_steps
from drivers.canopen.maps import CanObject
from drivers.canopen.node import DriveNode
from drivers.canopen.pdo import type_code
from drivers.canopen.sdo import SdoBus, SdoFailed, SdoSilent
from drivers.cia402 import drive_state, power_state
from drivers.map_rules import BYTES
from drivers.scaling import torque_per_count
from gateway.core.signals import DriveState

_IDENTITY = 0x1018
_RATED_TORQUE_TOLERANCE = 1e-3  #: of the line's figure; more would scale every torque wrongly


async def read_number(sdo: SdoBus, node: int, entry: CanObject) -> int | float:
    """The raw number in an object. Raises SdoFailed, also for a length that is not that of its type."""
    data = await sdo.upload(node, entry.index, entry.sub, BYTES[entry.type])
    try:
        return struct.unpack(type_code(entry.type), data)[0]
    except struct.error as error:
        raise SdoFailed(f"object {entry.index:04X}h sub {entry.sub}: {len(data)} bytes are no {entry.type}") from error


async def read_safe_torque_off(sdo: SdoBus, node: DriveNode) -> bool:
    """Whether the drive says that safe torque off is active; False where its map knows no such object."""
    entry = node.device.objects.safe_torque_off
    if entry is None:
        return False
    return bool(int(await read_number(sdo, node.node, entry)) >> entry.bit & 1) != entry.inverted


async def check_drive(sdo: SdoBus, node: DriveNode) -> list[str]:
    """What speaks against the drive, before anything is written. Reads only."""
    try:
        reasons = await _check_identity(sdo, node)
        if reasons:
            return reasons
        statusword = int(await read_number(sdo, node.node, node.device.objects.statusword))
        if drive_state(power_state(statusword)) in (DriveState.ENABLED, DriveState.STOPPING):
            reasons.append(f"is still enabled (statusword {statusword:04X}h); take its torque off first")
        reasons += await _check_rated_torque(sdo, node) + await _check_max_torque(sdo, node)
        node.stage.safe_torque_off = await read_safe_torque_off(sdo, node)
        return reasons
    except SdoSilent:
        return [f"node {node.node} does not answer; check its power, node number, bit rate and wiring"]
    except SdoFailed as error:
        return [str(error)]


async def _check_identity(sdo: SdoBus, node: DriveNode) -> list[str]:
    wanted = node.device.identity
    vendor = int.from_bytes(await sdo.upload(node.node, _IDENTITY, 1, 4), "little")
    product = int.from_bytes(await sdo.upload(node.node, _IDENTITY, 2, 4), "little")
    if (vendor, product) == (wanted.vendor_id, wanted.product_code):
        return []
    return [
        f"is another device: vendor {vendor:#x} product {product:#x}, its map says "
        f"vendor {wanted.vendor_id:#x} product {wanted.product_code:#x}; correct `map` or the node number"
    ]


async def _check_rated_torque(sdo: SdoBus, node: DriveNode) -> list[str]:
    entry = node.device.objects.rated_torque
    if entry is None:
        return []
    wanted_nm = node.settings.rated_torque_nm
    found_nm = await read_number(sdo, node.node, entry) * torque_per_count(entry.unit, entry.scale, wanted_nm)
    if abs(found_nm - wanted_nm) <= _RATED_TORQUE_TOLERANCE * wanted_nm:
        return []
    return [f"has a rated torque of {found_nm:g} Nm, the line says {wanted_nm:g} Nm; correct rated_torque_nm"]


async def _check_max_torque(sdo: SdoBus, node: DriveNode) -> list[str]:
    entry, settings = node.device.objects.max_torque, node.settings
    if entry.writable:
        return []
    nm_per_count = torque_per_count(entry.unit, entry.scale, settings.rated_torque_nm)
    found_nm = await read_number(sdo, node.node, entry) * nm_per_count
    if found_nm + nm_per_count >= settings.torque_limit_nm:
        return []
    return [f"gives at most {found_nm:g} Nm, limits.torque_nm is {settings.torque_limit_nm:g}; lower the limit"]


async def configure_drives(sdo: SdoBus, nodes: list[DriveNode]) -> tuple[list[Transaction], list[str]]:
    """Write every drive's settings and read them back; the transactions to undo, and what went wrong."""
    transactions: list[Transaction] = []
    reasons: list[str] = []
    for node in nodes:
        transaction = Transaction(sdo, node.node)
        transactions.append(transaction)
        try:
            await transaction.run(drive_steps(node.device, node.settings))
        except (SdoFailed, ValueError) as error:
            reasons.append(f"{node.name}: {error}")
    return transactions, reasons


async def undo_all(transactions: list[Transaction]) -> list[str]:
    """Take every transaction back, the last first; returns what could not be restored."""
    return [failure for transaction in reversed(transactions) for failure in await transaction.undo()]

"""Whether the nodes of a bus may be relied on: there, the right ones, configured, watchdogs proven."""

import asyncio
from collections.abc import Sequence

from drivers.canopen.map_parts import CanIdentity
from drivers.canopen.node import Node
from drivers.canopen.sdo import SdoBus, SdoFailed, SdoSilent
from drivers.canopen.station import Station
from drivers.canopen.transaction import Expected, Transaction, differences
from gateway.core.finding import Finding, finding

WAKING_S = 5.0  #: that a node whose heartbeat is there is waited for until its SDO server answers
HEARTBEAT_AWAITED_S = 1.0  #: that a node that was heard, and is silent now, is waited for
ASKED_AGAIN_S = 0.25
SERIAL_READINGS = 2  #: an abort may be of the moment
_IDENTITY = 0x1018


async def check_identity(sdo: SdoBus, station: Station, wanted: CanIdentity) -> list[Finding]:
    """What speaks against the node being the device of its map. Raises SdoFailed."""
    vendor = int.from_bytes(await sdo.upload(station.node, _IDENTITY, 1, 4), "little")
    product = int.from_bytes(await sdo.upload(station.node, _IDENTITY, 2, 4), "little")
    if (vendor, product) == (wanted.vendor_id, wanted.product_code):
        return []
    should = {"wanted_vendor": wanted.vendor_id, "wanted_product": wanted.product_code}
    return [finding("node-is-another", device=station.name, vendor=vendor, product=product, **should)]


async def check_fixed(sdo: SdoBus, station: Station, expected: Sequence[Expected]) -> list[Finding]:
    """What the node has otherwise than its map says. Raises SdoFailed."""
    return [
        finding("object-differs", device=station.name, object=at, found=found, wanted=wanted)
        for at, found, wanted in await differences(sdo, station.node, expected)
    ]


async def read_serial(sdo: SdoBus, node: int) -> str:
    """The serial number (1018h:04), which not every node has; empty where it has none. Raises SdoSilent.

    Nodes without one abort in their own ways. One that has told it before and aborts twice counts as exchanged.
    """
    for _ in range(SERIAL_READINGS):
        try:
            number = int.from_bytes(await sdo.upload(node, _IDENTITY, 4, 4), "little")
        except SdoSilent:
            raise
        except SdoFailed:
            continue
        return f"{number:#x}" if number else ""
    return ""


async def check_nodes(sdo: SdoBus, nodes: Sequence[Node]) -> list[Finding]:
    """What speaks against the nodes, before anything is written. Reads only."""
    found = await asyncio.gather(*(_check_awake(sdo, node) for node in nodes))
    return [reason for reasons in found for reason in reasons]


async def _check_awake(sdo: SdoBus, node: Node) -> list[Finding]:
    """The same of one. A node that was just switched on may send heartbeats before its SDO server answers."""
    station, now_s = node.station, asyncio.get_running_loop().time
    began_s = now_s()
    while True:
        heartbeats = station.heartbeats
        try:
            return await _check(sdo, node)
        except SdoSilent:
            pass
        if not await _is_alive(node, heartbeats):
            return [finding("node-silent", device=station.name, node=station.node)]
        waited_s = now_s() - began_s
        if waited_s >= WAKING_S:
            return [finding("sdo-silent", device=station.name, state=station.state_name, waited_s=waited_s)]
        await asyncio.sleep(ASKED_AGAIN_S)


async def _is_alive(node: Node, heartbeats: int) -> bool:
    """Whether it has sent a heartbeat since it had sent so many, or does so before long. One never heard does not."""
    station, now_s = node.station, asyncio.get_running_loop().time
    until_s = now_s() + (HEARTBEAT_AWAITED_S if station.nmt_state is not None else 0.0)
    while station.heartbeats == heartbeats and now_s() < until_s:  # noqa: ASYNC110 (a station does no I/O)
        await asyncio.sleep(station.heartbeat_s)
    return station.heartbeats != heartbeats


async def _check(sdo: SdoBus, node: Node) -> list[Finding]:
    """Raises SdoSilent."""
    try:
        if reasons := await check_identity(sdo, node.station, node.identity):
            return reasons
        node.station.serial = await read_serial(sdo, node.station.node)
        return await node.check(sdo)
    except SdoSilent:
        raise
    except SdoFailed as error:
        return [finding("sdo-refused", device=node.station.name, error=str(error))]


async def configure_nodes(sdo: SdoBus, nodes: Sequence[Node], transactions: list[Transaction]) -> list[Finding]:
    """Write every node's settings and read them back; what went wrong.

    What has to be undone is in `transactions`: also when this is cancelled half-way.
    """
    reasons: list[Finding] = []
    for node in nodes:
        transaction = Transaction(sdo, node.station)
        transactions.append(transaction)
        try:
            reasons += await transaction.run(node.steps())
        except (SdoFailed, ValueError) as error:
            reasons.append(finding("node-not-configured", device=node.station.name, error=str(error)))
    return reasons


async def undo_all(transactions: list[Transaction]) -> list[Finding]:
    """Take every transaction back, the last first; returns what could not be restored. None is left then."""
    failures: list[Finding] = []
    while transactions:
        failures += await transactions[-1].undo()
        transactions.pop()
    return failures

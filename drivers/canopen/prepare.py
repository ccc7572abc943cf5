"""Whether the nodes of a bus may be relied on: there, the right ones, configured, watchdogs proven."""

import asyncio
from collections.abc import Sequence

from drivers.canopen.map_parts import CanIdentity
from drivers.canopen.node import Node
from drivers.canopen.sdo import SdoBus, SdoFailed, SdoSilent
from drivers.canopen.transaction import Transaction

_IDENTITY = 0x1018


async def check_identity(sdo: SdoBus, node: int, wanted: CanIdentity) -> list[str]:
    """What speaks against the node being the device of its map. Raises SdoFailed."""
    vendor = int.from_bytes(await sdo.upload(node, _IDENTITY, 1, 4), "little")
    product = int.from_bytes(await sdo.upload(node, _IDENTITY, 2, 4), "little")
    if (vendor, product) == (wanted.vendor_id, wanted.product_code):
        return []
    return [
        f"is another device: vendor {vendor:#x} product {product:#x}, its map says "
        f"vendor {wanted.vendor_id:#x} product {wanted.product_code:#x}; correct `map` or the node number"
    ]


async def check_nodes(sdo: SdoBus, nodes: Sequence[Node]) -> list[str]:
    """What speaks against the nodes, before anything is written, each with its name. Reads only."""
    found = await asyncio.gather(*(_check(sdo, node) for node in nodes))
    return [f"{node.station.name}: {line}" for node, lines in zip(nodes, found, strict=True) for line in lines]


async def _check(sdo: SdoBus, node: Node) -> list[str]:
    try:
        return await check_identity(sdo, node.station.node, node.identity) or await node.check(sdo)
    except SdoSilent:
        return [f"node {node.station.node} does not answer; check its power, node number, bit rate and wiring"]
    except SdoFailed as error:
        return [str(error)]


async def configure_nodes(sdo: SdoBus, nodes: Sequence[Node], transactions: list[Transaction]) -> list[str]:
    """Write every node's settings and read them back; what went wrong.

    What has to be undone is in `transactions`: also when this is cancelled half-way.
    """
    reasons: list[str] = []
    for node in nodes:
        transaction = Transaction(sdo, node.station.node)
        transactions.append(transaction)
        try:
            await transaction.run(node.steps())
        except (SdoFailed, ValueError) as error:
            reasons.append(f"{node.station.name}: {error}")
    return reasons


async def undo_all(transactions: list[Transaction]) -> list[str]:
    """Take every transaction back, the last first; returns what could not be restored. None is left then."""
    failures: list[str] = []
    while transactions:
        failures += await transactions[-1].undo()
        transactions.pop()
    return failures

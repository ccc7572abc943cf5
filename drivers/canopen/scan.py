"""Who is on a CAN bus: first it is listened to, then nodes are asked by SDO upload for what every device has.

Where somebody commands or asks the nodes already, they are not asked: an SDO server answers one client at a time, and
the other's transfer would be broken.
"""

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.canopen.listening import Listening
from drivers.canopen.maps import CanMap
from drivers.canopen.reading_bus import ReadingBus
from drivers.canopen.sdo import SdoSilent
from drivers.inspection import Progress
from gateway.core.line import CanopenBus

NODES = range(1, 128)
_AT_A_TIME = 8  #: nodes; each waits for its own answer

_DEVICE_TYPE, _IDENTITY = 0x1000, 0x1018
_NAME, _HARDWARE, _SOFTWARE = 0x1008, 0x1009, 0x100A


@dataclass(frozen=True, slots=True)
class NodeFound:
    """`vendor_id` to `serial` are None where the node does not say; `answers`: by SDO, not by heartbeat alone."""

    node: int
    nmt_state: str
    heartbeat_hz: float | None
    answers: bool
    device_type: int | None = None
    name: str = ""
    hardware: str = ""
    software: str = ""
    vendor_id: int | None = None
    product_code: int | None = None
    revision: int | None = None
    serial: int | None = None
    maps: tuple[str, ...] = ()  #: those of this vendor and product

    @property
    def profile(self) -> str:
        """What it is by the lower half of object 1000h (CiA 301, 7.5.2.1)."""
        number = None if self.device_type is None else self.device_type & 0xFFFF
        return f"CiA {number}" if number else ""


@dataclass(frozen=True, slots=True)
class CanScan:
    listened_s: float
    load: float
    listening: Listening
    nodes: tuple[NodeFound, ...]
    not_asked: str  #: why the nodes were not asked; empty when they were
    errors: tuple[str, ...]


async def scan(
    config: CanopenBus, listen_s: float, maps: Mapping[str, CanMap], progress: Progress, nodes: Sequence[int] = NODES
) -> CanScan:
    """Listen for `listen_s`, then ask `nodes`. Raises OSError, with what to do, when the bus cannot be opened."""
    bus = ReadingBus(config, list(nodes))
    try:
        progress(f"listening for {listen_s:g} s")
        await bus.listen(listen_s)
        heard = bus.listening
        found = {node: _heard(node, heard) for node in heard.nmt_states}
        not_asked = heard.master() or bus.gone
        if not not_asked:
            bus.ask()
            found |= await _ask_all(bus, nodes, maps, progress)
        return CanScan(
            listened_s=listen_s,
            load=heard.load(config.bitrate_bit_per_s, listen_s),
            listening=heard,
            nodes=tuple(found[node] for node in sorted(found)),
            not_asked=not_asked,
            errors=tuple(bus.errors),
        )
    finally:
        await bus.close()


async def _ask_all(
    bus: ReadingBus, nodes: Sequence[int], maps: Mapping[str, CanMap], progress: Progress
) -> dict[int, NodeFound]:
    free = asyncio.Semaphore(_AT_A_TIME)
    done = 0

    async def ask(node: int) -> NodeFound | None:
        nonlocal done
        async with free:
            found = await _ask(bus, node, maps)
        done += 1
        progress(f"asked {done} of {len(nodes)} nodes")
        return found

    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(ask(node)) for node in nodes]
    answers = [task.result() for task in tasks]
    return {found.node: found for found in answers if found is not None}


def _heard(node: int, heard: Listening) -> NodeFound:
    return NodeFound(node, heard.state_of(node), _heartbeat_hz(node, heard), answers=False)


async def _ask(bus: ReadingBus, node: int, maps: Mapping[str, CanMap]) -> NodeFound | None:
    """None when it does not answer. Whoever aborts is there, too."""
    try:
        device_type = await bus.object(node, _DEVICE_TYPE, 0, "u32")
        identity = [await bus.object(node, _IDENTITY, sub, "u32") for sub in (1, 2, 3, 4)]
        texts = [await bus.text(node, index) for index in (_NAME, _HARDWARE, _SOFTWARE)]
    except SdoSilent:
        return None
    vendor, product, revision, serial = (None if n.value is None else int(n.value) for n in identity)
    return NodeFound(
        node,
        bus.listening.state_of(node),
        _heartbeat_hz(node, bus.listening),
        answers=True,
        device_type=None if device_type.value is None else int(device_type.value),
        name=texts[0],
        hardware=texts[1],
        software=texts[2],
        vendor_id=vendor,
        product_code=product,
        revision=revision,
        serial=serial,
        maps=fitting(maps, vendor, product),
    )


def fitting(maps: Mapping[str, CanMap], vendor_id: int | None, product_code: int | None) -> tuple[str, ...]:
    """The maps of this vendor and product."""
    found = (vendor_id, product_code)
    return tuple(
        name for name, device in maps.items() if (device.identity.vendor_id, device.identity.product_code) == found
    )


def _heartbeat_hz(node: int, heard: Listening) -> float | None:
    seen = heard.frames.get(0x700 + node)
    return None if seen is None else seen.rate_hz

"""What doctor and scan ask of CANopen nodes, against scripted drives; and that they only ask."""

import asyncio
import struct
from collections.abc import Awaitable, Callable
from typing import Any

from drivers.canopen.inspect import inspect
from drivers.canopen.map_parts import CanIdentity
from drivers.canopen.maps import CanMap, DriveMap
from drivers.canopen.reading_bus import ReadingBus
from drivers.canopen.scan import CanScan, scan
from drivers.cia402 import PowerState
from drivers.device_map import MAPS, load_map
from drivers.inspection import BusFacts
from drivers.wiring import Wired
from gateway.core.line import CanopenBus
from tests.protocol.driver_support import FAULT, GROUP, Drive, Drives, line
from tests.support.ports import free_port

LISTEN_S = 0.1
READS = {0x40, 0x60, 0x70, 0x80}  #: first bytes of SDO uploads and their abort (CiA 301, 7.2.4.3)


def quiet(text: str) -> None:
    """Nobody waits."""


async def inspected(bus: CanopenBus, drives: int = 2, listen_s: float = LISTEN_S) -> BusFacts:
    of_line = line(drives)
    devices = [Wired(drive, bus, load_map(MAPS / f"{drive.map}.toml")) for drive in of_line.drives]
    return await inspect(bus, devices, listen_s, 0.0, quiet)


def bench(body: Callable[[CanopenBus, Drives], Awaitable[None]], *peers: Drive) -> None:
    """`body` with a bus and drives on it; afterwards everything that was sent to them must have been a reading."""
    wire: dict[str, Any] = {"interface": "udp_multicast", "channel": GROUP, "port": free_port()}

    async def run() -> None:
        bus = CanopenBus(name="drives", protocol="canopen", **wire)
        async with Drives(list(peers), **wire, hop_limit=0, fd=False) as drives:
            await body(bus, drives)
            for cob_id, data in drives.frames:
                assert cob_id & ~0x7F == 0x600 and data[0] in READS, f"{cob_id:03X}h {data.hex()} is no reading"
        for drive in peers:
            assert not drive.writes and not drive.nmt and not drive.rpdos

    asyncio.run(run())


def test_a_drive_as_its_map_says() -> None:
    async def body(bus: CanopenBus, drives: Drives) -> None:
        facts = await inspected(bus)
        first, second = facts.devices
        for device, node in ((first, 1), (second, 2)):
            assert device.believed and device.place == f"node {node}"
            assert device.drive is not None and device.watchdog is not None
            assert device.drive.power is PowerState.SWITCH_ON_DISABLED
            assert device.drive.rated_torque_nm is not None and device.drive.rated_torque_nm.value == 80.0
            assert device.drive.max_torque_nm is not None and device.drive.max_torque_nm.value == 80.0
            assert device.drive.safe_torque_off is False
            assert device.watchdog.low_s == 0.01 and device.watchdog.high_s == 0.2
        assert first.watchdog is not None and first.watchdog.now_s.value == 0.0
        assert second.watchdog is not None and second.watchdog.now_s.value == 0.05

    first, second = Drive(1), Drive(2)
    second.objects[0x1400, 5] = struct.pack("<H", 50)
    bench(body, first, second)


def test_another_device_a_missing_watchdog_and_nobody() -> None:
    async def body(bus: CanopenBus, drives: Drives) -> None:
        facts = await inspected(bus, drives=3)
        foreign, lame, nobody = facts.devices
        assert foreign.identity is not None and not foreign.identity.fits
        assert foreign.identity.found == "vendor 0x520 product 0x999"
        assert foreign.drive is None, "what another device says means nothing"
        assert lame.watchdog is not None and lame.watchdog.now_s.value is None
        assert "1400h sub 5" in lame.watchdog.now_s.trouble
        assert lame.drive is not None and lame.drive.power is not None, "the rest is told all the same"
        assert "does not answer" in nobody.silent

    foreign, lame = Drive(1), Drive(2)
    foreign.objects[0x1018, 2] = struct.pack("<I", 0x999)
    del lame.objects[0x1400, 5]
    bench(body, foreign, lame)


def test_a_drive_in_fault_names_its_error_and_one_in_sto_says_so() -> None:
    async def body(bus: CanopenBus, drives: Drives) -> None:
        faulty, stopped = (device.drive for device in (await inspected(bus)).devices)
        assert faulty is not None and faulty.power is PowerState.FAULT
        assert faulty.error.startswith("error 8250h")
        assert stopped is not None and stopped.safe_torque_off is True and not stopped.error

    faulty, stopped = Drive(1), Drive(2)
    faulty.statusword = FAULT
    faulty.objects[0x603F, 0] = struct.pack("<H", 0x8250)
    stopped.objects[0x60FD, 0] = struct.pack("<I", 1 << 16)
    bench(body, faulty, stopped)


def test_a_stopped_node_is_told_from_one_that_is_not_there() -> None:
    async def body(bus: CanopenBus, drives: Drives) -> None:
        looking = asyncio.create_task(inspected(bus, listen_s=0.3))
        while not looking.done():
            drives.heartbeat(1, 4)
            await asyncio.sleep(0.02)
        stopped, silent = looking.result().devices
        assert stopped.silent == "is stopped (NMT) and answers no SDO"
        assert silent.silent == "does not answer by SDO"

    first = Drive(1)
    first.sdo_answers = False
    bench(body, first)


def test_nodes_that_somebody_commands_are_not_asked() -> None:
    async def body(bus: CanopenBus, drives: Drives) -> None:
        async def master() -> None:
            while True:
                drives.send(0x201, bytes(5))
                await asyncio.sleep(0.02)

        commanding = asyncio.create_task(master())
        try:
            facts = await inspected(bus, listen_s=0.3)
            found = await scan(bus, 0.3, {}, quiet, range(1, 4))
        finally:
            commanding.cancel()
        assert "RPDO1 of node 1" in facts.not_asked
        assert all(device.silent == facts.not_asked for device in facts.devices)
        assert "RPDO1 of node 1" in found.not_asked and not found.nodes
        assert {cob_id for cob_id, _ in drives.frames} == {0x201}, "ours alone: nobody was asked anything"
        drives.frames.clear()
        drives.drives[1].rpdos.clear()

    bench(body, Drive(1), Drive(2))


def test_a_bus_that_cannot_be_opened_is_said() -> None:
    async def run() -> None:
        bus = CanopenBus(name="drives", protocol="canopen", interface="socketcan", channel="nowhere9")
        facts = await inspected(bus)
        assert "cannot open socketcan nowhere9" in facts.trouble and not facts.devices

    asyncio.run(run())


def test_nothing_but_a_reading_can_leave() -> None:
    async def run() -> None:
        bus = ReadingBus(CanopenBus(name="b", protocol="canopen", interface="virtual", channel="inspect-only"), [1])
        try:
            await bus.listen(0.0)
            bus.ask()
            for write in (bus.sdo.download(1, 0x6040, 0, b"\x0f\0"), bus.sdo.download(1, 0x2000, 0, bytes(20))):
                try:
                    await write
                except AssertionError as refused:
                    assert "does not send 601h" in str(refused)
                else:
                    raise AssertionError("a write has left")
        finally:
            await bus.close()

    asyncio.run(run())


def maps() -> dict[str, CanMap]:
    device = load_map(MAPS / "cia402-torque.toml")
    assert isinstance(device, DriveMap)
    other = device.model_copy(update={"identity": CanIdentity(vendor_id=1, product_code=2)})
    return {"cia402-torque": device, "another": other}


async def scanned(bus: CanopenBus, listen_s: float = LISTEN_S) -> CanScan:
    return await scan(bus, listen_s, maps(), quiet, range(1, 8))


def test_scan_finds_who_answers_with_the_maps_that_fit() -> None:
    async def body(bus: CanopenBus, drives: Drives) -> None:
        found = await scanned(bus)
        assert [node.node for node in found.nodes] == [3, 5]
        known, unknown = found.nodes
        assert known.maps == ("cia402-torque",) and known.profile == "CiA 402" and known.name == "spin"
        assert (unknown.vendor_id, unknown.product_code, unknown.maps) == (0x520, 0x777, ())
        assert unknown.answers and unknown.name == "", "optional objects are aborted: it is there all the same"

    known, unknown = Drive(3), Drive(5)
    known.objects |= {(0x1000, 0): struct.pack("<I", 0x00020192), (0x1008, 0): b"spin"}
    unknown.objects[0x1018, 2] = struct.pack("<I", 0x777)
    bench(body, known, unknown)


def test_scan_counts_what_it_hears() -> None:
    async def body(bus: CanopenBus, drives: Drives) -> None:
        looking = asyncio.create_task(scanned(bus, listen_s=0.3))
        while not looking.done():
            drives.heartbeat(9, 0x7F)
            await asyncio.sleep(0.01)
        found = looking.result()
        heard = found.listening.frames[0x709]
        assert heard.bits == 65 * heard.count, "55 + 10 s bits a frame"
        assert found.load == heard.bits / (1e6 * 0.3)
        (node,) = found.nodes
        assert (node.node, node.nmt_state, node.answers) == (9, "pre-operational", False)

    bench(body)

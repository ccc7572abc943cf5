"""The CANopen link against scripted drives: raw frames over udp_multicast, and over virtual."""

import asyncio
import errno
import os
import socket
import struct
from collections.abc import Awaitable, Callable
from math import inf, nan
from typing import Any

import can
import pytest

from drivers.canopen.link import CanopenLink
from drivers.port import PrepareRefused
from drivers.power_stage import ORDERS_IGNORED
from drivers.registry import build_links
from gateway.core.finding import Finding, finding
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs, Quality
from tests.protocol.driver_support import (
    ENABLED,
    FAULT,
    GROUP,
    READY,
    SWITCH_ON_DISABLED,
    Drive,
    Drives,
    cycle,
    line,
    until,
)
from tests.support.ports import free_port

Body = Callable[[CanopenLink, Drives, Drive, Drive], Awaitable[None]]


def bench(body: Body, **bus: Any) -> None:
    """Two drives on a fresh bus, the link open."""
    if not bus:
        bus = {"interface": "udp_multicast", "channel": GROUP, "port": free_port()}
    peer_bus = {**bus, "hop_limit": 0, "fd": False} if bus["interface"] == "udp_multicast" else bus

    async def run() -> None:
        first, second = Drive(1), Drive(2)
        link = build_links(line(can_bus=bus))[0]
        assert isinstance(link, CanopenLink)
        async with Drives([first, second], **peer_bus) as drives:
            await link.open()
            try:
                await body(link, drives, first, second)
            finally:
                await link.close()

    asyncio.run(run())


def write(link: CanopenLink, request: DriveRequest, torque_nm: float = 0.0) -> Outputs:
    outputs = Outputs(2)
    outputs.drive_request[:] = request
    outputs.torque_nm[:] = torque_nm
    link.write(outputs)
    return outputs


async def settle(drives: Drives) -> None:
    """Let the peer read everything that was sent before."""
    seen = len(drives.frames)
    drives.send(0x67F, bytes(8))  # a frame to nobody
    await until(lambda: any(cob_id == 0x67F for cob_id, _ in drives.frames[seen:]))


def test_prepare_configures_and_proves_the_watchdog() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        await link.prepare()
        for drive in (first, second):
            assert drive.objects[0x1400, 5] == struct.pack("<H", 100)
            assert drive.objects[0x6060, 0] == b"\x0a"
            assert drive.objects[0x1017, 0] == struct.pack("<H", 100)
            assert drive.objects[0x1400, 1] == struct.pack("<I", 0x200 + drive.node)
            assert drive.objects[0x1800, 1] == struct.pack("<I", 0x40000180 + drive.node), "bit 30 is the drive's own"
            assert drive.objects[0x1600, 0] == b"\x03"
            mapped = [struct.unpack("<I", drive.objects[0x1600, sub])[0] for sub in (1, 2, 3)]
            assert mapped == [0x60400010, 0x60710010, 0x60600008]
            mapped = [struct.unpack("<I", drive.objects[0x1A00, sub])[0] for sub in (1, 2, 3)]
            assert mapped == [0x60410010, 0x606C0020, 0x60770010]
            assert drive.nmt == [0x80, 0x01], "configured in pre-operational, then started"
            # The mapping is only touched while the PDO is off (bit 31) and empty (sub 0 is 0).
            order = [(index, sub) for index, sub, _ in drive.writes]
            off = drive.writes[order.index((0x1400, 1))]
            assert struct.unpack("<I", off[2])[0] >> 31
            assert order.index((0x1400, 1)) < order.index((0x1600, 0)) < order.index((0x1600, 1))
            assert order[-2:] == [(0x1400, 1), (0x1800, 1)]

    bench(body)


def test_silent_link_sends_nothing() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        drives.heartbeat(1, 0x7F)
        await cycle(link, inputs)
        write(link, DriveRequest.ENABLE, 10.0)
        await cycle(link, inputs)
        await settle(drives)
        assert [cob_id for cob_id, _ in drives.frames] == [0x67F]
        assert list(inputs.drive_state) == [DriveState.OFF, DriveState.ABSENT]
        assert set(inputs.speed.quality) == {Quality.MISSING}

        await link.prepare()
        link.silence()
        drives.frames.clear()
        await cycle(link, inputs)
        write(link, DriveRequest.ENABLE, 10.0)
        await settle(drives)
        assert [cob_id for cob_id, _ in drives.frames] == [0x67F]

    bench(body)


@pytest.mark.parametrize("interface", ["udp_multicast", pytest.param("virtual", marks=pytest.mark.wires)])
def test_a_cycle_reads_si_and_commands_one_transition_at_a_time(interface: str) -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.speed_um_per_s, first.torque_per_mille = -123_456, 250
        now_s = asyncio.get_running_loop().time()
        link.trigger(now_s)
        await link.collect(inputs, now_s + 0.5)
        assert inputs.speed.value[0] == pytest.approx(-0.123456)
        assert inputs.torque.value[0] == pytest.approx(20.0)  # 250 per mille of 80 Nm
        assert inputs.speed.time_s[0] == now_s, "a sample is as old as its SYNC"
        assert inputs.speed.good() and inputs.torque.good()
        for statusword, state, controlword in (
            (SWITCH_ON_DISABLED, DriveState.OFF, 0x06),
            (READY, DriveState.READY, 0x07),
            (0x0233, DriveState.READY, 0x0F),
            (ENABLED, DriveState.ENABLED, 0x0F),
        ):
            first.statusword = second.statusword = statusword
            await cycle(link, inputs)
            assert list(inputs.drive_state) == [state, state]
            first.rpdos.clear()
            write(link, DriveRequest.ENABLE, 10.0)
            await until(lambda: bool(first.rpdos))
            torque_per_mille = 125 if statusword == ENABLED else 0  # 10 Nm of 80 Nm, and only when enabled
            assert first.rpdos == [struct.pack("<Hhb", controlword, torque_per_mille, 10)]
        assert link.health.malformed == link.health.timeouts == 0

    if interface == "virtual":
        bench(body, interface="virtual", channel="test-driver-canopen")
    else:
        bench(body)


def test_duplicate_and_late_answers_are_discarded() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()

        def twice(drive: Drive) -> list[bytes]:
            other = struct.pack("<Hih", SWITCH_ON_DISABLED, 999, 0)
            return [drive.tpdo(), other]

        first.speed_um_per_s = 1_000_000
        first.on_sync = twice
        await cycle(link, inputs)
        assert inputs.speed.value[0] == 1.0
        await settle(drives)
        await until(lambda: link.health.malformed == 1)

        first.on_sync = lambda drive: []
        await cycle(link, inputs, 0.02)
        assert list(inputs.speed.quality) == [Quality.STALE, Quality.GOOD]
        assert link.health.timeouts == 1
        # The answer to that SYNC comes now, and waits in the socket when the next SYNC is sent.
        drives.send(0x181, struct.pack("<Hih", SWITCH_ON_DISABLED, 5_000_000, 0))
        await cycle(link, inputs, 0.02)
        assert list(inputs.speed.quality) == [Quality.STALE, Quality.GOOD]
        assert inputs.speed.value[0] == 1.0, "the last good value stays"
        assert (link.health.timeouts, link.health.malformed) == (2, 2)

    bench(body)


@pytest.mark.parametrize("payload", [b"", bytes(7), struct.pack("<Hi", ENABLED, 5)])
def test_wrong_length_is_no_answer(payload: bytes) -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.on_sync = lambda drive: [payload]
        await cycle(link, inputs, 0.02)
        assert list(inputs.speed.quality) == [Quality.MISSING, Quality.GOOD]
        assert link.health.malformed == 1
        assert "drive-1" in link.health.last_error and "8" in link.health.last_error

    bench(body)


def test_a_drive_that_is_lost_is_told_to_stop_and_its_watchdog_is_not_fed() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.statusword = second.statusword = ENABLED
        await cycle(link, inputs)
        first.on_sync = lambda drive: []
        for missed in (1, 2):  # held meanwhile
            await cycle(link, inputs, 0.02)
            assert list(inputs.drive_state) == [DriveState.ENABLED] * 2
            first.rpdos.clear()
            write(link, DriveRequest.ENABLE, 10.0)
            await until(lambda: bool(first.rpdos))
            assert first.rpdos[0][:4] == struct.pack("<Hh", 0x0F, 125), missed
        first.rpdos.clear()
        first.nmt.clear()
        for _ in range(4):
            await cycle(link, inputs, 0.02)
            assert list(inputs.drive_state) == [DriveState.ABSENT, DriveState.ENABLED]
            write(link, DriveRequest.ENABLE, 10.0)
            await settle(drives)
        assert first.nmt == [0x80], "once; it takes torque off without a SYNC"
        assert first.rpdos == [], "if it did not hear that, its watchdog has to fire"
        assert link.health.absent == ["drive-1"] and "drive-1" in link.health.last_error
        assert second.rpdos and second.nmt == [0x80, 0x01]
        # An absent drive is not waited for: this returns although the deadline is far away.
        async with asyncio.timeout(5.0):
            await cycle(link, inputs, 60.0)
        # It did not hear the command and is back: heard, but not fed until it has been prepared again.
        first.on_sync = lambda drive: [drive.tpdo()]
        await until_back(link, inputs)
        assert list(inputs.drive_state) == [DriveState.FAULT, DriveState.ENABLED] and inputs.speed.good()
        write(link, DriveRequest.ENABLE, 10.0)
        await settle(drives)
        assert first.rpdos == [] and first.nmt == [0x80]
        first.statusword = second.statusword = READY
        await link.prepare()
        await cycle(link, inputs)
        assert list(inputs.drive_state) == [DriveState.READY] * 2
        write(link, DriveRequest.READY)
        await until(lambda: bool(first.rpdos))

    bench(body)


def test_a_drive_without_heartbeats_is_not_fed_either() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.statusword = second.statusword = ENABLED
        await cycle(link, inputs)
        first.rpdos.clear()
        drives.drives[1].nmt.clear()
        node = link._nodes[0]  # noqa: SLF001
        assert node.station.heard_s is not None
        node.station.heard_s -= 10.0
        write(link, DriveRequest.ENABLE, 10.0)
        await settle(drives)
        assert (first.nmt, first.rpdos) == ([0x80], [])

    bench(body)


async def until_back(link: CanopenLink, inputs: Inputs) -> None:
    """Cycles that wait as briefly as those of a line until every drive is heard again."""
    async with asyncio.timeout(5.0):
        while DriveState.ABSENT in inputs.drive_state:
            await cycle(link, inputs, 0.02)


def test_drives_that_were_all_absent_are_heard_again() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.on_sync = second.on_sync = lambda drive: []
        for _ in range(5):
            await cycle(link, inputs, 0.02)
        assert list(inputs.drive_state) == [DriveState.ABSENT] * 2
        first.on_sync = second.on_sync = lambda drive: [drive.tpdo()]
        first.speed_um_per_s = 1_000_000
        await cycle(link, inputs, 0.02)
        await settle(drives)  # their answers are under way, though nobody waited for them
        assert inputs.speed.quality[0] != Quality.GOOD, "a late sample is not used"
        await cycle(link, inputs)
        assert inputs.speed.good() and inputs.speed.value[0] == 1.0

    bench(body)


def test_all_that_waits_is_read_before_a_sync() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        await cycle(link, inputs)
        first.on_sync = lambda drive: []
        others = [(0x555, b"")] * 300
        link._bus._drain(1 << 16)  # noqa: SLF001
        wire: Any = link._bus._wire  # noqa: SLF001
        wire.receive = iter([*others, (0x181, first.tpdo()), None, None, None]).__next__
        link.trigger(asyncio.get_running_loop().time())
        assert link.health.malformed == 1, "the old answer is found behind all the others, before the SYNC"

    bench(body)


def test_the_answer_of_an_absent_drive_does_not_stand_in_for_another() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.on_sync = lambda drive: []
        for _ in range(3):
            await cycle(link, inputs, 0.02)
        asked = asyncio.Event()

        def later(drive: Drive) -> list[bytes]:
            asked.set()
            return []

        first.on_sync, second.on_sync = (lambda drive: [drive.tpdo()]), later
        collecting = asyncio.create_task(cycle(link, inputs, 5.0))
        await asked.wait()
        drives.send(0x081, bytes(1))  # an EMCY of a wrong length: counted once the link has read what came before
        await until(lambda: link.health.malformed == 1)
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert not collecting.done(), "the second drive's answer is still to come"
        drives.send(0x182, second.tpdo())
        await collecting
        assert inputs.speed.good()

    bench(body)


def test_frames_stay_on_this_machine() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        assert link._bus._bus is not None  # noqa: SLF001
        descriptor = link._bus._bus.fileno()  # noqa: SLF001
        with socket.socket(fileno=os.dup(descriptor)) as interface:
            assert interface.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 0

    bench(body)


def test_heartbeat_is_supervised_by_time() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        await cycle(link, inputs)
        heard_s = asyncio.get_running_loop().time()
        assert list(inputs.drive_state) == [DriveState.OFF] * 2
        drives.drives.clear()  # nobody answers, no heartbeat comes
        link.trigger(heard_s + 0.151)
        await link.collect(inputs, 0.0)
        assert list(inputs.drive_state) == [DriveState.OFF] * 2, "without torque they may be late"
        link.trigger(heard_s + 0.301)
        await link.collect(inputs, 0.0)
        assert list(inputs.drive_state) == [DriveState.ABSENT] * 2, "3 x 100 ms have passed"

    bench(body)


def test_boot_up_means_lost_settings() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.statusword = second.statusword = ENABLED
        await cycle(link, inputs)
        drives.heartbeat(1, 0)
        drives.heartbeat(1, 5)  # whatever it says afterwards
        await cycle(link, inputs)
        assert list(inputs.drive_state) == [DriveState.FAULT, DriveState.ENABLED]
        assert "restarted" in link.health.last_error and "drive-1" in link.health.last_error
        write(link, DriveRequest.ENABLE, 10.0)
        await until(lambda: bool(first.rpdos))
        assert first.rpdos[0][:4] == bytes(4), "no torque for a drive whose watchdog is gone"
        first.statusword = second.statusword = READY
        await link.prepare()
        await cycle(link, inputs)
        assert list(inputs.drive_state) == [DriveState.READY] * 2

    bench(body)


@pytest.mark.parametrize("state", [0x04, 0x7F])
def test_leaving_operational_is_a_fault(state: int) -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        await cycle(link, inputs)
        drives.heartbeat(2, state)
        await cycle(link, inputs)
        assert list(inputs.drive_state) == [DriveState.OFF, DriveState.FAULT]

    bench(body)


def test_emergency_counts_at_once_until_it_is_reset() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.statusword = second.statusword = ENABLED
        await cycle(link, inputs)
        drives.send(0x082, struct.pack("<HB5x", 0x8250, 0x11))
        await cycle(link, inputs)
        assert list(inputs.drive_state) == [DriveState.ENABLED, DriveState.FAULT], "before the statusword says so"
        assert "drive-2" in link.health.last_error and "8250h" in link.health.last_error
        second.statusword = FAULT
        edges: list[int] = []
        for _ in range(4):
            await cycle(link, inputs)
            second.rpdos.clear()
            write(link, DriveRequest.RESET_FAULT)
            await until(lambda: bool(second.rpdos))
            edges.append(struct.unpack("<H", second.rpdos[0][:2])[0])
        assert edges == [0x80, 0x00, 0x80, 0x00], "bit 7 has to rise"
        second.statusword = SWITCH_ON_DISABLED
        await cycle(link, inputs)
        assert list(inputs.drive_state) == [DriveState.ENABLED, DriveState.OFF]

    bench(body)


@pytest.mark.parametrize("torque_nm", [nan, inf, -inf, 1e9, 2700.0])
def test_a_torque_that_cannot_be_commanded_is_never_sent(torque_nm: float) -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs, outputs = Inputs(2), Outputs(2)
        await link.prepare()
        first.statusword = second.statusword = ENABLED
        await cycle(link, inputs)
        outputs.drive_request[:] = DriveRequest.ENABLE
        outputs.torque_nm[:] = torque_nm, 8.0
        link.write(outputs)
        await until(lambda: bool(second.rpdos))
        assert not first.rpdos
        assert link.health.malformed == 1 and "drive-1" in link.health.last_error

    bench(body)


def test_safe_torque_off_is_asked_for_while_a_drive_may_not_switch_on() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.statusword = second.statusword = ENABLED
        await cycle(link, inputs)
        first.objects[0x60FD, 0] = struct.pack("<I", 1 << 16)
        first.statusword = SWITCH_ON_DISABLED & ~0x10
        async with asyncio.timeout(5.0):
            while inputs.drive_state[0] != DriveState.STO:
                await cycle(link, inputs)
                link.write(Outputs(2))
        assert inputs.drive_state[1] == DriveState.ENABLED
        first.statusword = READY
        await cycle(link, inputs)
        assert inputs.drive_state[0] == DriveState.READY

    bench(body)


def test_a_drive_that_ignores_its_orders_is_dropped() -> None:
    """Its watchdog has to fire, so nothing may renew it."""

    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.statusword = second.statusword = ENABLED
        await cycle(link, inputs)
        write(link, DriveRequest.ENABLE, 10.0)
        second.statusword = SWITCH_ON_DISABLED
        for _ in range(ORDERS_IGNORED + 1):
            await cycle(link, inputs)
            write(link, DriveRequest.OFF)
        await settle(drives)
        assert first.nmt == [0x80, 0x01] and len(first.rpdos) == ORDERS_IGNORED + 2
        first.rpdos.clear()
        for _ in range(3):
            await cycle(link, inputs)
            write(link, DriveRequest.OFF)
        await settle(drives)
        assert (first.nmt, first.rpdos) == ([0x80, 0x01, 0x80], []), "told once, and fed no more"
        assert second.nmt == [0x80, 0x01] and second.rpdos
        await cycle(link, inputs)
        assert list(inputs.drive_state) == [DriveState.FAULT, DriveState.OFF]
        first.statusword = READY
        await link.prepare()
        await cycle(link, inputs)
        write(link, DriveRequest.OFF)
        await until(lambda: bool(first.rpdos))
        assert inputs.drive_state[0] == DriveState.READY

    bench(body)


# what prepare refuses


def refusal(arrange: Callable[[Drive, Drive], None]) -> tuple[list[Finding], Drive, Drive]:
    seen: list[tuple[list[Finding], Drive, Drive]] = []

    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        arrange(first, second)
        with pytest.raises(PrepareRefused) as refused:
            await link.prepare()
        drives.frames.clear()
        await cycle(link, Inputs(2))
        write(link, DriveRequest.ENABLE, 10.0)
        await settle(drives)
        assert [cob_id for cob_id, _ in drives.frames] == [0x67F], "a refused link stays silent"
        seen.append((refused.value.reasons, first, second))

    bench(body)
    return seen[0]


def test_every_reason_is_given_with_its_device() -> None:
    def arrange(first: Drive, second: Drive) -> None:
        first.objects[0x1018, 2] = struct.pack("<I", 0x999)
        second.objects[0x6076, 0] = struct.pack("<I", 60_000)
        second.objects[0x6072, 0] = struct.pack("<H", 500)
        second.statusword = ENABLED

    reasons, first, second = refusal(arrange)
    vendors = {"vendor": 0x520, "wanted_vendor": 0x520}
    assert reasons == [
        finding("node-is-another", device="drive-1", product=0x999, wanted_product=0x402, **vendors),
        finding("still-enabled", drive="drive-2", statusword=ENABLED),
        finding("rated-torque-differs", drive="drive-2", found_nm=60.0, wanted_nm=80.0),
        finding("max-torque-too-low", drive="drive-2", found_nm=40.0, limit_nm=60.0),
    ]
    assert first.writes == second.writes == [] and first.nmt == second.nmt == [0x80]


def test_a_missing_drive_is_refused() -> None:
    def arrange(first: Drive, second: Drive) -> None:
        second.sdo_answers = False

    reasons, first, _ = refusal(arrange)
    assert reasons == [finding("node-silent", device="drive-2", node=2)]
    assert first.writes == []


def test_an_sdo_abort_undoes_the_whole_transaction() -> None:
    pristine = Drive(1).objects, Drive(2).objects

    def arrange(first: Drive, second: Drive) -> None:
        second.aborts[0x1400, 5] = 0x06090030

    reasons, first, second = refusal(arrange)
    (reason,) = reasons
    error = str(reason.parameters["error"])
    assert (reason.code, reason.parameters["device"]) == ("node-not-configured", "drive-2")
    assert "1400h sub 5" in error and "06090030" in error, "what the library says"
    assert (first.objects, second.objects) == pristine
    assert first.writes and second.writes, "there was something to undo"
    assert first.nmt[-1] == second.nmt[-1] == 0x80 and 0x01 not in first.nmt


def test_a_watchdog_that_does_not_stick_is_found_by_reading_it_back() -> None:
    def arrange(first: Drive, second: Drive) -> None:
        first.stubborn.add((0x1400, 5))

    reasons, first, second = refusal(arrange)
    reads_back = {"object": "object 1400h sub 5", "set_counts": 100, "found_counts": 0}
    assert reasons == [finding("object-reads-back", device="drive-1", **reads_back)]
    assert second.objects == Drive(2).objects


def test_a_drive_that_does_not_start_is_refused() -> None:
    def arrange(first: Drive, second: Drive) -> None:
        second.starts = False

    reasons, first, second = refusal(arrange)
    assert [(one.code, one.parameters["device"]) for one in reasons] == [("node-not-operational", "drive-2")]
    assert first.objects == Drive(1).objects and second.objects == Drive(2).objects


def test_a_drive_that_restarts_meanwhile_is_refused() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        second.starts = False
        preparing = asyncio.create_task(link.prepare())
        await until(lambda: 0x01 in second.nmt)
        drives.heartbeat(2, 0)
        drives.heartbeat(2, 5)
        with pytest.raises(PrepareRefused, match="restarted-meanwhile"):
            await preparing

    bench(body)


@pytest.mark.parametrize(
    ("number", "advice"), [(errno.ENODEV, "ip link set nocan9 up"), (errno.EAFNOSUPPORT, "this kernel has no CAN")]
)
def test_a_bus_that_cannot_be_opened_says_what_to_do(number: int, advice: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(**_: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(can, "Bus", fails)

    async def run() -> None:
        link = build_links(line(can_bus={"interface": "socketcan", "channel": "nocan9"}))[0]
        with pytest.raises(OSError, match=advice):
            await link.open()
        with pytest.raises(PrepareRefused) as refused:
            await link.prepare()
        assert refused.value.reasons[0].code == "can-bus-not-open"
        assert advice in str(refused.value.reasons[0].parameters["error"])
        await link.close()

    asyncio.run(run())


def test_a_bus_that_was_not_there_is_opened_by_prepare(monkeypatch: pytest.MonkeyPatch) -> None:
    real, attempts = can.Bus, [OSError(errno.ENODEV, "No such device")]

    def comes_up(**options: Any) -> can.BusABC:
        if attempts:
            raise attempts.pop()
        return real(**options)

    async def run() -> None:
        bus = {"interface": "udp_multicast", "channel": GROUP, "port": free_port()}
        link = build_links(line(can_bus=bus))[0]
        async with Drives([Drive(1), Drive(2)], **bus, hop_limit=0, fd=False):
            monkeypatch.setattr(can, "Bus", comes_up)
            with pytest.raises(OSError, match="No such device"):
                await link.open()
            inputs = Inputs(2)
            await link.prepare()
            await cycle(link, inputs)
            assert inputs.speed.good()
            await link.close()

    asyncio.run(run())


def test_a_stopped_node_is_recovered() -> None:
    """In NMT stopped a node answers no SDO; its heartbeats may not even have been seen yet."""

    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        second.sdo_answers = False
        leave_stopped = drives._on_nmt  # noqa: SLF001

        def on_nmt(command: int, node: int) -> None:
            second.sdo_answers |= (command, node) == (0x80, 2)
            leave_stopped(command, node)

        drives._on_nmt = on_nmt  # noqa: SLF001
        await link.prepare()
        await cycle(link, inputs := Inputs(2))
        assert inputs.speed.good()

    bench(body)


def test_an_object_of_unstated_size_is_read_without_its_surplus_zeros() -> None:
    """CiA 301: an expedited upload may leave its size open (s = 0); four bytes come then."""
    pristine = Drive(1).objects

    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        stated = first.sdo

        def unstated(request: bytes) -> bytes | None:
            answer = stated(request)
            return b"\x42" + answer[1:] if answer is not None and answer[0] & 0xE2 == 0x42 else answer

        first.sdo = unstated
        await link.prepare()
        assert first.objects[0x1400, 5] == struct.pack("<H", 100) and len(first.objects[0x6060, 0]) == 1
        second.aborts[0x1400, 5] = 0x06090030
        first.objects.update(pristine)
        with pytest.raises(PrepareRefused):
            await link.prepare()
        assert first.objects == pristine, "undone with the lengths that the objects have"

    bench(body)


def test_surplus_bytes_that_are_not_zero_are_refused() -> None:
    def arrange(first: Drive, second: Drive) -> None:
        first.objects[0x6072, 0] = struct.pack("<HH", 1000, 1)

    reasons, _, _ = refusal(arrange)
    assert reasons == [finding("sdo-refused", device="drive-1", error="object 6072h sub 0: 4 bytes are no u16")]


def test_garbage_on_the_bus_is_counted_and_harmless() -> None:
    port = free_port()

    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as raw:
            raw.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            # The peer reads the same bus: it must not choke, so the garbage goes out after it stopped listening.
            drives.send(0x701, bytes(3))  # a heartbeat of a wrong length
            drives.send(0x081, bytes(2))  # an EMCY of a wrong length
            drives.send(0x581, bytes(5))  # an SDO answer of a wrong length
            drives.send(0x555, bytes(8))  # nobody's
            await cycle(link, inputs)
            assert link.health.malformed == 2 and inputs.speed.good()
            asyncio.get_running_loop().remove_reader(drives._bus.fileno())  # noqa: SLF001
            raw.sendto(b"\xc1no frame", (GROUP, port))
            await until(lambda: link.health.malformed == 3)
            assert "discarded" in link.health.last_error

    bench(body, interface="udp_multicast", channel=GROUP, port=port)

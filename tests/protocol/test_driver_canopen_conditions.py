"""What a CANopen drive says beside its state: mode, power, warnings; and one that has just been switched on."""

import asyncio
import struct
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.canopen import prepare
from drivers.canopen.link import CanopenLink
from drivers.device_map import MAPS, MapRefused, load_map
from drivers.port import PrepareRefused
from drivers.registry import build_links
from gateway.core.finding import finding
from gateway.core.signals import DriveCondition, DriveRequest, DriveState, Inputs, Outputs
from tests.protocol.driver_support import ENABLED, FAULT, GROUP, READY, Drive, Drives, cycle, line, until
from tests.support.ports import free_port

Body = Callable[[CanopenLink, Drives, Drive], Awaitable[None]]
PERIOD_S = 0.02  # of the tests: how often a drive is asked


def bench(body: Body, maps: Path = MAPS, **objects: bytes | None) -> None:
    """One drive on a fresh bus, the link open."""
    port = free_port()
    bus: dict[str, Any] = {"interface": "udp_multicast", "channel": GROUP, "port": port}

    async def run() -> None:
        drive = Drive(1)
        link = build_links(line(n=1, can_bus=bus), maps)[0]
        assert isinstance(link, CanopenLink)
        async with Drives([drive], **bus, hop_limit=0, fd=False) as drives:
            await link.open()
            try:
                await body(link, drives, drive)
            finally:
                await link.close()

    asyncio.run(run())


def changed_map(tmp_path: Path, *changes: tuple[str, str]) -> Path:
    """All maps, with that of the drive changed."""
    for path in MAPS.glob("*.toml"):
        (tmp_path / path.name).write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    path = tmp_path / "cia402-torque.toml"
    text = path.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text, "the change did not apply"
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
    return tmp_path


WITHOUT_DISPLAY = ('mode_displayed = { index = 0x6061, type = "i8", shown = "always" }\n', "")


async def cycles_until(link: CanopenLink, inputs: Inputs, condition: Callable[[], bool]) -> None:
    outputs = Outputs(1)
    outputs.drive_request[:] = DriveRequest.READY
    async with asyncio.timeout(5.0):
        while not condition():
            await cycle(link, inputs)
            link.write(outputs)
            await asyncio.sleep(PERIOD_S)


def says(inputs: Inputs, condition: DriveCondition) -> bool:
    return bool(int(inputs.drive_condition[0]) & condition)


def test_a_drive_that_stays_in_another_mode_says_so_before_it_is_enabled() -> None:
    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        drive.objects[0x6061, 0], drive.statusword = b"\0", READY
        inputs = Inputs(1)
        await link.prepare()
        await cycle(link, inputs)
        assert says(inputs, DriveCondition.MODE_UNCONFIRMED), "it has not said yet"
        await cycles_until(link, inputs, lambda: says(inputs, DriveCondition.WRONG_MODE))
        assert inputs.drive_mode[0] == 0 and inputs.drive_state[0] == DriveState.READY
        drive.objects[0x6061, 0] = b"\x0a"
        await cycles_until(link, inputs, lambda: inputs.drive_condition[0] == 0)
        drive.statusword, drive.objects[0x6061, 0] = ENABLED, b"\x03"
        await cycles_until(link, inputs, lambda: says(inputs, DriveCondition.WRONG_MODE))
        assert inputs.drive_mode[0] == 3, "it is asked on while the line runs"

    bench(body)


@pytest.mark.parametrize("displays", [True, False])
def test_a_map_that_does_not_name_the_display_goes_by_the_profile(tmp_path: Path, displays: bool) -> None:
    """As maps from before this object was known: 6061h belongs to 6060h; a drive that has none is served as before."""

    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        drive.statusword = READY
        drive.objects[0x6061, 0] = b"\0"
        if not displays:
            del drive.objects[0x6061, 0]
        inputs = Inputs(1)
        await link.prepare()
        for _ in range(5):
            await cycles_until(link, inputs, lambda: True)
            assert inputs.drive_condition[0] == 0, "0 at rest may be all that it displays"
        drive.statusword = ENABLED
        await cycle(link, inputs)
        if displays:
            await cycles_until(link, inputs, lambda: says(inputs, DriveCondition.WRONG_MODE))
        else:
            await cycles_until(link, inputs, lambda: inputs.drive_condition[0] == 0)
            assert link.health.malformed == 0, "nobody said that it has one"

    bench(body, changed_map(tmp_path, WITHOUT_DISPLAY))


def test_a_mode_in_the_pdo_is_not_asked_for(tmp_path: Path) -> None:
    pdo = (
        'objects = ["statusword", "speed", "torque"]',
        'objects = ["statusword", "torque", "speed", "mode_displayed"]',
    )
    short = (
        'speed = { index = 0x606C, type = "i32", unit = "um/s" }',
        'speed = { index = 0x606C, type = "i16", unit = "mm/s" }',
    )

    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        del drive.objects[0x6061, 0]
        modes = [10]
        drive.on_sync = lambda one: [struct.pack("<Hhhb", ENABLED, 0, 0, modes[0])]
        inputs = Inputs(1)
        await link.prepare()
        await cycle(link, inputs)
        assert inputs.drive_condition[0] == 0
        modes[0] = 0
        await cycle(link, inputs)
        assert says(inputs, DriveCondition.MODE_UNCONFIRMED), "one answer is no proof"
        await cycle(link, inputs)
        assert says(inputs, DriveCondition.WRONG_MODE)
        assert link.health.malformed == 0

    bench(body, changed_map(tmp_path, pdo, short))


def test_power_limits_and_warnings_are_bits_of_the_statusword() -> None:
    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        inputs = Inputs(1)
        await link.prepare()
        drive.statusword = READY & ~0x10
        await cycles_until(link, inputs, lambda: inputs.drive_condition[0] == DriveCondition.NO_POWER)
        drive.statusword = READY | 0x0880
        await cycle(link, inputs)
        assert inputs.drive_condition[0] == DriveCondition.LIMITED | DriveCondition.WARNS
        link.silence()
        await cycle(link, inputs)
        assert inputs.drive_condition[0] == 0, "a silent link hears nothing"

    bench(body)


def test_a_drive_that_warns_goes_on_and_one_that_is_in_fault_does_not() -> None:
    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        inputs = Inputs(1)
        await link.prepare()
        drive.statusword = ENABLED
        await cycle(link, inputs)
        drives.send(0x081, struct.pack("<HB5x", 0x4210, 0x08))
        await cycles_until(link, inputs, lambda: bool(inputs.drive_warning[0]))
        assert inputs.drive_warning[0] == 0x08 << 16 | 0x4210 and inputs.drive_state[0] == DriveState.ENABLED
        assert "4210h" in link.health.last_error
        outputs = Outputs(1)
        outputs.drive_request[:], outputs.torque_nm[:] = DriveRequest.ENABLE, 8.0
        drive.rpdos.clear()
        link.write(outputs)
        await until(lambda: bool(drive.rpdos))
        assert drive.rpdos[0] == struct.pack("<Hhb", 0x0F, 100, 10), "its torque stays"
        drives.send(0x081, bytes(8))
        await cycles_until(link, inputs, lambda: not inputs.drive_warning[0])
        drives.send(0x081, struct.pack("<HB5x", 0x4210, 0x09))
        drive.statusword = FAULT
        await cycles_until(link, inputs, lambda: inputs.drive_state[0] == DriveState.FAULT)
        assert link._nodes[0].station.emergency and not inputs.drive_warning[0]  # noqa: SLF001

    bench(body)


# one that was switched on just now


def test_a_node_whose_sdo_server_wakes_up_late_is_waited_for() -> None:
    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        drive.sdo_answers = False
        arming = asyncio.create_task(link.prepare())
        while sum(cob_id == 0x601 for cob_id, _ in drives.frames) < 3:
            drives.heartbeat(1, 0x7F)
            await asyncio.sleep(0.02)
        drive.sdo_answers = True
        while not arming.done():
            drives.heartbeat(1, 0x7F if 0x01 not in drive.nmt else 5)
            await asyncio.sleep(0.02)
        await arming

    bench(body)


def test_one_that_does_not_wake_up_is_named_as_what_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prepare, "WAKING_S", 0.5)

    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        drive.sdo_answers = False
        arming = asyncio.create_task(link.prepare())
        while not arming.done():
            drives.heartbeat(1, 0x7F)
            await asyncio.sleep(0.02)
        with pytest.raises(PrepareRefused) as refusal:
            await arming
        (reason,) = refusal.value.reasons
        assert reason.code == "sdo-silent"
        assert reason.parameters["device"] == "drive-1" and reason.parameters["state"] == "pre-operational"
        assert float(reason.parameters["waited_s"]) >= 0.5
        assert drive.writes == []

    bench(body)


def test_one_that_was_heard_and_is_gone_is_not_waited_for_long() -> None:
    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        inputs = Inputs(1)
        drives.heartbeat(1, 0x7F)
        while inputs.drive_state[0] == DriveState.ABSENT:
            await cycle(link, inputs, 0.01)
        drive.sdo_answers = False
        with pytest.raises(PrepareRefused) as refusal:
            await link.prepare()
        assert refusal.value.reasons == [finding("node-silent", device="drive-1", node=1)]

    bench(body)


# a watchdog that does nothing


SHIPPED = 'abort_connection = { index = 0x6007, type = "i16", value = 2, writable = true, required = false }'


def with_option(value: int, writable: str, required: str = "true") -> tuple[str, str]:
    said = f'index = 0x6007, type = "i16", value = {value}, writable = {writable}, required = {required}'
    return SHIPPED, f"abort_connection = {{ {said} }}"


def test_a_drive_that_has_the_standard_option_code_is_told_to_take_its_torque_off() -> None:
    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        drive.objects[0x6007, 0] = struct.pack("<h", 0)  # no action
        await link.prepare()
        assert drive.objects[0x6007, 0] == struct.pack("<h", 2)

    bench(body)


def test_a_drive_that_does_not_take_the_option_code_is_refused() -> None:
    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        drive.objects[0x6007, 0] = struct.pack("<h", 0)
        drive.stubborn.add((0x6007, 0))
        with pytest.raises(PrepareRefused) as refusal:
            await link.prepare()
        reads_back = {"object": "object 6007h sub 0", "set_counts": 2, "found_counts": 0}
        assert refusal.value.reasons == [finding("object-reads-back", device="drive-1", **reads_back)]

    bench(body)


def test_a_drive_without_the_option_code_is_refused_where_its_map_requires_it(tmp_path: Path) -> None:
    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        with pytest.raises(PrepareRefused) as refusal:
            await link.prepare()
        (reason,) = refusal.value.reasons
        assert reason.code == "node-not-configured" and "6007h" in str(reason.parameters["error"])

    async def spared(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        await link.prepare()
        assert all(index != 0x6007 for index, _, _ in drive.writes)

    bench(body, changed_map(tmp_path, with_option(2, "true")))
    bench(spared)


@pytest.mark.parametrize(("says", "codes"), [(0, ["object-differs", "watchdog-without-reaction"]), (2, [])])
def test_a_watchdog_whose_reaction_is_none_is_refused_by_name(tmp_path: Path, says: int, codes: list[str]) -> None:
    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        drive.objects[0x6007, 0] = struct.pack("<h", says)
        if not codes:
            await link.prepare()
            return
        with pytest.raises(PrepareRefused) as refusal:
            await link.prepare()
        assert [reason.code for reason in refusal.value.reasons] == codes
        assert drive.writes == []

    bench(body, changed_map(tmp_path, with_option(2, "false")))


QUICK_STOP = 'quick_stop = {{ index = {index}, type = "i16", value = {value}, writable = true }}'


@pytest.mark.parametrize(
    ("quick_stop", "named"),
    [
        ("", "options.quick_stop: is missing"),
        (QUICK_STOP.format(index="0x605A", value=6), "options.quick_stop.value: 6"),
        (QUICK_STOP.format(index="0x605E", value=2), "options.quick_stop.index: 0x605e"),
    ],
)
def test_a_map_whose_drive_reacts_by_a_quick_stop_says_that_it_ends_without_torque(
    tmp_path: Path, quick_stop: str, named: str
) -> None:
    shipped, reacts = with_option(3, "true")
    assert named in refusal_of(changed_map(tmp_path, (shipped, f"{reacts}\n{quick_stop}")))


@pytest.mark.parametrize("value", [0, 4])
def test_a_drive_that_reacts_by_a_quick_stop_is_told_to_leave_it(tmp_path: Path, value: int) -> None:
    async def body(link: CanopenLink, drives: Drives, drive: Drive) -> None:
        drive.objects[0x605A, 0] = struct.pack("<h", 6)
        drive.objects[0x6007, 0] = struct.pack("<h", 0)
        await link.prepare()
        assert drive.objects[0x605A, 0] == struct.pack("<h", value)
        assert drive.objects[0x6007, 0] == struct.pack("<h", 3)

    shipped, reacts = with_option(3, "true")
    quick_stop = QUICK_STOP.format(index="0x605A", value=value)
    bench(body, changed_map(tmp_path, (shipped, f"{reacts}\n{quick_stop}")))


def refusal_of(folder: Path) -> str:
    with pytest.raises(MapRefused) as refusal:
        load_map(folder / "cia402-torque.toml")
    (reason,) = refusal.value.reasons
    return reason


def test_a_map_with_a_heartbeat_watchdog_says_what_the_drive_does_then(tmp_path: Path) -> None:
    heartbeat = (
        ('index = 0x1400\nsub = 5\ntype = "u16"', 'kind = "heartbeat-consumer"\nindex = 0x1016\nsub = 1\ntype = "u32"'),
    )
    reason = refusal_of(changed_map(tmp_path, *heartbeat, (SHIPPED, "")))
    assert "options.abort_connection: is missing" in reason and "0x6007" in reason
    assert "options.abort_connection.required: false" in refusal_of(changed_map(tmp_path, *heartbeat))
    assert "writable = true" in refusal_of(changed_map(tmp_path, with_option(2, "false", "false")))
    load_map(changed_map(tmp_path, *heartbeat, with_option(2, "true")) / "cia402-torque.toml")


def test_a_map_that_sets_no_reaction_is_refused(tmp_path: Path) -> None:
    assert "0 does not take torque away; allowed: 1 (fault)" in refusal_of(
        changed_map(tmp_path, with_option(0, "true"))
    )

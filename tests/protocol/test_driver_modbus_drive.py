"""Drives on Modbus TCP, one unit each, against a raw TCP server that plays them."""

import asyncio
import struct
from collections.abc import Callable
from math import inf, nan

import pytest

from drivers.modbus.link import ModbusLink
from drivers.port import PrepareRefused
from gateway.core.finding import Finding, finding
from gateway.core.signals import DriveRequest, DriveState, Inputs, Quality
from tests.protocol.driver_support import ENABLED, FAULT, READY, SWITCH_ON_DISABLED, Registers, cycle, until
from tests.protocol.modbus_support import ModbusDrive, drive_bench, enabled, interrupt, torques

ENABLE, OFF, TO_READY = DriveRequest.ENABLE, DriveRequest.OFF, DriveRequest.READY


def test_a_cycle_reads_si_and_a_silent_link_writes_nothing() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        assert list(inputs.drive_state) == [DriveState.ABSENT] * 2
        drives[0].number(2, ">i", -100_000)
        drives[0].number(4, ">h", 550)
        link.write(torques(ENABLE, 8.0, 8.0))
        await cycle(link, inputs)
        assert inputs.speed.value[0] == pytest.approx(-0.1) and inputs.speed.good()
        assert inputs.torque.value[0] == pytest.approx(44.0), "of 80 Nm"
        assert list(inputs.drive_state) == [DriveState.OFF] * 2
        assert inputs.tension.good() and inputs.plc.quality == Quality.GOOD, "all units in one cycle"
        assert drives[0].reads == [(1, 23)] and not drives[0].writes

    drive_bench(body)


def test_prepare_sets_the_watchdog_and_a_drive_is_enabled_step_by_step() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await link.prepare()
        assert [drive.registers[23] for drive in drives] == [100, 100]
        assert [drive.writes for drive in drives] == [[(23, 23)]] * 2, "nothing else is written by arming"
        states: list[int] = []
        for _ in range(5):
            link.write(torques(ENABLE, 8.0, -8.0))
            await cycle(link, inputs)
            states.append(inputs.drive_state[0])
        assert states == [DriveState.OFF, DriveState.READY, DriveState.READY, DriveState.ENABLED, DriveState.ENABLED]
        assert drives[0].power.commands == [(0x00, 0), (0x06, 0), (0x07, 0), (0x0F, 0), (0x0F, 100)]
        assert drives[1].power.commands[-1] == (0x0F, -100)
        assert drives[0].writes[-1] == (10, 11), "controlword and target torque in one request"
        link.write(torques(OFF, 8.0, 8.0))
        await cycle(link, inputs)
        assert drives[0].power.commands[-1] == (0x00, 0) and drives[0].power.statusword == SWITCH_ON_DISABLED

    drive_bench(body)


def test_what_the_drive_says_of_itself() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        drives[0].power.statusword = 0x0237  # enabled, but the target torque is not followed
        await cycle(link, inputs)
        assert inputs.drive_state[0] == DriveState.READY
        drives[0].power.statusword, drives[0].registers[5] = 0x0240, 1
        await cycle(link, inputs)
        assert inputs.drive_state[0] == DriveState.STO
        drives[0].power.statusword, drives[0].registers[5], drives[0].registers[6] = FAULT, 0, 0x8250
        await cycle(link, inputs)
        assert inputs.drive_state[0] == DriveState.FAULT and inputs.drive_state[1] == DriveState.ENABLED
        assert "drive-1: fault" in link.health.last_error and "communication watchdog" in link.health.last_error
        link.write(torques(ENABLE, 8.0, 8.0))
        await cycle(link, inputs)
        assert drives[0].power.commands[-1] == (0x00, 0), "a fault is never left by itself"
        link.write(torques(DriveRequest.RESET_FAULT, 0.0, 0.0))
        await cycle(link, inputs)
        assert drives[0].power.commands[-1] == (0x80, 0)

    drive_bench(body)


@pytest.mark.parametrize("torque_nm", [nan, inf, -inf, 2622.0, -2622.0])
def test_a_torque_that_cannot_be_commanded_is_not_written(torque_nm: float) -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        before = [len(drive.power.commands) for drive in drives]
        link.write(torques(ENABLE, torque_nm, 4.0))
        await cycle(link, inputs)
        assert len(drives[0].power.commands) == before[0], "its watchdog has the last word"
        assert drives[1].power.commands[before[1] :] == [(0x0F, 50)], "another unit is another matter"
        assert link.health.malformed == 1 and "drive-1" in link.health.last_error
        assert inputs.speed.good(), "it is read all the same"

    drive_bench(body)


def test_a_drive_that_is_not_heard_is_absent_and_never_fed_again() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)

        async def deaf(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            if unit > 10:
                answer = await drives[unit - 11].script(head, unit, pdu)  # it hears, but is not heard
                return [] if unit == 11 else answer
            return None

        play, peer.script = peer.script, deaf
        states: list[int] = []
        for _ in range(4):
            link.write(torques(ENABLE, 8.0, 8.0))
            await cycle(link, inputs)
            states.append(inputs.drive_state[0])
            assert inputs.drive_state[1] == DriveState.ENABLED and inputs.speed.quality[0] == Quality.STALE
        assert states == [DriveState.ENABLED] * 2 + [DriveState.ABSENT] * 2
        assert link.health.absent == ["drive-1"]
        fed = len(drives[0].power.commands)
        for _ in range(3):
            link.write(torques(ENABLE, 8.0, 8.0))
            await cycle(link, inputs)
        peer.script = play
        inputs.speed.quality[0] = Quality.STALE
        async with asyncio.timeout(5.0):
            while not inputs.speed.good():
                link.write(torques(ENABLE, 8.0, 8.0))
                await cycle(link, inputs, 0.05)
                await asyncio.sleep(0)
        for _ in range(3):
            link.write(torques(ENABLE, 8.0, 8.0))
            await cycle(link, inputs)
        assert len(drives[0].power.commands) == fed, "not even when it is heard again"
        assert inputs.drive_state[0] == DriveState.FAULT and "arm again" in link.health.last_error
        assert drives[1].power.commands[-1] == (0x0F, 100)
        drives[0].power.statusword = SWITCH_ON_DISABLED  # its watchdog has taken torque off
        drives[1].power.statusword = SWITCH_ON_DISABLED
        await enabled(link, inputs)
        assert len(drives[0].power.commands) > fed, "arming begins anew"

    drive_bench(body)


def test_a_drive_that_was_restarted_in_between_gets_no_torque() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        fed = [len(drive.power.commands) for drive in drives]
        await interrupt(link, peer, inputs, lambda: drives[0].registers.__setitem__(23, 0))  # the default
        link.write(torques(ENABLE, 8.0, 8.0))
        await cycle(link, inputs)
        assert len(drives[1].power.commands) > fed[1]
        assert list(inputs.drive_state) == [DriveState.FAULT, DriveState.ENABLED]
        assert "watchdog reads 0, 100 was set" in link.health.last_error
        drives[0].registers[23] = 100  # whoever set it: nothing comes back by itself
        for _ in range(8):
            link.write(torques(ENABLE, 8.0, 8.0))
            await cycle(link, inputs)
        assert drives[0].power.commands[fed[0] :] == [(0x00, 0)] * 5, "told to rest, and left alone then"

    drive_bench(body)


def test_release_leaves_the_drives_in_order() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        drives[1].power.obeys = False
        link.write(torques(ENABLE, 8.0, 8.0))
        await link.release()
        assert [drive.power.commands[-1] for drive in drives] == [(0x00, 0)] * 2
        assert drives[0].registers[23] == 0, "nobody waits any more"
        assert drives[1].registers[23] == 100, "still enabled: its watchdog has the last word"
        assert "drive-2" in link.health.last_error
        fed = [len(drive.power.commands) for drive in drives]
        link.write(torques(ENABLE, 8.0, 8.0))
        await cycle(link, inputs)
        assert [len(drive.power.commands) for drive in drives] == fed

    drive_bench(body)


def test_release_sends_the_last_command_first() -> None:
    """A loop that breaks writes zero, triggers, and releases at once."""

    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        fed = len(drives[0].power.commands)
        link.write(torques(OFF, 0.0, 0.0))
        link.trigger(asyncio.get_running_loop().time())
        await link.release()
        assert drives[0].power.commands[fed:] == [(0x00, 0)] * 3, "the cycle's, at rest, and with the watchdog off"

    drive_bench(body)


def test_periods_go_on_while_the_line_is_armed() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        for _ in range(5):
            arming = asyncio.create_task(link.prepare())
            while not arming.done():
                link.write(torques(TO_READY, 0.0, 0.0))
                await cycle(link, inputs, 0.02)
                await asyncio.sleep(0)  # between periods others come to their turn, also where nothing was waited for
            await arming
            for _ in range(3):
                link.write(torques(TO_READY, 0.0, 0.0))
                await cycle(link, inputs)
            assert list(inputs.drive_state) == [DriveState.READY] * 2 and inputs.tension.good()
            assert inputs.plc.quality == Quality.GOOD
            await link.release()

    drive_bench(body)


# what prepare refuses


def refusal(arrange: Callable[[list[ModbusDrive]], None]) -> tuple[list[Finding], list[ModbusDrive]]:
    seen: list[tuple[list[Finding], list[ModbusDrive]]] = []

    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        arrange(drives)
        with pytest.raises(PrepareRefused) as refused:
            await link.prepare()
        commands = [len(drive.power.commands) for drive in drives]
        link.write(torques(ENABLE, 8.0, 8.0))
        await cycle(link, Inputs(2))
        assert [len(drive.power.commands) for drive in drives] == commands, "a refused link stays silent"
        seen.append((refused.value.reasons, drives))

    drive_bench(body)
    return seen[0]


def set_register(register: int, value: int) -> Callable[[list[ModbusDrive]], None]:
    def arrange(drives: list[ModbusDrive]) -> None:
        drives[1].registers[register] = value

    return arrange


@pytest.mark.parametrize(
    ("arrange", "found"),
    [
        (set_register(0, 0x5201), finding("device-id-differs", device="drive-2", found=0x5201, wanted=0x5203)),
        (set_register(20, 2), finding("rated-torque-differs", drive="drive-2", found_nm=145.536, wanted_nm=80.0)),
        (set_register(22, 700), finding("max-torque-too-low", drive="drive-2", found_nm=56.0, limit_nm=60.0)),
        (
            lambda drives: setattr(drives[1].power, "statusword", ENABLED),
            finding("still-enabled", drive="drive-2", statusword=0x1237),
        ),
        (
            lambda drives: setattr(drives[1].power, "statusword", 0x0217),
            finding("still-enabled", drive="drive-2", statusword=0x0217),
        ),
    ],
)
def test_what_speaks_against_a_drive_is_named_before_anything_is_written(
    arrange: Callable[[list[ModbusDrive]], None], found: Finding
) -> None:
    reasons, drives = refusal(arrange)
    assert reasons == [found]
    assert not drives[0].writes and not drives[1].writes


def test_all_reasons_come_at_once() -> None:
    def arrange(drives: list[ModbusDrive]) -> None:
        drives[0].registers[22] = 1
        drives[1].registers[20] = 0
        drives[1].power.statusword = ENABLED

    reasons, _ = refusal(arrange)
    assert [(reason.code, reason.parameters["drive"]) for reason in reasons] == [
        ("max-torque-too-low", "drive-1"),
        ("rated-torque-differs", "drive-2"),
        ("still-enabled", "drive-2"),
    ]


@pytest.mark.parametrize("mode", ["stubborn", "refuses"])
def test_a_watchdog_that_cannot_be_set_undoes_all(mode: str) -> None:
    def arrange(drives: list[ModbusDrive]) -> None:
        drives[0].registers[23] = 700
        if mode == "stubborn":
            drives[1].stubborn.add(23)
        else:
            drives[1].refuses[23] = 3

    reasons, drives = refusal(arrange)
    watchdog = {"device": "drive-2", "setting": "watchdog"}
    assert reasons == [
        finding("setting-reads-back", **watchdog, set_counts=100, found_counts=0)
        if mode == "stubborn"
        else finding("setting-not-set", **watchdog, error="exception 3 to function 16")
    ]
    assert drives[0].registers[23] == 700, "the drive that took it has its own again"


def test_a_silent_drive_is_named() -> None:
    reasons, _ = refusal(lambda drives: setattr(drives[1], "silent", True))
    (reason,) = reasons
    assert reason.code == "unit-not-read"
    assert (reason.parameters["device"], reason.parameters["unit"]) == ("drive-2", 12)


def test_a_drive_that_is_ready_may_be_armed() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        drives[0].power.statusword, drives[1].power.statusword = READY, FAULT
        await link.prepare()
        inputs = Inputs(2)
        for request in (DriveRequest.RESET_FAULT, DriveRequest.RESET_FAULT):
            link.write(torques(request, 0.0, 0.0))
            await cycle(link, inputs)
        assert list(inputs.drive_state) == [DriveState.OFF] * 2
        link.write(torques(TO_READY, 0.0, 0.0))
        await cycle(link, inputs)
        link.write(torques(TO_READY, 0.0, 0.0))
        await cycle(link, inputs)
        assert list(inputs.drive_state) == [DriveState.READY] * 2

    drive_bench(body)


def test_a_drive_that_dies_costs_the_others_nothing() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        drives[0].silent = True
        for _ in range(4):
            link.write(torques(ENABLE, 8.0, 8.0))
            await cycle(link, inputs)
            assert inputs.drive_state[1] == DriveState.ENABLED and inputs.tension.good()
        await until(lambda: inputs.drive_state[0] == DriveState.ABSENT)
        async with asyncio.timeout(5.0):
            for _ in range(5):
                link.write(torques(ENABLE, 8.0, 8.0))
                await cycle(link, inputs, 60.0)
                assert inputs.drive_state[1] == DriveState.ENABLED

    drive_bench(body)


def test_the_first_request_on_a_new_connection_writes_nothing() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        await interrupt(link, peer, inputs, lambda: None)
        link.write(torques(ENABLE, 8.0, 8.0))
        await cycle(link, inputs)
        assert (inputs.drive_state == DriveState.ENABLED).all(), "a blink of the connection is survived"
        asked = [pdu for unit, pdu in peer.requests if unit == 11]
        proofs = [struct.pack(">BHH", 3, *block) for block in ((0, 1), (20, 2), (22, 1), (23, 1))]
        assert asked[:4] == proofs, "identity, rated torque, max torque, watchdog"
        assert asked[4][0] == 23

    drive_bench(body)

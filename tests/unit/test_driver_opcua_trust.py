"""Which devices on OPC UA are still commanded, what they are told last, and how they are left. No server."""

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from drivers.opcua.link import PROOF_PERIOD_S
from drivers.opcua.messages import Question
from drivers.opcua.status import BAD_TRANSACTION_FAILED
from drivers.power_stage import ORDERS_IGNORED
from gateway.core.signals import DriveRequest, DriveState, Quality
from tests.protocol.driver_opcua_support import line
from tests.unit.test_driver_opcua_link import REFUSED, Rig

PROOF_CYCLES = round(PROOF_PERIOD_S / line("opc.tcp://127.0.0.1:1").control.period_s)  #: one of them asks for proofs
NO_COMMUNICATION = 0x80310000
CLAMPED = 0x00300000
LAST_WRITE_OF_2 = {f"Axis2.{name}" for name in ("Controlword", "TargetTorque", "Life", "Watchdog")}
LAST_WORDS = {"Axis1.Controlword", "Axis1.TargetTorque"}


def run(scene: Callable[[Rig], Awaitable[None]]) -> None:
    """With drives enabled and transport on."""

    async def play() -> None:
        rig = Rig()
        await rig.arm()
        rig.outputs.drive_request[:] = DriveRequest.ENABLE
        rig.outputs.torque_nm[:] = 5.0
        rig.outputs.run, rig.outputs.speed_request_m_per_s = True, 0.2
        await cycles(rig, 5)
        assert list(rig.inputs.drive_state) == [DriveState.ENABLED] * 2
        await scene(rig)

    asyncio.run(play())


async def cycles(rig: Rig, count: int) -> list[Question]:
    """The questions of so many cycles."""
    asked = len(rig.channel.questions)
    for _ in range(count):
        await rig.cycle()
    return rig.channel.questions[asked:]


def written(rig: Rig, questions: list[Question]) -> set[str]:
    return set[str]().union(*(rig.channel.names(question)[0] for question in questions))


# obedience


def test_an_axis_that_does_not_obey_is_not_written_to_any_more() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.deaf.add("Axis1")
        rig.outputs.drive_request[:] = DriveRequest.OFF
        told = await cycles(rig, ORDERS_IGNORED)
        assert "Axis1.Life" in rig.channel.names(told[-1])[0]
        await cycles(rig, 3)
        left = written(rig, await cycles(rig, 20))
        assert not any(node.startswith("Axis1.") for node in left)
        assert {"Axis2.Life", "Line.Life"} <= left
        assert rig.inputs.drive_state[0] == DriveState.FAULT
        assert f"drive-1: ignored {ORDERS_IGNORED} orders" in rig.link.health.last_error
        rig.channel.devices.deaf.clear()
        rig.channel.devices.set("Axis1.Statusword", 0x0250)  # its watchdog's doing
        await rig.link.prepare()
        assert "Axis1.Life" in written(rig, await cycles(rig, 2))

    run(scene)


# release


async def released(rig: Rig) -> list[dict[str, float]]:
    """What `release` writes."""
    asked = len(rig.channel.questions)
    await rig.link.release()
    return [
        {name: number for place, number in question.writes for name in rig.channel.names_of(place)}
        for question in rig.channel.questions[asked:]
        if question.writes
    ]


def test_only_an_axis_that_says_it_is_off_loses_its_watchdog() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.deaf.add("Axis1")
        first, off, again = await released(rig)
        assert first["Axis1.Controlword"] == first["Axis2.TargetTorque"] == 0.0
        assert {"Axis1.Life", "Axis2.Life"} <= set(first)
        assert set(off) == LAST_WRITE_OF_2 and off["Axis2.Watchdog"] == 0.0 and again == {"Axis2.Watchdog": 100.0}
        assert rig.channel.devices.value("Axis1.Watchdog") == 100
        said = "drive-1: was told to take torque off and does not say that it is (statusword 1237h)"
        assert said in rig.link.health.last_error and "drive-2" not in rig.link.health.last_error

    run(scene)


@pytest.mark.parametrize("statusword", [0x0007, 0x0217, 0x021F, 0x0000, 0x020C])
def test_what_is_no_word_of_a_drive_that_is_off_is_none(statusword: int) -> None:
    """Quick stop, fault reaction, nothing at all, a combination that does not exist."""

    async def scene(rig: Rig) -> None:
        rig.channel.devices.deaf.add("Axis1")
        rig.channel.devices.set("Axis1.Statusword", statusword)
        _, off, _ = await released(rig)
        assert set(off) == LAST_WRITE_OF_2

    run(scene)


def test_an_axis_that_takes_its_time_is_waited_for() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.deaf.add("Axis1")
        rig.channel.after_reads(3, lambda: rig.channel.devices.set("Axis1.Statusword", 0x0250))
        _, off, _ = await released(rig)
        assert off["Axis1.Watchdog"] == off["Axis2.Watchdog"] == 0.0

    run(scene)


def test_an_axis_that_refuses_its_last_command_keeps_no_other_from_it() -> None:
    async def scene(rig: Rig) -> None:
        refuses = rig.channel.devices.refuses
        refuses["Axis1.TargetTorque"] = REFUSED
        refuses["Axis2.TargetTorque"] = BAD_TRANSACTION_FAILED
        rig.channel.after_reads(1, lambda: refuses.pop("Axis2.TargetTorque"))
        *_, off, again = await released(rig)
        assert set(off) == LAST_WRITE_OF_2 and off["Axis2.Watchdog"] == 0.0 and again == {"Axis2.Watchdog": 100.0}
        assert "drive-1: its last command was refused (BadNotWritable)" in rig.link.health.last_error

    run(scene)


def test_a_watchdog_that_cannot_be_switched_off_is_said() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.refuses["Axis2.Watchdog"] = CLAMPED
        await released(rig)
        assert "drive-2: its watchdog cannot be switched off: GoodClamped" in rig.link.health.last_error

    run(scene)


@pytest.mark.parametrize("answered", [1, 2], ids=["before the look", "behind the look"])
def test_no_watchdog_is_switched_off_on_another_connection_than_the_last_command(answered: int) -> None:
    """Whoever is connected there now may never have heard that command, though he says that he is off."""

    async def scene(rig: Rig) -> None:
        def connect_anew() -> None:
            rig.channel.connection += 1
            rig.link.trigger(asyncio.get_running_loop().time())  # a cycle may be the first to see it

        rig.channel.after_reads(answered, connect_anew)
        [only] = await released(rig)
        assert LAST_WORDS <= set(only)
        assert rig.channel.devices.value("Axis1.Watchdog") == rig.channel.devices.value("Axis2.Watchdog") == 100
        assert "not released, their watchdogs take torque off: connected anew" in rig.link.health.last_error

    run(scene)


def test_a_look_on_another_connection_is_none() -> None:
    async def scene(rig: Rig) -> None:
        def connect_anew() -> None:
            rig.channel.connection += 1

        rig.channel.after_reads(1, connect_anew)
        assert len(await released(rig)) == 1
        assert "connected anew" in rig.link.health.last_error

    run(scene)


# proof on a connection that stays


def test_the_proof_is_asked_for_again_about_once_a_second() -> None:
    async def scene(rig: Rig) -> None:
        questions = await cycles(rig, 3 * PROOF_CYCLES)
        asked = [question for question in questions if "Axis1.Watchdog" in rig.channel.names(question)[1]]
        assert len(asked) == 3
        proofs = {"Axis1.DeviceId", "Amplifier.DeviceId", "Line.DeviceId", "Axis2.Watchdog", "Line.Watchdog"}
        assert all(proofs <= rig.channel.names(question)[1] for question in asked)

    run(scene)


def test_an_axis_that_lost_its_watchdog_is_told_to_take_torque_off_and_not_fed() -> None:
    """In silence it would keep its torque: nothing would ever take it off."""

    async def scene(rig: Rig) -> None:
        rig.channel.devices.set("Axis1.Watchdog", 0)
        rig.channel.devices.deaf.add("Axis1")
        await cycles(rig, PROOF_CYCLES + 1)
        assert rig.inputs.drive_state[0] == DriveState.FAULT
        told = rig.link.health.last_error
        assert "drive-1: watchdog reads 0, 100 was set" in told and told.endswith("it is told to take torque off")
        assert {node for node in written(rig, await cycles(rig, 10)) if "Axis1" in node} == LAST_WORDS
        assert rig.channel.devices.value("Axis1.Controlword") == rig.channel.devices.value("Axis1.TargetTorque") == 0
        rig.channel.devices.set("Axis1.Statusword", 0x0250)
        await cycles(rig, 2)
        assert not {node for node in written(rig, await cycles(rig, 10)) if "Axis1" in node}

    run(scene)


def test_an_axis_that_refuses_to_be_told_off_does_not_keep_the_others_from_their_commands() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.set("Axis1.Watchdog", 0)
        rig.channel.devices.deaf.add("Axis1")
        await cycles(rig, PROOF_CYCLES + 1)
        rig.channel.devices.refuses["Axis1.Controlword"] = REFUSED
        await cycles(rig, 2)
        assert not {node for node in written(rig, await cycles(rig, 10)) if "Axis1" in node}

    run(scene)


def test_another_device_in_the_place_of_an_axis_is_told_nothing() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.set("Axis1.DeviceId", 0x5203)
        await cycles(rig, PROOF_CYCLES + 5)
        assert not {node for node in written(rig, await cycles(rig, 10)) if "Axis1" in node}
        assert rig.inputs.drive_state[0] == DriveState.ABSENT
        assert rig.inputs.speed.quality[0] == Quality.STALE

    run(scene)


def test_another_device_in_the_place_of_the_amplifier_is_not_believed() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.set("Amplifier.DeviceId", 1)
        await cycles(rig, PROOF_CYCLES)
        await rig.cycle()
        assert list(rig.inputs.tension.quality) == [Quality.BAD] * 2

    run(scene)


def test_a_plc_that_lost_its_watchdog_is_told_to_stop_and_counts_as_lost() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.set("Line.Watchdog", 0)
        await cycles(rig, PROOF_CYCLES + 2)
        assert rig.inputs.plc.quality == Quality.STALE
        assert rig.channel.devices.value("Line.Run") == 0.0 and rig.channel.devices.value("Line.SpeedRequest") == 0.0
        assert not {node for node in written(rig, await cycles(rig, 10)) if node.startswith("Line")}

    run(scene)


@pytest.mark.parametrize(("answers", "dropped"), [(2, False), (3, True)])
def test_a_proof_may_miss_as_often_as_any_reading(answers: int, dropped: bool) -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.status["Axis1.Watchdog"] = NO_COMMUNICATION
        seen = 0
        for _ in range(PROOF_CYCLES + answers):
            await rig.cycle()
            seen += "Axis1.Watchdog" in rig.channel.names(rig.question)[1]
            if seen == answers:
                rig.channel.devices.status.clear()
        await cycles(rig, 2)
        assert bool(rig.inputs.drive_state[0] == DriveState.FAULT) == dropped

    run(scene)


# what is new, and what was measured


def test_a_statusword_whose_time_stands_still_is_missed_and_its_axis_lost() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.frozen.add("Axis1.Statusword")
        await cycles(rig, 4)  # the first brings the time stamp that stands still
        assert list(rig.inputs.speed.quality) == [Quality.STALE, Quality.GOOD]
        assert rig.link.health.last_error == "drive-1: statusword: its source time stamp stands still"
        await cycles(rig, 4)
        assert rig.inputs.drive_state[0] == DriveState.ABSENT
        assert not {node for node in written(rig, await cycles(rig, 5)) if "Axis1" in node}

    run(scene)


def test_a_value_whose_time_stands_still_is_missed_alone() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.frozen |= {"Axis1.Speed", "Axis2.Torque", "Cell2.Tension"}
        await cycles(rig, 3)
        assert rig.inputs.speed.good() and rig.inputs.torque.good() and rig.inputs.tension.good()
        await rig.cycle()
        assert list(rig.inputs.speed.quality) == [Quality.STALE, Quality.GOOD]
        assert list(rig.inputs.torque.quality) == [Quality.GOOD, Quality.STALE]
        assert list(rig.inputs.tension.quality) == [Quality.GOOD, Quality.STALE]
        assert list(rig.inputs.drive_state) == [DriveState.ENABLED] * 2
        rig.channel.devices.frozen.clear()
        await rig.cycle()
        assert rig.inputs.speed.good() and rig.inputs.torque.good() and rig.inputs.tension.good()

    run(scene)


def test_without_time_stamps_there_is_the_rest() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.stamps = False
        await cycles(rig, 20)
        assert rig.inputs.speed.good() and rig.inputs.tension.good()
        assert list(rig.inputs.drive_state) == [DriveState.ENABLED] * 2

    run(scene)


def test_a_tension_at_the_limit_of_its_amplifier_is_no_measurement() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.status["Cell1.Tension"] = 0x00000600
        await rig.cycle()
        assert list(rig.inputs.tension.quality) == [Quality.BAD, Quality.GOOD]
        assert rig.link.health.last_error == "cell-1: Good (status 00000600h), at its high limit"

    run(scene)


def test_a_command_that_was_clamped_is_a_refusal() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.refuses["Axis1.TargetTorque"] = CLAMPED
        await cycles(rig, 2)
        assert rig.inputs.drive_state[0] == DriveState.FAULT
        assert "drive-1: its command was refused: GoodClamped" in rig.link.health.last_error

    run(scene)


def test_a_number_that_moves_by_itself_is_no_echo() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.echoes = False
        for k in range(6):
            rig.channel.devices.set("Line.LifeEcho", 37 * k + 5000)
            await rig.cycle()
        assert rig.inputs.plc.quality == Quality.STALE
        assert "its echo of the life counter stands still" in rig.link.health.last_error

    run(scene)


# an arming that is cancelled


async def cancelled_prepare(rig: Rig) -> None:
    """Cancelled while the first watchdog is being written, which is done all the same."""
    await rig.link.release()
    rig.channel.devices.set("Axis1.Watchdog", 250)
    rig.channel.devices.set("Axis2.Watchdog", 0)
    rig.channel.devices.set("Axis1.Statusword", 0x0250)
    rig.channel.devices.set("Axis2.Statusword", 0x0250)
    arming = asyncio.create_task(rig.link.prepare())
    asked = asyncio.Event()
    rig.channel.on_write("Axis1.Watchdog", asked.set)
    async with asyncio.timeout(5.0):
        await asked.wait()
    arming.cancel()
    await asyncio.gather(arming, return_exceptions=True)
    assert rig.channel.devices.value("Axis1.Watchdog") == 100


def test_what_a_cancelled_arming_wrote_is_undone_by_the_next_release() -> None:
    async def scene(rig: Rig) -> None:
        await cancelled_prepare(rig)
        await rig.link.release()
        assert [rig.channel.devices.value(f"Axis{k}.Watchdog") for k in (1, 2)] == [250, 0]
        asked = len(rig.channel.questions)
        await rig.link.release()
        assert len(rig.channel.questions) == asked

    run(scene)


def test_an_arming_in_between_does_not_take_what_it_finds_for_what_was_before() -> None:
    async def scene(rig: Rig) -> None:
        await cancelled_prepare(rig)
        rig.channel.devices.refuses["Line.Watchdog"] = REFUSED
        with pytest.raises(Exception, match="setting-not-set"):
            await rig.link.prepare()
        assert [rig.channel.devices.value(f"Axis{k}.Watchdog") for k in (1, 2)] == [250, 0]

    run(scene)


def test_on_another_connection_there_may_be_another_device_and_nothing_is_undone() -> None:
    async def scene(rig: Rig) -> None:
        await cancelled_prepare(rig)
        rig.channel.connection += 1
        await rig.cycle()
        await rig.link.release()
        assert rig.channel.devices.value("Axis1.Watchdog") == 100
        assert "the watchdogs of drive-1 stay as they are" in rig.link.health.last_error

    run(scene)

"""The OPC UA link against a server, with the engine in the same event loop: what may be believed, what is written."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from math import inf, nan
from typing import Any

import pytest
from asyncua import ua

from drivers.opcua.messages import Plan
from drivers.opcua.session import LAST_NUMBER, Session
from drivers.port import PrepareRefused
from gateway.core.finding import Finding, finding
from gateway.core.signals import DriveRequest, DriveState, Quality
from tests.protocol.driver_opcua_support import U32, DeviceServer, Rig, device_server, line, link_in_process

pytestmark = pytest.mark.wires

CODES = ua.StatusCodes


@pytest.fixture(scope="module")
def shared_server() -> Iterator[DeviceServer]:
    with device_server() as server:
        yield server


@pytest.fixture
def server(shared_server: DeviceServer) -> DeviceServer:
    shared_server.reset()
    return shared_server


def run(server: DeviceServer, scene: Callable[[Rig], Awaitable[None]]) -> None:
    async def play() -> None:
        link = link_in_process(line(server.endpoint))
        try:
            await link.open()
            await scene(Rig(link))
        finally:
            await link.close()

    asyncio.run(play())


def test_everything_is_read_and_nothing_is_written_before_prepare(server: DeviceServer) -> None:
    async def scene(rig: Rig) -> None:
        await rig.until(lambda: rig.inputs.tension.good() and rig.inputs.plc.quality == Quality.GOOD)
        await rig.cycle()
        inputs = rig.inputs
        assert list(inputs.tension.value) == [10.0, 20.0]
        assert list(inputs.speed.value) == [0.1, 0.2]
        assert list(inputs.torque.value) == [1.0, 2.0]
        assert inputs.unwind_speed.value[0] == 0.1
        assert list(inputs.drive_state) == [DriveState.OFF] * 2
        assert inputs.plc.permissive and not inputs.plc.emergency_stop and not inputs.plc.running
        assert server.devices.writes == []
        assert rig.link.health.absent == []

    run(server, scene)


def test_a_round_trip_of_all_roles(server: DeviceServer) -> None:
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.enable(torque_nm=5.0)
        assert [devices.value(f"{name}.Watchdog") for name in ("Axis1", "Axis2", "Line")] == [100] * 3
        await rig.until(lambda: devices.value("Axis2.TargetTorque") == 5.0)
        assert devices.value("Line.SpeedRequest") == 0.2
        both = {f"Axis{k}.{name}" for k in (1, 2) for name in ("Controlword", "TargetTorque", "Life")}
        assert set(devices.writes[-1]) == both | {"Line.Run", "Line.SpeedRequest", "Line.Life", "Line.Warning"}
        for life in (devices.written(f"{name}.Life") for name in ("Axis1", "Axis2", "Line")):
            assert len(set(life)) == len(life)
        rig.link.silence()
        written = len(devices.writes)
        for _ in range(3):
            await rig.cycle()
        assert len(devices.writes) == written
        assert rig.inputs.tension.good()

    run(server, scene)


def test_a_command_is_written_once(server: DeviceServer) -> None:
    """A loop that hands nothing over any more lets the watchdogs fire."""

    async def scene(rig: Rig) -> None:
        await rig.enable()
        await rig.cycle()
        now_s = asyncio.get_running_loop().time()
        rig.link.trigger(now_s)
        await rig.link.collect(rig.inputs, now_s + 1.0)
        written = len(server.devices.writes)
        for _ in range(3):
            now_s = asyncio.get_running_loop().time()
            rig.link.trigger(now_s)
            await rig.link.collect(rig.inputs, now_s + 1.0)
        assert len(server.devices.writes) == written

    run(server, scene)


@pytest.mark.parametrize(
    ("status", "text"),
    [
        (CODES.BadSensorFailure, "cell-1: BadSensorFailure"),
        (CODES.UncertainSensorNotAccurate, "cell-1: UncertainSensorNotAccurate"),
        (CODES.UncertainSensorNotAccurate | 0x400, "cell-1: UncertainSensorNotAccurate"),  # with flags
        (0x80FF0000, "cell-1: Bad (status 80FF0000h)"),
    ],
)
def test_a_tension_that_is_not_good_is_bad(server: DeviceServer, status: int, text: str) -> None:
    async def scene(rig: Rig) -> None:
        await rig.until(rig.inputs.tension.good)
        server.devices.status["Cell1.Tension"] = status
        await rig.cycle()
        assert list(rig.inputs.tension.quality) == [Quality.BAD, Quality.GOOD]
        assert rig.inputs.tension.value[0] == 10.0
        assert text in rig.link.health.last_error

    run(server, scene)


@pytest.mark.parametrize("tension_n", [nan, inf, 100.5, -100.5])
def test_a_tension_that_cannot_be_is_bad(server: DeviceServer, tension_n: float) -> None:
    async def scene(rig: Rig) -> None:
        await rig.until(rig.inputs.tension.good)
        server.devices.set("Cell2.Tension", tension_n)
        await rig.cycle()
        assert list(rig.inputs.tension.quality) == [Quality.GOOD, Quality.BAD]
        assert "beyond its capacity of 100 N" in rig.link.health.last_error

    run(server, scene)


def test_the_channels_own_status_is_heard(server: DeviceServer) -> None:
    async def scene(rig: Rig) -> None:
        await rig.until(rig.inputs.tension.good)
        server.devices.set("Cell2.Status", 2)
        await rig.cycle()
        assert list(rig.inputs.tension.quality) == [Quality.GOOD, Quality.BAD]
        assert rig.link.health.last_error == "cell-2: wire break"

    run(server, scene)


@pytest.mark.parametrize(
    ("node", "value"),
    [
        ("Cell1.Tension", ua.Variant("12.0", ua.VariantType.String)),
        ("Cell1.Tension", ua.Variant(12.0, ua.VariantType.Float)),
        ("Cell1.Tension", ua.Variant([12.0], ua.VariantType.Double)),
        ("Cell1.Tension", ua.Variant(None, ua.VariantType.Null)),
    ],
)
def test_a_value_of_another_type_is_bad(server: DeviceServer, node: str, value: ua.Variant) -> None:
    async def scene(rig: Rig) -> None:
        await rig.until(rig.inputs.tension.good)
        server.devices.nodes[node] = (value.VariantType, value.Value)
        await rig.cycle()
        assert list(rig.inputs.tension.quality) == [Quality.BAD, Quality.GOOD]
        assert "cell-1: BadTypeMismatch" in rig.link.health.last_error

    run(server, scene)


def test_a_sample_counter_that_stands_still_is_a_miss(server: DeviceServer) -> None:
    async def scene(rig: Rig) -> None:
        await rig.until(rig.inputs.tension.good)
        server.devices.counts = False
        await rig.cycle()
        await rig.cycle()
        assert list(rig.inputs.tension.quality) == [Quality.STALE] * 2
        assert "the sample counter stands still" in rig.link.health.last_error

    run(server, scene)


def test_an_amplifier_that_is_not_healthy_is_not_believed(server: DeviceServer) -> None:
    async def scene(rig: Rig) -> None:
        await rig.until(rig.inputs.tension.good)
        server.devices.set("Amplifier.Healthy", False)
        await rig.cycle()
        assert list(rig.inputs.tension.quality) == [Quality.BAD] * 2

    run(server, scene)


def test_a_drives_bad_values_are_bad_one_by_one(server: DeviceServer) -> None:
    async def scene(rig: Rig) -> None:
        await rig.until(rig.inputs.speed.good)
        server.devices.status["Axis1.Speed"] = CODES.BadNoCommunication
        server.devices.set("Axis2.Torque", nan)
        await rig.cycle()
        assert list(rig.inputs.speed.quality) == [Quality.BAD, Quality.GOOD]
        assert list(rig.inputs.torque.quality) == [Quality.GOOD, Quality.BAD]

    run(server, scene)


def test_a_drive_without_statusword_is_lost_and_not_written_to(server: DeviceServer) -> None:
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.enable()
        devices.status["Axis1.Statusword"] = CODES.BadNoCommunication
        await rig.until(lambda: rig.inputs.drive_state[0] == DriveState.ABSENT)
        await rig.cycle()
        assert rig.inputs.speed.quality[0] == Quality.BAD
        devices.status.clear()
        devices.writes.clear()
        await rig.until(lambda: len(devices.written("Axis2.Life")) > 2)
        assert devices.written("Axis1.Life") == []
        assert list(rig.inputs.drive_state) == [DriveState.FAULT, DriveState.ENABLED]
        rig.outputs.drive_request[:] = DriveRequest.OFF
        await rig.until(lambda: devices.value("Axis2.Statusword") == 0x0250)
        devices.set("Axis1.Statusword", 0x0250)  # its watchdog's doing
        await rig.prepare()
        await rig.until(lambda: devices.written("Axis1.Life") != [])

    run(server, scene)


def test_a_fault_is_named_with_its_code(server: DeviceServer) -> None:
    async def scene(rig: Rig) -> None:
        server.devices.set("Axis1.Statusword", 0x0218)
        server.devices.set("Axis1.ErrorCode", 0x8250)
        server.devices.set("Axis2.SafeTorqueOff", True)
        await rig.until(lambda: rig.inputs.drive_state[0] == DriveState.FAULT)
        assert rig.inputs.drive_state[1] == DriveState.STO
        assert rig.link.health.last_error == "drive-1: fault 8250h"

    run(server, scene)


def test_an_echo_that_stands_still_is_found(server: DeviceServer) -> None:
    async def scene(rig: Rig) -> None:
        await rig.enable()
        server.devices.echoes = False
        await rig.until(lambda: rig.inputs.plc.quality == Quality.STALE)
        assert "its echo of the life counter stands still" in rig.link.health.last_error
        assert rig.inputs.tension.good()

    run(server, scene)


@pytest.mark.parametrize("bystander", [0, CODES.BadTransactionFailed])
def test_a_drive_that_refuses_a_command_is_named_and_left_to_its_watchdog(server: DeviceServer, bystander: int) -> None:
    """The server does nothing of a Write of which a part is refused: it must not be repeated for all drives."""
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.enable()
        devices.bystander = bystander
        devices.refuses["Axis1.TargetTorque"] = CODES.BadNotWritable
        await rig.until(lambda: rig.inputs.drive_state[0] == DriveState.FAULT)
        assert "drive-1: its command was refused: BadNotWritable" in rig.link.health.last_error
        devices.writes.clear()
        await rig.until(lambda: len(devices.written("Axis2.Life")) > 2)
        assert devices.written("Axis1.Life") == []
        assert rig.inputs.drive_state[1] == DriveState.ENABLED
        assert rig.inputs.plc.quality == Quality.GOOD

    run(server, scene)


def test_a_plc_that_refuses_a_command_is_not_there_for_the_loop(server: DeviceServer) -> None:
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.enable()
        devices.refuses["Line.Run"] = CODES.BadUserAccessDenied
        await rig.until(lambda: rig.inputs.plc.quality == Quality.STALE)
        devices.writes.clear()
        await rig.until(lambda: len(devices.written("Axis1.Life")) > 2)
        assert devices.written("Line.Life") == []
        assert rig.inputs.unwind_speed.quality[0] == Quality.GOOD
        assert "BadUserAccessDenied" in rig.link.health.last_error

    run(server, scene)


@pytest.mark.parametrize("speed_m_per_s", [nan, inf, 51.0])
def test_a_speed_that_cannot_be_asked_for_is_not_written(server: DeviceServer, speed_m_per_s: float) -> None:
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.enable()
        rig.outputs.speed_request_m_per_s = speed_m_per_s
        await rig.until(lambda: rig.inputs.plc.quality == Quality.STALE)
        await rig.cycle()
        devices.writes.clear()
        await rig.until(lambda: len(devices.written("Axis1.Life")) > 2)
        assert devices.written("Line.Life") == []
        rig.outputs.speed_request_m_per_s = 0.1
        await rig.until(lambda: rig.inputs.plc.quality == Quality.GOOD)

    run(server, scene)


def test_a_torque_that_is_not_finite_is_not_written(server: DeviceServer) -> None:
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.enable()
        rig.outputs.torque_nm[0] = nan
        await rig.cycle()
        await rig.cycle()
        devices.writes.clear()
        await rig.until(lambda: len(devices.written("Axis2.Life")) > 2)
        assert devices.written("Axis1.Life") == []

    run(server, scene)


REFUSALS: list[tuple[Callable[[DeviceServer], object], Finding]] = [
    (
        lambda s: s.devices.set("Axis2.DeviceId", 0x5203),
        finding("device-id-differs", device="drive-2", found=0x5203, wanted=0x5205),
    ),
    (
        lambda s: s.devices.set("Line.DeviceId", 1),
        finding("device-id-differs", device="plc", found=1, wanted=0x5207),
    ),
    (
        lambda s: s.devices.nodes.pop("Axis1.DeviceId"),
        finding("node-not-read", device="drive-1", node="identity", status="BadNodeIdUnknown"),
    ),
    (
        lambda s: s.devices.nodes.pop("Axis2.SerialNumber"),
        finding("node-not-read", device="drive-2", node="serial", status="BadNodeIdUnknown"),
    ),
    (
        lambda s: s.devices.nodes.update({"Line.SerialNumber": (ua.VariantType.Double, 4711.0)}),
        finding("node-not-read", device="plc", node="serial", status="BadTypeMismatch"),
    ),
    (
        lambda s: s.devices.set("Axis1.Statusword", 0x1237),
        finding("still-enabled", drive="drive-1", statusword=0x1237),
    ),
    (
        lambda s: s.devices.set("Axis1.RatedTorque", 40.0),
        finding("rated-torque-differs", drive="drive-1", found_nm=40.0, wanted_nm=80.0),
    ),
    (
        lambda s: s.devices.set("Axis1.RatedTorque", nan),
        finding("rated-torque-differs", drive="drive-1", found_nm=nan, wanted_nm=80.0),
    ),
    (
        lambda s: s.devices.set("Axis2.MaxTorque", 59.0),
        finding("max-torque-too-low", drive="drive-2", found_nm=59.0, limit_nm=60.0),
    ),
    (
        lambda s: s.devices.set("Axis2.MaxTorque", nan),
        finding("max-torque-too-low", drive="drive-2", found_nm=nan, limit_nm=60.0),
    ),
    (
        lambda s: s.devices.set("Amplifier.Channels", 1),
        finding("channel-missing", device="cell-2", channel=2, channels=1),
    ),
    (
        lambda s: s.devices.refuses.update({"Axis2.Watchdog": CODES.BadOutOfRange}),
        finding("setting-not-set", device="drive-2", setting="watchdog", error="BadOutOfRange"),
    ),
    (
        lambda s: s.devices.stubborn.add("Line.Watchdog"),
        finding("setting-reads-back", device="plc", setting="watchdog", set_counts=100, found_counts=0.0),
    ),
    (
        lambda s: s.devices.nodes.update({"Axis1.Watchdog": (U32, 0)}),
        finding("node-not-read", device="drive-1", node="watchdog", status="BadTypeMismatch"),
    ),
]


@pytest.mark.parametrize(("spoil", "found"), REFUSALS, ids=[found.code for _, found in REFUSALS])
def test_prepare_refuses_by_name_and_leaves_no_watchdog_set(
    server: DeviceServer, spoil: Callable[[DeviceServer], object], found: Finding
) -> None:
    devices = server.devices
    spoil(server)

    async def scene(rig: Rig) -> None:
        with pytest.raises(PrepareRefused) as refused:
            await rig.prepare()
        assert found in refused.value.reasons
        assert [devices.value(f"{name}.Watchdog") for name in ("Axis1", "Axis2", "Line")] == [0] * 3
        devices.writes.clear()
        for _ in range(3):
            await rig.cycle()
        assert devices.writes == []

    run(server, scene)


def test_every_reason_is_named(server: DeviceServer) -> None:
    server.devices.set("Axis1.DeviceId", 1)
    server.devices.set("Axis2.RatedTorque", 1.0)
    server.devices.set("Line.DeviceId", 1)

    async def scene(rig: Rig) -> None:
        with pytest.raises(PrepareRefused) as refused:
            await rig.prepare()
        assert [reason.code for reason in refused.value.reasons] == [
            "device-id-differs",
            "rated-torque-differs",
            "device-id-differs",
        ]

    run(server, scene)


def test_release_takes_torque_off_and_ends_supervision(server: DeviceServer) -> None:
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.enable()
        await rig.link.release()
        off, unsupervised, supervised = devices.writes[-3:]
        last = {k: devices.value(f"Axis{k}.Life") - 1 for k in (1, 2)}
        assert off == {
            f"Axis{k}.{name}": value
            for k in (1, 2)
            for name, value in (("Controlword", 0), ("TargetTorque", 0.0), ("Life", last[k]))
        }
        lives = {f"Axis{k}.Life": last[k] + 1 for k in (1, 2)}
        assert unsupervised == {**off, **lives, "Axis1.Watchdog": 0, "Axis2.Watchdog": 0}
        assert supervised == {"Axis1.Watchdog": 100, "Axis2.Watchdog": 100}
        devices.writes.clear()
        for _ in range(3):
            await rig.cycle()
        assert devices.writes == []
        await rig.link.release()  # nobody is written to: nothing to say
        assert devices.writes == []

    run(server, scene)


@pytest.mark.parametrize("word", [0x0237, 0x021F, 0x0207, 0x0235], ids="{:04X}h".format)
def test_a_drive_that_does_not_say_that_its_torque_is_off_keeps_its_watchdog(server: DeviceServer, word: int) -> None:
    """Enabled, in a fault reaction, in quick stop, or in what the profile does not know, after it was told to rest."""
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.enable()
        devices.deaf.add("Axis1")
        devices.set("Axis1.Statusword", word)
        devices.writes.clear()
        await rig.link.release()
        assert f"drive-1: was told to take torque off and does not say that it is (statusword {word:04X}h)" in (
            rig.link.health.last_error
        )
        assert devices.written("Axis1.Watchdog") == [] and devices.written("Axis2.Watchdog") == [0, 100]

    run(server, scene)


@pytest.mark.parametrize("begin", [LAST_NUMBER - 20, 2**32 - 21])
def test_a_connection_outlives_the_last_of_its_request_numbers(
    server: DeviceServer, monkeypatch: pytest.MonkeyPatch, begin: int
) -> None:
    opened, protocols = Session.open, []

    async def open_late(plan: Plan) -> Session:
        session = await opened(plan)
        protocol: Any = session._client.uaclient.protocol  # noqa: SLF001
        protocol._request_id = protocol._request_handle = begin  # noqa: SLF001
        protocols.append(protocol)
        return session

    monkeypatch.setattr(Session, "open", open_late)

    async def scene(rig: Rig) -> None:
        await rig.until(lambda: rig.inputs.tension.good() and rig.inputs.plc.quality == Quality.GOOD)
        for _ in range(60):
            await rig.cycle()
        await rig.until(lambda: rig.inputs.tension.good())
        (protocol,) = protocols  # it was never connected again
        assert 0 < protocol._request_id < 1000 and rig.link.health.absent == []  # noqa: SLF001

    run(server, scene)

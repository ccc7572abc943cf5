"""The OPC UA face of the simulated line: asyncua's client as the peer."""

import asyncio
import gc
import math
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, ua

from sim_plant.devices.amplifier import Amplifier, ChannelStatus
from sim_plant.devices.cia402 import State
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.opcua import NAMESPACE, OpcUaFace
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.world import World

PLANT = load_plant(Path(__file__).parents[2] / "sim_plant/plants/s_real.toml")
V, S = ua.VariantType, ua.StatusCodes

AXIS = {
    "DeviceId": (V.UInt32, "r"),
    "SerialNumber": (V.String, "r"),
    "Statusword": (V.UInt16, "r"),
    "Speed": (V.Double, "r"),
    "Torque": (V.Double, "r"),
    "SafeTorqueOff": (V.Boolean, "r"),
    "ErrorCode": (V.UInt16, "r"),
    "Controlword": (V.UInt16, "w"),
    "TargetTorque": (V.Double, "w"),
    "Life": (V.UInt16, "w"),
    "Watchdog": (V.UInt16, "w"),
    "RatedTorque": (V.Double, "r"),
    "MaxTorque": (V.Double, "r"),
}
AMPLIFIER = {
    "DeviceId": (V.UInt32, "r"),
    "SerialNumber": (V.String, "r"),
    "Channels": (V.UInt16, "r"),
    "SampleCounter": (V.UInt16, "r"),
    "Healthy": (V.Boolean, "r"),
}
CELL = {"Tension": (V.Double, "r"), "Status": (V.UInt16, "r")}
LINE = {
    "DeviceId": (V.UInt32, "r"),
    "SerialNumber": (V.UInt32, "r"),
    "Permissive": (V.Boolean, "r"),
    "EmergencyStopHealthy": (V.Boolean, "r"),
    "Running": (V.Boolean, "r"),
    "WatchdogTripped": (V.Boolean, "r"),
    "Local": (V.Boolean, "r"),
    "UnwindSpeed": (V.Double, "r"),
    "LifeEcho": (V.UInt16, "r"),
    "Run": (V.Boolean, "w"),
    "Warning": (V.Boolean, "w"),
    "SpeedRequest": (V.Double, "w"),
    "Life": (V.UInt16, "w"),
    "Watchdog": (V.UInt16, "w"),
}
TABLE = {
    f"{device}.{name}": row
    for device, rows in (
        *((f"Axis{c}", AXIS) for c in (1, 2)),
        ("Amplifier", AMPLIFIER),
        *((f"Cell{c}", CELL) for c in range(1, 7)),
        ("Line", LINE),
    )
    for name, row in rows.items()
}


class Peer:
    """A client that says names and values."""

    def __init__(self, client: Client, index: int) -> None:
        self.client = client
        self.index = index

    def node(self, name: str) -> ua.NodeId:
        return ua.NodeId(name, self.index)

    async def data(self, *names: str) -> list[ua.DataValue]:
        return await self.client.uaclient.read_attributes([self.node(n) for n in names], ua.AttributeIds.Value)

    async def read(self, *names: str) -> Any:
        data = await self.data(*names)
        assert all(value.StatusCode.is_good() for value in data)
        return [value.Value.Value for value in data] if len(data) > 1 else data[0].Value.Value

    async def write(self, values: Mapping[str, Any]) -> list[int]:
        """Status codes. A value is of the table's type unless it is a variant."""
        variants = [v if isinstance(v, ua.Variant) else ua.Variant(v, TABLE[name][0]) for name, v in values.items()]
        nodes = [self.node(name) for name in values]
        statuses = await self.client.uaclient.write_attributes(
            nodes, [ua.DataValue(v) for v in variants], ua.AttributeIds.Value
        )
        return [status.value for status in statuses]


class Bench:
    """Two axes, the amplifier with its cells and the PLC on a port of their own, in time that the test steps."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.world = World(PLANT, 7)
        self.recorder = Recorder(self.world)
        self.drives = {c: Drive(c - 1, self.world, self.recorder, 1.2, 3.0) for c in (1, 2)}
        self.amplifier = Amplifier(self.world)
        self.plc = LinePlc(self.world, self.recorder, drives=list(self.drives.values()))
        self.face = OpcUaFace(self.drives, self.amplifier, range(1, 7), self.plc, lambda: self.now_s)
        self.port = 0

    @property
    def url(self) -> str:
        return f"opc.tcp://127.0.0.1:{self.port}/"

    @asynccontextmanager
    async def peer(self) -> AsyncIterator[Peer]:
        async with Client(self.url, timeout=5) as client:
            yield Peer(client, await client.get_namespace_index(NAMESPACE))

    async def enable(self, peer: Peer, torque_nm: float = 0.0) -> None:
        """Axis 1 to operation enabled."""
        for controlword in (0x06, 0x07, 0x0F):
            assert await peer.write({"Axis1.Controlword": controlword, "Axis1.TargetTorque": torque_nm}) == [0, 0]


def on_bench(test: Callable[[Bench], Awaitable[None]]) -> None:
    async def run() -> None:
        bench = Bench()
        bench.port = await bench.face.open("127.0.0.1", 0)
        try:
            async with asyncio.timeout(30):
                await test(bench)
        finally:
            await bench.face.close()
            rest = asyncio.all_tasks() - {asyncio.current_task()}
            assert not rest, f"left behind: {rest}"

    # Garbage of other tests is not this one's, and with the standard's nodes a collection takes long.
    gc.freeze()
    try:
        asyncio.run(run())
    finally:
        gc.unfreeze()


def test_the_address_space_is_the_table() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            objects = await peer.client.nodes.objects.get_children()
            ours = {node.nodeid.Identifier: node for node in objects if node.nodeid.NamespaceIndex == peer.index}
            assert set(ours) == {name.split(".")[0] for name in TABLE}
            found = {}
            for node in ours.values():
                for child in await node.get_children():
                    attributes = (
                        ua.AttributeIds.AccessLevel,
                        ua.AttributeIds.UserAccessLevel,
                        ua.AttributeIds.DataType,
                    )
                    access, user_access, data_type = [v.Value.Value for v in await child.read_attributes(attributes)]
                    assert access == user_access
                    value = await child.read_data_value()
                    assert value.Value.VariantType.value == data_type.Identifier
                    found[child.nodeid.Identifier] = (value.Value.VariantType, {1: "r", 3: "w"}[access])
            assert found == TABLE
            assert (await peer.client.get_node(peer.node("Axis1.Speed")).read_description()).Text == "m/s"
            assert bench.face.malformed == 0

    on_bench(test)


def test_values_and_units() -> None:
    async def test(bench: Bench) -> None:
        bench.world.start_at_equilibrium(bench.world.tension_n + [20, 22, 24, 26, 28, 30], 0.1)
        bench.now_s = 0.25
        async with bench.peer() as peer:
            assert await peer.read("Axis1.DeviceId", "Amplifier.DeviceId", "Line.DeviceId") == [0x5205, 0x5206, 0x5207]
            assert await peer.read("Axis1.RatedTorque", "Axis1.MaxTorque") == [1.2, 3.0]
            speed, torque = await peer.read("Axis2.Speed", "Axis2.Torque")
            assert speed == pytest.approx(bench.world.speed_m_per_s[1], abs=5e-3)
            assert torque == bench.world.torque_nm[1]
            assert await peer.read("Amplifier.Channels", "Amplifier.SampleCounter") == [6, 250]
            assert await peer.read("Amplifier.Healthy") is True
            for c in range(1, 7):
                tension, status = await peer.read(f"Cell{c}.Tension", f"Cell{c}.Status")
                assert tension == pytest.approx(bench.world.tension_n[c - 1], abs=0.6) and status == 0
            assert await peer.read("Line.UnwindSpeed") == pytest.approx(0.1, abs=5e-3)
            assert await peer.read("Line.Permissive", "Line.EmergencyStopHealthy", "Line.Running") == [
                True,
                True,
                False,
            ]
            bench.amplifier.healthy = False
            assert await peer.read("Amplifier.Healthy") is False

    on_bench(test)


def test_the_bytes_and_the_stack_say_the_same() -> None:
    """A Read of the variables alone takes the short way; with another node in it, asyncua's."""

    async def test(bench: Bench) -> None:
        bench.now_s = 0.1
        bench.amplifier.set_status(2, ChannelStatus.WIRE_BREAK)
        bench.amplifier.set_status(3, ChannelStatus.OVERLOAD)
        async with bench.peer() as peer:
            nodes = [peer.node(name) for name in TABLE]
            clock = ua.NodeId(ua.ObjectIds.Server_ServerStatus_State)
            short = await peer.client.uaclient.read_attributes(nodes, ua.AttributeIds.Value)
            long = await peer.client.uaclient.read_attributes([*nodes, clock], ua.AttributeIds.Value)
            assert long.pop().Value.Value == ua.ServerState.Running
            assert [(v.Value, v.StatusCode) for v in short] == [(v.Value, v.StatusCode) for v in long]
            assert all(v.SourceTimestamp is not None for v in (*short, *long))

    on_bench(test)


class Held:
    """What a client sends, kept back until `send`."""

    def __init__(self, peer: Peer) -> None:
        self._protocol: Any = peer.client.uaclient.protocol
        self._write = self._protocol.transport.write
        self._protocol.transport.write = self._keep
        self._new = asyncio.Semaphore(0)
        self.kept = b""

    def _keep(self, message: bytes) -> None:
        self.kept += message
        self._new.release()

    async def one_more(self) -> None:
        await self._new.acquire()

    def send(self, times: int = 1) -> None:
        """All in one piece; what comes later goes at once."""
        self._protocol.transport.write = self._write
        self._write(times * self.kept)


def test_requests_in_one_piece_are_answered_in_their_order() -> None:
    """Also where asyncua has to answer one that stands between two that need it not."""

    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            held = Held(peer)
            answered: list[str] = []
            life, clock = peer.node("Axis1.Life"), ua.NodeId(ua.ObjectIds.Server_ServerStatus_State)

            async def ask(name: str, request: Awaitable[Any]) -> Any:
                answer = await request
                answered.append(name)
                return answer

            async def read(*nodes: ua.NodeId) -> list[Any]:
                data = await peer.client.uaclient.read_attributes(list(nodes), ua.AttributeIds.Value)
                return [value.Value.Value for value in data]

            async with asyncio.TaskGroup() as group:
                tasks: list[asyncio.Task[Any]] = []
                for name, request in (
                    ("write", peer.write({"Axis1.Life": 5})),
                    ("read", read(life)),
                    ("stack", read(clock, life)),
                    ("write again", peer.write({"Axis1.Life": 6})),
                    ("read again", read(life)),
                ):
                    tasks.append(group.create_task(ask(name, request)))
                    await held.one_more()
                held.send()
            assert [task.result() for task in tasks] == [[0], [5], [ua.ServerState.Running, 5], [0], [6]]
            assert answered == ["write", "read", "stack", "write again", "read again"]

    on_bench(test)


def test_a_request_that_comes_twice_ends_the_connection_and_acts_once() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            held = Held(peer)
            writing = asyncio.create_task(peer.write({"Axis1.Life": 5}))
            await held.one_more()
            requests = bench.face.requests
            held.send(times=2)
            await asyncio.gather(writing, return_exceptions=True)
        assert (bench.face.requests, bench.face.malformed) == (requests + 1, 1)
        async with bench.peer() as peer:
            assert await peer.read("Axis1.Life") == 5

    on_bench(test)


def test_one_read_is_one_instant() -> None:
    async def test(bench: Bench) -> None:
        asked = 0

        def clock() -> float:
            nonlocal asked
            asked += 1
            bench.now_s += 0.001
            return bench.now_s

        bench.face.clock = clock
        async with bench.peer() as peer:
            for names in (tuple(TABLE), ("Amplifier.SampleCounter", "Amplifier.SampleCounter")):
                before = asked
                data = await peer.data(*names)
                assert asked == before + 1
                assert len({value.SourceTimestamp for value in data}) == 1
            assert data[0].Value.Value == data[1].Value.Value == round(bench.now_s * 1e3)

    on_bench(test)


@pytest.mark.parametrize(
    ("status", "code"),
    [
        (ChannelStatus.OVERLOAD, S.UncertainSensorNotAccurate),
        (ChannelStatus.NOT_CALIBRATED, S.UncertainSensorNotAccurate),
    ],
)
def test_a_cell_that_is_not_to_be_trusted_says_so(status: ChannelStatus, code: int) -> None:
    async def test(bench: Bench) -> None:
        bench.amplifier.set_status(2, status)
        async with bench.peer() as peer:
            good, doubtful, word = await peer.data("Cell1.Tension", "Cell2.Tension", "Cell2.Status")
            assert good.StatusCode.is_good()
            assert doubtful.StatusCode.value == S.UncertainSensorNotAccurate and math.isfinite(doubtful.Value.Value)
            assert word.StatusCode.is_good() and word.Value.Value == status

    on_bench(test)


def test_a_broken_wire_has_no_value() -> None:
    async def test(bench: Bench) -> None:
        bench.amplifier.set_status(5, ChannelStatus.WIRE_BREAK)
        async with bench.peer() as peer:
            broken, word = await peer.data("Cell5.Tension", "Cell5.Status")
            assert broken.StatusCode.value == S.BadSensorFailure
            assert broken.Value is None or broken.Value.Value is None
            assert word.StatusCode.is_good() and word.Value.Value == 2

    on_bench(test)


def test_drive_to_operation_enabled_and_torque() -> None:
    async def test(bench: Bench) -> None:
        drive = bench.drives[1]
        async with bench.peer() as peer:
            assert await peer.read("Axis1.Statusword") & 0x024F == 0x0240  # switch on disabled, remote
            for controlword, state in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27)):
                assert await peer.write({"Axis1.Controlword": controlword, "Axis1.TargetTorque": 0.5}) == [0, 0]
                assert await peer.read("Axis1.Statusword") & 0x6F == state
            word, torque = await peer.read("Axis1.Statusword", "Axis1.Torque")
            assert word & 1 << 12 and torque == bench.world.torque_nm[0] == 0.5
            # Torque alone, and beyond what the drive gives.
            assert await peer.write({"Axis1.TargetTorque": -9.0}) == [0]
            word, torque = await peer.read("Axis1.Statusword", "Axis1.Torque")
            assert word & 1 << 11 and torque == -3.0
            assert await peer.read("Axis1.Controlword", "Axis1.TargetTorque") == [0x0F, -9.0]
            assert await peer.write({"Axis1.Controlword": 0}) == [0]
            assert drive.state is State.SWITCH_ON_DISABLED and await peer.read("Axis1.Torque") == 0.0
            assert bench.drives[2].state is State.SWITCH_ON_DISABLED

    on_bench(test)


def test_safe_torque_off() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            await bench.enable(peer, 0.5)
            bench.now_s = 0.01
            bench.drives[1].set_sto(True, bench.now_s)
            word, sto, torque = await peer.read("Axis1.Statusword", "Axis1.SafeTorqueOff", "Axis1.Torque")
            assert word & 0x5F == 0x40 and sto is True and torque == 0.0
            await bench.enable(peer, 0.5)
            assert bench.world.torque_nm[0] == 0.0
            bench.drives[1].set_sto(False, bench.now_s)
            assert await peer.read("Axis1.SafeTorqueOff") is False
            assert await peer.read("Axis1.Statusword") & 0x4F == 0x40

    on_bench(test)


def test_a_fault_is_told_and_reset() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            bench.drives[1].fault(0x4210, 0.0)
            assert await peer.read("Axis1.ErrorCode") == 0x4210
            assert await peer.write({"Axis1.Controlword": 0x80}) == [0]
            assert await peer.read("Axis1.ErrorCode") == 0
            assert await peer.read("Axis1.Statusword") & 0x4F == 0x40

    on_bench(test)


def test_the_axis_watchdog_is_fed_by_life_alone() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            assert await peer.write({"Axis1.Watchdog": 100}) == [0]
            await bench.enable(peer, 0.5)
            bench.now_s = 5.0
            assert await peer.write({"Axis1.TargetTorque": 0.6}) == [0]
            assert await peer.read("Axis1.ErrorCode") == 0  # it counts from the first change of Life
            assert await peer.write({"Axis1.Life": 1}) == [0]
            for step in range(1, 4):
                bench.now_s = 5.0 + 0.09 * step
                assert await peer.write({"Axis1.TargetTorque": 0.5, "Axis1.Life": 1 + step}) == [0, 0]
            fed_s = bench.now_s
            for ahead_s in (0.03, 0.06, 0.09):  # commands and the same Life again do not feed it
                bench.now_s = fed_s + ahead_s
                assert (
                    await peer.write({"Axis1.Controlword": 0x0F, "Axis1.TargetTorque": 0.7, "Axis1.Life": 4}) == [0] * 3
                )
            assert await peer.read("Axis1.Torque", "Axis1.ErrorCode") == [0.7, 0]
            bench.now_s = fed_s + 0.101
            word, torque, error = await peer.read("Axis1.Statusword", "Axis1.Torque", "Axis1.ErrorCode")
            assert (word & 0x4F, torque, error) == (0x08, 0.0, 0x8250)
            [trip] = bench.recorder.recording().of_kind("watchdog")
            assert trip["time_s"] == pytest.approx(fed_s + 0.1, abs=1.1e-3) and trip["watchdog_s"] == 0.1
            # A reset ends it; torque comes back only through the states, and time counts from the next change.
            bench.now_s += 1.0
            assert await peer.write({"Axis1.Controlword": 0x80}) == [0]
            bench.now_s += 1.0
            await bench.enable(peer, 0.2)
            assert await peer.read("Axis1.Torque", "Axis1.ErrorCode") == [0.2, 0]
            assert len(bench.recorder.recording().of_kind("watchdog")) == 1

    on_bench(test)


def test_the_axis_watchdog_acts_without_anybody_asking() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            await bench.enable(peer, 0.5)
            assert await peer.write({"Axis1.Watchdog": 50, "Axis1.Life": 1}) == [0, 0]
        bench.world.advance(0.049)
        assert bench.world.torque_nm[0] == 0.5
        bench.world.advance(0.051)
        assert bench.world.torque_nm[0] == 0.0 and bench.drives[1].state is State.FAULT

    on_bench(test)


def test_a_watchdog_that_is_switched_off_ends_with_the_next_life() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            await bench.enable(peer, 0.5)
            assert await peer.write({"Axis1.Watchdog": 50, "Axis1.Life": 1}) == [0, 0]
            bench.now_s = 0.04
            assert await peer.write({"Axis1.Watchdog": 0, "Axis1.Life": 2}) == [0, 0]
            bench.now_s = 9.0
            assert await peer.read("Axis1.Torque", "Axis1.Watchdog") == [0.5, 0]

    on_bench(test)


def test_the_line_runs_and_stops_with_life() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            state = ("Line.Running", "Line.WatchdogTripped", "Line.LifeEcho")
            assert await peer.write({"Line.Watchdog": 100}) == [0]
            assert await peer.write({"Line.Run": True, "Line.SpeedRequest": 0.1, "Line.Life": 7}) == [0] * 3
            assert await peer.read(*state) == [True, False, 7]
            assert bench.world.unwind_speed_m_per_s == 0.1
            bench.now_s = 0.09
            assert await peer.write({"Line.Life": 8}) == [0]
            bench.now_s = 0.18
            assert await peer.write({"Line.SpeedRequest": 0.2, "Line.Life": 8}) == [0, 0]
            assert await peer.read(*state) == [True, False, 8]
            bench.now_s = 0.192
            assert await peer.read(*state) == [False, True, 8]
            assert bench.world.unwind_speed_m_per_s == 0.0
            assert await peer.write({"Line.Life": 9}) == [0]
            assert await peer.read(*state) == [False, True, 9]  # latched until run was 0
            assert await peer.write({"Line.Run": False}) == [0]
            assert await peer.write({"Line.Run": True, "Line.Life": 10}) == [0, 0]
            assert await peer.read(*state) == [True, False, 10]
            bench.plc.emergency_stop = True
            bench.plc.permissive = False
            names = ("Line.Permissive", "Line.EmergencyStopHealthy", "Line.Running")
            assert await peer.read(*names) == [False, False, False]
        [trip] = bench.recorder.recording().of_kind("plc_watchdog")
        assert trip["time_s"] == pytest.approx(0.19)

    on_bench(test)


REFUSED: list[tuple[str, Any, int]] = [
    ("Axis1.TargetTorque", math.nan, S.BadOutOfRange),
    ("Axis1.TargetTorque", math.inf, S.BadOutOfRange),
    ("Axis1.TargetTorque", ua.Variant(1.0, V.Float), S.BadTypeMismatch),
    ("Axis1.TargetTorque", ua.Variant([1.0], V.Double), S.BadTypeMismatch),
    ("Axis1.Watchdog", 9, S.BadOutOfRange),
    ("Axis1.Watchdog", 1001, S.BadOutOfRange),
    ("Axis1.Watchdog", ua.Variant(100, V.UInt32), S.BadTypeMismatch),
    ("Axis1.Life", ua.Variant("1", V.String), S.BadTypeMismatch),
    ("Axis1.Life", ua.Variant(), S.BadTypeMismatch),
    ("Axis1.Torque", 1.0, S.BadNotWritable),
    ("Axis1.RatedTorque", 1.0, S.BadNotWritable),
    ("Cell1.Tension", 1.0, S.BadNotWritable),
    ("Amplifier.Healthy", True, S.BadNotWritable),
    ("Line.SpeedRequest", -math.inf, S.BadOutOfRange),
    ("Line.Watchdog", 5, S.BadOutOfRange),
    ("Line.Run", ua.Variant(1, V.UInt16), S.BadTypeMismatch),
    ("Line.Permissive", False, S.BadNotWritable),
    ("Line.Nothing", ua.Variant(1, V.UInt16), S.BadNodeIdUnknown),
]


def test_one_bad_value_and_none_acts() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            await bench.enable(peer, 0.5)
            written = [name for name, (_, access) in TABLE.items() if access == "w"]
            before = await peer.read(*written)
            for name, value, code in REFUSED:
                good = {"Axis1.Controlword": 0, "Axis2.Watchdog": 100, "Line.Run": True, "Line.SpeedRequest": 0.1}
                good.pop(name, None)
                *others, refused = await peer.write({**good, name: value})
                assert (name, refused) == (name, code)
                assert set(others) == {S.BadTransactionFailed}
                assert await peer.read(*written) == before
                assert await peer.read("Axis1.Torque", "Line.Running", "Line.LifeEcho") == [0.5, False, 0]
            assert bench.face.malformed == 0

    on_bench(test)


def test_all_values_of_a_write_act_at_one_instant() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            for controlword in (0x06, 0x0F):
                bench.now_s += 0.01
                command = {f"Axis{c}.Controlword": controlword for c in (1, 2)}
                assert await peer.write(command | {f"Axis{c}.TargetTorque": 0.1 * c for c in (1, 2)}) == [0] * 4
            assert await peer.read("Axis1.Torque", "Axis2.Torque") == [0.1, 0.2]
        enabled = [e for e in bench.recorder.recording().of_kind("drive_state") if e["state"] == "OPERATION_ENABLED"]
        assert [e["roller"] for e in enabled] == [1, 2]
        assert {e["time_s"] for e in enabled} == {0.02}

    on_bench(test)


def test_nothing_else_can_be_written_called_or_added() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as peer:
            client = peer.client
            value = ua.DataValue(ua.Variant("x", V.String))
            for node, attribute in (
                (peer.node("Axis1.Life"), ua.AttributeIds.DisplayName),
                (peer.node("Axis1"), ua.AttributeIds.BrowseName),
                (ua.NodeId(ua.ObjectIds.Server_ServerArray), ua.AttributeIds.Value),
                (ua.NodeId(ua.ObjectIds.Server_ServerDiagnostics_EnabledFlag), ua.AttributeIds.Value),
            ):
                [status] = await client.uaclient.write_attributes([node], [value], attribute)
                assert status.value == S.BadNotWritable
            with pytest.raises(ua.uaerrors.BadServiceUnsupported):
                await client.nodes.objects.add_variable(peer.index, "mine", 1.0)
            with pytest.raises(ua.uaerrors.BadServiceUnsupported):
                await client.get_node(ua.ObjectIds.Server).call_method(
                    ua.NodeId(ua.ObjectIds.Server_GetMonitoredItems), ua.Variant(1, V.UInt32)
                )
            with pytest.raises(ua.uaerrors.BadServiceUnsupported):
                await client.uaclient.delete_nodes(ua.DeleteNodesParameters())
            assert await peer.read("Axis1.Life") == 0

    on_bench(test)


def test_one_endpoint_without_security_for_anonymous_only() -> None:
    async def test(bench: Bench) -> None:
        [endpoint] = await Client(bench.url).connect_and_get_server_endpoints()
        assert endpoint.EndpointUrl == bench.url
        assert endpoint.SecurityMode == ua.MessageSecurityMode.None_
        assert [token.TokenType for token in endpoint.UserIdentityTokens] == [ua.UserTokenType.Anonymous]
        admin = Client(bench.url)
        admin.set_user("admin")
        with pytest.raises(ua.UaError):
            await admin.connect()

    on_bench(test)


def test_subscribers_are_told() -> None:
    async def test(bench: Bench) -> None:
        told: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()

        class Handler:
            def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
                told.put_nowait((node.nodeid.Identifier, value))

        async with bench.peer() as peer:
            subscription = await peer.client.create_subscription(1, Handler())
            node = peer.client.get_node(peer.node("Axis1.Torque"))
            await subscription.subscribe_data_change(node)
            assert await told.get() == ("Axis1.Torque", 0.0)
            await bench.enable(peer, 0.5)
            assert await told.get() == ("Axis1.Torque", 0.5)

    on_bench(test)


def test_two_clients_and_one_that_comes_again() -> None:
    async def test(bench: Bench) -> None:
        async with bench.peer() as first, bench.peer() as second:
            await bench.enable(first, 0.5)
            assert await second.read("Axis1.Torque") == 0.5
            assert await second.write({"Axis1.TargetTorque": 0.4}) == [0]
            assert await first.read("Axis1.TargetTorque") == 0.4
        async with bench.peer() as again:
            assert await again.read("Axis1.Torque", "Axis1.Controlword") == [0.4, 0x0F]
            assert bench.face.requests > 10 and bench.face.malformed == 0

    on_bench(test)


def test_what_is_on_another_wire_is_not_there() -> None:
    async def run() -> None:
        bench = Bench()
        face = OpcUaFace({3: Drive(2, bench.world, bench.recorder, 1.2, 3.0)}, None, (), None, lambda: 0.0)
        bench.port = await face.open("127.0.0.1", 0)
        try:
            async with bench.peer() as peer:
                [axis, *rest] = await peer.data(
                    "Axis3.DeviceId", "Axis1.DeviceId", "Amplifier.DeviceId", "Line.DeviceId"
                )
                assert axis.Value.Value == 0x5205
                assert {value.StatusCode.value for value in rest} == {S.BadNodeIdUnknown}
        finally:
            await face.close()

    asyncio.run(run())


def test_a_cell_without_a_channel_is_refused() -> None:
    bench = Bench()
    with pytest.raises(ValueError, match="7"):
        OpcUaFace({}, bench.amplifier, (1, 7), None, lambda: 0.0)
    with pytest.raises(ValueError, match="1"):
        OpcUaFace({}, None, (1,), None, lambda: 0.0)


def test_a_port_that_is_taken_is_an_os_error() -> None:
    async def test(bench: Bench) -> None:
        other = OpcUaFace({}, None, (), None, lambda: 0.0)
        with pytest.raises(OSError):
            await other.open("127.0.0.1", bench.port)
        await other.close()

    on_bench(test)


def test_close_leaves_nothing_behind_and_may_come_twice() -> None:
    async def run() -> None:
        bench = Bench()
        threads = threading.active_count()
        bench.port = await bench.face.open("127.0.0.1", 0)
        client = Client(bench.url, timeout=5)
        await client.connect()
        await (await client.create_subscription(100, object())).subscribe_data_change(
            client.get_node(ua.NodeId("Axis1.Torque", 2))
        )
        await bench.face.close()
        await bench.face.close()
        with pytest.raises((ConnectionError, ua.UaError, asyncio.TimeoutError)):
            await client.get_node(2258).read_value()
        await client.disconnect()
        assert threading.active_count() == threads
        with pytest.raises(OSError):
            await asyncio.open_connection("127.0.0.1", bench.port)
        # And the same face may open again.
        bench.port = await bench.face.open("127.0.0.1", 0)
        async with bench.peer() as peer:
            assert await peer.read("Axis1.DeviceId") == 0x5205
        await bench.face.close()

    asyncio.run(run())


def test_a_device_that_fails_is_not_hidden() -> None:
    async def test(bench: Bench) -> None:
        told: list[dict[str, Any]] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: told.append(context))

        def broken() -> float:
            raise ArithmeticError("the line is broken")

        async with bench.peer() as peer:
            bench.face.clock = broken
            with pytest.raises(ConnectionError):
                await peer.read("Axis1.Torque")
            bench.face.clock = lambda: bench.now_s
        assert [type(context["exception"]) for context in told] == [ArithmeticError]

    on_bench(test)

"""The simulated line as a process on real wires: the canopen library, bare frames and pymodbus as its peers."""

import asyncio
import gc
import json
import re
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import canopen
import pytest
from pymodbus.client import ModbusTcpClient

from sim_plant.faces.canopen import CanopenFace
from sim_plant.faces.canopen_bus import FaceUnavailable, open_bus
from sim_plant.faces.canopen_sdo import EDS_PATH
from sim_plant.faces.kernel_stamp import Stamp
from sim_plant.faults.control import SOCKET_FILE, ask
from sim_plant.plant import PlantRefused, load_plant, plant_of
from sim_plant.process import main, run_plant
from sim_plant.recorder import read_recording
from sim_plant.wired import WiredLine, WorldClock
from tests.support.patience import PATIENCE_S
from tests.support.ports import free_port

pytestmark = pytest.mark.wires

ROOT = Path(__file__).parents[2]
PLANT = ROOT / "sim_plant/plants/s_real.toml"
GROUP = "239.74.163.2"


class Line:
    """The process, and what it said when it was ready."""

    def __init__(self, folder: Path, *more: str, plant: Path = PLANT) -> None:
        self.folder = folder
        self.can_port = free_port()
        command = [sys.executable, "-m", "sim_plant.process", str(plant), "--record", str(folder)]
        command += ["--can-port", str(self.can_port), "--modbus-port", "0", *more]
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        told = self.process.stdout.readline()
        if not told:
            _, errors = self.process.communicate()
            raise AssertionError(f"the line was not ready: {errors}")
        self.ready: dict[str, Any] = json.loads(told)

    def end(self, number: int) -> tuple[int, str]:
        """Exit code and standard error after a signal."""
        self.process.send_signal(number)
        _, errors = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, errors


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    line = Line(tmp_path / "recording")
    yield line
    if line.process.poll() is None:
        line.process.kill()
        line.process.communicate()
    for pipe in (line.process.stdout, line.process.stderr):
        assert pipe is not None
        pipe.close()


@pytest.fixture
def master(line: Line) -> Iterator[canopen.Network]:
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.05
    network.connect(interface="udp_multicast", channel=GROUP, port=line.can_port, hop_limit=0, fd=False)
    yield network
    network.disconnect()


def until(condition: Callable[[], bool], timeout_s: float = 5.0) -> None:
    """Wait for something that another process or thread will do."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        select.select([], [], [], 0.005)


def test_ready_talks_and_ends_with_a_summary(line: Line, master: canopen.Network) -> None:
    assert line.ready["ready"] is True and line.ready["spans"] == 6
    assert line.ready["can_port"] == line.can_port
    node = master.add_node(2, str(EDS_PATH))
    assert node.nmt.wait_for_heartbeat(2) == "PRE-OPERATIONAL"
    assert node.sdo[0x1018][1].raw == 0x520
    assert node.sdo[0x1008].raw == "r2r-drive"
    with pytest.raises(canopen.SdoAbortedError) as refusal:
        node.sdo[0x1400][5].raw = 5
    assert refusal.value.code == 0x06090030
    node.sdo[0x1400][5].raw = 100
    assert node.sdo[0x1400][5].raw == 100

    # The drive is enabled, gives torque, and stops by itself when the commands do.
    sent: list[canopen.emcy.EmcyError] = []
    node.emcy.add_callback(sent.append)
    statuswords: list[int] = []
    master.subscribe(0x182, lambda _id, data, _time: statuswords.append(struct.unpack_from("<H", data)[0]))
    node.nmt.state = "OPERATIONAL"
    for controlword, torque in [(0x06, 0), (0x07, 0), (0x0F, 0), (0x0F, 10)]:
        seen = len(statuswords)
        master.send_message(0x202, struct.pack("<HhB", controlword, torque, 10))
        master.send_message(0x80, b"")
        until(lambda seen=seen: len(statuswords) > seen)
    assert statuswords[-1] & 0x6F == 0x27
    until(lambda: bool(sent))
    assert (sent[0].code, sent[0].register) == (0x8250, 0x11)

    with ModbusTcpClient("127.0.0.1", port=line.ready["modbus_port"]) as client:
        assert client.read_input_registers(0, count=2, device_id=1).registers == [0x5201, 6]
        assert client.read_holding_registers(0, count=1, device_id=2).registers == [0x5202]

    code, errors = line.end(signal.SIGTERM)
    assert code == 0, errors
    summary = json.loads((line.folder / "summary.json").read_text())
    assert summary["unsafe_total"] == 0 and summary["faces"]["modbus"]["requests"] == 2
    recording = read_recording(line.folder)
    assert recording.events[-1]["kind"] == "end"
    assert recording.events[-1]["counts"] == summary["counts"]
    torque = [event["torque_nm"] for event in recording.of_kind("torque")]
    assert torque[-2] > 0.0 and torque[-1] == 0.0
    [command] = [event for event in recording.of_kind("command") if event["target_torque_nm"] > 0.0]
    [trip] = recording.of_kind("watchdog")
    assert trip["time_s"] - command["time_s"] == pytest.approx(0.1, abs=0.002)


# Every role on every wire


def plant_with(tmp_path: Path, roles: str, more: str = "") -> Path:
    """The plant S_real with these words at the top of its wires."""
    path = tmp_path / "plant.toml"
    text = re.sub(r"(?m)^(drives|load_cells|plc) = .*\n", "", PLANT.read_text())
    text = re.sub(r"(?m)^\[wires\].*\n", "", text)
    path.write_text(text.replace("[wires.canopen]\n", f"[wires]\n{roles}\n[wires.canopen]\n{more}"))
    return path


@pytest.fixture
def any_line(tmp_path: Path) -> Iterator[Callable[..., Line]]:
    lines: list[Line] = []

    def start(roles: str, more: str = "") -> Line:
        lines.append(Line(tmp_path / "recording", "--opcua-port", "0", plant=plant_with(tmp_path, roles, more)))
        return lines[-1]

    yield start
    for line in lines:
        if line.process.poll() is None:
            line.process.kill()
            line.process.communicate()
        for pipe in (line.process.stdout, line.process.stderr):
            assert pipe is not None
            pipe.close()


def faces(line: Line) -> dict[str, Any]:
    """What the summary says of the faces."""
    code, errors = line.end(signal.SIGTERM)
    assert code == 0, errors
    return json.loads((line.folder / "summary.json").read_text())["faces"]


def test_everything_on_one_can_bus_with_wire_time(any_line: Callable[..., Line]) -> None:
    line = any_line('drives = "canopen"\nload_cells = "canopen"\nplc = "canopen"', "wire_time = true\n")
    assert (line.ready["can_port"], line.ready["modbus_port"]) == (line.can_port, None)
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.05
    network.connect(interface="udp_multicast", channel=GROUP, port=line.can_port, hop_limit=0, fd=False)
    try:
        seen: list[int] = []
        nodes = [*range(1, 7), 101, 120]
        for can_id in [0x180 + node for node in nodes] + [0x281 + 100, 0x381 + 100]:
            network.subscribe(can_id, lambda can_id, _data, _time: seen.append(can_id))
        network.send_message(0, b"\1\0")
        network.send_message(0x80, b"")
        until(lambda: len(seen) == 10)
    finally:
        network.disconnect()
    assert seen == sorted(seen)
    counts = faces(line)
    assert counts.keys() == {"canopen"} and counts["canopen"]["wire_busy_s"] > 0.0


def test_everything_in_one_rack(any_line: Callable[..., Line]) -> None:
    line = any_line('drives = "rack"\nload_cells = "rack"\nplc = "rack"')
    assert line.ready["can_port"] is None and line.ready["opcua_port"] is None
    with ModbusTcpClient("127.0.0.1", port=line.ready["modbus_port"]) as client:
        assert client.read_holding_registers(0, count=2, device_id=3).registers == [0x5204, 6]
        for unit in (1, 2, 11):
            assert client.read_holding_registers(0, count=1, device_id=unit).exception_code == 11
    assert faces(line).keys() == {"modbus"}


def test_roles_may_be_divided_between_wires(any_line: Callable[..., Line]) -> None:
    drives = [*["modbus-tcp"] * 5, "canopen"]
    line = any_line(f'drives = {drives}\nload_cells = "modbus-tcp"\nplc = "rack"')
    with ModbusTcpClient("127.0.0.1", port=line.ready["modbus_port"]) as client:
        for unit, device in ((1, 0x5201), (3, 0x5204), (11, 0x5203), (15, 0x5203)):
            assert client.read_holding_registers(0, count=1, device_id=unit).registers == [device]
        assert client.read_holding_registers(0, count=1, device_id=16).exception_code == 11
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.05
    network.connect(interface="udp_multicast", channel=GROUP, port=line.can_port, hop_limit=0, fd=False)
    try:
        assert network.add_node(6, str(EDS_PATH)).nmt.wait_for_heartbeat(2) == "PRE-OPERATIONAL"
    finally:
        network.disconnect()
    assert faces(line).keys() == {"canopen", "modbus"}


def test_opc_ua_is_opened_when_it_is_used(any_line: Callable[..., Line]) -> None:
    line = any_line('drives = "opcua"\nload_cells = "opcua"\nplc = "opcua"')
    assert line.ready["can_port"] is None and line.ready["modbus_port"] is None
    with socket.create_connection(("127.0.0.1", line.ready["opcua_port"]), timeout=PATIENCE_S):
        pass
    counts = faces(line)
    assert counts.keys() == {"opcua"} and counts["opcua"].keys() == {"requests", "malformed"}


@pytest.mark.parametrize(
    ("wires", "reason"),
    [
        ({"drives": ["canopen"] * 5}, "wires.drives: has 5 entries; give one word, or a list of 6 (spans = 6)"),
        ({"drives": "profibus"}, "wires.drives: is 'profibus', should be 'canopen', 'modbus-tcp', 'opcua' or 'rack'"),
        ({"plc": "canopen", "canopen": {"plc_node": 6}}, "so the line PLC has node 6, as the drive of roller 6 has"),
        (
            {"load_cells": "canopen", "canopen": {"amplifier_node": 3}},
            "so load-cell amplifier 1 has node 3, as the drive of roller 3 has (first_node = 1)",
        ),
        ({"modbus": {"plc_unit": 1}}, "wires.modbus.plc_unit: is 1, and so the line PLC has unit 1, as the load-cell"),
        (
            {"drives": "rack", "modbus": {"rack_unit": 2}},
            "wires.modbus.rack_unit: is 2, and so the rack has unit 2, as the line PLC has (plc_unit = 2)",
        ),
        (
            {"drives": "modbus-tcp", "modbus": {"first_drive_unit": 243}},
            "wires.modbus.first_drive_unit: is 243, at most 242 for 6 units (1 to 247)",
        ),
        ({"plc": "opcua", "opcua": {"port": 5020}}, "wires.opcua.port: is 5020, as wires.modbus.port"),
        ({"canopen": {"wire_tme": True}}, "wires.canopen.wire_tme: unknown key; did you mean wire_time?"),
    ],
)
def test_wires_that_cannot_be_are_refused_by_name(wires: dict[str, Any], reason: str) -> None:
    document = tomllib.loads(PLANT.read_text()) | {"wires": wires}
    with pytest.raises(PlantRefused) as refused:
        plant_of(document)
    assert len(refused.value.reasons) == 1
    assert reason in refused.value.reasons[0]


def test_a_rack_has_room_for_fourteen_spans() -> None:
    document = tomllib.loads(PLANT.read_text()) | {"wires": {"drives": "rack"}}
    assert plant_of(document | {"spans": 14}).wires.on("rack", 14).rollers == tuple(range(1, 15))
    with pytest.raises(
        PlantRefused, match=r"wires\.drives: is 'rack', which carries at most 14 spans; the plant has 15"
    ):
        plant_of(document | {"spans": 15})


def test_addresses_of_devices_that_are_elsewhere_do_not_clash() -> None:
    document = tomllib.loads(PLANT.read_text())
    wires = {"canopen": {"plc_node": 1, "amplifier_node": 1}, "modbus": {"rack_unit": 1, "first_drive_unit": 1}}
    assert plant_of(document | {"wires": wires}).wires.canopen.plc_node == 1


def test_a_killed_process_leaves_a_recording(line: Line, master: canopen.Network) -> None:
    master.send_message(0, bytes((1, 1)))
    master.send_message(0x201, struct.pack("<HhB", 0x06, 0, 10))
    master.send_message(0x80, b"")
    events = line.folder / "events.jsonl"
    until(lambda: "READY_TO_SWITCH_ON" in events.read_text())
    until(lambda: len(read_recording(line.folder).time_s) > 200)
    line.end(signal.SIGKILL)
    recording = read_recording(line.folder)
    assert len(recording.time_s) > 200
    assert [event["state"] for event in recording.of_kind("drive_state")] == ["READY_TO_SWITCH_ON"]
    assert not recording.of_kind("end") and not (line.folder / "summary.json").exists()


def test_faults_can_be_asked_for_without_planning_them(line: Line) -> None:
    control = Path(line.ready["control"])
    assert control.name == SOCKET_FILE
    answer = ask(control, {"do": "inject", "fault": "plc permissive-lost"})
    assert answer["ok"], answer


def test_a_fault_from_the_start_waits_for_its_device(tmp_path: Path) -> None:
    line = Line(tmp_path / "recording", "--fault", "drive 2 restart", "--fault", "drive 3 restart at 0")
    assert line.end(signal.SIGTERM)[0] == 0
    injected = read_recording(tmp_path / "recording").of_kind("fault-injected")
    assert [event["fault"] for event in injected] == ["drive 2 restart", "drive 3 restart"]


def test_ends_on_an_interrupt_too(line: Line) -> None:
    code, errors = line.end(signal.SIGINT)
    assert code == 0 and "Traceback" not in errors


def test_a_scaled_line_runs_faster(tmp_path: Path) -> None:
    line = Line(tmp_path / "recording", "--scale", "10")
    until(lambda: len(read_recording(line.folder).time_s) > 10_000, timeout_s=30.0)
    assert time.monotonic() - line.ready["monotonic_start_s"] < 10.0  # in which it has lived for 10 s at the least
    assert line.end(signal.SIGTERM)[0] == 0
    assert read_recording(line.folder).events[0]["time_scale"] == 10.0


# A line that fails


def failing_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception) -> int:
    """The exit code of a line that meets `error` once it has been ready."""

    async def run(_: WiredLine, __: asyncio.Event) -> None:
        raise error

    monkeypatch.setattr(WiredLine, "run", run)
    ready: list[WiredLine] = []
    code = run_plant(
        PLANT, record_folder=tmp_path / "recording", can_port=free_port(), modbus_port=0, on_ready=ready.append
    )
    assert len(ready) == 1
    return code


@pytest.fixture
def unfrozen() -> Iterator[None]:
    """A line freezes what lives when it is ready; a test process goes on living."""
    yield
    gc.unfreeze()


@pytest.mark.usefixtures("unfrozen")
def test_a_line_that_the_system_fails_in_mid_run_was_not_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert failing_line(tmp_path, monkeypatch, OSError(28, "No space left on device")) == 1
    assert "failed while it ran: No space left on device" in capsys.readouterr().err
    assert (tmp_path / "recording" / "summary.json").exists()


@pytest.mark.usefixtures("unfrozen")
def test_a_mistake_in_the_program_is_no_refusal_either(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="our own"):
        failing_line(tmp_path, monkeypatch, ValueError("our own"))


class Refused:
    """Calls the command in this process, where it must refuse, and returns what it said."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self.capsys = capsys

    def __call__(self, *arguments: str) -> str:
        assert main(list(arguments)) == 2
        said = self.capsys.readouterr()
        assert said.out == ""
        return said.err


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    return Refused(capsys)


def test_says_what_to_do_when_something_is_taken(line: Line, refused: Refused, tmp_path: Path) -> None:
    other = str(tmp_path / "other")
    can_port, modbus_port = str(line.can_port), str(line.ready["modbus_port"])
    said = refused(str(PLANT), "--record", other, "--can-port", can_port, "--modbus-port", "0")
    assert can_port in said and "choose another port" in said
    # The folder of the attempt that failed is free for the next.
    said = refused(str(PLANT), "--record", other, "--can-port", str(free_port()), "--modbus-port", modbus_port)
    assert modbus_port in said and "0 takes a free one" in said
    assert not (tmp_path / "other").exists()
    (tmp_path / "other").mkdir()
    refused(str(PLANT), "--record", other, "--can-port", str(free_port()), "--modbus-port", modbus_port)
    assert not list((tmp_path / "other").iterdir()), "a folder that was there before stays"
    said = refused(str(PLANT), "--record", str(line.folder))
    assert "already holds a recording" in said


def test_says_what_is_wrong_with_its_arguments(refused: Refused, tmp_path: Path) -> None:
    record = str(tmp_path / "recording")
    assert "nowhere.toml" in refused("nowhere.toml", "--record", record)
    assert "scale" in refused(str(PLANT), "--record", record, "--scale", "nan")
    bad = tmp_path / "bad.toml"
    bad.write_text(PLANT.read_text().replace("spans = 6", "spans = 600"))
    assert "spans" in refused(str(bad), "--record", record)
    assert not (tmp_path / "recording").exists()


@pytest.mark.parametrize(
    ("option", "port", "allowed"),
    [
        ("--can-port", "-1", "1 to 65535"),
        ("--can-port", "0", "1 to 65535"),
        ("--can-port", "99999", "1 to 65535"),
        ("--modbus-port", "-1", "0 to 65535"),
        ("--modbus-port", "99999", "0 to 65535"),
        ("--opcua-port", "65536", "0 to 65535"),
    ],
)
def test_a_port_that_cannot_be_is_refused(option: str, port: str, allowed: str, refused: Refused, tmp_path: Path):
    said = refused(str(PLANT), "--record", str(tmp_path / "recording"), option, port)
    assert option in said and port in said and allowed in said
    assert not (tmp_path / "recording").exists()


def test_whatever_fails_at_the_opening_leaves_no_recording(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from sim_plant import wired

    async def run() -> None:
        settings = wired.Settings(tmp_path / "recording", can_port=free_port(), modbus_port=0)
        line = wired.WiredLine(load_plant(PLANT), settings)
        monkeypatch.setattr(wired, "open_bus", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            await line.open()

    asyncio.run(run())
    assert not (tmp_path / "recording").exists()


def test_two_lines_may_have_one_port_in_two_groups() -> None:
    port = free_port()
    first = open_bus("udp_multicast", GROUP, port)
    second = open_bus("udp_multicast", "239.74.163.3", port)
    with pytest.raises(FaceUnavailable, match="taken"):
        open_bus("udp_multicast", GROUP, port)
    first.close()
    second.close()


def test_a_configuration_file_of_the_user_does_not_choose_the_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    """python-can would add what its files and CAN_CONFIG say."""
    monkeypatch.setenv("CAN_CONFIG", '{"receive_own_messages": true}')
    bus = open_bus("virtual", f"config-{free_port()}", 0)
    bus.bus.send(can.Message(arbitration_id=0x123, is_extended_id=False))
    assert bus.bus.recv(0) is None
    bus.close()


def test_without_a_multicast_route_it_says_how_to_add_one(monkeypatch: pytest.MonkeyPatch) -> None:
    from sim_plant.faces import canopen_bus

    def no_route(*_: object, **__: object) -> None:
        try:
            raise OSError(19, "No such device")
        except OSError as error:
            raise can.CanInitializationError("could not create or configure socket") from error

    monkeypatch.setattr(canopen_bus, "MulticastBus", no_route)
    port = free_port()
    for _ in range(2):  # nothing is held after a failure
        with pytest.raises(canopen_bus.FaceUnavailable, match=re.escape("ip route add 239.0.0.0/8 dev lo")):
            open_bus("udp_multicast", GROUP, port)


def test_frames_of_a_bus_without_a_descriptor_come_through_a_thread() -> None:
    async def run() -> list[int]:
        channel = f"thread-{free_port()}"
        here, there = can.Bus(channel, "virtual"), can.Bus(channel, "virtual")
        face = CanopenFace(there, [], 1, lambda: 0.0)
        face.attach(asyncio.get_running_loop())
        here.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        async with asyncio.timeout(PATIENCE_S):
            while not face.foreign:  # noqa: ASYNC110
                await asyncio.sleep(0.001)
        face.detach()
        here.shutdown()
        there.shutdown()
        return [face.foreign]

    before = threading.active_count()
    assert asyncio.run(run()) == [1]
    assert threading.active_count() == before


def test_a_frame_acts_when_it_arrived_and_never_on_a_wall_clock_that_was_set() -> None:
    clock = WorldClock(2.0)
    clock.monotonic_start_s -= 1.0  # two seconds of the line ago
    at = time.time()
    for stamped in (can.Message(timestamp=at - 0.1), Stamp(at - 0.1)):
        assert clock.arrival_s(stamped) == pytest.approx(1.8, abs=0.05)
    for stamp in (at + 3600.0, at - 3600.0, float("nan")):
        assert clock.arrival_s(can.Message(timestamp=stamp)) == pytest.approx(2.0, abs=0.05)

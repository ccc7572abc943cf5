"""The simulated line as a process on real wires: the canopen library, bare frames and pymodbus as its peers."""

import asyncio
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
from sim_plant.plant import load_plant
from sim_plant.process import main
from sim_plant.recorder import read_recording
from sim_plant.wired import WorldClock

ROOT = Path(__file__).parents[2]
PLANT = ROOT / "sim_plant/plants/s_real.toml"
GROUP = "239.74.163.2"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Line:
    """The process, and what it said when it was ready."""

    def __init__(self, folder: Path, *more: str) -> None:
        self.folder = folder
        self.can_port = free_port()
        command = [sys.executable, "-m", "sim_plant.process", str(PLANT), "--record", str(folder)]
        command += ["--can-port", str(self.can_port), "--modbus-port", "0", *more]
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.ready: dict[str, Any] = json.loads(self.process.stdout.readline())

    def end(self, number: int) -> tuple[int, str]:
        """Exit code and standard error after a signal."""
        self.process.send_signal(number)
        _, errors = self.process.communicate(timeout=10)
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


def test_ends_on_an_interrupt_too(line: Line) -> None:
    code, errors = line.end(signal.SIGINT)
    assert code == 0 and "Traceback" not in errors


def test_a_scaled_line_runs_faster(tmp_path: Path) -> None:
    line = Line(tmp_path / "recording", "--scale", "10")
    begin = time.monotonic()
    until(lambda: len(read_recording(line.folder).time_s) > 5000)
    assert time.monotonic() - begin < 4.0
    assert line.end(signal.SIGTERM)[0] == 0
    assert read_recording(line.folder).events[0]["time_scale"] == 10.0


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

    monkeypatch.setattr(canopen_bus.can, "Bus", no_route)
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
        async with asyncio.timeout(5):
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
    assert clock.arrival_s(can.Message(timestamp=at - 0.1)) == pytest.approx(1.8, abs=0.05)
    for stamp in (at + 3600.0, at - 3600.0, float("nan")):
        assert clock.arrival_s(can.Message(timestamp=stamp)) == pytest.approx(2.0, abs=0.05)

"""`r2rgate scan` and `r2rgate doctor` against the simulated line, and `scan` as a person meets it."""

import asyncio
import json
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from gateway.cli import scan_commands
from gateway.cli.doctor_check import Check
from gateway.cli.doctor_commands import inspected
from gateway.cli.main import app
from gateway.core.line import Line
from gateway.core.line_template import line_template
from gateway.mailbox.listener import Listener
from gateway.mailbox.paths import LOOP_SOCKET
from sim_plant.plant import plant_of
from sim_plant.recorder import read_recording
from sim_plant.wired import Settings, WiredLine
from tests.protocol.driver_support import GROUP, Registers
from tests.support.patience import PATIENCE_S
from tests.support.ports import free_port

pytestmark = pytest.mark.wires

PLANT = Path("sim_plant/plants/s_real.toml")


@pytest.fixture(autouse=True)
def no_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever else runs on this computer is no loop of the test's."""
    monkeypatch.setattr(scan_commands, "running_lines", list)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["scan", *(str(argument) for argument in arguments)])


# the simulated line, with its devices on one wire after the other


def simulated(folder: Path, wire: str) -> WiredLine:
    document = tomllib.loads(PLANT.read_text())
    document["wires"] |= {"drives": wire, "load_cells": wire, "plc": wire}
    return WiredLine(plant_of(document), Settings(folder / "record", can_port=free_port(), modbus_port=0))


def template(sim: WiredLine, wire: str) -> Line:
    """The template's line, on the wire of the simulated one."""
    document: dict[str, Any] = tomllib.loads(line_template(6))
    if wire == "canopen":
        bus = {"interface": "udp_multicast", "channel": GROUP, "port": sim.can_port, "protocol": "canopen"}
        maps, places = ("cia402-torque", "r2r-cell-can", "line-plc-can"), (None, 101, 120)
    else:
        bus = {"host": "127.0.0.1", "port": sim.modbus_port, "protocol": "modbus-tcp"}
        maps, places = ("r2r-rack-drive", "r2r-rack-cells", "r2r-rack-plc"), (3, 3, 3)
    document["buses"] = [{"name": "all", **bus}]
    for k, drive in enumerate(document["drives"], 1):
        axis = {"address": k} if places[0] is None else {"address": places[0], "channel": k}
        drive |= {"bus": "all", "map": maps[0], **axis}
    for cell in document["load_cells"]:
        cell |= {"bus": "all", "map": maps[1], "address": places[1]}
    document["plc"] |= {"bus": "all", "map": maps[2], "address": places[2]}
    return Line.model_validate(document)


@pytest.mark.parametrize("wire", ["canopen", "rack"])
def test_every_role_of_the_simulated_line_is_fine(tmp_path: Path, wire: str) -> None:
    async def body() -> list[Check]:
        sim = simulated(tmp_path, wire)
        stop = asyncio.Event()
        await sim.open()
        living = asyncio.create_task(sim.run(stop))
        try:
            return await inspected(template(sim, wire), tmp_path / "run", lambda text: None)
        finally:
            stop.set()
            await living
            await sim.close()

    checks = asyncio.run(body())
    assert {check.verdict for check in checks} == {"OK"}, [check for check in checks if check.verdict != "OK"]
    groups = [check.group for check in checks if check.name in ("state", "value", "v0")]
    assert groups == ["drives"] * 6 + ["load cells"] * 6 + ["line PLC"]
    seen = {event["kind"] for event in read_recording(tmp_path / "record").events}
    assert not seen & {"command", "torque", "unsafe"}, "doctor has commanded something"


# the commands


@contextmanager
def registers() -> Iterator[Registers]:
    """A Modbus peer in a thread of its own."""
    started = threading.Event()
    ending: list[Callable[[], object]] = []
    peer = Registers()

    async def live() -> None:
        loop, end = asyncio.get_running_loop(), asyncio.Event()
        ending.append(lambda: loop.call_soon_threadsafe(end.set))
        async with peer:
            started.set()
            await end.wait()

    thread = threading.Thread(target=lambda: asyncio.run(live()))
    thread.start()
    try:
        assert started.wait(PATIENCE_S)
        yield peer
    finally:
        ending[0]()
        thread.join()


def test_scan_modbus_as_table_and_as_json() -> None:
    with registers() as peer:
        table = run("modbus", "127.0.0.1", "--port", peer.port, "--units", "1,2")
        document = run("modbus", "127.0.0.1", "--port", peer.port, "--units", "1-2", "--json")
        register = run("modbus", "127.0.0.1", "--port", peer.port, "--units", 2, "--register", 0)
        peer.tension(1, float("nan"))
        numbers = run("modbus", "127.0.0.1", "--port", peer.port, "--units", 1, "--register", 16, "--json")
        nothing = run("modbus", "127.0.0.1", "--port", peer.port, "--units", 2, "--register", 900, "--function", "3")
    assert table.exit_code == 0 and "loadcell-amp" in table.stdout and "line-plc" in table.stdout
    assert "\x1b" not in table.stdout and max(map(len, table.stdout.splitlines())) <= 80
    assert [unit["maps"] for unit in json.loads(document.stdout)["units"]] == [["loadcell-amp"], ["line-plc"]]
    assert register.exit_code == 0 and str(0x5202) in register.stdout
    rows = json.loads(numbers.stdout, parse_constant=pytest.fail)["rows"]
    assert {row["reading"]: row["from_zero"] for row in rows}["f32 high-first"] == "nan"
    assert nothing.exit_code == 1 and "exception 2" in nothing.stderr
    assert {pdu[0] for _, pdu in peer.requests} <= {3, 4}


def test_nothing_found_says_what_to_check() -> None:
    with registers() as peer:
        port = peer.port
    result = run("modbus", "127.0.0.1", "--port", port)
    assert result.exit_code == 1 and "firewall" in result.stderr
    result = run("opcua", f"opc.tcp://127.0.0.1:{port}")
    assert result.exit_code == 1 and "firewall" in result.stderr


def test_an_empty_can_bus_says_what_to_check(monkeypatch: pytest.MonkeyPatch) -> None:
    result = run("canopen", "--interface", "virtual", "--channel", "scan-empty", "--seconds", 0.1)
    assert result.exit_code == 1 and "in this process" in result.stderr and "terminated" not in result.stderr
    result = run("canopen", "--interface", "socketcan", "--channel", "nowhere9")
    assert result.exit_code == 1 and "nowhere9" in result.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("modbus", "h", "--units", "1-x"),
        ("modbus", "h", "--units", "9-3"),
        ("modbus", "h", "--units", "256"),
        ("modbus", "h", "--port", "0"),
        ("modbus", "h", "--register", "70000"),
        ("canopen", "--bitrate", "1"),
        ("canopen", "--port", "5"),
        ("canopen", "--interface", "udp_multicast"),
        ("modbus", "127.0.0.1:502"),
        ("modbus-tcp", "h", "--units", "9-3"),
        ("canopen", "--interface", "serial"),
        ("opcua", "127.0.0.1"),
        ("opcua", "opc.tcp://h:1", "--under", "nothing"),
    ],
)
def test_bad_arguments_are_refused(arguments: tuple[str, ...]) -> None:
    assert run(*arguments).exit_code == 2


@pytest.mark.parametrize(
    "arguments", [("canopen", "--interface", "virtual"), ("modbus", "127.0.0.1"), ("opcua", "opc.tcp://127.0.0.1:1")]
)
def test_beside_a_loop_nothing_is_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]
) -> None:
    folder = tmp_path / "line"
    monkeypatch.setattr(scan_commands, "running_lines", lambda: [folder])
    listener = Listener(folder / LOOP_SOCKET)
    try:
        result = run(*arguments)
    finally:
        listener.close()
    assert result.exit_code == 3 and "a loop runs" in result.stderr and "--other-bus" in result.stderr


def test_ctrl_c_ends_without_a_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    async def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("drivers.modbus.scan.scan", interrupted)
    result = run("modbus", "127.0.0.1")
    assert result.exit_code == 130 and result.stderr == "interrupted\n"

"""A line PLC with a warning output and a local signal, and one without: maps and what `check` says of them."""

from pathlib import Path
from typing import Any

import pytest

from drivers.canopen import map_plc as canopen
from drivers.canopen.plc import PlcNode
from drivers.device_map import MAPS, load_map
from drivers.modbus.maps import PlcMap as ModbusPlcMap
from drivers.modbus.plc import Plc as ModbusPlc
from drivers.opcua.maps import PlcMap as OpcUaPlcMap
from drivers.opcua.nodes import NodeTable
from drivers.opcua.plc import Plc as OpcUaPlc
from gateway.cli import plc_signals
from gateway.cli.plc_signals import missing_plc_signals
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.signals import Outputs

TEXT = line_template(1)
LINE = load_line(TEXT, "line.toml")
PLC_MAPS = ("line-plc", "line-plc-can", "r2r-opcua-plc", "r2r-rack-plc")


def without_signals(device: Any) -> Any:
    read, write = device.read.model_copy(update={"local": None}), device.write.model_copy(update={"warning": None})
    return device.model_copy(update={"read": read, "write": write})


def warning(on: bool) -> Outputs:
    outputs = Outputs(1)
    outputs.run, outputs.warning = True, on
    return outputs


@pytest.mark.parametrize("name", PLC_MAPS)
def test_every_map_that_comes_along_has_both_signals(name: str) -> None:
    device = load_map(MAPS / f"{name}.toml")
    assert device.role == "line-plc"
    assert device.write.warning is not None and device.read.local is not None


@pytest.mark.parametrize("name", ["line-plc", "r2r-rack-plc"])
def test_the_warning_is_a_bit_of_the_command_on_modbus_where_there_is_one(name: str) -> None:
    device = load_map(MAPS / f"{name}.toml")
    assert isinstance(device, ModbusPlcMap)
    for plc_map, bits in ((device, [0b01, 0b11]), (without_signals(device), [0b01, 0b01])):
        plc = ModbusPlc(plc_map, LINE.plc, 0.1)
        assert [plc.command(warning(on))[0] for on in (False, True)] == bits


def test_the_warning_is_a_bit_of_the_command_on_canopen_where_there_is_one() -> None:
    device = load_map(MAPS / "line-plc-can.toml")
    assert isinstance(device, canopen.PlcMap)
    for plc_map, bits in ((device, [0b01, 0b11]), (without_signals(device), [0b01, 0b01])):
        plc = PlcNode(plc_map, LINE.plc, 0.1)
        sent = [plc.command(warning(on), 0.0) for on in (False, True)]
        assert [frame[1][0] for frame in sent if frame is not None] == bits


def test_the_warning_is_a_node_on_opc_ua_where_there_is_one() -> None:
    device = load_map(MAPS / "r2r-opcua-plc.toml")
    assert isinstance(device, OpcUaPlcMap)
    counts: list[tuple[int, bool]] = []
    for plc_map in (device, without_signals(device)):
        table = NodeTable()
        plc = OpcUaPlc(plc_map, LINE.plc, 0.1, table)
        counts.append((len(plc.reads), any("Line.Warning" in str(node) for node in table.nodes)))
    assert counts == [(7, True), (6, False)]


def test_check_says_what_the_line_does_without_them(monkeypatch: pytest.MonkeyPatch) -> None:
    assert missing_plc_signals(TEXT, "line.toml", LINE) == []

    def old_map(path: Path) -> Any:
        return without_signals(load_map(path))

    monkeypatch.setattr(plc_signals, "load_map", old_map)
    said = missing_plc_signals(TEXT, "line.toml", LINE)
    assert [problem.key for problem in said] == ["plc.map", "plc.map"]
    assert "no warning output" in said[0].wrong and "waits 3 s" in said[0].wrong and "no local signal" in said[1].wrong
    assert TEXT.splitlines()[said[0].line - 1].startswith("map = ")

"""`init` and `check` as a person in a terminal meets them."""

import json
import re
from itertools import product
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner, Result

from gateway.cli.line_commands import check, init, known_maps
from gateway.core.line_template import line_template

app = typer.Typer()
app.command()(init)
app.command()(check)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "200"})


def test_what_init_writes_check_accepts(tmp_path: Path) -> None:
    path = tmp_path / "a line.toml"
    assert run("init", "--out", path).exit_code == 0
    result = run("check", path)
    assert result.exit_code == 0, result.output
    assert f"{path}: valid. demo/line-1: 6 spans; period 10 ms, latency 10 ms" in result.output
    assert "bus drives: canopen, udp_multicast 239.74.163.2:43113; 6 drives; load 15% of at most 80%" in result.output
    assert "bus io: modbus-tcp, 127.0.0.1:5020; 6 load cells, 1 PLC" in result.output
    assert "recipe tension: 0.01 m/s; needs 3.8 Nm of 60 Nm (margin 94%)" in result.output


def test_init_adapts_to_the_number_of_spans(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    assert run("init", "--spans", 60, "--out", path).exit_code == 0
    result = run("check", path)
    assert result.exit_code == 0, result.output
    assert "60 spans" in result.output
    assert run("init", "--spans", 61, "--out", tmp_path / "other.toml").exit_code == 2


def test_init_overwrites_only_when_forced(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_text("mine", encoding="utf-8")
    refused = run("init", "--out", path)
    assert refused.exit_code == 2
    assert "--force" in refused.output
    assert path.read_text(encoding="utf-8") == "mine"
    assert run("init", "--out", path, "--force").exit_code == 0
    assert path.read_text(encoding="utf-8") == line_template(6)


def test_init_says_why_it_cannot_write(tmp_path: Path) -> None:
    result = run("init", "--out", tmp_path / "nowhere" / "line.toml")
    assert result.exit_code == 2
    assert "cannot be written: No such file or directory" in result.output


def test_check_prints_every_error_sorted_and_exits_2(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    text = line_template().replace("tension_max_n", "tension_mx_n", 1).replace('bus = "io"', 'bus = "i"', 1)
    path.write_text(text, encoding="utf-8")
    result = run("check", path)
    assert result.exit_code == 2
    first, second, last = result.output.splitlines()
    assert first.startswith(f"{path}:24: limits.tension_mx_n = 60.0: there is no such key")
    assert first.endswith("did you mean tension_max_n?")
    assert second.endswith(
        'load_cells[1].bus = "i": there is no such bus; allowed: one of "drives", "io"; did you mean "io"?'
    )
    assert last == f"{path}: refused, 2 errors (drives[3] is the third [[drives]] table)"


def test_check_as_json(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_text(line_template().replace("channel = 3\n", "channel = 2\n"), encoding="utf-8")
    result = run("check", path, "--json")
    assert result.exit_code == 2
    refused = json.loads(result.output)
    assert (refused["valid"], refused["summary"]) == (False, None)
    (problem,) = refused["problems"]
    assert (problem["key"], problem["value"], problem["nearest"]) == ("load_cells[3].channel", "2", "3")
    path.write_text(line_template().replace("latency_s = 0.010", "latency_s = 0.05"), encoding="utf-8")
    accepted = run("check", path, "--json")
    assert accepted.exit_code == 0
    document = json.loads(accepted.output)
    assert document["valid"]
    assert [warning["key"] for warning in document["warnings"]] == ["control.latency_s"]
    assert document["summary"]["buses"][0]["load"] == pytest.approx(0.1534)
    assert document["summary"]["recipes"][0]["needed_nominal_nm"] == pytest.approx(3.814)


def test_warnings_are_printed_and_the_exit_code_stays_0(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_text(line_template().replace("latency_s = 0.010", "latency_s = 0.05"), encoding="utf-8")
    result = run("check", path)
    assert result.exit_code == 0
    assert f"warning: {path}:16: control.latency_s = 0.05: is 5 periods" in result.output
    assert "1 warning: legal, but look again." in result.output


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (None, ":1: cannot be read: No such file or directory (r2rgate init writes one)"),
        (b"format = 1\nsite = '\xff'\n", ":2: is not UTF-8 here"),
        (b"#" * 1_000_001, ":1: is larger than 1 MB"),
        (b"format = \n", ":1: column 10: not TOML (Invalid value)"),
    ],
)
def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path, data: bytes | None, said: str) -> None:
    path = tmp_path / "line.toml"
    if data is not None:
        path.write_bytes(data)
    result = run("check", path)
    assert result.exit_code == 2
    assert said in result.output


def test_a_folder_is_refused(tmp_path: Path) -> None:
    result = run("check", tmp_path)
    assert result.exit_code == 2
    assert "cannot be read: Is a directory" in result.output


@pytest.mark.parametrize("command", ["init", "check"])
def test_help_has_an_example(command: str) -> None:
    result = run(command, "--help")
    assert result.exit_code == 0
    assert f"Example: r2rgate {command}" in result.output


def test_every_shipped_map_has_a_role_that_the_line_knows() -> None:
    assert set(known_maps()) >= {"cia402-torque", "loadcell-amp", "line-plc"}
    protocols, roles = ("canopen", "modbus-tcp", "opcua"), ("drive", "load-cell", "line-plc")
    assert {(protocol, role) for protocol, role, _ in known_maps().values()} <= set(product(protocols, roles))


def test_check_warns_once_of_devices_whose_exchange_is_not_seen(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_text(line_template(), encoding="utf-8")
    assert "serial number" not in run("check", path).output
    assert json.loads(run("check", path, "--json").output)["serial_unnamed"] == []
    text = re.sub(r"address = 1\b(.*)\nchannel = (\d+)", r"address = 3\2\1", line_template())
    path.write_text(text.replace('"loadcell-amp"', '"hbm-wtx"'), encoding="utf-8")
    said = run("check", path).output
    (told,) = [row for row in said.splitlines() if "serial number" in row]
    assert told.startswith("warning: the device maps of load-cell-1, load-cell-2, ") and "plc" not in told


def test_check_tells_which_device_maps_name_no_option_code(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_text(line_template(), encoding="utf-8")
    said = run("check", path).output
    assert "note: no option code says what a watchdog does in device map line-plc (" in said
    assert "cia402-torque" not in said
    document = json.loads(run("check", path, "--json").output)
    (plc,) = document["reaction_unnamed"]
    assert plc.startswith("line-plc (")

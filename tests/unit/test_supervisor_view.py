"""`r2rgate status` as a person and a shell see it."""

import asyncio
import csv
import io
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from gateway.cli import status_commands
from gateway.cli.status_commands import export_csv, status
from gateway.cli.status_view import render
from gateway.core.deployment import WiringStatus
from gateway.core.finding import finding
from gateway.core.status import BusStatus, ChangeStatus, GatewayStatus
from gateway.core.topics import GATEWAY_STATUS
from gateway.mailbox.unix import UnixMailbox
from tests.unit.supervisor_support import frame_of, short_folder
from tests.unit.test_historian import writer_of
from tests.unit.test_supervisor_status import Bench, example

pytestmark = pytest.mark.wires

app = typer.Typer()
app.command("status")(status)
app.command("export-csv")(export_csv)


def text_of(shown: GatewayStatus, width: int, height: int | None = None) -> list[str]:
    console = Console(width=width, file=io.StringIO(), highlight=False)
    console.print(render(shown, width, height))
    assert isinstance(console.file, io.StringIO)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


def running(spans: int = 6, **changes: Any) -> GatewayStatus:
    bench = Bench(spans)
    bench.run_loop(100, spans=spans, **changes)
    for k in range(20):
        bench.say("state", f"event {k} " + "and so on " * 20)
    return bench.gateway.status()


@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40)])
@pytest.mark.parametrize("spans", [1, 6, 7, 20, 60])
def test_it_fits_the_screen_and_shows_the_newest_events(width: int, height: int, spans: int) -> None:
    lines = text_of(running(spans), width, height)
    assert len(lines) <= height
    assert max(map(len, lines)) <= width
    assert sum("event 19" in line or "event 18" in line or "event 17" in line for line in lines) == 3
    shown = sum(line.split(maxsplit=2)[1].startswith("span-") for line in lines if len(line.split()) > 5)
    assert (shown == spans) != any(f"and {spans - shown} more spans" in line for line in lines)


@pytest.mark.parametrize(
    ("stage", "text", "said"),
    [
        ("probation", "not kept yet: it has been watched for 7 s of 30 s", "on probation since 7 s: not kept yet"),
        ("running", "", "running since 7 s"),
    ],
)
def test_what_is_being_done_to_the_line_is_shown_and_the_screen_still_fits(stage: str, text: str, said: str) -> None:
    kind = "gains" if stage == "probation" else "experiment"
    status = running(20)
    change = ChangeStatus(proposal="ab" * 32, kind=kind, stage=stage, since_wall_s=status.wall_s - 7.0, text=text)
    lines = text_of(status.model_copy(update={"change": change}), 80, 24)
    assert len(lines) <= 24 and max(map(len, lines)) <= 80
    assert [line for line in lines if f"{kind.capitalize()} abababababab {said}" in line]


@pytest.mark.parametrize(
    ("bus", "said"),
    [
        (BusStatus(open=True, text="", agents=["monitoring", "sysid"], refused=0), "agents     monitoring, sysid"),
        (
            BusStatus(open=False, text="the port is in use " * 9, agents=[], refused=0),
            "agents     their bus is closed:",
        ),
    ],
)
def test_agents_are_shown_or_that_their_bus_is_closed_and_the_screen_still_fits(bus: BusStatus, said: str) -> None:
    lines = text_of(running(20).model_copy(update={"agents_bus": bus}), 80, 24)
    assert len(lines) <= 24 and max(map(len, lines)) <= 80
    assert [line for line in lines if line.startswith(said)]
    nobody = BusStatus(open=True, text="", agents=[], refused=0)
    assert not [
        line for line in text_of(running(20).model_copy(update={"agents_bus": nobody}), 80, 24) if "agents" in line
    ]


def test_the_audits_head_is_one_row_that_says_where_the_whole_of_it_is_and_the_screen_still_fits() -> None:
    known = running(20).model_copy(update={"audit_head": f"301:{'39' * 32}"})
    lines = text_of(known, 80, 24)
    assert len(lines) <= 24 and max(map(len, lines)) <= 80
    assert [line.split() for line in lines if line.startswith("audit")] == [
        ["audit", "head", "301:393939393939...", "(--json", "has", "it", "whole)"]
    ]
    assert not [line for line in text_of(running(20), 80, 24) if line.startswith("audit")]


def test_the_reason_of_the_newest_state_is_told_to_its_end() -> None:
    bench = Bench(6)
    bench.run_loop(100, spans=6)
    bench.say("state", "STOP: " + "the reason goes on " * 10 + "to its end")
    bench.say("note", "and something else " * 20)
    lines = text_of(bench.gateway.status(), 80)
    assert any(line.endswith("to its end") for line in lines) and max(map(len, lines)) <= 80
    assert sum("something else" in line for line in lines) == 1


def test_the_span_that_needs_a_look_is_shown_among_many() -> None:
    drive_state = np.full(60, 3, np.int8)
    drive_state[57] = 5
    tension_n = np.linspace(20.0, 40.0, 60)
    tension_n[44] += 15.0
    quality = np.zeros(60, np.int8)
    quality[50] = 2
    lines = text_of(running(60, drive_state=drive_state, tension_n=tension_n, tension_quality=quality), 80, 24)
    assert any("58 span-58" in line and "FAULT" in line for line in lines)
    assert any("45 span-45" in line and "+15.00" in line for line in lines)
    assert any("51 span-51" in line and "BAD" in line for line in lines)


def test_the_bar_shows_set_point_and_tension_where_they_lie_in_the_band() -> None:
    limits = running().limits
    middle = (limits.tension_min_n + limits.tension_max_n) / 2
    tension_n = np.array([middle, limits.tension_min_n, limits.tension_max_n, 0.5, 99.0, np.nan])
    lines = text_of(running(tension_n=tension_n, tension_setpoint_n=np.full(6, middle)), 120)
    bars = [next(word for word in line.split() if "\u2500" in word) for line in lines if "span-" in line]
    assert {len(bar) for bar in bars} == {40}
    assert bars[0].index("\u25cf") == 20
    assert (bars[1].index("\u25cf"), bars[1].index("\u2502")) == (0, 20)
    assert bars[2].index("\u25cf") == 39
    assert (bars[3][0], bars[4][-1]) == ("<", ">")
    assert "\u25cf" not in bars[5]


def test_it_says_the_state_in_words_and_what_to_do_next() -> None:
    lines = text_of(running(held=2, saturated=True), 120)
    assert "RUN  tension and speed are controlled" in lines[0]
    assert "signal missing for 2 periods" in lines[0]
    assert "torque at its limit" in lines[0]
    assert "r2rgate hold" in lines[1]
    lines = text_of(Bench().gateway.status(), 80)
    assert "loop not running" in lines[0]
    assert "r2rgate loop" in lines[1]
    assert any("no frame yet" in line for line in lines)
    assert any("no events yet" in line for line in lines)


@contextmanager
def served(bench: Bench, folder: Path) -> Iterator[None]:
    """The status of `bench` on a socket, from a thread of its own."""
    ready, end = threading.Event(), threading.Event()

    async def serve() -> None:
        mailbox = UnixMailbox()

        async def answer(_: bytes) -> bytes:
            return bench.gateway.status().model_dump_json().encode()

        mailbox.serve(GATEWAY_STATUS, answer)
        await mailbox.listen(folder / "gateway.sock")
        ready.set()
        await asyncio.to_thread(end.wait)
        await mailbox.close()

    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    try:
        assert ready.wait(10.0)
        yield
    finally:
        end.set()
        thread.join()


def test_exit_codes_tell_running_no_gateway_and_no_loop() -> None:
    with short_folder() as folder:
        result = CliRunner().invoke(app, ["status", "--run-dir", str(folder)])
        assert result.exit_code == 3
        assert "start it with `r2rgate gateway" in result.stderr
        bench = Bench()
        with served(bench, folder):
            assert CliRunner().invoke(app, ["status", "--run-dir", str(folder)]).exit_code == 4
            bench.run_loop(10)
            result = CliRunner().invoke(app, ["status", "--run-dir", str(folder)])
            assert result.exit_code == 0
            assert "tension and speed are controlled" in result.stdout
            result = CliRunner().invoke(app, ["status", "--json", "--run-dir", str(folder)])
            assert json.loads(result.stdout)["loop"]["state"] == "RUN"


def test_a_run_folder_with_too_long_a_path_is_refused_in_words() -> None:
    result = CliRunner().invoke(app, ["status", "--run-dir", "/tmp/" + "x" * 120])
    assert result.exit_code == 3
    assert "shorter run folder" in result.stderr


def test_without_a_run_folder_the_only_line_is_taken_and_several_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    with short_folder() as folder:
        monkeypatch.setattr(status_commands, "running_lines", list)
        result = CliRunner().invoke(app, ["status"])
        assert (result.exit_code, "r2rgate run" in result.stderr) == (3, True)
        monkeypatch.setattr(status_commands, "running_lines", lambda: [folder / "a", folder / "b"])
        result = CliRunner().invoke(app, ["status"])
        assert result.exit_code == 2
        assert f"--run-dir {folder / 'a'}\n" in result.stderr
        monkeypatch.setattr(status_commands, "running_lines", lambda: [folder])
        with served(Bench(), folder):
            assert CliRunner().invoke(app, ["status"]).exit_code == 4


def test_a_gateway_of_another_version_is_told_as_such() -> None:
    with pytest.raises(status_commands.Unreachable, match="another version"):
        status_commands.parse_status(b"{}")


def test_history_becomes_csv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = writer_of(tmp_path / "h")
    writer.store([frame_of(k, float(k)) for k in range(5)], [], 1000.0)
    writer.disconnect()
    monkeypatch.setattr(status_commands.time, "time", lambda: 1004.5)
    arguments = ["export-csv", str(tmp_path / "out.csv"), "--history", str(tmp_path / "h"), "--last", "2"]
    result = CliRunner().invoke(app, [*arguments, "--fields", "sequence, tension_n"])
    assert result.exit_code == 0, result.output
    with (tmp_path / "out.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["wall_s", "sequence", *(f"tension_n_{k}" for k in range(1, 7))]
    assert [row[:2] for row in rows[1:]] == [["1003.0", "3"], ["1004.0", "4"]]
    assert all(len(row) == 8 for row in rows)
    result = CliRunner().invoke(app, [*arguments, "--fields", "tensions"])
    assert result.exit_code == 2
    assert "nearest is" in result.stderr


def test_alarms_stand_in_one_line_and_the_screen_still_fits() -> None:
    shown = example().alarms[0]
    alarms = [shown.model_copy(update={"acknowledged": False}), shown, shown]
    alarms.append(shown.model_copy(update={"shelved_until_wall_s": 1.0}))
    lines = text_of(running(20).model_copy(update={"alarms": alarms}), 120, 24)
    assert len(lines) <= 24 and max(map(len, lines)) <= 120
    (line,) = [line for line in lines if line.startswith("Alarms: ")]
    assert line.startswith("Alarms: a load cell cannot be trusted (!); a load cell cannot be trusted; ")
    assert "Alarms" not in "".join(text_of(running(20), 120, 24))


@pytest.mark.parametrize(
    ("wiring", "said"),
    [
        (WiringStatus(unproved=[finding("wiring-unproved")]), "Not proved: "),
        (WiringStatus(not_read=True), "Proved; arming reads whether the devices are still the same"),
        (WiringStatus(proved_wall_s=1.0), ""),
    ],
)
def test_whether_the_wiring_is_proved_is_said_and_the_screen_still_fits(wiring: WiringStatus, said: str) -> None:
    shown = running().model_copy(update={"wiring": wiring})
    lines = text_of(shown, 80, 24)
    assert len(lines) <= 24
    told = [line for line in lines if "roved" in line]
    assert [line[: len(said)] for line in told] == ([said] if said else [])

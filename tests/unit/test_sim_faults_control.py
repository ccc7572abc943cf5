"""Faults of a line that runs: the control socket, and the commands that talk to it."""

import asyncio
import json
import socket
import stat
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from gateway.cli.fault_commands import REFUSED, UNREACHABLE
from gateway.cli.main import app
from sim_plant.faults.control import LONGEST_LINE, MAX_CONNECTIONS, SOCKET_FILE, ControlServer, ControlUnavailable, ask
from sim_plant.faults.stepped import injector_of
from sim_plant.faults.table import FAULTS
from sim_plant.plant import load_plant
from sim_plant.stepped import SteppedLine

PLANT = load_plant("sim_plant/plants/s_real.toml")


def server_of(line: SteppedLine) -> ControlServer:
    return ControlServer(injector_of(line), lambda: line.world.now_s)


@pytest.fixture
def line() -> SteppedLine:
    line = SteppedLine(PLANT, 1, 0.0)
    line.sample(12.5)
    return line


@pytest.fixture
def server(line) -> ControlServer:
    return server_of(line)


def answer(server: ControlServer, **request: object) -> dict[str, object]:
    return server.answer(json.dumps(request).encode())


def test_injected_listed_and_cleared(server, line):
    assert answer(server, do="inject", fault="load-cell 3 nan for 0.2") == {"ok": True, "number": 1, "time_s": 12.5}
    assert answer(server, do="inject", fault="plc permissive-lost at 20") == {"ok": True, "number": 2, "time_s": 12.5}
    assert answer(server, do="list")["faults"] == [
        {"number": 1, "fault": "load-cell 3 nan for 0.2", "acts": True, "begin_s": 12.5, "end_s": 12.7},
        {"number": 2, "fault": "plc permissive-lost at 20", "acts": False, "begin_s": 20.0, "end_s": None},
    ]
    assert answer(server, do="clear", number=1) == {"ok": True, "numbers": [1], "time_s": 12.5}
    assert answer(server, do="clear") == {"ok": True, "numbers": [2], "time_s": 12.5}
    assert answer(server, do="list")["faults"] == []
    kinds = [event["kind"] for event in line.recorder.events if event["kind"].startswith("fault")]
    assert kinds == ["fault-injected", "fault-cleared"]


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        (b"", "no JSON"),
        (b"\xff\xfe", "no JSON"),
        (b"[" * 4000, "no JSON"),
        (b"[]", "a request is a JSON object"),
        (b"{}", "allowed"),
        (b'{"do": "inject"}', "allowed"),
        (b'{"do": "inject", "fault": 3}', "allowed"),
        (b'{"do": "inject", "fault": "plc mute", "at": 3}', "allowed"),
        (b'{"do": "clear", "number": "1"}', "allowed"),
        (b'{"do": "clear", "number": true}', "allowed"),
        (b'{"do": "clear", "number": 1.0}', "allowed"),
        (b'{"do": "clear", "number": 7}', "there is no fault 7"),
        (b'{"do": "list", "x": 1}', "allowed"),
        (b'{"do": "inject", "fault": "load-cell 3 nam"}', "Did you mean nan?"),
        (b'{"do": "inject", "fault": "load-cell 9 nan"}', "allowed: 1 to 6"),
    ],
)
def test_what_is_refused_is_said_and_changes_nothing(server, line, request_, said):
    events = len(line.recorder.events)
    got = server.answer(request_)
    assert got["ok"] is False and said in got["reason"]
    assert len(line.recorder.events) == events and answer(server, do="list")["faults"] == []


@given(st.binary(max_size=60))
def test_every_line_has_an_answer(data):
    got = _QUIET.answer(data)
    assert got["ok"] in (True, False) and json.dumps(got)


_QUIET = server_of(SteppedLine(PLANT, 1, 0.0))


def serving(path: Path, test: Callable[[], Awaitable[None]], server: ControlServer) -> None:
    async def whole() -> None:
        await server.open(path)
        try:
            await test()
        finally:
            await server.close()

    asyncio.run(whole())


def test_the_socket_is_the_users_alone_answers_and_is_taken_away(tmp_path, server):
    path = tmp_path / SOCKET_FILE

    async def test() -> None:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        got = await asyncio.to_thread(ask, path, {"do": "inject", "fault": "drive 1 sto for 0.1"})
        assert got == {"ok": True, "number": 1, "time_s": 12.5}
        got = await asyncio.to_thread(ask, path, {"do": "list"})
        assert [fault["fault"] for fault in got["faults"]] == ["drive 1 sto for 0.1"]

    serving(path, test, server)
    assert not path.exists()
    with pytest.raises(ControlUnavailable, match="Is it running"):
        ask(path, {"do": "list"})


def test_one_client_asks_several_times_and_too_long_a_line_ends_only_its_connection(tmp_path, server):
    path = tmp_path / SOCKET_FILE

    async def test() -> None:
        reader, writer = await asyncio.open_unix_connection(path)
        for _ in range(3):
            writer.write(b'{"do": "list"}\n')
            assert json.loads(await reader.readline())["ok"]
        writer.write(b"x" * (LONGEST_LINE + 1000))
        assert await reader.read() == b""
        writer.close()
        assert (await asyncio.to_thread(ask, path, {"do": "list"}))["ok"]

    serving(path, test, server)


def test_there_is_a_bound_to_connections(tmp_path, server):
    path = tmp_path / SOCKET_FILE

    async def test() -> None:
        open_ = [await asyncio.open_unix_connection(path) for _ in range(MAX_CONNECTIONS)]
        for reader, writer in open_:
            writer.write(b'{"do": "list"}\n')
            assert await reader.readline()
        reader, writer = await asyncio.open_unix_connection(path)
        assert await reader.read() == b""
        for _, each in [*open_, (reader, writer)]:
            each.close()

    serving(path, test, server)


def test_a_socket_that_nobody_listens_on_is_replaced(tmp_path, server):
    path = tmp_path / SOCKET_FILE
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))

    async def test() -> None:
        assert (await asyncio.to_thread(ask, path, {"do": "list"}))["ok"]

    serving(path, test, server)


def test_what_is_in_the_way_stays(tmp_path, server, line):
    path = tmp_path / SOCKET_FILE
    path.write_text("mine")
    with pytest.raises(ControlUnavailable, match="is no socket"):
        asyncio.run(server.open(path))
    assert path.read_text() == "mine"
    path.unlink()

    async def second() -> None:
        with pytest.raises(ControlUnavailable, match="runs already"):
            await server_of(line).open(path)
        assert (await asyncio.to_thread(ask, path, {"do": "list"}))["ok"]

    serving(path, second, server)


def test_a_path_that_cannot_be_is_refused(tmp_path, server):
    with pytest.raises(ControlUnavailable, match="allowed are 107"):
        asyncio.run(server.open(tmp_path / ("x" * 120)))
    with pytest.raises(ControlUnavailable, match="No such file"):
        asyncio.run(server.open(tmp_path / "no" / "folder.sock"))


@pytest.mark.parametrize("said", [b"", b"hello\n", b"[]\n", b'{"ok": 1}\n'])
def test_something_else_that_answers_is_told_apart(tmp_path, said):
    path = tmp_path / SOCKET_FILE

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.write(said)
        writer.close()

    async def whole() -> None:
        async with await asyncio.start_unix_server(serve, path):
            with pytest.raises(ControlUnavailable, match="is no simulated line"):
                await asyncio.to_thread(ask, path, {"do": "list"})

    asyncio.run(whole())


# The commands.


def command(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["fault", *(str(argument) for argument in arguments)])


def test_every_fault_is_listed():
    text = command("list").output
    assert all(fault.name in text and fault.example in text for fault in FAULTS)
    assert [row["fault"] for row in json.loads(command("list", "--json").output)] == [fault.name for fault in FAULTS]


def test_commands_reach_the_line_by_its_socket_or_its_recording(tmp_path, server):
    path = tmp_path / SOCKET_FILE

    async def test() -> None:
        do = partial(asyncio.to_thread, command)
        shown = await do("inject", "--control", tmp_path, "load-cell 3 nan for 0.2")
        assert shown.exit_code == 0 and shown.output.startswith("fault 1: load-cell 3 nan for 0.2")
        shown = await do("inject", "--control", path, "--json", "plc permissive-lost at 20")
        assert json.loads(shown.output) == {"ok": True, "number": 2, "time_s": 12.5}
        shown = await do("list", "--control", path)
        assert shown.output.splitlines() == [
            "1  acts  from 12.500 s to 12.700 s  load-cell 3 nan for 0.2",
            "2  waits  from 20.000 s until cleared  plc permissive-lost at 20",
        ]
        shown = await do("clear", "2", "--control", path)
        assert shown.output == "cleared: 2, at 12.500 s of the line\n"
        shown = await do("clear", "9", "--control", path)
        assert shown.exit_code == REFUSED and "there is no fault 9" in shown.output
        shown = await do("clear", "--control", path)
        assert shown.output.startswith("cleared: 1,")
        assert (await do("list", "--control", path)).output.startswith("no faults")
        shown = await do("inject", "--control", path, "load-cell 9 nan")
        assert shown.exit_code == REFUSED and "allowed: 1 to 6" in shown.output

    serving(path, test, server)


def test_words_that_mean_nothing_are_refused_before_anything_is_asked(tmp_path):
    shown = command("inject", "--control", tmp_path, "load-cell 3 nam")
    assert shown.exit_code == REFUSED and "Did you mean nan?" in shown.output


def test_a_line_that_does_not_run_is_named(tmp_path):
    shown = command("list", "--control", tmp_path)
    assert shown.exit_code == UNREACHABLE and str(tmp_path) in shown.output.replace("\n", "")

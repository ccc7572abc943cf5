"""The gateway as a process: sockets, signals, single instance, restarts of it and of the loop, commands with who."""

import asyncio
import os
import signal
import sqlite3
import subprocess
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.core.line_past import RecordsAfter, TensionsBetween
from gateway.core.messages import Event, Reply
from gateway.core.states import LoopState, Phase
from gateway.core.status import GatewayStatus
from gateway.core.topics import (
    GATEWAY_COMMAND,
    GATEWAY_PAST,
    GATEWAY_STATUS,
    LOOP_COMMAND,
    LOOP_EVENT,
    LOOP_SHOWN,
    LOOP_TELEMETRY,
)
from gateway.mailbox.paths import GATEWAY_DATA
from gateway.mailbox.port import RemoteError, Unreachable
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.history import History
from tests.unit.supervisor_support import ShowsWho, child, frame_of, short_folder, until

pytestmark = pytest.mark.wires

GATEWAY = """
import sys
from pathlib import Path
from tests.unit.supervisor_support import line_of
from gateway.supervisor.process import run_gateway
sys.exit(run_gateway(line_of(), Path(sys.argv[1]), Path(sys.argv[1]) / "data"))
"""


@contextmanager
def gateway(folder: Path) -> Iterator[subprocess.Popen[str]]:
    with child(GATEWAY, folder) as (process, said):
        assert said.startswith("gateway of demo/")
        yield process


@asynccontextmanager
async def loop_and_client(folder: Path, shown: bool = True) -> AsyncIterator[tuple[UnixMailbox, UnixMailbox]]:
    """The loop's side and an operator's. The clock is fast: the loop looks for its gateway at each publish.

    `shown`: it says who it is on its own socket.
    """
    turn = iter(range(10**9))
    loop, client = UnixMailbox(lambda: float(next(turn))), UnixMailbox()
    loop.connect((LOOP_TELEMETRY, LOOP_EVENT), folder / "gateway.sock")
    client.connect((GATEWAY_STATUS, GATEWAY_COMMAND), folder / "gateway.sock")
    if shown:
        loop.serve(LOOP_SHOWN, ShowsWho(folder).answer)
        await loop.listen(folder / "loop.sock")
    try:
        yield loop, client
    finally:
        await client.close()
        await loop.close()


def run(story: Callable[[Path], Coroutine[Any, Any, None]]) -> None:
    async def bounded(folder: Path) -> None:
        async with asyncio.timeout(30.0):
            await story(folder)

    with short_folder() as folder:
        asyncio.run(bounded(folder))


async def ask(client: UnixMailbox) -> GatewayStatus:
    return GatewayStatus.model_validate_json(await client.request(GATEWAY_STATUS, b"", 5.0))


async def status_with(client: UnixMailbox, condition: Callable[[GatewayStatus], bool]) -> GatewayStatus:
    while not condition(status := await ask(client)):  # noqa: ASYNC110
        await asyncio.sleep(0.01)
    return status


async def heard(loop: UnixMailbox, client: UnixMailbox, sequence: int = 1, **changes: Any) -> int:
    """Publishes frames, of a line in RUN unless `changes`, until the gateway says that its loop runs; the next number.

    One frame is not enough: it is old after a second, which may have passed before who publishes is known.
    """
    while not (await ask(client)).loop.running:
        loop.publish(LOOP_TELEMETRY, frame_of(sequence, time.monotonic(), **changes))
        sequence += 1
        await asyncio.sleep(0.02)
    return sequence


def test_from_start_to_sigterm_everything_is_kept() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder) as process:
            async with loop_and_client(folder) as (loop, client):
                assert not (await ask(client)).loop.running
                for k in range(150):
                    assert loop.publish(LOOP_TELEMETRY, frame_of(k, time.monotonic()))
                event = Event(time_s=time.monotonic(), kind="state", text="TENSIONING to RUNNING")
                loop.publish(LOOP_EVENT, event.model_dump_json().encode())
                status = await status_with(
                    client,
                    lambda status: "loop-up" in {event.kind for event in status.events} and status.link.frames >= 150,
                )
                assert status.link.frames == 150
                assert (status.loop.running, status.loop.state) == (True, "RUN")
                process.terminate()
                assert process.wait(10.0) == 0
                with pytest.raises(Unreachable, match="r2rgate gateway"):
                    await ask(client)
        assert not (folder / "gateway.sock").exists()
        with History(folder / "data" / GATEWAY_DATA / "history.sqlite") as history:
            found = history.read_wall(time.time() - 60.0, time.time() + 1.0, ["sequence", "wall_s"])
            assert found["sequence"].tolist() == list(range(150))
            assert abs(found["wall_s"][-1] - time.time()) < 20.0
            kinds = [event.kind for event in history.events(0.0, 1e12)]
            assert kinds[0] == "gateway-up"
            assert kinds[-1] == "gateway-down"
            assert {"state", "loop-up"} <= set(kinds)

    run(story)


def test_an_end_of_which_a_step_fails_takes_the_others_all_the_same() -> None:
    breaks = "async def fails(self):\n    raise RuntimeError('gone')\n\nAgentsBus.close = fails\n"
    program = GATEWAY.replace("sys.exit", f"from gateway.supervisor.agents_bus import AgentsBus\n{breaks}sys.exit")

    async def story(folder: Path) -> None:
        with child(program, folder) as (process, said):
            assert said.startswith("gateway of demo/")
            process.terminate()
            assert process.wait(20.0) == 0
        with History(folder / "data" / GATEWAY_DATA / "history.sqlite") as history:
            events = history.events(0.0, 1e12)
        told = [event.data.get("task") for event in events if event.kind == "task-failed"]
        assert told == ["closing the agents' bus"]
        assert events[-1].kind == "gateway-down"
        assert not (folder / "gateway.sock").exists()

    run(story)


def test_a_second_instance_ends_with_3_and_a_sentence_and_touches_nothing() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder) as process:
            with child(GATEWAY, folder) as (second, _):
                said = second.communicate(timeout=20.0)[1]
                assert second.returncode == 3
            assert f"by process {process.pid}" in said
            assert "Traceback" not in said
            async with loop_and_client(folder) as (_, client):
                kinds = [event.kind for event in (await ask(client)).events]
                assert kinds.count("gateway-up") == 1

    run(story)


def test_a_run_folder_that_cannot_be_used_ends_with_2_and_a_sentence() -> None:
    with short_folder() as folder:
        (folder / "x").write_text("")
        with child(GATEWAY, folder / "x") as (process, _):
            said = process.communicate(timeout=20.0)[1]
            assert process.returncode == 2
        assert said.startswith("the gateway cannot start: the run folder")


def test_after_a_sigkill_the_next_gateway_takes_over_and_the_loop_finds_it() -> None:
    async def story(folder: Path) -> None:
        async with loop_and_client(folder) as (loop, client):
            sequence = 0
            for _ in range(2):
                with gateway(folder) as process:
                    sequence = await heard(loop, client, sequence)
                    await status_with(client, lambda status: status.historian.frames_stored > 0)
                    process.kill()
                    process.wait()
            with History(folder / "data" / GATEWAY_DATA / "history.sqlite") as history:
                found = history.read(0.0, 1e12, ["sequence"])["sequence"].tolist()
                assert found == sorted(set(found))
                assert len(found) >= 2
                assert history.damaged == []

    run(story)


def test_a_loop_may_come_go_and_come_again() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            async with loop_and_client(folder, shown=False) as (loop, client):
                reply = Reply.model_validate_json(await client.request(GATEWAY_COMMAND, b'{"command":"arm"}', 5.0))
                assert not reply.ok
                assert "start it with `r2rgate loop" in reply.text

                async def answer(payload: bytes) -> bytes:
                    if b"stop" in payload:  # the gateway asks for the configuration, too
                        stopped = frame_of(1, time.monotonic(), state=LoopState.STOP, phase=Phase.OFF)
                        loop.publish(LOOP_TELEMETRY, stopped)
                    return Reply(ok=True, state="READY", text=payload.decode()).model_dump_json().encode()

                for _ in range(2):
                    running = UnixMailbox()
                    running.serve(LOOP_COMMAND, answer)
                    running.serve(LOOP_SHOWN, ShowsWho(folder).answer)
                    await running.listen(folder / "loop.sock")
                    answered = await client.request(GATEWAY_COMMAND, b'{"command":"stop"}', 5.0)
                    assert Reply.model_validate_json(answered).ok
                    await heard(loop, client, 2)
                    await running.close()
                    await status_with(client, lambda status: not status.loop.running)
                status = await ask(client)
                assert status.loop.restarts == 1
                commands = [event.text for event in status.events if event.kind == "command"]
                assert len(commands) == 3
        with History(folder / "data" / GATEWAY_DATA / "history.sqlite") as history:
            stored = [event for event in history.events(0.0, 1e12) if event.kind == "command"]
            assert stored[0].data["uid"] == os.getuid()
            assert stored[0].data["pid"] == os.getpid()

    run(story)


def test_rubbish_on_the_socket_changes_nothing() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder) as process:
            async with loop_and_client(folder) as (loop, client):
                loop.connect((LOOP_COMMAND,), folder / "gateway.sock")
                for k in range(50):
                    loop.publish(LOOP_TELEMETRY, os.urandom(k))
                    loop.publish(LOOP_EVENT, os.urandom(k))
                with pytest.raises(RemoteError, match="not served"):
                    await loop.request(LOOP_COMMAND, b"", 5.0)
                status = await status_with(client, lambda status: status.link.malformed == 100)
                assert status.link.frames == 0
                process.send_signal(signal.SIGINT)
                assert process.wait(10.0) == 0

    run(story)


FAILING_LOOK = """
import sys
from pathlib import Path
from tests.unit.supervisor_support import line_of
from gateway.supervisor.gate import Gate
from gateway.supervisor.process import run_gateway

looks, mended = 0, Path(sys.argv[1]) / "mended"
look = Gate.look

async def failing(gate):
    global looks
    looks += 1
    if not mended.exists():
        raise KeyError(f"look {looks}")
    await look(gate)

Gate.look = failing
sys.exit(run_gateway(line_of(), Path(sys.argv[1]), Path(sys.argv[1]) / "data"))
"""


def test_a_look_that_raises_is_an_alarm_and_is_taken_again() -> None:
    async def story(folder: Path) -> None:
        with child(FAILING_LOOK, folder) as (process, said):
            assert said.startswith("gateway of demo/")
            async with loop_and_client(folder) as (_, client):
                found = await status_with(client, lambda status: any(one.in_a_row > 2 for one in status.task_faults))
                assert [(one.task, one.error) for one in found.task_faults] == [("gate", "KeyError")]
                assert found.task_faults[0].times > 2
                found = await status_with(client, lambda status: bool(status.alarms))
                assert [alarm.name for alarm in found.alarms] == ["gateway-task"]
                assert [event.kind for event in found.events].count("task-failed") == 1
                (folder / "mended").touch()
                await status_with(client, lambda status: all(one.in_a_row == 0 for one in status.task_faults))
                await status_with(client, lambda status: any(one.kind == "gate" for one in status.events))
            process.send_signal(signal.SIGTERM)
            _, err = process.communicate(timeout=20)
            assert process.returncode == 0 and err.count("Traceback") == 1 and "KeyError: 'look 1'" in err

    run(story)


FAILING_HANDLER = """
import sys
from pathlib import Path
from tests.unit.supervisor_support import line_of
from gateway.supervisor.process import run_gateway
from gateway.supervisor.service import Gateway

async def failing(gateway, payload, who):
    raise LookupError("nothing like it")

Gateway.command = failing
sys.exit(run_gateway(line_of(), Path(sys.argv[1]), Path(sys.argv[1]) / "data"))
"""


def test_a_handler_that_raises_ends_no_connection_and_is_not_silent() -> None:
    async def story(folder: Path) -> None:
        with child(FAILING_HANDLER, folder) as (_, said):
            assert said.startswith("gateway of demo/")
            async with loop_and_client(folder) as (_, client):
                with pytest.raises(RemoteError, match="LookupError"):
                    await client.request(GATEWAY_COMMAND, b'{"command": "stop"}', 5.0)
                found = await status_with(client, lambda status: bool(status.task_faults))
                assert "LookupError: nothing like it" in found.task_faults[0].text

    run(story)


#: What SQLite holds of a file with a write-ahead log for as long as it is open: kind, first and last byte.
SHARED = ("READ", "1073741826", "1073742335")


def test_a_question_of_the_past_costs_the_gateway_no_lock_and_another_program_no_row() -> None:
    """Where nobody holds a lock, an SQLite before 3.51 takes itself for the last one and deletes the log."""

    async def story(folder: Path) -> None:
        history = folder / "data" / GATEWAY_DATA / "history.sqlite"
        with gateway(folder) as process:
            async with loop_and_client(folder) as (loop, client):
                client.connect((GATEWAY_PAST,), folder / "gateway.sock")
                await heard(loop, client)
                await until(lambda: SHARED in locks_of(process.pid, history))
                now_s = time.time()
                for asked in (TensionsBetween(from_wall_s=now_s - 60.0, to_wall_s=now_s), RecordsAfter()):
                    await client.request(GATEWAY_PAST, asked.model_dump_json().encode(), 10.0)
                assert SHARED in locks_of(process.pid, history)
                with closing(sqlite3.connect(history)) as another:
                    another.execute("SELECT count(*) FROM blob").fetchone()
                assert history.with_name("history.sqlite-wal").exists()

    run(story)


def locks_of(pid: int, path: Path) -> set[tuple[str, ...]]:
    """What a process holds of a file, as the kernel lists it: kind, first and last byte."""
    rows = [row.split() for row in Path("/proc/locks").read_text().splitlines()]
    inode = f":{path.stat().st_ino}" if path.exists() else "of none"
    return {(row[3], *row[6:]) for row in rows if row[4] == str(pid) and row[5].endswith(inode)}

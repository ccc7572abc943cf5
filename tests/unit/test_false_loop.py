"""What speaks as the loop and is not: a real gateway process, and other processes that take sockets and publish."""

import asyncio
import os
import stat
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.operate_commands import request
from gateway.core.messages import Reply, Stop
from gateway.core.states import LoopState, Phase
from gateway.core.status import GatewayStatus
from gateway.core.topics import GATEWAY_COMMAND, LOOP_COMMAND, LOOP_SHOWN, LOOP_TELEMETRY
from gateway.mailbox.loop_proof import (
    KEY_FILE,
    NoKey,
    NotTheLoop,
    keep_key,
    make_key,
    new_challenge,
    proven,
    read_key,
    shown,
)
from gateway.mailbox.paths import GATEWAY_DATA
from gateway.mailbox.port import Peer
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.audit_file import AuditFile
from tests.unit.supervisor_support import ShowsWho, child, frame_of, short_folder
from tests.unit.test_supervisor_process import GATEWAY, ask, gateway, heard, loop_and_client, run, status_with

pytestmark = pytest.mark.wires

#: Serves the loop's socket where told to, and says what a loop in RUN says; how it shows who it is: not, or by relay.
FALSE_LOOP = """
import asyncio, json, sys, time
from pathlib import Path
from gateway.core.messages import Reply
from gateway.core.topics import LOOP_COMMAND, LOOP_EVENT, LOOP_SHOWN, LOOP_TELEMETRY
from gateway.core.messages import Event
from gateway.mailbox.unix import UnixMailbox
from tests.unit.supervisor_support import frame_of

async def main():
    folder, does = Path(sys.argv[1]), sys.argv[2].split("/")[-1]
    box, old, told = UnixMailbox(), UnixMailbox(), []
    box.connect({LOOP_TELEMETRY, LOOP_EVENT}, folder / "gateway.sock")
    old.connect({LOOP_SHOWN}, folder / "true.sock")

    async def answer(payload):
        return Reply(ok=True, state="STOP", text="done (says the false loop)").model_dump_json().encode()

    async def relay(payload):
        return await old.request(LOOP_SHOWN, payload, 1.0)

    async def again(payload):
        if not told:
            told.append(await old.request(LOOP_SHOWN, payload, 1.0))
        return told[0]

    async def never(payload):
        await asyncio.Event().wait()

    if does == "is_silent":
        box.serve(LOOP_COMMAND, never)
        box.serve(LOOP_SHOWN, never)
        await box.listen(folder / "loop.sock")
    elif does != "publishes":
        box.serve(LOOP_COMMAND, answer)
        if does in ("relays", "repeats"):
            box.serve(LOOP_SHOWN, relay if does == "relays" else again)
        await box.listen(folder / "loop.sock")
    print("false", flush=True)
    k = 0
    while True:
        k += 1
        box.publish(LOOP_TELEMETRY, frame_of(k, time.monotonic()))
        box.publish(LOOP_EVENT, Event(time_s=time.monotonic(), kind="state", text="forged").model_dump_json().encode())
        await asyncio.sleep(0.01)

asyncio.run(main())
"""


@contextmanager
def false_loop(folder: Path, does: str) -> Iterator[subprocess.Popen[str]]:
    with child(FALSE_LOOP, folder, Path(does)) as (process, said):
        assert said == "false\n"
        yield process


#: What may be found of what takes the loop's socket; of one that publishes as well, that it does.
SAID = {
    "answers": {"false-loop-mute", "false-loop-speaks"},
    "relays": {"false-loop-relay", "false-loop-speaks"},
    "repeats": {"false-loop-relay", "false-loop-replay", "false-loop-speaks"},
}


def codes_of(status: GatewayStatus) -> set[str]:
    return {one.code for one in status.loop.false_loop}


def recorded(folder: Path) -> set[str]:
    """Kinds of records in the audit."""
    with AuditFile(folder / "data" / GATEWAY_DATA) as file:
        return {record.kind for record in (row.record() for row in file.rows())}


def alarms_of(status: GatewayStatus) -> set[str]:
    return {alarm.name for alarm in status.alarms}


async def say(client: UnixMailbox, payload: bytes) -> Reply:
    return Reply.model_validate_json(await client.request(GATEWAY_COMMAND, payload, 10.0))


@pytest.mark.parametrize("does", ["answers", "relays", "repeats"])
def test_a_process_that_took_the_loops_socket_is_not_believed_whatever_it_answers(does: str) -> None:
    async def story(folder: Path) -> None:
        true = UnixMailbox()
        true.serve(LOOP_SHOWN, ShowsWho(folder, Phase.OFF).answer)
        await true.listen(folder / "true.sock")
        with gateway(folder), false_loop(folder, does):
            async with loop_and_client(folder, shown=False) as (_, client):
                found = await status_with(client, lambda status: "false-loop" in alarms_of(status))
                assert not found.loop.running and found.loop.state == "UNKNOWN" and found.link.frames == 0
                assert "forged" not in {event.text for event in found.events}
                assert codes_of(found) <= SAID[does]
                reply = await say(client, b'{"command":"stop"}')
                assert (reply.ok, reply.known) == (False, False)
                assert [one.code for one in reply.findings] == ["false-loop-answered"]
            while "false-loop" not in recorded(folder):  # noqa: ASYNC110 - it is in another process
                await asyncio.sleep(0.05)
            straight = await request(folder, Stop())
            assert (straight.ok, straight.known) == (False, False)
            assert [one.code for one in straight.findings] in (
                ["false-loop-mute", "stop-not-known"], ["false-loop-relay", "stop-not-known"],
                ["false-loop-replay", "stop-not-known"],
            )  # fmt: skip
        await true.close()

    run(story)


def test_one_who_publishes_beside_the_loop_is_counted_and_named_and_the_loop_is_heard_as_ever() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            async with loop_and_client(folder) as (loop, client):
                sequence = await heard(loop, client, state=LoopState.STOP, phase=Phase.OFF)
                with false_loop(folder, "publishes") as false:
                    while True:
                        stopped = frame_of(sequence, time.monotonic(), state=LoopState.STOP, phase=Phase.OFF)
                        loop.publish(LOOP_TELEMETRY, stopped)
                        sequence += 1
                        found = await ask(client)
                        assert found.loop.state in ("STOP", "UNKNOWN")  # never what the other one says
                        if "false-loop" in alarms_of(found):
                            break
                        await asyncio.sleep(0.02)
                    (said,) = found.loop.false_loop
                    assert said.code == "false-loop-speaks"
                    told = {"process_pid": false.pid, "process_uid": os.getuid(), "loop_pid": os.getpid()}
                    assert said.parameters == told
                    assert [one.findings for one in found.alarms if one.name == "false-loop"] == [[said]]
                    assert found.link.untaken > 0 and found.link.frames < sequence
                    assert "forged" not in {event.text for event in found.events}

    run(story)


@pytest.mark.parametrize("ahead_s", [1e6, 30.0, -1.0])
def test_a_frame_of_the_future_or_the_past_is_refused_and_hides_no_other(ahead_s: float) -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            async with loop_and_client(folder) as (loop, client):
                sequence, last_s = 0, 0.0
                while not (await ask(client)).loop.running:  # the gateway has first to know who the loop is
                    sequence, last_s = sequence + 1, time.monotonic()
                    loop.publish(LOOP_TELEMETRY, frame_of(sequence, last_s))
                    await asyncio.sleep(0.02)
                sent = sequence
                before = (
                    await status_with(client, lambda status: status.link.frames + status.link.untaken == sent)
                ).link
                off_s = (time.monotonic() if ahead_s > 0.0 else last_s) + ahead_s
                loop.publish(LOOP_TELEMETRY, frame_of(sent + 1, off_s))
                found = await status_with(client, lambda status: status.link.untaken == before.untaken + 1)
                assert codes_of(found) == {"loop-frame-future" if ahead_s > 0.0 else "loop-frame-past"}
                assert found.link.frames == before.frames
                loop.publish(LOOP_TELEMETRY, frame_of(sent + 2, time.monotonic()))
                await status_with(client, lambda status: status.link.frames == before.frames + 1)
                await heard(loop, client, sent + 3)
                await status_with(client, lambda status: not status.loop.running)  # a future frame keeps none alive

    run(story)


def test_done_is_what_the_frames_of_the_loop_show_and_a_reply_that_contradicts_them_is_a_fault() -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            async with loop_and_client(folder) as (loop, client):
                shows = {"state": LoopState.RUN, "phase": Phase.RUNNING}

                async def answer(_: bytes) -> bytes:
                    return Reply(ok=True, state="STOP", text="the line stops").model_dump_json().encode()

                loop.serve(LOOP_COMMAND, answer)

                async def periods() -> None:
                    k = 0
                    while True:
                        k += 1
                        loop.publish(LOOP_TELEMETRY, frame_of(k, time.monotonic(), **shows))
                        await asyncio.sleep(0.01)

                running = asyncio.create_task(periods())
                await status_with(client, lambda status: status.loop.running)
                for command in (b'{"command":"stop"}', b'{"command":"hold"}'):
                    reply = await say(client, command)
                    assert (reply.ok, reply.known) == (False, False)
                    (said,) = reply.findings
                    assert said.code == "reply-contradicted"
                    assert (said.parameters["answered"], said.parameters["shown"]) == ("STOP", "RUN")
                await status_with(client, lambda status: "false-loop" in alarms_of(status))
                shows |= {"state": LoopState.STOP, "phase": Phase.SLOWING}
                assert (await say(client, b'{"command":"stop"}')).ok
                running.cancel()
                await asyncio.gather(running, return_exceptions=True)
                reply = await say(client, b'{"command":"stop"}')  # and without frames nothing is done
                assert (reply.ok, reply.known) == (False, False) and reply.findings[0].parameters["shown"] == "-"

    run(story)


def test_a_stop_from_the_command_line_is_done_when_the_loop_shows_it() -> None:
    async def story(folder: Path) -> None:
        loop, who = UnixMailbox(), ShowsWho(folder)

        async def answer(_: bytes) -> bytes:
            return Reply(ok=True, state="STOP", text="the line stops").model_dump_json().encode()

        loop.serve(LOOP_COMMAND, answer)
        loop.serve(LOOP_SHOWN, who.answer)
        await loop.listen(folder / "loop.sock")
        reply = await request(folder, Stop())
        assert (reply.ok, reply.known) == (False, False)
        assert [one.code for one in reply.findings] == ["stop-not-shown", "stop-not-known"]
        assert reply.findings[0].parameters["phase"] == "RUNNING"
        who.phase = Phase.SLOWING
        assert (await request(folder, Stop())).ok
        await loop.close()

    run(story)


@pytest.mark.parametrize("does", ["answers", "is_silent"])
def test_a_stop_goes_through_the_gateway_where_the_loops_socket_was_taken_from_it(does: str) -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            async with loop_and_client(folder) as (loop, client):
                stopped: list[bytes] = []
                sequence = 1

                async def answer(payload: bytes) -> bytes:
                    stopped.append(payload)
                    for k in (sequence, sequence + 1):
                        frame = frame_of(k, time.monotonic(), state=LoopState.STOP, phase=Phase.OFF)
                        loop.publish(LOOP_TELEMETRY, frame)
                    return Reply(ok=True, state="STOP", text="the line stops").model_dump_json().encode()

                loop.serve(LOOP_COMMAND, answer)
                sequence = await heard(loop, client)
                (folder / "loop.sock").unlink()
                (folder / "loop.sock.lock").unlink()
                with false_loop(folder, does):
                    began_s = time.monotonic()
                    reply = await request(folder, Stop(), 10.0)
                    took_s = time.monotonic() - began_s
                assert {one.code for one in reply.findings} == {"false-loop-mute"} and took_s < 5.0
                assert reply.ok and "through the gateway" in reply.text and b'{"command":"stop"}' in stopped

    run(story)


def test_a_second_gateway_of_the_same_data_ends_at_once_whatever_its_run_folder() -> None:
    other = GATEWAY.replace('Path(sys.argv[1]) / "data"', "Path(sys.argv[2])")

    async def story(folder: Path) -> None:
        with gateway(folder), child(other, folder / "elsewhere", folder / "data") as (process, _):
            assert process.wait(20.0) == 3
            assert "is the gateway of the line whose data lie in" in process.communicate()[1]
            assert not (folder / "elsewhere" / "gateway.sock").exists()

    run(story)


# ---- the proof


def test_a_key_is_made_once_is_its_users_alone_and_is_replaced_where_it_cannot_be_used() -> None:
    with short_folder() as folder:
        with pytest.raises(NoKey, match="cannot be read"):
            read_key(folder)
        key = make_key(folder)
        assert make_key(folder) == read_key(folder) == key and len(key) == 32
        path = folder / KEY_FILE
        assert stat.S_IMODE(path.stat().st_mode) == 0o600 and list(folder.iterdir()) == [path]
        path.chmod(0o644)
        with pytest.raises(NoKey, match="not its user's alone"):
            read_key(folder)
        path.chmod(0o600)
        path.write_bytes(key[:-1])
        with pytest.raises(NoKey, match="another length"):
            read_key(folder)
        another = make_key(folder)
        assert another == read_key(folder) != key
        path.unlink()
        path.symlink_to("/etc/hostname")
        with pytest.raises(NoKey):
            read_key(folder)
        path.unlink()
        os.mkfifo(path, 0o600)
        with pytest.raises(NoKey, match="not its user's alone"):  # at once: nobody writes to that pipe
            read_key(folder)
        keep_key(folder, key)
        assert read_key(folder) == key and path.is_file() and list(folder.iterdir()) == [path]
        with pytest.raises(NoKey):
            keep_key(folder / "missing", key)


@pytest.mark.parametrize("spoil", ["deleted", "damaged"])
def test_a_key_that_is_gone_is_told_and_is_no_false_loop(spoil: str) -> None:
    async def story(folder: Path) -> None:
        with gateway(folder):
            async with loop_and_client(folder) as (loop, client):
                sequence = await heard(loop, client)
                if spoil == "deleted":
                    (folder / KEY_FILE).unlink()
                else:
                    (folder / KEY_FILE).write_bytes(b"short")
                found = await status_with(client, lambda status: any(one.kind == "loop-key" for one in status.events))
                codes = {one.code for event in found.events if event.kind == "loop-key" for one in event.findings}
                assert codes == {"loop-key-unreadable" if spoil == "deleted" else "loop-key-damaged"}
                assert not found.loop.false_loop and "false-loop" not in alarms_of(found)
                await status_with(client, lambda status: not status.loop.running)
                await heard(loop, client, sequence)  # as ever

    run(story)


def test_an_answer_counts_for_its_challenge_its_process_and_unchanged() -> None:
    key, challenge = b"k" * 32, new_challenge()
    said: dict[str, Any] = {
        "challenge": challenge, "start": "a" * 64, "pid": 7, "sequence": 3, "time_s": 1.5, "state": "RUN",
        "phase": "RUNNING",
    }  # fmt: skip
    answer = shown(key, **said)
    found = proven(key, challenge, answer, Peer(1000, 7))
    assert (found.start, found.pid, found.phase) == ("a" * 64, 7, "RUNNING")
    assert proven(key, challenge, answer, None) == found
    with pytest.raises(NotTheLoop, match="words of process 7"):
        proven(key, challenge, answer, Peer(1000, 8))
    with pytest.raises(NotTheLoop, match="told before"):
        proven(key, new_challenge(), answer, Peer(1000, 7))
    with pytest.raises(NotTheLoop, match="does not know the line's key"):
        proven(b"l" * 32, challenge, answer, Peer(1000, 7))
    changes = ((b'"RUN"', b'"STOP"'), (b"1.5", b"2.5"), (b'"pid": 7', b'"pid": 8'), (b"RUNNING", b"OFF"))
    for before, after in changes:
        with pytest.raises(NotTheLoop, match="does not know the line's key"):
            proven(key, challenge, answer.replace(before, after), Peer(1000, 7))
    for rubbish in (b"", b"{}", os.urandom(200), answer[:-1], b"[" * 10000):
        with pytest.raises(NotTheLoop, match="no loop answers"):
            proven(key, challenge, rubbish, Peer(1000, 7))

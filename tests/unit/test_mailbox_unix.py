"""The unix mailbox between well-behaved parties, and who may listen where."""

import asyncio
import os
import signal
import socket
import stat
import tracemalloc
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.core.topics import GATEWAY_STATUS, LOOP_COMMAND, LOOP_EVENT, LOOP_TELEMETRY
from gateway.mailbox.codec import Envelope, Kind, encode
from gateway.mailbox.listener import AlreadyRunning, CannotListen, PathTooLong
from gateway.mailbox.places import MAX_IN_FLIGHT
from gateway.mailbox.port import MAX_PAYLOAD, PEER, Peer, RemoteError, Unreachable
from gateway.mailbox.unix import MAX_CONNECTIONS, RECONNECT_S, UnixMailbox
from tests.unit.supervisor_support import child, short_folder, until

CROWD = 10


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@asynccontextmanager
async def mailboxes(count: int) -> AsyncIterator[list[UnixMailbox]]:
    made = [UnixMailbox() for _ in range(count)]
    try:
        yield made
    finally:
        for mailbox in made:
            await mailbox.close()


def run(story: Callable[[Path], Coroutine[Any, Any, None]]) -> None:
    """`story` in an event loop and a folder of its own, bounded in time."""

    async def bounded(folder: Path) -> None:
        async with asyncio.timeout(10.0):
            await story(folder)

    with short_folder() as folder:
        asyncio.run(bounded(folder))


async def echo(payload: bytes) -> bytes:
    return payload


def test_messages_arrive_whole_and_in_order() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (loop, gateway):
            heard: asyncio.Queue[bytes] = asyncio.Queue()
            gateway.subscribe(LOOP_TELEMETRY, heard.put_nowait)
            await gateway.listen(folder / "g")
            loop.connect({LOOP_TELEMETRY}, folder / "g")
            sent = [b"", b"\0", bytes(MAX_PAYLOAD), *(str(k).encode() for k in range(100))]
            for payload in sent:
                assert loop.publish(LOOP_TELEMETRY, payload)
            assert [await heard.get() for _ in sent] == sent

    run(story)


def test_a_publisher_finds_its_listener_late_and_again_looking_once_a_second() -> None:
    async def story(folder: Path) -> None:
        clock = Clock()
        loop = UnixMailbox(clock)
        loop.connect({LOOP_TELEMETRY}, folder / "g")
        heard: asyncio.Queue[bytes] = asyncio.Queue()
        assert not loop.publish(LOOP_TELEMETRY, b"nobody there")
        for _ in range(2):
            gateway = UnixMailbox()
            gateway.subscribe(LOOP_TELEMETRY, heard.put_nowait)
            await gateway.listen(folder / "g")
            assert not loop.publish(LOOP_TELEMETRY, b"too early to look again")
            clock.now_s += RECONNECT_S
            assert loop.publish(LOOP_TELEMETRY, b"here")
            assert await heard.get() == b"here"
            await gateway.close()
            await until(lambda: not loop.publish(LOOP_TELEMETRY, b"gone"))
        assert loop.counters.connects == 2
        assert loop.counters.dropped >= 5
        await loop.close()

    run(story)


def test_answers_find_their_requests_in_whatever_order_they_come() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (asking, serving):
            gates = [asyncio.Event() for _ in range(MAX_IN_FLIGHT)]
            arrived: asyncio.Queue[int] = asyncio.Queue()

            async def answer(payload: bytes) -> bytes:
                arrived.put_nowait(int(payload))
                await gates[int(payload)].wait()
                return b"answer to " + payload

            serving.serve(LOOP_COMMAND, answer)
            await serving.listen(folder / "l")
            asking.connect({LOOP_COMMAND}, folder / "l")
            asked = [asyncio.create_task(asking.request(LOOP_COMMAND, b"%d" % k, 5.0)) for k in range(len(gates))]
            for _ in gates:
                await arrived.get()
            for gate in reversed(gates):
                gate.set()
                await asyncio.sleep(0)
            assert await asyncio.gather(*asked) == [b"answer to %d" % k for k in range(len(gates))]

    run(story)


def test_a_late_answer_is_dropped_and_the_next_request_gets_its_own() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (asking, serving):
            late = asyncio.Event()

            async def answer(payload: bytes) -> bytes:
                if payload == b"slow":
                    await late.wait()
                return payload

            serving.serve(LOOP_COMMAND, answer)
            await serving.listen(folder / "l")
            asking.connect({LOOP_COMMAND}, folder / "l")
            with pytest.raises(Unreachable, match="did not answer within 0.02 s"):
                await asking.request(LOOP_COMMAND, b"slow", 0.02)
            late.set()
            assert await asking.request(LOOP_COMMAND, b"quick", 5.0) == b"quick"
            assert asking.counters.late_answers == 1

    run(story)


def test_an_answer_of_one_peer_cannot_satisfy_a_request_to_another() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(3) as (asking, honest, forging):
            honest.serve(LOOP_COMMAND, echo)
            await honest.listen(folder / "l")
            await forging.listen(folder / "f")
            asking.connect({LOOP_COMMAND}, folder / "l")
            # A peer that dials in and answers ids it was never asked, ahead of the honest answer.
            await asking.listen(folder / "a")
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as forger:
                forger.connect(str(folder / "a"))
                for number in range(1, 20):
                    forger.send(encode(Envelope(Kind.ANSWER, LOOP_COMMAND.name, number, b"forged")))
                assert await asking.request(LOOP_COMMAND, b"true", 5.0) == b"true"
                await until(lambda: asking.counters.late_answers == 19)

    run(story)


def test_a_handler_that_fails_is_an_error_for_the_asking_side_and_the_server_lives() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (asking, serving):

            async def answer(payload: bytes) -> bytes:
                if payload == b"raise":
                    raise RuntimeError("no such span \udcff")
                return bytes(MAX_PAYLOAD + 1) if payload == b"long" else payload

            serving.serve(LOOP_COMMAND, answer)
            await serving.listen(folder / "l")
            asking.connect({LOOP_COMMAND, GATEWAY_STATUS}, folder / "l")
            with pytest.raises(RemoteError, match="RuntimeError: no such span"):
                await asking.request(LOOP_COMMAND, b"raise", 5.0)
            with pytest.raises(RemoteError, match=f"{MAX_PAYLOAD + 1} bytes"):
                await asking.request(LOOP_COMMAND, b"long", 5.0)
            with pytest.raises(RemoteError, match=f"{MAX_PAYLOAD + 1} bytes"):
                await asking.request(LOOP_COMMAND, bytes(MAX_PAYLOAD + 1), 5.0)
            with pytest.raises(RemoteError, match="not served here"):
                await asking.request(GATEWAY_STATUS, b"", 5.0)
            assert await asking.request(LOOP_COMMAND, b"fine", 5.0) == b"fine"
            assert serving.counters.handler_errors == 1
            with pytest.raises(ValueError, match="served already"):
                serving.serve(LOOP_COMMAND, echo)

    run(story)


def test_a_subscriber_that_raises_is_counted_and_the_next_one_hears() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (loop, gateway):
            heard: asyncio.Queue[bytes] = asyncio.Queue()

            def fail(_: bytes) -> None:
                raise KeyError("broken")

            gateway.subscribe(LOOP_EVENT, fail)
            gateway.subscribe(LOOP_EVENT, heard.put_nowait)
            await gateway.listen(folder / "g")
            loop.connect({LOOP_EVENT}, folder / "g")
            loop.publish(LOOP_EVENT, b"1")
            loop.publish(LOOP_EVENT, b"2")
            assert [await heard.get(), await heard.get()] == [b"1", b"2"]
            assert gateway.counters.handler_errors == 2

    run(story)


def test_unreachable_says_what_to_start() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(1) as (asking,):
            with pytest.raises(Unreachable, match="no path"):
                await asking.request(LOOP_COMMAND, b"", 1.0)
            asking.connect({LOOP_COMMAND}, folder / "l")
            with pytest.raises(Unreachable, match="loop not running: start it with `r2rgate loop"):
                await asking.request(LOOP_COMMAND, b"", 1.0)

    run(story)


def test_a_server_that_was_restarted_is_found_by_the_next_request() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(1) as (asking,):
            asking.connect({LOOP_COMMAND}, folder / "l")
            for k in range(3):
                serving = UnixMailbox()
                serving.serve(LOOP_COMMAND, echo)
                await serving.listen(folder / "l")
                assert await asking.request(LOOP_COMMAND, b"%d" % k, 5.0) == b"%d" % k
                await serving.close()

    run(story)


def test_a_server_that_goes_while_it_is_asked_ends_the_request_at_once() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(1) as (asking,):
            serving = UnixMailbox()
            asked = asyncio.Event()

            async def answer(_: bytes) -> bytes:
                asked.set()
                await asyncio.Event().wait()
                return b""

            serving.serve(LOOP_COMMAND, answer)
            await serving.listen(folder / "l")
            asking.connect({LOOP_COMMAND}, folder / "l")
            waiting = asyncio.create_task(asking.request(LOOP_COMMAND, b"", 60.0))
            await asked.wait()
            await serving.close()
            with pytest.raises(Unreachable, match="closed the connection"):
                await waiting

    run(story)


def test_the_handler_knows_who_asks() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (asking, serving):

            async def answer(_: bytes) -> bytes:
                peer = PEER.get()
                assert peer is not None
                return f"{peer.uid} {peer.pid}".encode()

            serving.serve(LOOP_COMMAND, answer)
            await serving.listen(folder / "l")
            asking.connect({LOOP_COMMAND}, folder / "l")
            answer_text = (await asking.request(LOOP_COMMAND, b"", 5.0)).decode()
            assert answer_text == f"{os.getuid()} {os.getpid()}"
            assert PEER.get() is None
            assert Peer(1, 2) == Peer(1, 2)

    run(story)


def test_a_closed_mailbox_leaves_no_socket_file_and_closes_twice() -> None:
    async def story(folder: Path) -> None:
        mailbox = UnixMailbox()
        await mailbox.listen(folder / "g")
        assert (folder / "g").is_socket()
        await mailbox.close()
        await mailbox.close()
        assert not (folder / "g").exists()

    run(story)


def test_closing_that_is_cancelled_leaves_no_connection_open() -> None:
    async def story(folder: Path) -> None:
        asked, waiting, tidied = asyncio.Event(), asyncio.Event(), asyncio.Event()

        async def slow(_: bytes) -> bytes:
            try:
                asked.set()
                await asyncio.Event().wait()
            finally:
                waiting.set()
                await tidied.wait()  # the mailbox that is closed waits for this
            return b""

        async with mailboxes(2) as (asking, serving):
            serving.serve(LOOP_COMMAND, slow)
            await serving.listen(folder / "l")
            asking.connect((LOOP_COMMAND,), folder / "l")
            request = asyncio.create_task(asking.request(LOOP_COMMAND, b"", 5.0))
            await asked.wait()
            closing = asyncio.create_task(serving.close())
            await waiting.wait()  # two cancellations in one turn are one, and nobody's
            closing.cancel()
            with pytest.raises(asyncio.CancelledError):
                await closing
            with pytest.raises(Unreachable, match="closed the connection"):
                await request
            assert not (folder / "l").exists()
            tidied.set()

    run(story)


def test_where_more_connect_than_there_is_room_for_whoever_was_quiet_for_longest_makes_room() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (asking, serving):
            serving.serve(LOOP_COMMAND, echo)
            await serving.listen(folder / "l")
            crowd = []
            try:
                for _ in range(MAX_CONNECTIONS + 5):
                    crowding = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                    crowd.append(crowding)
                    crowding.connect(str(folder / "l"))
                    await asyncio.sleep(0)  # the backlog is shorter than the crowd
                await until(lambda: serving.counters.refused == 5)
                asking.connect({LOOP_COMMAND}, folder / "l")
                assert await asking.request(LOOP_COMMAND, b"x", 5.0) == b"x"
                assert serving.counters.refused == 6
                assert [len(crowding.recv(1, socket.MSG_DONTWAIT)) for crowding in crowd[:6]] == [0] * 6  # closed
                with pytest.raises(BlockingIOError):
                    crowd[6].recv(1, socket.MSG_DONTWAIT)
            finally:
                for crowding in crowd:
                    crowding.close()

    run(story)


def test_socket_and_folder_are_private() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(1) as (mailbox,):
            old = os.umask(0)
            try:
                await mailbox.listen(folder / "new" / "g")
            finally:
                os.umask(old)
            assert stat.S_IMODE((folder / "new").stat().st_mode) == 0o700
            assert stat.S_IMODE((folder / "new" / "g").stat().st_mode) == 0o600

    run(story)


def test_a_folder_that_others_may_write_and_a_file_that_is_no_socket_are_refused() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(1) as (mailbox,):
            (folder / "open").mkdir()
            (folder / "open").chmod(0o777)
            with pytest.raises(CannotListen, match="written by others"):
                await mailbox.listen(folder / "open" / "g")
            (folder / "file").write_text("precious")
            with pytest.raises(CannotListen, match="no socket"):
                await mailbox.listen(folder / "file")
            assert (folder / "file").read_text() == "precious"
            with pytest.raises(CannotListen, match="cannot be made"):
                await mailbox.listen(folder / "file" / "below" / "g")

    run(story)


def test_a_path_longer_than_the_kernel_takes_is_refused_with_its_length() -> None:
    async def story(folder: Path) -> None:
        fits = folder / ("x" * (107 - len(str(folder)) - 1))
        async with mailboxes(2) as (listening, dialling):
            for mailbox, path in ((listening, fits), (dialling, fits)):
                with pytest.raises(PathTooLong, match="108 bytes.*107.*shorter run folder"):
                    mailbox.connect({LOOP_COMMAND}, Path(f"{path}y"))
            with pytest.raises(PathTooLong):
                await listening.listen(Path(f"{fits}y"))
            listening.serve(LOOP_COMMAND, echo)
            await listening.listen(fits)
            dialling.connect({LOOP_COMMAND}, fits)
            assert await dialling.request(LOOP_COMMAND, b"x", 5.0) == b"x"

    run(story)


LISTEN = """
import asyncio, sys
from pathlib import Path
from gateway.mailbox.unix import UnixMailbox

async def main():
    await UnixMailbox().listen(Path(sys.argv[1]))
    print("listening", flush=True)
    await asyncio.Event().wait()

asyncio.run(main())
"""


@pytest.mark.wires
def test_a_living_listener_is_refused_and_a_killed_one_replaced() -> None:
    async def story(folder: Path) -> None:
        path = folder / "g"
        with child(LISTEN, path) as (living, said):
            assert said == "listening\n"
            async with mailboxes(1) as (mailbox,):
                with pytest.raises(AlreadyRunning, match=f"process {living.pid}"):
                    await mailbox.listen(path)
                living.send_signal(signal.SIGSTOP)
                with pytest.raises(AlreadyRunning):
                    await mailbox.listen(path)
                living.kill()
                living.wait()
                assert path.is_socket()
                await mailbox.listen(path)

    run(story)


def test_a_living_socket_of_a_program_that_takes_no_lock_is_refused_too() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(1) as (mailbox,):
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as foreign:
                foreign.bind(str(folder / "g"))
                foreign.listen()
                with pytest.raises(AlreadyRunning, match="no lock"):
                    await mailbox.listen(folder / "g")
            await mailbox.listen(folder / "g")

    run(story)


def test_connections_share_the_room_for_what_they_receive() -> None:
    """A longest message fits; connections by the dozen need not each hold room for one."""

    async def story(folder: Path) -> None:
        async with mailboxes(1 + CROWD) as (server, *clients):
            server.serve(LOOP_COMMAND, echo)
            await server.listen(folder / "loop.sock")
            tracemalloc.start()
            try:
                before_bytes, _ = tracemalloc.get_traced_memory()
                for number, client in enumerate(clients):
                    client.connect({LOOP_COMMAND}, folder / "loop.sock")
                    word = str(number).encode()
                    assert await client.request(LOOP_COMMAND, word, 5.0) == word
                held_bytes = tracemalloc.get_traced_memory()[0] - before_bytes
            finally:
                tracemalloc.stop()
            assert held_bytes < MAX_PAYLOAD
            assert await clients[0].request(LOOP_COMMAND, bytes(MAX_PAYLOAD), 5.0) == bytes(MAX_PAYLOAD)

    run(story)

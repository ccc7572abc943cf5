"""The unix mailbox against peers that flood, stall, die or send rubbish: the other side neither waits nor fails."""

import asyncio
import os
import random
import signal
import socket
import time
from pathlib import Path

import pytest

from gateway.core.topics import LOOP_COMMAND, LOOP_TELEMETRY
from gateway.mailbox.codec import MAX_DATAGRAM, Envelope, Kind, decode, encode
from gateway.mailbox.connection import READ_BUDGET
from gateway.mailbox.listener import BACKLOG
from gateway.mailbox.places import MAX_IN_FLIGHT
from gateway.mailbox.port import RemoteError, Unreachable
from gateway.mailbox.turns import LONG_PER_WINDOW, MAX_PER_WINDOW, WINDOW_S
from gateway.mailbox.unix import UnixMailbox
from tests.unit.supervisor_support import child, frame_of, until
from tests.unit.test_mailbox_unix import LISTEN, echo, mailboxes, run

pytestmark = pytest.mark.wires

LONGEST_CALL_S = 1.0  # a blocked call would take for ever; a busy test machine may take its time


def _longest_publish_s(mailbox: UnixMailbox, payload: bytes, count: int) -> tuple[float, int]:
    longest_s, taken = 0.0, 0
    for _ in range(count):
        began_s = time.perf_counter()
        taken += mailbox.publish(LOOP_TELEMETRY, payload)
        longest_s = max(longest_s, time.perf_counter() - began_s)
    return longest_s, taken


def test_a_stopped_reader_costs_dropped_messages_and_no_time() -> None:
    async def story(folder: Path) -> None:
        with child(LISTEN, folder / "g") as (reader, said):
            assert said == "listening\n"
            async with mailboxes(1) as (loop,):
                loop.connect({LOOP_TELEMETRY}, folder / "g")
                assert loop.publish(LOOP_TELEMETRY, b"before")
                reader.send_signal(signal.SIGSTOP)
                longest_s, taken = _longest_publish_s(loop, frame_of(1, 1.0), 5000)
                assert 100 < taken < 2000  # bounded, and some seconds' worth
                assert loop.counters.dropped == 5000 - taken
                assert longest_s < LONGEST_CALL_S
                reader.send_signal(signal.SIGCONT)
                await until(lambda: loop.publish(LOOP_TELEMETRY, b"again"))
                assert loop.counters.connects == 1
                reader.kill()
                reader.wait()
                await until(lambda: not loop.publish(LOOP_TELEMETRY, b"dead"))

    run(story)


def test_a_listener_that_never_accepts_blocks_neither_publisher_nor_request() -> None:
    async def story(folder: Path) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stuck:
            stuck.bind(str(folder / "g"))
            stuck.listen(0)
            crowd = [UnixMailbox() for _ in range(3)]
            try:
                results = []
                for mailbox in crowd:
                    mailbox.connect({LOOP_TELEMETRY, LOOP_COMMAND}, folder / "g")
                    longest_s, taken = _longest_publish_s(mailbox, b"x", 10)
                    assert longest_s < LONGEST_CALL_S
                    results.append(taken)
                assert results[0] == 10  # waits in the backlog, and its messages with it
                assert results[-1] == 0  # the backlog is full
                with pytest.raises(Unreachable, match="stuck"):
                    await crowd[-1].request(LOOP_COMMAND, b"", 5.0)
            finally:
                for mailbox in crowd:
                    await mailbox.close()

    run(story)


def test_a_request_to_a_peer_that_has_stopped_reading_fails_at_once() -> None:
    async def story(folder: Path) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stuck:
            stuck.bind(str(folder / "g"))
            stuck.listen(BACKLOG)
            async with mailboxes(1) as (asking,):
                asking.connect({LOOP_TELEMETRY, LOOP_COMMAND}, folder / "g")
                while asking.publish(LOOP_TELEMETRY, bytes(1000)):
                    pass
                began_s = time.perf_counter()
                with pytest.raises(Unreachable, match="stopped reading"):
                    await asking.request(LOOP_COMMAND, bytes(1000), 60.0)
                assert time.perf_counter() - began_s < 1.0

    run(story)


def test_rubbish_is_counted_and_the_next_message_understood() -> None:
    async def story(folder: Path) -> None:
        rng = random.Random(7)
        async with mailboxes(1) as (gateway,):
            heard: asyncio.Queue[bytes] = asyncio.Queue()
            gateway.subscribe(LOOP_TELEMETRY, heard.put_nowait)
            await gateway.listen(folder / "g")
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as peer:
                peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4 * MAX_DATAGRAM)
                peer.setblocking(False)
                peer.connect(str(folder / "g"))
                good = encode(Envelope(Kind.PUBLISH, LOOP_TELEMETRY.name, 0, b"good"))
                bad = [bytes([9]) + rng.randbytes(rng.randrange(300)) for _ in range(50)]
                bad += [good[:k] for k in range(1, 11)]
                bad += [good[:11] + b"\xff" * 14, good + bytes(MAX_DATAGRAM)]
                for datagram in bad:
                    await asyncio.get_running_loop().sock_sendall(peer, datagram)
                await asyncio.get_running_loop().sock_sendall(peer, good)
                assert await heard.get() == b"good"
                assert gateway.counters.malformed == len(bad)
                assert f"process {os.getpid()}" in gateway.counters.last_error

    run(story)


FLOOD = """
import socket, sys
from gateway.mailbox.codec import Envelope, Kind, encode
peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
peer.connect(sys.argv[1])
request = encode(Envelope(Kind.REQUEST, "loop/command", 1, b"x"))
print("flooding", flush=True)
while True:
    peer.send(request)
"""


def test_a_flood_of_requests_leaves_the_others_and_the_event_loop_alive() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (asking, serving):
            serving.serve(LOOP_COMMAND, echo)
            await serving.listen(folder / "l")
            with child(FLOOD, folder / "l") as (_, said):
                assert said == "flooding\n"
                # Its answers, which it never reads, fill its buffer first.
                await until(lambda: serving.counters.dropped > 0)
                asking.connect({LOOP_COMMAND}, folder / "l")
                lags_s = []
                began_s = time.perf_counter()
                for k in range(100):
                    assert await asking.request(LOOP_COMMAND, b"%d" % k, 5.0) == b"%d" % k
                    due_s = time.perf_counter() + 0.005
                    await asyncio.sleep(0.005)
                    lags_s.append(time.perf_counter() - due_s)
                assert time.perf_counter() - began_s < 5.0
                assert sorted(lags_s)[50] < 0.05

    run(story)


def test_what_waits_is_read_a_few_at_a_time_so_that_others_have_their_turn() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (loop, gateway):
            in_this_turn, most = 0, 0
            heard = 0

            def hear(_: bytes) -> None:
                nonlocal in_this_turn, most, heard
                heard, in_this_turn = heard + 1, in_this_turn + 1
                most = max(most, in_this_turn)

            gateway.subscribe(LOOP_TELEMETRY, hear)
            await gateway.listen(folder / "g")
            loop.connect({LOOP_TELEMETRY}, folder / "g")
            for _ in range(100):
                assert loop.publish(LOOP_TELEMETRY, b"x")
            while heard < 100:  # noqa: ASYNC110 - counts the turns of the event loop
                in_this_turn = 0
                await asyncio.sleep(0)
            assert most == READ_BUDGET

    run(story)


def test_a_peer_is_read_at_most_so_often_and_loses_only_its_own_messages() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (loop, gateway):
            heard: list[bytes] = []
            gateway.subscribe(LOOP_TELEMETRY, heard.append)
            await gateway.listen(folder / "g")
            loop.connect({LOOP_TELEMETRY}, folder / "g")
            began_s = time.perf_counter()
            while loop.counters.dropped < 1000:
                loop.publish(LOOP_TELEMETRY, b"x")
                await asyncio.sleep(0)
            windows = (time.perf_counter() - began_s) / WINDOW_S + 2
            assert len(heard) <= MAX_PER_WINDOW * windows
            before = len(heard)
            await until(lambda: len(heard) > before)  # and is read again

    run(story)


LONG_FLOOD = """
import socket, sys
from gateway.mailbox.codec import Envelope, Kind, encode
longest = encode(Envelope(Kind.PUBLISH, "loop/telemetry", 0, bytes(262_144)))
peers = [socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(8)]
for peer in peers:
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 300_000)
    peer.connect(sys.argv[1])
    peer.setblocking(False)
print("flooding", flush=True)
while True:
    for peer in peers:
        try:
            peer.send(longest)
        except BlockingIOError:
            pass
"""


def test_the_longest_messages_of_many_are_read_so_many_bytes_at_a_time_and_a_short_one_is_answered_beside_them() -> (
    None
):
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (asking, serving):
            heard: list[int] = []
            serving.subscribe(LOOP_TELEMETRY, lambda payload: heard.append(len(payload)))
            serving.serve(LOOP_COMMAND, echo)
            await serving.listen(folder / "l")
            asking.connect({LOOP_COMMAND}, folder / "l")
            with child(LONG_FLOOD, folder / "l") as (_, said):
                assert said == "flooding\n"
                began_s = time.perf_counter()
                while len(heard) < 12:
                    assert await asking.request(LOOP_COMMAND, b"stop", 5.0) == b"stop"
                windows = (time.perf_counter() - began_s) / WINDOW_S + 2
                assert sum(heard) <= LONG_PER_WINDOW * windows

    run(story)


def test_an_answer_that_comes_twice_is_taken_once() -> None:
    async def story(folder: Path) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listening:
            listening.bind(str(folder / "l"))
            listening.listen()
            async with mailboxes(1) as (asking,):
                asking.connect({LOOP_COMMAND}, folder / "l")
                assert not asking.publish(LOOP_TELEMETRY, b"")
                asking.connect({LOOP_TELEMETRY}, folder / "l")
                assert asking.publish(LOOP_TELEMETRY, b"")
                serving, _ = listening.accept()
                assert decode(serving.recv(MAX_DATAGRAM)).kind is Kind.PUBLISH
                for payload in (b"first", b"second"):
                    waiting = asyncio.create_task(asking.request(LOOP_COMMAND, payload, 5.0))
                    await asyncio.sleep(0)
                    asked = decode(serving.recv(MAX_DATAGRAM))
                    for _ in range(3):
                        serving.send(encode(asked._replace(kind=Kind.ANSWER)))
                    assert await waiting == payload
                await until(lambda: asking.counters.late_answers == 4)
                serving.close()

    run(story)


def test_too_many_requests_at_once_are_refused_with_a_word() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (asking, serving):
            done = asyncio.Event()

            async def answer(payload: bytes) -> bytes:
                await done.wait()
                return payload

            serving.serve(LOOP_COMMAND, answer)
            await serving.listen(folder / "l")
            asking.connect({LOOP_COMMAND}, folder / "l")
            payloads = [b"%d" % k for k in range(MAX_IN_FLIGHT + 1)]
            asked = [asyncio.create_task(asking.request(LOOP_COMMAND, payload, 5.0)) for payload in payloads]
            with pytest.raises(RemoteError, match="at once"):
                await asked[-1]
            done.set()
            assert await asyncio.gather(*asked[:-1]) == payloads[:-1]
            assert await asking.request(LOOP_COMMAND, b"again", 5.0) == b"again"
            assert serving.counters.refused == 1

    run(story)


def test_a_peer_that_dies_with_questions_open_leaves_the_server_whole() -> None:
    async def story(folder: Path) -> None:
        async with mailboxes(2) as (asking, serving):
            gone = asyncio.Event()
            answered: asyncio.Queue[bytes] = asyncio.Queue()

            async def answer(payload: bytes) -> bytes:
                if payload == b"dying":
                    await gone.wait()
                answered.put_nowait(payload)
                return payload

            serving.serve(LOOP_COMMAND, answer)
            await serving.listen(folder / "l")
            dying = UnixMailbox()
            dying.connect({LOOP_COMMAND}, folder / "l")
            task = asyncio.create_task(dying.request(LOOP_COMMAND, b"dying", 5.0))
            asking.connect({LOOP_COMMAND}, folder / "l")
            assert await asking.request(LOOP_COMMAND, b"first", 5.0) == b"first"
            await dying.close()
            with pytest.raises(Unreachable):
                await task
            assert await asking.request(LOOP_COMMAND, b"second", 5.0) == b"second"
            gone.set()
            assert [await answered.get() for _ in range(3)] == [b"first", b"second", b"dying"]
            assert await asking.request(LOOP_COMMAND, b"third", 5.0) == b"third"

    run(story)

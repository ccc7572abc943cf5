"""The event loop in virtual time: it jumps, it waits for sockets and threads, and it says so when it cannot go on."""

import asyncio
import socket
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support import virtual_time
from tests.support.virtual_time import START_S, TimeStuck, VirtualTimeLoop


def run(story):
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(story)


def now_s():
    return asyncio.get_running_loop().time()


async def ticker(times):
    while True:
        await asyncio.sleep(0.001)
        times.append(now_s())


async def echo(reader, writer):
    while data := await reader.read(100):
        writer.write(data)
    writer.close()


class EchoUdp(asyncio.DatagramProtocol):
    def connection_made(self, transport):
        self.transport = transport

    def datagram_received(self, data, addr):
        self.transport.sendto(data, addr)


def test_half_an_hour_passes_at_once_and_many_small_jumps_are_one_large_one():
    async def story():
        await asyncio.sleep(1800.0)
        for _ in range(1000):
            await asyncio.sleep(0.001)
        return now_s()

    assert run(story()) == START_S + 1801.0


@settings(max_examples=30)
@given(
    st.lists(
        st.tuples(st.floats(-1.0, 60.0), st.booleans(), st.floats(0.0, 60.0)), min_size=1, max_size=12
    )
)  # fmt: skip
def test_timers_act_at_their_times_in_their_order_and_time_never_runs_backwards(timers):
    async def story():
        loop, acted = asyncio.get_running_loop(), []
        for delay_s, cancelled, further_s in timers:

            def act(when_s, further_s):
                acted.append((when_s, loop.time()))
                due_s = loop.time() + further_s
                loop.call_at(due_s, lambda: acted.append((due_s, loop.time())))

            handle = loop.call_at(START_S + delay_s, act, START_S + delay_s, further_s)
            if cancelled:
                handle.cancel()
        await asyncio.sleep(130.0)
        return acted

    acted = run(story())
    assert len(acted) == 2 * sum(not cancelled for _, cancelled, _ in timers)
    for due_s, acted_s in acted:
        assert abs(acted_s - max(due_s, START_S)) <= 2e-9 * len(timers)
    assert [acted_s for _, acted_s in acted] == sorted(acted_s for _, acted_s in acted)


def test_who_waits_for_a_time_just_ahead_gets_there():
    async def story():
        due_s = now_s() + 2e-10
        while now_s() < due_s:  # noqa: ASYNC110 (as devices do that wait for a time)
            await asyncio.sleep(due_s - now_s())
        return now_s()

    assert run(story()) == START_S + 1e-9


def test_what_was_sent_has_arrived_before_time_goes_on():
    """Over TCP, against a timer that is always due next."""

    async def story():
        times = []
        asyncio.create_task(ticker(times))  # noqa: RUF006 (the runner cancels it)
        server = await asyncio.start_server(echo, "127.0.0.1", 0)
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        for k in range(300):
            writer.write(bytes([k % 256]))
            assert await reader.readexactly(1) == bytes([k % 256])
        writer.close()
        server.close()
        await writer.wait_closed()
        return times

    assert run(story()) == []


def test_time_stands_still_while_a_thread_talks_with_the_loop():
    async def story():
        times = []
        asyncio.create_task(ticker(times))  # noqa: RUF006
        transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(EchoUdp, ("127.0.0.1", 0))
        address = transport.get_extra_info("sockname")

        def talk():
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
                client.settimeout(10.0)
                for k in range(50):
                    client.sendto(bytes([k]), address)
                    assert client.recv(1) == bytes([k])

        await asyncio.gather(asyncio.to_thread(talk), asyncio.to_thread(talk))
        during = len(times)
        transport.close()
        await asyncio.sleep(0.0105)
        return during, len(times)

    assert run(story()) == (0, 10)


def test_time_waits_for_a_thread_whose_task_was_cancelled():
    async def story():
        entered, release, finished = threading.Event(), threading.Event(), []

        def work():
            entered.set()
            release.wait(10.0)
            finished.append(True)

        task = asyncio.create_task(asyncio.to_thread(work))
        await asyncio.to_thread(entered.wait, 10.0)
        task.cancel()
        asyncio.get_running_loop().call_soon(release.set)
        await asyncio.sleep(0.001)
        return finished, task.cancelled()

    assert run(story()) == ([True], True)


def test_a_deadlock_names_who_waits_and_where():
    async def nobody_calls_back():
        await asyncio.get_running_loop().create_future()

    async def story():
        task = asyncio.create_task(nobody_calls_back(), name="the forgotten one")
        await asyncio.sleep(1.0)
        await task

    with pytest.raises(
        TimeStuck, match=r"no timer is set.*the forgotten one \(.*nobody_calls_back\) at .*test_virtual"
    ):
        run(story())


def test_what_is_busy_for_ever_or_ticks_for_ever_is_stopped(monkeypatch):
    async def spin():
        while True:  # noqa: ASYNC110 (that is the point)
            await asyncio.sleep(0)

    monkeypatch.setattr(virtual_time, "MOST_POLLS_AT_ONE_INSTANT", 1000)
    with pytest.raises(TimeStuck, match="busy for ever.*spin"):
        run(spin())
    monkeypatch.setattr(virtual_time, "LONGEST_RUN_S", 1.0)
    with pytest.raises(TimeStuck, match="have passed.*ticker"):
        run(ticker([]))

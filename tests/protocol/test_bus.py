"""The agents' bus over the unix socket: real sessions, in this process and in others that are killed and stopped."""

import asyncio
import os
import signal
from pathlib import Path

import pytest
import zenoh

from gateway.core.topics import ASK_JUDGE, Topic
from gateway.mailbox.bus import BusUnavailable, connect, open_router
from gateway.mailbox.paths import BUS_SOCKET
from gateway.mailbox.port import RemoteError, Unreachable
from tests.protocol.bus_support import (
    AGENT,
    DECIDE,
    LINE,
    LONG_S,
    STATUS,
    client,
    echo,
    is_here,
    never,
    opened,
    router,
    run,
    session_of,
    unguarded,
)
from tests.unit.supervisor_support import child, line_of, until

pytestmark = pytest.mark.wires


def test_agents_ask_the_gateway_and_the_phases_ask_agents() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents, client(folder) as phases:
            gateway.serve(STATUS, echo)
            agents.serve(DECIDE, echo)
            await is_here(phases, DECIDE)
            assert await agents.request(STATUS, b"1", LONG_S) == b"echo 1"
            assert await phases.request(DECIDE, b"2", LONG_S) == b"echo 2"
            assert await gateway.request(DECIDE, b"", LONG_S) == b"echo "
            assert (folder / BUS_SOCKET).stat().st_mode & 0o777 == 0o600

    run(story)


def test_what_nobody_serves_is_said_at_once_with_what_to_start() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents:
            with pytest.raises(Unreachable, match="start it with `r2rgate agents"):
                await gateway.request(DECIDE, b"", LONG_S)
            with pytest.raises(Unreachable, match="start it with `r2rgate gateway"):
                await agents.request(STATUS, b"", LONG_S)

    run(story)


def test_a_handler_that_fails_is_told_to_who_asks_and_one_that_is_slow_is_given_up() -> None:
    async def fail(_: bytes) -> bytes:
        raise ValueError("no such thing")

    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents:
            gateway.serve(STATUS, fail)
            gateway.serve(ASK_JUDGE.of("sysid"), never)
            with pytest.raises(RemoteError, match="ask/sysid/status failed: ValueError: no such thing"):
                await agents.request(STATUS, b"", LONG_S)
            assert gateway.counters.handler_errors == 1
            with pytest.raises(Unreachable, match="did not answer within 0.05 s"):
                await agents.request(ASK_JUDGE.of("sysid"), b"", 0.05)
            with pytest.raises(ValueError, match="is served already"):
                gateway.serve(STATUS, echo)

    run(story)


def test_two_lines_on_one_router_never_meet() -> None:
    async def story(folder: Path) -> None:
        hall = await opened(unguarded(folder))
        one, other = await connect(folder, "demo", "line-1"), await connect(folder, "demo", "line-2")
        asking = await connect(folder, "demo", "line-2")
        heard: list[bytes] = []
        topic = Topic("news", "publish", "1/s", kept=False)
        try:
            one.serve(DECIDE, echo)
            one.subscribe(topic, heard.append)
            await is_here(hall, DECIDE)
            with pytest.raises(Unreachable, match="nobody answers"):
                await asking.request(DECIDE, b"", LONG_S)
            other.serve(DECIDE, never)
            assert await hall.request(DECIDE, b"1", LONG_S) == b"echo 1"
            assert not other.publish(topic, b"of line 2")
            await until(lambda: hall.publish(topic, b"of line 1"))
            await until(lambda: bool(heard))
            assert set(heard) == {b"of line 1"}
        finally:
            for mailbox in (asking, other, one, hall):
                await mailbox.close()

    run(story)


def test_a_router_lets_only_its_own_line_in() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder, line="line-2") as stranger, client(folder) as agents:
            gateway.serve(STATUS, echo)
            stranger.serve(DECIDE, never)
            agents.serve(DECIDE, echo)
            await is_here(gateway, DECIDE)
            with pytest.raises(Unreachable, match="nobody answers"):
                await stranger.request(STATUS, b"", LONG_S)
            assert await gateway.request(DECIDE, b"", LONG_S) == b"echo "

    run(story)


def test_an_agent_that_is_killed_ends_what_waits_for_it_and_is_gone_and_the_next_is_found() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway:
            here: list[bool] = []
            gateway.watch(DECIDE, here.append)
            for life in range(2):
                with child(AGENT, folder) as (process, said):
                    assert said == "up\n"
                    await until(lambda: here[-1:] == [True])
                    assert await gateway.request(DECIDE, b"a", LONG_S) == b"chosen: a"
                    waiting = asyncio.create_task(gateway.request(DECIDE, b"sleep", 1000.0))
                    assert process.stdout is not None
                    assert await asyncio.to_thread(process.stdout.readline) == "asleep\n"
                    process.kill()
                    with pytest.raises(Unreachable):  # within the test's own time, not a thousand seconds
                        await waiting
                    with pytest.raises(Unreachable):  # that it has died may be known here, or only be on its way
                        await gateway.request(DECIDE, b"a", 1000.0)
                    await until(lambda: here[-1:] == [False])
                assert here == [True, False] * (life + 1)

    run(story)


def test_an_agent_that_is_stopped_costs_the_time_of_a_request_then_is_gone_and_comes_again_by_itself() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway:
            here: list[bool] = []
            gateway.watch(DECIDE, here.append)
            with child(AGENT, folder) as (process, _):
                await until(lambda: here == [True])
                os.kill(process.pid, signal.SIGSTOP)
                with pytest.raises(Unreachable, match="did not answer within 0.2 s"):
                    await gateway.request(DECIDE, b"a", 0.2)
                with pytest.raises(Unreachable, match="went away|nobody answers"):
                    await gateway.request(DECIDE, b"a", 1000.0)
                await until(lambda: here == [True, False])
                os.kill(process.pid, signal.SIGCONT)
                await until(lambda: here == [True, False, True])
                assert await gateway.request(DECIDE, b"a", LONG_S) == b"chosen: a"

    run(story)


def test_when_the_gateway_comes_again_its_agents_are_back_by_themselves() -> None:
    async def story(folder: Path) -> None:
        first = await open_router(LINE, folder)
        async with client(folder) as agents:
            agents.serve(DECIDE, echo)
            await is_here(first, DECIDE)
            await first.close()
            async with router(folder) as second:
                await is_here(second, DECIDE)
                second.serve(STATUS, echo)
                assert await second.request(DECIDE, b"2", LONG_S) == b"echo 2"
                assert await agents.request(STATUS, b"3", LONG_S) == b"echo 3"

    run(story)


def test_a_request_ends_with_the_token_of_who_serves_even_where_zenoh_still_waits() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents:
            session, key = session_of(agents), f"demo/line-1/{DECIDE.name}"
            asked: list[zenoh.Query] = []
            served = session.declare_queryable(key, zenoh.handlers.Callback(asked.append, indirect=False))
            token = session.liveliness().declare_token(key)
            await is_here(gateway, DECIDE)
            waiting = asyncio.create_task(gateway.request(DECIDE, b"", 1000.0))
            await until(lambda: bool(asked))
            await asyncio.to_thread(token.undeclare)
            with pytest.raises(Unreachable, match="went away before there was an answer"):
                await waiting
            await asyncio.to_thread(asked[0].drop)
            await asyncio.to_thread(served.undeclare)

    run(story)


def test_closing_ends_what_waits_on_either_side_and_may_be_done_twice() -> None:
    async def story(folder: Path) -> None:
        gateway = await open_router(LINE, folder)
        begun = asyncio.Event()

        async def hang(_: bytes) -> bytes:
            begun.set()
            return await never(b"")

        async with client(folder) as agents:
            gateway.serve(STATUS, hang)
            agents.serve(DECIDE, never)
            await is_here(gateway, DECIDE)
            theirs = asyncio.create_task(agents.request(STATUS, b"", 1000.0))
            ours = asyncio.create_task(gateway.request(DECIDE, b"", 1000.0))
            await begun.wait()
            await gateway.close()
            await gateway.close()
            for waiting in (theirs, ours):
                with pytest.raises(Unreachable):
                    await waiting
            with pytest.raises(Unreachable, match="has left the bus"):
                await gateway.request(DECIDE, b"", 1.0)
        assert not (folder / BUS_SOCKET).exists()

    run(story)


def test_a_bus_that_cannot_be_is_refused_with_the_reason() -> None:
    async def story(folder: Path) -> None:
        with pytest.raises(BusUnavailable, match="no gateway on .*start it with `r2rgate gateway"):
            await connect(folder, "demo", "line-1")
        with pytest.raises(BusUnavailable, match="cannot be opened on .*no-folder"):
            await open_router(LINE, folder / "no-folder")
        with pytest.raises(BusUnavailable, match="choose a shorter run folder"):
            await open_router(LINE, folder / ("x" * 100))
        with pytest.raises(BusUnavailable, match="has # in it: choose another"):
            await open_router(LINE, folder / "a#b")
        async with router(folder):
            with pytest.raises(BusUnavailable, match="cannot be opened on") as refused:
                await open_router(line_of(2), folder)
            assert ".rs" not in str(refused.value)

    run(story)

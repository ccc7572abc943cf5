"""The agents' bus over the unix socket: real sessions, in this process and in others that are killed and stopped."""

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.core.topics import AGENT_DECIDE, ASK_JUDGE, ASK_PROPOSE, ASK_STATUS, Topic
from gateway.mailbox.bus import BusUnavailable, client_settings, connect, open_router, router_settings
from gateway.mailbox.paths import BUS_SOCKET
from gateway.mailbox.port import MAX_PAYLOAD, RemoteError, Unreachable
from gateway.mailbox.zenoh_bridge import MOST_WAITING
from gateway.mailbox.zenoh_served import MAX_IN_FLIGHT
from tests.protocol.bus_support import AGENT, LINE, client, is_here, opened, router, run
from tests.unit.supervisor_support import child, line_of, short_folder, until

DECIDE = AGENT_DECIDE.of("sysid")
STATUS = ASK_STATUS.of("sysid")
LONG_S = 30.0  #: that a test would notice, had it to wait for it


async def echo(payload: bytes) -> bytes:
    return b"echo " + payload


async def never(_: bytes) -> bytes:
    await asyncio.sleep(1000.0)
    return b""


def unguarded(folder: Path, **changes: Any) -> dict[str, Any]:
    """A router without access rules, for what the mailbox itself promises."""
    settings = router_settings(LINE, folder / BUS_SOCKET) | changes
    return {key: value for key, value in settings.items() if key not in ("access_control", "low_pass_filter")}


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


def test_a_flood_of_messages_and_of_requests_is_turned_away_and_the_gateway_answers_others() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as flooding, client(folder) as calm:
            heard: list[bytes] = []
            gateway.serve(STATUS, echo)
            gateway.serve(ASK_STATUS.of("monitoring"), echo)
            topic = Topic("ask/sysid/status", "publish", "1/s", kept=False)
            gateway.subscribe(topic, heard.append)
            for _ in range(10_000):  # no row of the table is published: not one comes through
                flooding.publish(topic, b"x" * 100)
            asked = [flooding.request(STATUS, b"", LONG_S) for _ in range(500)]
            answers = asyncio.gather(*asked, return_exceptions=True)
            assert await calm.request(ASK_STATUS.of("monitoring"), b"", LONG_S) == b"echo "
            found = await answers
            refused = [one for one in found if isinstance(one, RemoteError)]
            assert len(refused) + sum(one == b"echo " for one in found) == len(found)
            assert len(refused) == gateway.counters.refused > 0
            assert "ask again later" in str(refused[-1]) or "at once" in str(refused[-1])
            assert heard == []

    run(story)


def test_a_subscriber_that_does_not_keep_up_loses_messages_which_are_counted_and_the_order_stays() -> None:
    async def story(folder: Path) -> None:
        hall, flooding = await opened(unguarded(folder)), await connect(folder, "demo", "line-1")
        heard: list[int] = []
        topic = Topic("news", "publish", "1/s", kept=False)
        try:
            hall.subscribe(topic, lambda payload: heard.append(int(payload)))
            await until(lambda: flooding.publish(topic, b"-1"))
            told = 0
            while hall.counters.dropped == 0:  # this event loop does not turn meanwhile
                flooding.publish(topic, b"%d" % told)
                told += 1
            assert told > MOST_WAITING
            await until(lambda: flooding.publish(topic, b"%d" % told) and heard[-1:] == [told])
            assert heard == sorted(heard)
            assert len(set(heard)) < told
        finally:
            await flooding.close()
            await hall.close()

    run(story)


def test_no_more_requests_than_allowed_are_answered_at_once() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents:
            topic = Topic(STATUS.name, "request", "", kept=False)  # without a rate
            gateway.serve(topic, never)
            asked = [asyncio.create_task(agents.request(topic, b"", LONG_S)) for _ in range(MAX_IN_FLIGHT + 2)]
            done: set[asyncio.Task[bytes]] = set()
            while len(done) < 2:
                done, _ = await asyncio.wait(asked, return_when=asyncio.FIRST_COMPLETED, timeout=0.01)
            assert all(f"more than {MAX_IN_FLIGHT} requests at once" in str(one.exception()) for one in done)
            assert gateway.counters.refused == len(done) == 2
            for one in asked:
                one.cancel()
            await asyncio.gather(*asked, return_exceptions=True)

    run(story)


def test_what_is_too_long_is_refused_on_either_side() -> None:
    async def long(payload: bytes) -> bytes:
        return payload + b"x"

    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents:
            gateway.serve(STATUS, long)
            whole = await agents.request(STATUS, bytes(MAX_PAYLOAD - 1), LONG_S)
            assert len(whole) == MAX_PAYLOAD
            with pytest.raises(RemoteError, match=f"answer of {MAX_PAYLOAD + 1} bytes"):
                await agents.request(STATUS, bytes(MAX_PAYLOAD), LONG_S)
            with pytest.raises(RemoteError, match=f"{MAX_PAYLOAD + 1} bytes of payload"):
                await agents.request(STATUS, bytes(MAX_PAYLOAD + 1), LONG_S)
            assert not agents.publish(Topic("news", "publish", "", kept=False), bytes(MAX_PAYLOAD + 1))

    run(story)


def test_whoever_has_no_limit_of_its_own_meets_that_of_the_router() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway:
            came: list[bytes] = []

            async def note(payload: bytes) -> bytes:
                came.append(payload)
                return b""

            gateway.serve(STATUS, note)
            hostile = await opened(client_settings(f"unixsock-stream/{folder / BUS_SOCKET}"))
            try:
                session = hostile._session  # noqa: SLF001
                for length in (MAX_PAYLOAD + 1, 64 * MAX_PAYLOAD):
                    key = f"demo/line-1/{STATUS.name}"
                    replies = await asyncio.to_thread(
                        lambda length=length, key=key: list(session.get(key, payload=bytes(length), timeout=0.2))
                    )
                    assert all(reply.ok is None for reply in replies)
                assert came == []
                assert await hostile.request(STATUS, b"1", LONG_S) == b""
            finally:
                await hostile.close()

    run(story)


@pytest.mark.parametrize("key", ["demo/line-1/ask/*/propose", "demo/line-1/ask/sysid/*", "**"])
def test_a_question_for_several_agents_at_once_reaches_nobody(key: str) -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents:
            came: list[bytes] = []

            async def note(payload: bytes) -> bytes:
                came.append(payload)
                return b""

            for topic in (ASK_PROPOSE.of("sysid"), ASK_PROPOSE.of("adaptation"), STATUS):
                gateway.serve(topic, note)
            session = agents._session  # noqa: SLF001
            replies = await asyncio.to_thread(lambda: list(session.get(key, payload=b"x", timeout=LONG_S)))
            assert all(reply.ok is None for reply in replies)
            assert came == []

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


NAME = st.from_regex(r"[a-z0-9]([a-z0-9-]{0,30}[a-z0-9])?", fullmatch=True)
PART = st.from_regex(r"[a-z][a-z0-9-]{0,11}", fullmatch=True)


def test_any_topic_and_payload_comes_through_as_it_was() -> None:
    with short_folder() as folder:
        with asyncio.Runner() as runner:
            hall = runner.run(opened(unguarded(folder)))
            here, there = (runner.run(connect(folder, "demo", "line-1")) for _ in range(2))
            served: set[str] = set()
            heard: list[tuple[str, bytes]] = []

            @settings(max_examples=60)
            @given(st.lists(PART, min_size=1, max_size=3).map("/".join), st.binary(max_size=300), st.booleans())
            def comes_through(name: str, payload: bytes, long: bool) -> None:
                payload = payload * (1000 if long else 1)
                asked = Topic(f"r/{name}", "request", "", kept=False)
                told = Topic(f"p/{name}", "publish", "", kept=False)

                async def there_and_back() -> None:
                    if name not in served:
                        served.add(name)
                        here.serve(asked, echo)
                        here.subscribe(told, lambda payload: heard.append((name, payload)))
                        await is_here(there, asked)
                    if len(payload) <= MAX_PAYLOAD - 5:
                        assert await there.request(asked, payload, LONG_S) == b"echo " + payload
                    heard.clear()
                    if len(payload) <= 60_000:  # longer ones take several buffers and may be dropped
                        await until(lambda: there.publish(told, payload))
                        await until(lambda: bool(heard))
                        assert heard[0] == (name, payload)

                runner.run(there_and_back())

            try:
                comes_through()
            finally:
                for mailbox in (there, here, hall):
                    runner.run(mailbox.close())

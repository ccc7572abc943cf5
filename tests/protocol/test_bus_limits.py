"""How much and how often on the agents' bus: floods, long messages, rates; and that all the rest comes through."""

import asyncio
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.core.topics import ASK_PROPOSE, ASK_STATUS, Topic
from gateway.mailbox.bus import connect
from gateway.mailbox.port import MAX_PAYLOAD, RemoteError
from gateway.mailbox.zenoh_bridge import MOST_WAITING
from gateway.mailbox.zenoh_served import MAX_IN_FLIGHT
from tests.protocol.bus_support import (
    LONG_S,
    STATUS,
    client,
    echo,
    is_here,
    never,
    opened,
    raw_answers,
    router,
    run,
    unguarded,
)
from tests.unit.supervisor_support import short_folder, until

pytestmark = pytest.mark.wires


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
            assert len(set(heard)) < told + 2  # -1 and the last are heard as well
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


@pytest.mark.parametrize("length", [MAX_PAYLOAD + 1, 64 * MAX_PAYLOAD])
def test_whoever_has_no_limit_of_its_own_meets_that_of_the_router(length: int) -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as hostile:
            gateway.serve(STATUS, echo)
            assert "echo" not in "".join(await raw_answers(hostile, f"demo/line-1/{STATUS.name}", bytes(length)))
            assert gateway.counters.refused == 0  # it has not come to the door
            async with client(folder) as agents:
                assert await agents.request(STATUS, b"1", LONG_S) == b"echo 1"

    run(story)


def test_what_the_router_lets_through_meets_the_limit_at_the_door() -> None:
    async def story(folder: Path) -> None:
        hall = await opened(unguarded(folder))
        async with client(folder) as hostile:
            hall.serve(STATUS, echo)
            (said,) = await raw_answers(hostile, f"demo/line-1/{STATUS.name}", bytes(MAX_PAYLOAD + 1))
            assert said == f"{STATUS.name}: {MAX_PAYLOAD + 1} bytes of payload, at most {MAX_PAYLOAD} are allowed"
            assert hall.counters.refused == 1
        await hall.close()

    run(story)


@pytest.mark.parametrize("key", ["demo/line-1/ask/*/propose", "demo/line-1/ask/sysid/*", "**"])
def test_a_question_for_several_agents_at_once_reaches_nobody(key: str) -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents:
            for topic in (ASK_PROPOSE.of("sysid"), ASK_PROPOSE.of("adaptation"), STATUS):
                gateway.serve(topic, echo)
            assert "echo" not in "".join(await raw_answers(agents, key, b"x"))

    run(story)


def test_an_agent_asks_no_oftener_than_the_table_says_and_takes_nothing_from_the_others() -> None:
    async def story(folder: Path) -> None:
        now_s = 0.0
        hall = await opened(unguarded(folder), lambda: now_s)
        async with client(folder) as agents:
            hall.serve(STATUS, echo)
            hall.serve(ASK_STATUS.of("code"), echo)
            for _ in range(round(ASK_STATUS.most_per_s)):
                await agents.request(STATUS, b"", LONG_S)
            with pytest.raises(RemoteError, match="ask/sysid/status: more than 10/s; ask again later"):
                await agents.request(STATUS, b"", LONG_S)
            assert await agents.request(ASK_STATUS.of("code"), b"", LONG_S) == b"echo "
            now_s += 1.01 / ASK_STATUS.most_per_s
            assert await agents.request(STATUS, b"", LONG_S) == b"echo "
            assert hall.counters.refused == 1
        await hall.close()

    run(story)


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


def test_a_place_on_the_bus_is_free_when_the_time_of_its_topic_is_over() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents:
            topic = Topic(STATUS.name, "request", "", kept=False, within_s=0.05)

            async def slow(payload: bytes) -> bytes:
                return await (never(payload) if payload == b"slow" else echo(payload))

            gateway.serve(topic, slow)
            asked = [agents.request(topic, b"slow", LONG_S) for _ in range(MAX_IN_FLIGHT)]
            told = await asyncio.gather(*asked, return_exceptions=True)
            assert all("no answer within 0.05 s" in str(one) for one in told)
            assert await agents.request(topic, b"quick", LONG_S) == b"echo quick"
            assert gateway.counters.handler_errors == MAX_IN_FLIGHT

    run(story)

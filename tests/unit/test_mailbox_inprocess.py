import asyncio

import pytest

from gateway.core.topics import GATEWAY_STATUS, LOOP_COMMAND, LOOP_TELEMETRY
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.port import MAX_PAYLOAD, RemoteError, Unreachable


def _two() -> tuple[InProcessMailbox, InProcessMailbox]:
    hub = Hub()
    return InProcessMailbox(hub), InProcessMailbox(hub)


def test_publish_calls_every_subscriber_before_it_returns() -> None:
    one, two = _two()
    heard: list[tuple[str, bytes]] = []
    two.subscribe(LOOP_TELEMETRY, lambda payload: heard.append(("a", payload)))
    two.subscribe(LOOP_TELEMETRY, lambda payload: heard.append(("b", payload)))
    assert one.publish(LOOP_TELEMETRY, b"x")
    assert heard == [("a", b"x"), ("b", b"x")]


def test_publish_without_a_listener_or_too_long_is_dropped_and_counted() -> None:
    one, two = _two()
    assert not one.publish(LOOP_TELEMETRY, b"x")
    heard: list[bytes] = []
    two.subscribe(LOOP_TELEMETRY, heard.append)
    assert not one.publish(LOOP_TELEMETRY, bytes(MAX_PAYLOAD + 1))
    assert one.publish(LOOP_TELEMETRY, bytes(MAX_PAYLOAD))
    assert (one.counters.dropped, len(heard)) == (2, 1)


def test_a_subscriber_that_raises_does_not_reach_the_publisher_nor_the_next() -> None:
    one, two = _two()
    heard: list[bytes] = []

    def fail(_: bytes) -> None:
        raise KeyError("broken")

    two.subscribe(LOOP_TELEMETRY, fail)
    two.subscribe(LOOP_TELEMETRY, heard.append)
    assert one.publish(LOOP_TELEMETRY, b"x")
    assert heard == [b"x"]
    assert one.counters.handler_errors == 1
    assert "KeyError" in one.counters.last_error


def test_request_answer_error_timeout_and_nobody_there() -> None:
    async def story() -> None:
        one, two = _two()

        async def answer(payload: bytes) -> bytes:
            if payload == b"fail":
                raise ValueError("no such span")
            if payload == b"hang":
                await asyncio.Event().wait()
            if payload == b"long":
                return bytes(MAX_PAYLOAD + 1)
            return payload[::-1]

        two.serve(LOOP_COMMAND, answer)
        assert await one.request(LOOP_COMMAND, b"abc", 1.0) == b"cba"
        with pytest.raises(RemoteError, match="ValueError: no such span"):
            await one.request(LOOP_COMMAND, b"fail", 1.0)
        with pytest.raises(Unreachable, match="did not answer"):
            await one.request(LOOP_COMMAND, b"hang", 0.01)
        with pytest.raises(RemoteError, match=f"{MAX_PAYLOAD + 1} bytes"):
            await one.request(LOOP_COMMAND, b"long", 1.0)
        with pytest.raises(RemoteError, match=f"{MAX_PAYLOAD + 1} bytes"):
            await one.request(LOOP_COMMAND, bytes(MAX_PAYLOAD + 1), 1.0)
        with pytest.raises(Unreachable, match="r2rgate gateway"):
            await one.request(GATEWAY_STATUS, b"", 1.0)
        with pytest.raises(ValueError, match="served already"):
            one.serve(LOOP_COMMAND, answer)

    asyncio.run(story())


def test_who_has_left_hears_and_answers_nothing() -> None:
    async def story() -> None:
        one, two = _two()
        heard: list[bytes] = []

        async def answer(payload: bytes) -> bytes:
            return payload

        two.subscribe(LOOP_TELEMETRY, heard.append)
        two.serve(LOOP_COMMAND, answer)
        await two.close()
        await two.close()
        assert not one.publish(LOOP_TELEMETRY, b"x")
        assert heard == []
        with pytest.raises(Unreachable):
            await one.request(LOOP_COMMAND, b"", 1.0)

    asyncio.run(story())

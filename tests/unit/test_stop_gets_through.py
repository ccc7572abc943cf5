"""Stop and hold have places and time of their own on every hop: whatever else hangs, they are answered, or told of."""

import asyncio
import threading
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import Any

import httpx
import pytest

from gateway.core.audit_record import Who
from gateway.core.line_past import RecordsAfter, TensionsBetween
from gateway.core.messages import Arm, Hold, Reply, Stop
from gateway.core.people import ForPerson, Person, Said
from gateway.core.states import LoopState, Phase
from gateway.core.topics import (
    AGENT_TOPICS,
    GATEWAY_COMMAND,
    GATEWAY_FOR_PERSON,
    GATEWAY_PAST,
    GATEWAY_STATUS,
    LOOP_COMMAND,
    SAFE_S,
    TOPICS,
    Topic,
)
from gateway.mailbox import places, unix
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.places import MAX_IN_FLIGHT, MAX_SAFE, safe_command
from gateway.mailbox.port import RemoteError, Unreachable
from gateway.mailbox.unix import UnixMailbox
from gateway.operator import line_side
from gateway.operator.line_side import READ, LineSide, NotTold
from gateway.operator.page import asks, serve
from gateway.operator.page.serve import serve_on
from gateway.supervisor import operated, past
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.past import Past
from gateway.supervisor.persons_desk import PersonsDesk
from tests.unit.page_support import page
from tests.unit.supervisor_support import line_of, short_folder, until
from tests.unit.test_supervisor_process import gateway, heard, loop_and_client

ANNA = Person(name="anna", role="operator", through="page")
LONG_S = 30.0


def of_anna(said: Said) -> bytes:
    return ForPerson(person=ANNA, said=said).model_dump_json().encode()


def run(story: Callable[[Path], Coroutine[Any, Any, None]]) -> None:
    async def bounded(folder: Path) -> None:
        async with asyncio.timeout(60.0):
            await story(folder)

    with short_folder() as folder:
        asyncio.run(bounded(folder))


async def answers(_: bytes) -> bytes:
    return b"answer"


async def never(_: bytes) -> bytes:
    await asyncio.Event().wait()
    return b""


async def with_mailboxes(folder: Path, story: Callable[[UnixMailbox, UnixMailbox], Awaitable[None]]) -> None:
    serving, asking = UnixMailbox(), UnixMailbox()
    try:
        await serving.listen(folder / "g")
        await story(serving, asking)
    finally:
        await asking.close()
        await serving.close()


def test_every_request_has_a_deadline_and_a_stop_the_one_that_is_promised():
    assert all(0.0 < topic.within_s <= 120.0 for topic in TOPICS)
    assert all(0.0 < row.of("sysid").within_s <= 1200.0 for row in AGENT_TOPICS)
    for topic in (LOOP_COMMAND, GATEWAY_COMMAND, GATEWAY_FOR_PERSON):
        said = of_anna(Hold()) if topic is GATEWAY_FOR_PERSON else Stop().model_dump_json().encode()
        assert places.within_s(topic, safe_command(topic.name, said)) == SAFE_S < topic.within_s


@pytest.mark.parametrize(
    ("payload", "found"),
    [
        (b'{"command":"stop"}', "stop"),
        (b'{"command": "hold"}', "hold"),
        (of_anna(Stop()), "stop"),
        (of_anna(Hold()), "hold"),
        (of_anna(Arm()), ""),
        (b'{"command":"start"}', ""),
        (b'{"command":"rollback","reason":"\\"stop\\""}', ""),
        (b'"stop"', ""),
        (b'{"said":"stop","command":["stop"]}', ""),
        (b'{"command":"stop"' + b" " * places.LONGEST_SAFE + b"}", ""),
        (b'{"x":' * 300 + b'"stop"', ""),
    ],
)
def test_what_is_a_stop_or_a_hold_is_seen_before_it_is_understood(payload, found):
    assert safe_command(LOOP_COMMAND.name, payload) == found
    assert safe_command(GATEWAY_PAST.name, payload) == ""


def test_what_hangs_fills_its_own_places_and_neither_those_of_a_stop_nor_of_another_topic():
    async def story(folder: Path) -> None:
        async def person(payload: bytes) -> bytes:
            return await (never(payload) if b"arm" in payload else answers(payload))

        async def meet(serving: UnixMailbox, asking: UnixMailbox) -> None:
            for topic, handler in ((GATEWAY_FOR_PERSON, person), (GATEWAY_PAST, never), (GATEWAY_STATUS, answers)):
                serving.serve(topic, handler)
            asking.connect((GATEWAY_FOR_PERSON, GATEWAY_PAST, GATEWAY_STATUS), folder / "g")
            for topic, payload in ((GATEWAY_FOR_PERSON, of_anna(Arm())), (GATEWAY_PAST, b"")):
                for _ in range(MAX_IN_FLIGHT):
                    with pytest.raises(Unreachable):
                        await asking.request(topic, payload, 0.001)  # each is given up, and hangs on
                with pytest.raises(RemoteError, match="at once"):
                    await asking.request(topic, payload, LONG_S)
            assert await asking.request(GATEWAY_STATUS, b"", LONG_S) == b"answer"
            for said in (Stop(), Hold()):
                assert await asking.request(GATEWAY_FOR_PERSON, of_anna(said), LONG_S) == b"answer"

        await with_mailboxes(folder, meet)

    run(story)


def test_holds_that_wait_leave_the_places_of_a_stop_and_there_is_an_end_to_either(monkeypatch):
    monkeypatch.setattr(places, "SAFE_S", LONG_S)

    async def story(folder: Path) -> None:
        free = asyncio.Event()
        came: list[bytes] = []

        async def command(payload: bytes) -> bytes:
            came.append(payload)
            await free.wait()
            return payload

        async def meet(serving: UnixMailbox, asking: UnixMailbox) -> None:
            serving.serve(LOOP_COMMAND, command)
            asking.connect((LOOP_COMMAND,), folder / "g")
            asked: list[asyncio.Task[bytes]] = []
            for said in (b'{"command":"hold"}', b'{"command":"stop"}'):
                asked += [asyncio.create_task(asking.request(LOOP_COMMAND, said, LONG_S)) for _ in range(MAX_SAFE)]
                await until(lambda: len(came) == len(asked))  # noqa: B023 - it is waited for here
                with pytest.raises(RemoteError, match=f"more than {MAX_SAFE}"):
                    await asking.request(LOOP_COMMAND, said, LONG_S)
            free.set()
            await asyncio.gather(*asked)

        await with_mailboxes(folder, meet)

    run(story)


@pytest.mark.parametrize("acts", [False, True])
def test_a_place_is_free_when_its_time_is_over_what_reads_is_cut_and_what_acts_comes_to_its_end(acts):
    topic = Topic("test/slow", "request", "", kept=False, within_s=0.05, acts=acts)

    async def story(folder: Path) -> None:
        free = asyncio.Event()
        ended: list[str] = []

        async def slow(payload: bytes) -> bytes:
            if payload == b"quick":
                return payload
            try:
                await free.wait()
            except asyncio.CancelledError:
                ended.append("cut")
                raise
            ended.append("done")
            return payload

        async def meet(serving: UnixMailbox, asking: UnixMailbox) -> None:
            serving.serve(topic, slow)
            asking.connect((topic,), folder / "g")
            asked = [asking.request(topic, b"", LONG_S) for _ in range(MAX_IN_FLIGHT)]
            told = await asyncio.gather(*asked, return_exceptions=True)
            assert all("no answer within 0.05 s" in str(one) for one in told)
            assert await asking.request(topic, b"quick", LONG_S) == b"quick"
            assert serving.counters.handler_errors == MAX_IN_FLIGHT  # a fault of a task, as the status tells it
            free.set()
            await until(lambda: len(ended) == MAX_IN_FLIGHT)
            assert set(ended) == {"done" if acts else "cut"}

        await with_mailboxes(folder, meet)

    run(story)


def test_what_acts_and_comes_to_no_end_is_bounded_and_no_stop_by_it(monkeypatch):
    monkeypatch.setattr(unix, "MAX_OVERDUE", 3)
    monkeypatch.setattr(places, "SAFE_S", LONG_S)
    topic = Topic(LOOP_COMMAND.name, "request", "", kept=False, within_s=0.01, acts=True)

    async def story(folder: Path) -> None:
        free = asyncio.Event()

        async def slow(payload: bytes) -> bytes:
            if b"stop" not in payload:
                await free.wait()
            return payload

        async def meet(serving: UnixMailbox, asking: UnixMailbox) -> None:
            serving.serve(topic, slow)
            asking.connect((topic,), folder / "g")
            for _ in range(3):
                with pytest.raises(RemoteError, match="no answer"):
                    await asking.request(topic, b"", LONG_S)
            with pytest.raises(RemoteError, match="have not come to their end"):
                await asking.request(topic, b"", LONG_S)
            stop = b'{"command":"stop"}'
            assert await asking.request(topic, stop, LONG_S) == stop
            free.set()
            await until(lambda: len(serving._answering) == 0)  # noqa: SLF001
            assert await asking.request(topic, b"", LONG_S) == b""

        await with_mailboxes(folder, meet)

    run(story)


@pytest.mark.wires
def test_a_history_that_hangs_blinds_nobody_and_keeps_no_record_from_being_told(monkeypatch):
    hangs = threading.Event()

    class Hangs:
        def __init__(self, _path: Path) -> None:
            hangs.wait()

    monkeypatch.setattr(past, "History", Hangs)
    monkeypatch.setattr(line_side, "ANSWERED_S", 0.01)  # each is given up soon

    async def story(folder: Path) -> None:
        async def meet(serving: UnixMailbox, asking: UnixMailbox) -> None:
            told = Past(line_of(), serving, folder, lambda: folder / "history.sqlite")

            serving.serve(GATEWAY_STATUS, answers)
            asking.connect(READ, folder / "g")
            side = LineSide(asking)
            query = TensionsBetween(from_wall_s=1.0, to_wall_s=60.0, points=600)
            for _ in range(MAX_IN_FLIGHT + 1):
                with pytest.raises(NotTold):
                    await side.tensions(query)
            assert await asking.request(GATEWAY_STATUS, b"", LONG_S) == b"answer"
            # Of the same topic, but another thread; it has its place again when the time of the topic is over.
            other = UnixMailbox()
            other.connect(READ, folder / "g")
            monkeypatch.setattr(line_side, "ANSWERED_S", LONG_S)
            with pytest.raises(NotTold, match="audit"):
                await LineSide(other).records(RecordsAfter(after=None).after)
            hangs.set()
            await other.close()
            await told.close()

        await with_mailboxes(folder, meet)

    run(story)


@pytest.mark.parametrize("said", [Stop(), Hold()])
def test_a_stop_is_answered_while_its_record_waits_and_a_record_that_fails_then_is_told(said, monkeypatch):
    monkeypatch.setattr(operated, "RECORDED_S", 0.01)

    async def story() -> None:
        disk, events, commands = asyncio.Event(), list[str](), list[bytes]()

        async def command(payload: bytes, _: Who) -> Reply:
            commands.append(payload)
            return Reply(ok=True, state="STOP", text="stopping")

        async def note(*_: object) -> None:
            await disk.wait()
            raise AuditUnavailable("the disk is full")

        async def unasked(*_: object) -> Reply:
            raise AssertionError

        hub = Hub()
        asking = InProcessMailbox(hub)
        kept = operated.Operated(note, lambda: 0.0, lambda kind, text, **_: events.append(text))
        PersonsDesk(InProcessMailbox(hub), command, unasked, unasked, kept, lambda: 0.0)
        reply = Reply.model_validate_json(await asking.request(GATEWAY_FOR_PERSON, of_anna(said), LONG_S))
        assert reply.ok and "waits for the disk" in reply.text and len(commands) == 1
        # One who may not is refused as soon, whatever the disk does.
        viewer = ForPerson(person=Person(name="vera", role="viewer", through="page"), said=said)
        payload = viewer.model_dump_json().encode()
        assert not Reply.model_validate_json(await asking.request(GATEWAY_FOR_PERSON, payload, LONG_S)).ok
        assert len(commands) == 1
        disk.set()
        await kept.close()
        await until(lambda: sum("the disk is full" in text for text in events) == 2)

    asyncio.run(story())


@pytest.mark.parametrize("said", [Stop(), Hold()])
def test_a_gateway_that_does_not_answer_is_told_with_what_to_press(said, monkeypatch):
    monkeypatch.setattr(line_side, "SAFE_S", 0.05)

    async def story(folder: Path) -> None:
        async def meet(serving: UnixMailbox, asking: UnixMailbox) -> None:
            serving.serve(GATEWAY_FOR_PERSON, never)
            asking.connect((GATEWAY_FOR_PERSON,), folder / "g")
            reply = await LineSide(asking).say(ANNA, said)
            assert (reply.ok, reply.known) == (False, False)
            (found,) = reply.findings
            assert (found.code, found.parameters["command"]) == ("gateway-unanswered", said.command)
            assert "emergency stop" in reply.text

        await with_mailboxes(folder, meet)

    run(story)


@pytest.mark.wires
@pytest.mark.parametrize("command", ["stop", "hold"])
def test_a_loop_that_does_not_answer_is_told_with_what_to_press(command):
    async def story(folder: Path) -> None:
        with gateway(folder):
            async with loop_and_client(folder) as (loop, client):
                loop.serve(LOOP_COMMAND, never)
                await heard(loop, client, state=LoopState.RUN, phase=Phase.RUNNING)
                said = b'{"command":"%s"}' % command.encode()
                reply = Reply.model_validate_json(await client.request(GATEWAY_COMMAND, said, LONG_S))
                assert (reply.ok, reply.known) == (False, False)
                assert [one.code for one in reply.findings] == ["loop-unanswered"]
                assert "emergency stop" in reply.text

    run(story)


@pytest.mark.wires
def test_stops_that_wait_at_the_page_leave_the_places_of_holds_and_of_all_else(monkeypatch):
    monkeypatch.setattr(line_side, "SAFE_S", LONG_S)
    monkeypatch.setattr(places, "SAFE_S", LONG_S)

    async def story() -> None:
        async with page() as there:
            await there.log_in()
            there.gateway.answers.clear()
            waiting = [asyncio.create_task(there.browser.post("/api/stop")) for _ in range(asks.MAX_SAFE)]
            await until(lambda: len(there.gateway.said) == asks.MAX_SAFE)
            crowded = await there.browser.post("/api/stop")
            assert crowded.status_code == 503 and crowded.json()["findings"][0]["code"] == "safe-crowded"
            there.gateway.answers.set()
            assert (await there.browser.post("/api/hold")).status_code == 200
            assert (await there.browser.get("/api/proposals")).status_code == 200
            await asyncio.gather(*waiting)
            assert (await there.browser.post("/api/stop")).status_code == 200
            assert [one.said.command for one in there.gateway.said[-2:]] == ["hold", "stop"]

    asyncio.run(story())


def test_a_stop_at_its_own_address_is_taken_from_this_page_of_whoever_may_alone():
    async def story() -> None:
        async with page() as there:
            assert (await there.browser.post("/api/stop")).status_code == 401
            await there.log_in("viewer")
            assert (await there.browser.post("/api/stop")).status_code == 403
            await there.log_in()
            assert (await there.browser.get("/api/stop")).status_code == 404
            there.browser.headers["origin"] = "http://elsewhere"
            assert (await there.browser.post("/api/stop")).status_code == 403
            said = [(one.person.name, one.said.command) for one in there.gateway.said]
            assert said == [("viewer", "stop")]  # on record, and not done

    asyncio.run(story())


@pytest.mark.wires
def test_a_page_that_is_full_of_silent_connections_has_a_place_for_a_stop(monkeypatch):
    monkeypatch.setattr(serve, "MOST_CONNECTIONS", 2)

    async def story() -> None:
        async with page() as there:
            await there.log_in()
            listener = serve.listening("http://127.0.0.1:0")
            port = listener.getsockname()[1]
            serving = asyncio.create_task(serve_on(there.app, listener))
            crowd = [await asyncio.open_connection("127.0.0.1", port) for _ in range(3)]
            headers, cookies = dict(there.browser.headers), there.browser.cookies
            base = f"http://127.0.0.1:{port}"
            async with httpx.AsyncClient(base_url=base, headers={**headers, "origin": base}, cookies=cookies) as other:
                stopped = await other.post("/api/stop")
                assert stopped.status_code == 200, stopped.text
            for _, writer in crowd:
                writer.close()
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            assert [one.said.command for one in there.gateway.said] == ["stop"]

    asyncio.run(story())

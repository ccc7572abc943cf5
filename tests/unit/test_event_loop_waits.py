"""The gateway's event loop waits for no store, no zip, no long hash and no directory of users: all in threads.

Every test is held to it (`tests.support.event_loop_guard`); here is what would be found, and the ways through a whole
gateway that others do not take.
"""

import asyncio
import os
import signal
from contextlib import suppress
from pathlib import Path

import apsw
import numpy as np
import pytest

from gateway.core.controller import config_hash
from gateway.core.decisions import Archive, ListProposals, ShowProposal
from gateway.core.line_past import RecordsAfter
from gateway.core.messages import Reply, Stop
from gateway.core.people import ForPerson, Person
from gateway.core.recording import Recording, recording_of
from gateway.core.telemetry import frame_dtype
from gateway.core.topics import (
    GATEWAY_ALARM,
    GATEWAY_COMMAND,
    GATEWAY_DECISION,
    GATEWAY_FOR_PERSON,
    GATEWAY_PAST,
    GATEWAY_PROPOSALS,
    GATEWAY_PROPOSE,
    GATEWAY_STATUS,
    LOOP_COMMAND,
)
from gateway.mailbox.paths import GATEWAY_DATA
from gateway.mailbox.port import Peer
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor import configurations, line_desk, peers, proposal_inbox
from gateway.supervisor.history import History
from gateway.supervisor.past import Past
from gateway.supervisor.process import serve
from gateway.tasks.threads import SMALL_BYTES, Worker, beside
from tests.support import event_loop_guard
from tests.support.event_loop_guard import Blocks
from tests.unit.deployer_gateway import Gateway
from tests.unit.deployer_support import FIRST, FakeJudge, hash_of, proposal
from tests.unit.supervisor_support import line_of, until
from tests.unit.test_stop_gets_through import with_mailboxes
from tests.unit.test_supervisor_process import ask, gateway, run

LINE = line_of()
LONG_S = 30.0
ANNA = Person(name="anna", role="operator", through="page")
ASKED = (
    GATEWAY_STATUS, GATEWAY_PROPOSALS, GATEWAY_PROPOSE, GATEWAY_DECISION, GATEWAY_PAST, GATEWAY_ALARM, GATEWAY_COMMAND,
)  # fmt: skip


def recording(samples: int = 500) -> Recording:
    frames = np.zeros(samples, frame_dtype(LINE.n))
    frames["time_s"] = LINE.control.period_s * np.arange(samples)
    return recording_of(frames, LINE.control.period_s, "a test")


@pytest.mark.parametrize(
    ("work", "found"),
    [
        (lambda: peers._look_up(os.geteuid()), "users"),  # noqa: SLF001
        (lambda: proposal_inbox._sha256(bytes(SMALL_BYTES + 1)), "hash of"),  # noqa: SLF001
        (lambda: line_desk._part(recording(), 0), "zip"),  # noqa: SLF001
        (lambda: line_desk._line_of(recording(), 0.0), "recording"),  # noqa: SLF001
    ],
)
def test_what_blocks_is_found_in_the_thread_of_an_event_loop_and_nowhere_else(work, found):
    async def story() -> None:
        await asyncio.to_thread(work)
        assert event_loop_guard.taken() == []
        with pytest.raises(Blocks, match=found):
            work()

    work()
    asyncio.run(story())
    (told,) = event_loop_guard.taken()
    assert "gateway/supervisor" in told


def test_a_store_is_found_in_the_thread_of_an_event_loop(tmp_path):
    async def story() -> None:
        past = Past.__new__(Past)
        past._history = lambda: tmp_path / "history.sqlite"  # noqa: SLF001
        with pytest.raises(Blocks):
            past._tensions(None)  # type: ignore[arg-type] # noqa: SLF001

    store = apsw.Connection(str(tmp_path / "history.sqlite"))
    store.execute("CREATE TABLE something (a)")
    store.close()
    with suppress(Exception):
        History(tmp_path / "history.sqlite")
    asyncio.run(story())
    assert "store" in event_loop_guard.taken()[0]


def test_what_is_long_is_done_in_a_thread_and_what_is_given_up_is_not_begun():
    done: list[str] = []

    async def story() -> None:
        here = await beside(SMALL_BYTES, asyncio._get_running_loop)  # noqa: SLF001
        there = await beside(SMALL_BYTES + 1, asyncio._get_running_loop)  # noqa: SLF001
        assert here is asyncio.get_running_loop() and there is None
        worker, begun, free = Worker("test"), asyncio.Event(), asyncio.Event()
        loop = asyncio.get_running_loop()

        def first() -> None:
            loop.call_soon_threadsafe(begun.set)
            asyncio.run_coroutine_threadsafe(free.wait(), loop).result()
            done.append("first")

        under_way = asyncio.create_task(worker.do(first))
        await begun.wait()
        given_up = asyncio.create_task(worker.do(done.append, "second"))
        await asyncio.sleep(0)
        given_up.cancel()
        free.set()
        await under_way
        await worker.do(done.append, "third")
        await worker.close(lambda: done.append("last"))

    asyncio.run(story())
    assert done == ["first", "third", "last"]


def test_recordings_of_a_judged_proposal_are_packed_and_hashed_in_a_thread():
    async def story() -> None:
        there = Gateway()
        context = there.surroundings.context

        async def with_data(book):
            return (await context(book))[0], [recording()]

        there.surroundings.context = with_data
        await there.look()
        one = proposal(1, config_hash(FIRST), there.loop.now_s)
        assert (await there.propose(one)).ok
        assert there.stage(one) == "waiting"
        await there.deployer.close()

    asyncio.run(story())


@pytest.mark.wires
def test_a_directory_of_users_that_is_away_keeps_neither_a_stop_nor_anybody_else_for_long(monkeypatch):
    monkeypatch.setattr(peers, "LOOKED_UP_S", 0.01)
    monkeypatch.setattr(peers, "_directory", Worker("test"))
    uid = 4_000_000_000

    async def story() -> None:
        away, loop = asyncio.Event(), asyncio.get_running_loop()

        def hangs(_: int) -> None:
            asyncio.run_coroutine_threadsafe(away.wait(), loop).result()

        monkeypatch.setattr(peers, "_look_up", hangs)
        assert peers.who_at_once(Peer(uid, 1)).name == f"user {uid}"
        assert (await peers.who_of(Peer(uid, 1))).name == f"user {uid}"
        away.set()

    asyncio.run(story())


@pytest.mark.wires
def test_whatever_is_asked_of_a_whole_gateway_its_event_loop_calls_nothing_that_blocks():
    class Judge(FakeJudge):
        def begin(self) -> None: ...

        async def close(self) -> None: ...

    async def story(folder: Path) -> None:
        serving = asyncio.create_task(serve(LINE, folder, folder / "data", Judge(), watch_s=0.02))
        await until(lambda: (folder / "gateway.sock").exists() or serving.done())
        client, saying = UnixMailbox(), UnixMailbox()
        client.connect(ASKED, folder / "gateway.sock")
        saying.connect((GATEWAY_FOR_PERSON,), folder / "gateway.sock")
        made = folder / "data" / GATEWAY_DATA / "configurations.sqlite"
        while (await ask(client)).audit_head == "" or not made.exists():  # noqa: ASYNC110
            await asyncio.sleep(0.01)

        async def say(topic, payload: bytes) -> bytes:
            return await client.request(topic, payload, LONG_S)

        open_ = ListProposals().model_dump_json().encode()
        while b"the gate is shut" in await say(GATEWAY_PROPOSALS, open_):  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        archive = Archive(configuration="newest", name="phi_stable", because="it held").model_dump_json().encode()
        one = proposal(1, config_hash(FIRST), asyncio.get_running_loop().time())
        for topic, payload in (
            (GATEWAY_PROPOSE, one.model_dump_json().encode()),
            (GATEWAY_PROPOSE, b" " * (2 * SMALL_BYTES)),
            (GATEWAY_PROPOSALS, ShowProposal(proposal=hash_of(one)).model_dump_json().encode()),
            (GATEWAY_DECISION, archive),
            (GATEWAY_DECISION, b'{"command":"roll-back"}'),
            (GATEWAY_DECISION, b'{"command":"line-changed","because":"a thinner web"}'),
            (GATEWAY_PAST, RecordsAfter(after=None).model_dump_json().encode()),
            (GATEWAY_PAST, b'{"command":"tensions","from_wall_s":0.0,"to_wall_s":1.0,"points":10}'),
            (GATEWAY_ALARM, b'{"command":"shelve","alarm":"load-cell","for_s":60.0,"because":"a test"}'),
            (GATEWAY_COMMAND, b'{"command":"arm"}'),
            (GATEWAY_COMMAND, b"\x78" + bytes(100)),
            (GATEWAY_STATUS, b""),
        ):
            assert await say(topic, payload)
        said = ForPerson(person=ANNA, said=Stop()).model_dump_json().encode()
        assert await saying.request(GATEWAY_FOR_PERSON, said, LONG_S)
        await client.close()
        await saying.close()
        signal.raise_signal(signal.SIGTERM)
        assert await serving == 0

    run(story)


@pytest.mark.wires
def test_a_stop_is_answered_while_a_store_is_held_and_an_archive_waits_for_it():
    async def story(folder: Path) -> None:
        store = folder / "data" / GATEWAY_DATA / configurations.FILE_NAME
        with gateway(folder):

            async def answer(_: bytes) -> bytes:
                return Reply(ok=True, state="STOP", text="stopping").model_dump_json().encode()

            async def meet(loop: UnixMailbox, client: UnixMailbox) -> None:
                await loop.listen(folder / "loop.sock")
                loop.serve(LOOP_COMMAND, answer)
                client.connect((*ASKED, GATEWAY_FOR_PERSON), folder / "gateway.sock")
                while not store.exists() or b"shut" in await client.request(GATEWAY_PROPOSALS, OPEN, LONG_S):  # noqa: ASYNC110
                    await asyncio.sleep(0.01)
                held = await asyncio.to_thread(apsw.Connection, str(store))
                await asyncio.to_thread(held.execute, "BEGIN EXCLUSIVE")
                waits = asyncio.create_task(client.request(GATEWAY_DECISION, ARCHIVE, LONG_S))
                said = ForPerson(person=ANNA, said=Stop()).model_dump_json().encode()
                for _ in range(5):
                    await client.request(GATEWAY_FOR_PERSON, said, LONG_S)
                    await client.request(GATEWAY_STATUS, b"", LONG_S)
                assert not waits.done()
                await asyncio.to_thread(held.close)
                assert not Reply.model_validate_json(await waits).ok  # there is none to be archived

            await with_mailboxes(folder / "other", meet)

    run(story)


OPEN = ListProposals().model_dump_json().encode()
ARCHIVE = Archive(configuration="newest", name="phi_stable", because="it held").model_dump_json().encode()

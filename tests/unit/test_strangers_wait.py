"""What a process publishes that nobody knows yet waits for it to show who it is, and takes no more room than it may."""

import asyncio

from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.port import MAX_PAYLOAD, PEER, Peer, Unreachable
from gateway.supervisor.gate import Gate
from gateway.supervisor.true_loop import MOST_STRANGERS, MOST_WAITING, MOST_WAITING_BYTES, TrueLoop
from tests.support.gateway_key import to_loop_over
from tests.unit.deployer_support import LINE, Death, FakeJudge, FakeLoop, FakeSurroundings


async def nobody(_: bytes) -> tuple[bytes, Peer | None]:
    raise Unreachable("nobody is there")


def held_after(tmp_path, payloads, strangers=1):
    """Bytes and messages that wait, and how many were not taken."""

    async def story():
        loop = TrueLoop(tmp_path, nobody, lambda: 0.0, lambda *_, **__: None, lambda: None)
        delivered = []
        take = loop.taken(delivered.append)
        try:
            for k in range(strangers):
                PEER.set(Peer(1000, 100 + k))
                for payload in payloads:
                    take(payload)
            return loop.waiting_bytes, loop.untaken, delivered
        finally:
            await loop.close()

    return asyncio.run(story())


def test_the_messages_of_strangers_are_bounded_by_their_bytes_as_well(tmp_path):
    waiting, untaken, delivered = held_after(tmp_path, [bytes(MAX_PAYLOAD)] * 100, strangers=2 * MOST_STRANGERS)
    assert waiting <= MOST_STRANGERS * MOST_WAITING_BYTES and not delivered
    fit = MOST_WAITING_BYTES // MAX_PAYLOAD
    assert untaken == 2 * MOST_STRANGERS * 100 - MOST_STRANGERS * fit


def test_and_by_their_number_where_they_are_short(tmp_path):
    waiting, untaken, _ = held_after(tmp_path, [b"x"] * (MOST_WAITING + 10))
    assert (waiting, untaken) == (MOST_WAITING, 10)


def test_a_loop_that_begins_is_asked_what_it_runs_though_its_events_were_lost(tmp_path):
    async def story():
        gate = Gate(
            LINE, InProcessMailbox(Hub()), to_loop_over(InProcessMailbox(Hub()), LINE), tmp_path, FakeJudge(),
            lambda configurations, models: FakeSurroundings(FakeLoop(Death())), lambda *_, **__: None, lambda: 0.0,
            lambda: 0.0,
        )  # fmt: skip
        try:
            gate.loop_begins()  # before the gate is open nothing is known of it anyway
            while gate.deployer is None:
                await gate.look()
            asked = []
            gate.deployer.look_again = lambda: asked.append("again")
            gate.loop_begins()
            assert asked == ["again"]
        finally:
            await gate.close()

    asyncio.run(story())

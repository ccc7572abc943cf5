"""What local processes say to the gateway: of each no more than its share, and what is safe always."""

import asyncio

import pytest

from gateway.core.audit_record import Who
from gateway.core.decisions import Confirm, RollBackNow
from gateway.core.messages import Reply
from gateway.core.topics import GATEWAY_DECISION
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.port import PEER, Peer
from gateway.supervisor.gate import Gate
from gateway.supervisor.peers import GATEWAY
from gateway.supervisor.said_inbox import OF_DECISIONS, SaidInbox, is_never_held_back
from tests.support.gateway_key import to_loop_over
from tests.unit.deployer_support import LINE, Death, FakeJudge, FakeLoop, FakeSurroundings


class Notes:
    """Events, by kind."""

    def __init__(self) -> None:
        self.kinds: list[str] = []
        self.left_out = 0

    def note(self, kind: str, text: str, **data: object) -> None:
        self.kinds.append(kind)
        left_out = data.get("left_out", 0)
        self.left_out += left_out if isinstance(left_out, int) else 0


def process(pid: int, uid: int = 1000) -> Who:
    return Who(name=f"user {uid}", uid=uid, pid=pid)


def test_a_flood_takes_its_share_and_nobody_elses_and_is_told_now_and_then() -> None:
    notes, now_s = Notes(), 0.0
    inbox = SaidInbox("decision", OF_DECISIONS, lambda: now_s, notes.note)
    refused = [inbox.refuse(process(1), 10) for _ in range(1000)]
    assert refused.count(None) == OF_DECISIONS.at_once and 0 < len(notes.kinds) <= 10
    assert inbox.refuse(process(2), 10) is None  # another process of the same user
    assert all(inbox.refuse(process(k, uid=1001), 10) is None for k in range(20))
    crowd = [inbox.refuse(process(100 + k), 10) for k in range(1000)]  # many processes are no more than one user
    assert crowd.count(None) <= OF_DECISIONS.group_at_once
    assert all(inbox.refuse(GATEWAY, 10) is None for _ in range(1000))  # this process itself
    now_s = 61.0
    assert inbox.refuse(process(1), 10) is None
    while inbox.refuse(process(1), 10) is None:
        pass
    assert notes.left_out > 900  # the next event tells how many


@pytest.mark.parametrize(
    ("payload", "safe"),
    [(b'{"command":"stop"}', True), (b'{"command": "hold"}', True), (b'{"command":"start"}', False), (b"", False),
     (b"\x78\x9c", False), (b'{"command":"stop"}' + b" " * 5000, False), (b"[" * 1000, False)],
)  # fmt: skip
def test_what_takes_the_line_to_the_safe_side_is_known_by_what_it_is(payload: bytes, safe: bool) -> None:
    assert is_never_held_back(payload) == safe


def test_whoever_floods_the_gate_with_decisions_is_refused_and_a_rollback_never(tmp_path):
    notes, hub = Notes(), Hub()
    confirm = Confirm(configuration="1" * 64, because="x").model_dump_json().encode()
    back = RollBackNow(comment="x").model_dump_json().encode()

    async def story():
        gate = Gate(
            LINE, InProcessMailbox(hub), to_loop_over(InProcessMailbox(Hub()), LINE), tmp_path, FakeJudge(),
            lambda configurations, models: FakeSurroundings(FakeLoop(Death())), notes.note, lambda: 0.0, lambda: 0.0,
        )  # fmt: skip
        asking = InProcessMailbox(hub)
        PEER.set(Peer(1000, 4000))

        async def flood(payload: bytes) -> list[str]:
            answers = [await asking.request(GATEWAY_DECISION, payload, 5.0) for _ in range(200)]
            return [one.code for answer in answers for one in Reply.model_validate_json(answer).findings]

        try:
            assert (await flood(confirm)).count("inbox-rate") == 200 - OF_DECISIONS.at_once
            told = len(notes.kinds)
            assert told <= OF_DECISIONS.at_once + 10
            assert not await flood(back) and len(notes.kinds) - told <= 10
        finally:
            await gate.close()

    asyncio.run(story())

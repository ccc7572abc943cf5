"""The bounds of what comes in: no caller takes more than its share, and none waits behind another's flood."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.audit_record import Who
from gateway.core.finding import Finding, finding
from gateway.core.messages import Reply
from gateway.mailbox.inbox import MOST_CALLERS, SOONEST_S, Bounds, Caller, FairQueue, RateLimiter, come_again_s
from gateway.supervisor.admission import bounds_of, caller_of, turned_away, why_not_author
from tests.unit.supervisor_support import line_of

BOUNDS = Bounds(1.0, 1.0, 3.0, 6.0, bytes=1000)
LINE = line_of()
CLI = Who(name="anna", uid=1000, pid=10)


def again_s(refusal: Finding) -> float:
    return float(refusal.parameters["again_s"])


def caller(pid: int, uid: int = 1000) -> Caller:
    return Caller(f"user {uid}", f"process {pid}")


@given(st.lists(st.floats(0.0, 0.5), min_size=1, max_size=200))
def test_a_process_is_taken_once_a_second_whatever_it_was_refused(steps):
    now_s, taken = 0.0, []
    door = RateLimiter(lambda: now_s)
    for step in steps:
        now_s += step
        refusal = door.refuse(caller(1), BOUNDS, 10)
        if refusal is None:
            taken.append(now_s)
        else:
            assert refusal.code == "inbox-rate" and 0.0 < again_s(refusal) <= 1.0 + 1e-9
    assert all(after - before >= 1.0 - 1e-9 for before, after in zip(taken, taken[1:], strict=False))


def test_when_to_come_again_is_when_it_is_taken():
    now_s = 5.0
    door = RateLimiter(lambda: now_s)
    assert door.refuse(caller(1), BOUNDS, 10) is None
    now_s = 5.25
    refusal = door.refuse(caller(1), BOUNDS, 10)
    assert refusal is not None and again_s(refusal) == 0.75
    now_s += again_s(refusal)
    assert door.refuse(caller(1), BOUNDS, 10) is None


def test_a_flood_of_one_process_takes_nothing_of_another_and_one_of_processes_nothing_of_another_user():
    now_s = 0.0
    door = RateLimiter(lambda: now_s)
    flood = 0
    for k in range(3000):  # half a minute
        now_s = k / 100.0
        flood += door.refuse(caller(1), BOUNDS, 10) is None
        if k % 500 == 250:
            assert door.refuse(caller(2), BOUNDS, 10) is None
    assert flood == 30
    taken = sum(door.refuse(caller(100 + k), BOUNDS, 10) is None for k in range(1000))
    assert taken <= 6
    assert door.refuse(caller(5, uid=1001), BOUNDS, 10) is None


def test_a_message_that_is_too_long_is_refused_and_costs_nothing():
    door = RateLimiter(lambda: 0.0)
    refusal = door.refuse(caller(1), BOUNDS, 1001)
    assert refusal is not None and refusal.code == "inbox-size"
    assert (refusal.parameters["size_bytes"], refusal.parameters["allowed_bytes"]) == (1001, 1000)
    assert door.refuse(caller(1), BOUNDS, 1000) is None


def test_accounts_are_bounded_and_the_quietest_goes_first():
    door = RateLimiter(lambda: 0.0)
    wide = Bounds(1.0, 1.0, 1e9, 1e9, bytes=1000)
    assert door.refuse(caller(0), wide, 1) is None
    for k in range(MOST_CALLERS - 1):
        assert door.refuse(caller(1 + k), wide, 1) is None
    assert door.refuse(caller(0), wide, 1) is not None
    for k in range(MOST_CALLERS):
        door.refuse(caller(5000 + k), wide, 1)
    assert door.refuse(caller(0), wide, 1) is None  # forgotten: its group's share still holds


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), max_size=60))
def test_all_that_waits_is_taken_once_in_turns_and_each_callers_in_its_order(puts):
    queue: FairQueue[tuple[Caller, int]] = FairQueue()
    for k, (uid, pid) in enumerate(puts):
        who = caller(pid, uid)
        queue.put(who, (who, k))
    taken = [queue.take() for _ in range(len(puts))]
    assert len(queue) == 0 and sorted(k for _, k in taken) == list(range(len(puts)))
    for who in {who for who, _ in taken}:
        order = [k for one, k in taken if one == who]
        assert order == sorted(order)
    groups = {who.group for who, _ in taken}
    assert {who.group for who, _ in taken[: len(groups)]} == groups  # nobody's first behind another's second


def test_one_waits_behind_no_flood_and_whoever_floods_is_refused():
    queue: FairQueue[str] = FairQueue()
    for _ in range(BOUNDS.waiting):
        assert queue.refuse(caller(1), BOUNDS, 30.0) is None
        queue.put(caller(1), "flood")
    refusal = queue.refuse(caller(1), BOUNDS, 30.0)
    assert refusal is not None and (refusal.code, again_s(refusal)) == ("inbox-full", 30.0)
    assert queue.refuse(caller(2), BOUNDS, 30.0) is None
    queue.put(caller(2), "real")
    assert [queue.take(), queue.take()] == ["flood", "real"]


def test_where_all_places_are_taken_another_user_still_finds_one():
    queue: FairQueue[int] = FairQueue()
    for k in range(BOUNDS.all_waiting):
        queue.put(caller(k), k)
    refusal = queue.refuse(caller(1000), BOUNDS, 30.0)
    assert refusal is not None and refusal.code == "inbox-full"
    assert queue.refuse(caller(1, uid=1001), BOUNDS, 30.0) is None


def test_who_proposes_is_who_the_connection_says():
    agent = Who(name="agent sysid")
    assert caller_of(agent) == Caller("agent sysid", "")
    assert caller_of(CLI) == Caller("user 1000", "process 10")
    assert why_not_author("agents", agent, ()) is None
    differs = why_not_author("engineer", agent, ())
    assert differs is not None and differs.code == "inbox-author"
    assert differs.parameters == {"author": "engineer", "connection": "agent sysid", "allowed": "agents"}
    for author in ("engineer", "rules", "agents", "anna", "planner"):
        assert why_not_author(author, CLI, ("bert",)) is None
    for author in ("bert", "root", "agent sysid"):
        differs = why_not_author(author, CLI, ("bert",))
        assert differs is not None and differs.parameters["connection"] == "anna"


def test_a_refusal_says_what_is_allowed_and_when_to_come_again():
    door = RateLimiter(lambda: 0.0)
    agent = Who(name="agent sysid")
    for who, every_s in ((CLI, 1.0), (agent, 10.0)):
        bounds = bounds_of(who, LINE)
        assert door.refuse(caller_of(who), bounds, 10) is None
        refusal = door.refuse(caller_of(who), bounds, 10)
        assert refusal is not None
        reply = turned_away(refusal)
        assert not reply.ok and reply.findings == [refusal] and len(reply.reasons) == 1
        assert refusal.parameters["every_s"] == refusal.parameters["again_s"] == pytest.approx(every_s)


def test_only_a_refusal_that_passes_is_worth_asking_again():
    def reply(*found: Finding) -> Reply:
        return Reply(ok=not found, state="", text="", findings=list(found))

    assert come_again_s(reply()) is None
    assert come_again_s(reply(finding("inbox-size", caller="x", size_bytes=9, allowed_bytes=1))) is None
    assert come_again_s(reply(finding("inbox-rate", caller="x", every_s=1.0, again_s=0.7))) == 0.7
    assert come_again_s(reply(finding("inbox-rate", caller="x", every_s=1.0, again_s=1e-9))) == SOONEST_S
    assert come_again_s(reply(finding("inbox-full", caller="x", waiting=4, allowed=4, again_s=30.0))) == 30.0

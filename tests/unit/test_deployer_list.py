"""How proposals are listed: page by page, and nothing that waits is hidden by what came after it."""

import asyncio

from gateway.core.controller import config_hash
from gateway.supervisor import lifecycle
from gateway.supervisor.deployer_sides import NotAtHand
from gateway.supervisor.lifecycle import Stage
from gateway.supervisor.small_changes import MOST_AT_ONCE
from tests.unit.deployer_gateway import PROBATION_S, TRUSTING, Gateway, hash_of, run, started
from tests.unit.deployer_support import FIRST, proposal


async def with_one_that_waits_before_many():
    gateway = Gateway()
    waits = proposal(1, config_hash(FIRST), gateway.loop.now_s)
    await gateway.propose(waits)
    others = [proposal(2, config_hash(FIRST), gateway.loop.now_s, nonce=k) for k in range(5)]
    gateway.judge.refuses = {hash_of(one) for one in others}
    for one in others:
        await gateway.propose(one)
    return gateway, hash_of(waits), [hash_of(one) for one in others]


@run
async def test_what_waits_is_listed_with_the_newest_however_many_came_after_it():
    gateway, waits, others = await with_one_that_waits_before_many()
    listed = [one.proposal for one in gateway.deployer.listed(2).proposals]
    assert gateway.deployer.book.entries[waits].stage is Stage.WAITING
    assert listed == [*reversed(others[3:]), waits]


@run
async def test_pages_together_are_everything_once_but_for_what_waits():
    gateway, waits, others = await with_one_that_waits_before_many()
    pages = [[one.proposal for one in gateway.deployer.listed(2, skip).proposals] for skip in (2, 4, 6)]
    assert pages == [[others[2], others[1]], [others[0], waits], []]


def test_what_is_done_with_leaves_memory_and_is_told_from_the_records(monkeypatch):
    monkeypatch.setattr(lifecycle, "MOST_CLOSED", 4)
    asyncio.run(one_in_service_one_that_waits_and_many_refused())


async def one_in_service_one_that_waits_and_many_refused():
    gateway = await started()
    first = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(first)
    assert (await gateway.decide(first)).ok
    await gateway.pass_time(PROBATION_S + 1.0)
    waits = proposal(2, gateway.loop.runs, gateway.loop.now_s)
    await gateway.propose(waits)
    others = [proposal(3, gateway.loop.runs, gateway.loop.now_s, nonce=k) for k in range(12)]
    gateway.judge.refuses = {hash_of(one) for one in others}
    for one in others:
        await gateway.propose(one)
    book, every = gateway.deployer.book, [hash_of(one) for one in (first, waits, *others)]
    await gateway.deployer.watch()
    for _ in range(2):
        held = list(book.entries)
        assert held[:2] == every[:2] and held[2:] == every[-len(held[2:]) :] and len(held) <= 2 + 4 + 1
        assert (book.made, book.forgotten) == (14, 14 - len(held))
        pages = [await gateway.deployer.page(4, skip) for skip in (0, 4, 8, 12)]
        assert [one.proposal for page in pages for one in page.proposals[:4]] == every[::-1]
        assert {page.since_change for page in pages} == {14}
        await gateway.deployer.at_hand(every[2][:8])
        shown = gateway.deployer.shown(every[2][:8])
        assert not isinstance(shown, str) and shown.proposal == others[0] and shown.stage == "refused"
        assert not (await gateway.propose(others[0])).ok
        assert book.made == 14
        gateway.begin()
        book = gateway.deployer.book


@run
async def test_however_much_waits_nothing_is_read_that_was_not_fetched_and_everything_has_its_turn():
    gateway = await started(TRUSTING)
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    assert (await gateway.decide(one)).ok
    await gateway.pass_time(PROBATION_S + 1.0)
    far = [proposal(9, gateway.loop.runs, gateway.loop.now_s, nonce=k) for k in range(2 * MOST_AT_ONCE + 1)]
    for each in far:
        await gateway.propose(each)
    small = proposal(2, gateway.loop.runs, gateway.loop.now_s, nonce=99)
    await gateway.propose(small)
    gateway.begin()
    at_hand, reads = set[str](), list[str]()
    blob = gateway.audit.blob

    async def fetch(ids):
        reads.extend(new := [id_ for id_ in ids if id_ not in at_hand])
        at_hand.clear()  # it is little
        at_hand.update(ids, new)

    def only_at_hand(id_):
        if id_ not in at_hand:
            raise NotAtHand("not read yet")
        return blob(id_)

    gateway.audit.fetch, gateway.audit.blob = fetch, only_at_hand
    for looked_at in (MOST_AT_ONCE, 2 * MOST_AT_ONCE):
        await gateway.deployer.at_hand()
        told = [line.why for line in reversed(gateway.deployer.listed(100).proposals) if line.stage == "waiting"]
        assert all("differs by" in why for why in told[:looked_at])
        assert set(told[looked_at:]) == {"whether it passes by its verdict alone was not looked at yet"}
    gateway.loop.pass_time(1.0)
    for _ in range(len(far) + 2):
        await gateway.deployer.at_hand()
        await gateway.deployer.watch()
    assert gateway.stage(small) is Stage.PROBATION
    read = len(reads)
    gateway.deployer.listed(100)
    await gateway.deployer.at_hand()
    assert len(reads) == read

"""How proposals are listed: page by page, and nothing that waits is hidden by what came after it."""

from gateway.core.controller import config_hash
from gateway.supervisor.lifecycle import Stage
from tests.unit.deployer_gateway import Gateway, hash_of, run
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

"""A rollback that waits for nothing, and an approval that is of everything it rests on."""

import asyncio

from gateway.core.controller import config_hash
from gateway.supervisor.lifecycle import Stage
from tests.unit.deployer_gateway import ANNA, Gateway, deployed, hash_of, run
from tests.unit.deployer_support import FIRST, proposal


@run
async def test_the_line_goes_back_while_the_disk_hangs_and_the_record_follows():
    gateway, one = await deployed()
    free, append = asyncio.Event(), gateway.audit.append

    async def hangs(*args, **kwargs):
        await free.wait()
        return await append(*args, **kwargs)

    gateway.audit.append = hangs
    asked = asyncio.create_task(gateway.deployer.roll_back("it squeals", ANNA))
    for _ in range(20):
        await asyncio.sleep(0)
    assert gateway.loop.runs == config_hash(FIRST) and not asked.done()
    free.set()
    assert (await asked).ok
    assert gateway.stage(one) is Stage.ROLLED_BACK
    assert {"rollback-asked", "rolled-back"} <= set(gateway.audit.kinds)


@run
async def test_the_line_goes_back_while_another_step_is_under_way():
    gateway, one = await deployed()
    async with gateway.deployer._records.one_step:  # noqa: SLF001
        asked = asyncio.create_task(gateway.deployer.roll_back("", ANNA))
        for _ in range(20):
            await asyncio.sleep(0)
        assert gateway.loop.runs == config_hash(FIRST) and not asked.done()
    assert (await asked).ok and gateway.stage(one) is Stage.ROLLED_BACK


@run
async def test_what_was_shown_before_another_model_was_accepted_is_not_approved():
    gateway = Gateway()
    one = proposal(1, config_hash(FIRST), gateway.loop.now_s)
    await gateway.propose(one)
    shown = gateway.deployer.shown(hash_of(one)).shown
    gateway.deployer.book.model = "f" * 64
    reply = await gateway.decide(one, shown=shown)
    assert not reply.ok and "proposals are judged by model ffffffffffff now" in reply.reasons[0]
    assert gateway.stage(one) is Stage.WAITING and gateway.loop.runs == config_hash(FIRST)


@run
async def test_who_asks_for_what_was_before_without_end_is_heard_and_fills_no_disk():
    gateway, one = await deployed()
    assert (await gateway.deployer.roll_back("", ANNA, None)).ok
    assert gateway.stage(one) is Stage.ROLLED_BACK and gateway.loop.runs == config_hash(FIRST)
    records = len(gateway.audit.records)
    gateway.loop.restart()
    told, tell = [], gateway.loop.tell

    async def counted(command, grounds=None):
        told.append(command.command)
        assert not gateway.deployer._records.one_step.locked()  # noqa: SLF001 (the gateway goes on looking)
        return await tell(command)

    gateway.loop.tell = counted
    for _ in range(100):
        assert (await gateway.deployer.roll_back("", ANNA, None)).ok
    assert set(told) == {"rollback"} and len(told) == 100
    assert "rollback-asked" not in gateway.audit.kinds and len(gateway.audit.records) == records
    gateway.loop.tell = tell
    assert (await gateway.deployer.roll_back("it squeals", ANNA, 101)).ok
    (asked,) = [what for kind, what in gateway.audit.records if kind == "rollback-asked"]
    assert asked == {"comment": "it squeals", "left_out": 101}

"""What was approved and cannot be stored: another program holds the store, or it is damaged."""

import asyncio
from pathlib import Path

import apsw
import pytest

from gateway.core.controller import config_hash
from gateway.supervisor.configurations import begin_configurations
from gateway.supervisor.deployer import MOST_RETRIES, RETRY_S
from gateway.supervisor.deployer_sides import NotKnown, NotTakenUp
from gateway.supervisor.lifecycle import Stage
from gateway.supervisor.models import begin_repository
from gateway.supervisor.store_writer import StoreWriter
from tests.unit.deployer_gateway import PROBATION_S, TRUSTING, Gateway, deployed, run
from tests.unit.deployer_support import FIRST, LINE, hash_of, proposal


async def trusted_once() -> Gateway:
    """A person has approved one change of gains, and it was kept: what is like it passes by its verdict alone."""
    gateway = Gateway(TRUSTING)
    await gateway.pass_time(1.0)
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    await gateway.pass_time(1.0)
    assert (await gateway.decide(one)).ok
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(one) is Stage.KEPT
    return gateway


async def failing(proposal, verdict) -> None:
    raise NotTakenUp("the store is locked")


async def not_known(proposal, verdict) -> None:
    raise NotKnown("the base is not known here")


async def look(gateway: Gateway, seconds: float) -> None:
    for _ in range(round(2.0 * seconds)):
        gateway.loop.pass_time(0.5)
        await gateway.deployer.at_hand()
        await gateway.look()


def approvals(gateway: Gateway, one) -> list[str]:
    return [
        kind for kind, what in gateway.audit.records
        if what.get("proposal") == hash_of(one) and kind in ("approved", "approval-lapsed", "deploying")
    ]  # fmt: skip


@pytest.mark.parametrize("fails", [failing, not_known])
def test_what_passes_by_its_verdict_is_tried_again_once_it_can_be_stored(fails) -> None:
    @run
    async def story():
        gateway = await trusted_once()
        two = proposal(2, gateway.loop.runs, gateway.loop.now_s, nonce=7)
        await gateway.propose(two)
        gateway.take_up = fails
        await look(gateway, 0.5)
        with pytest.raises((NotTakenUp, NotKnown)) as raised:
            await fails(two, None)
        assert gateway.deployer.trouble == str(raised.value)
        assert gateway.stage(two) is Stage.WAITING
        assert str(raised.value) in gateway.deployer.book.entries[hash_of(two)].why
        await look(gateway, RETRY_S / 2.0)
        assert approvals(gateway, two) == ["approved", "approval-lapsed"]
        assert gateway.deployer.trouble == ""
        gateway.take_up = Gateway(TRUSTING).take_up
        await look(gateway, RETRY_S)
        assert approvals(gateway, two) == ["approved", "approval-lapsed", "approved", "deploying"]
        await look(gateway, PROBATION_S + 1.0)
        assert gateway.stage(two) is Stage.KEPT

    story()


@run
async def test_what_can_never_be_stored_waits_for_a_person_in_the_end():
    gateway = await trusted_once()
    two = proposal(2, gateway.loop.runs, gateway.loop.now_s, nonce=7, lifetime_s=1e5)
    await gateway.propose(two)
    gateway.take_up = failing
    await look(gateway, RETRY_S * 2.0 ** (MOST_RETRIES + 1))
    assert approvals(gateway, two) == (MOST_RETRIES + 1) * ["approved", "approval-lapsed"]
    assert gateway.stage(two) is Stage.WAITING
    gateway.take_up = Gateway(TRUSTING).take_up
    assert (await gateway.decide(two)).ok and gateway.stage(two) is Stage.PROBATION


@run
async def test_a_persons_approval_of_what_cannot_be_stored_is_answered_with_why_and_counts_no_more():
    gateway, _ = await deployed()
    await gateway.pass_time(PROBATION_S + 1.0)
    two = proposal(2, gateway.loop.runs, gateway.loop.now_s)
    await gateway.propose(two)
    gateway.take_up = failing
    reply = await gateway.decide(two)
    assert not reply.ok and reply.reasons == ["the store is locked"]
    assert gateway.stage(two) is Stage.WAITING  # at once, not with the next look


@run
async def test_another_approval_while_a_change_is_on_probation_keeps_no_lease_waiting_for_a_store():
    gateway, one = await deployed()
    two = proposal(2, gateway.loop.runs, gateway.loop.now_s)
    await gateway.propose(two)
    taken_up = []

    async def noted(proposal, verdict) -> None:
        taken_up.append(proposal)

    gateway.take_up = noted
    reply = await gateway.decide(two)
    assert not reply.ok and "one change at a time" in reply.reasons[0]
    assert taken_up == [] and gateway.stage(two) is Stage.WAITING


@pytest.mark.wires
def test_a_store_that_a_backup_holds_for_five_seconds_ends_nothing_and_holds_up_nobody(tmp_path: Path) -> None:
    begin_configurations(tmp_path / "configurations.sqlite").close()
    begin_repository(tmp_path / "models.sqlite").close()

    @run
    async def story():
        gateway = await trusted_once()
        writer = StoreWriter(LINE, tmp_path, tmp_path, lambda: gateway.loop.now_s)
        gateway.take_up = writer.take_up
        two = proposal(2, gateway.loop.runs, gateway.loop.now_s, nonce=7)
        await gateway.propose(two)
        await gateway.deployer.at_hand()
        backup = apsw.Connection(str(tmp_path / "configurations.sqlite"))
        backup.execute("BEGIN EXCLUSIVE")
        looking = asyncio.create_task(gateway.deployer.watch())
        turns = 0
        while not looking.done():  # noqa: ASYNC110
            await asyncio.sleep(0.01)
            turns += 1
        await looking
        assert turns > 10  # others had their turn in these 5 s: where the event loop waits for the lock, one or two
        assert "configurations.sqlite" in gateway.deployer.trouble and gateway.stage(two) is Stage.WAITING
        backup.execute("ROLLBACK")
        backup.close()
        await look(gateway, RETRY_S + 1.0)
        assert gateway.stage(two) is Stage.PROBATION
        await look(gateway, PROBATION_S + 1.0)
        assert gateway.stage(two) is Stage.KEPT

    story()
    with begin_configurations(tmp_path / "configurations.sqlite") as configurations:
        (stored,) = configurations.entries(LINE.site, LINE.line)
        assert len(stored.origins) == 1

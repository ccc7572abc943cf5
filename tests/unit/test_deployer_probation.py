"""A change on probation: it is kept, stays, or goes back to what was good."""

import asyncio
import contextlib

from gateway.core.controller import config_hash
from gateway.core.line_model import model_hash
from gateway.supervisor.lifecycle import Stage
from gateway.supervisor.on_the_line import ASKED_AGAIN_S, LEASE_S, UNRECORDED_S
from gateway.supervisor.patience import LONGEST_WAIT_S
from tests.unit.deployer_gateway import ANNA, PROBATION_S, deployed, run, started
from tests.unit.deployer_support import FIRST, LINE, controller, hash_of, proposal
from tests.unit.model_support import model as fitted


@run
async def test_an_audit_that_fails_on_probation_leaves_the_line_on_what_was_good():
    gateway, one = await deployed()
    gateway.audit.available = False
    await gateway.pass_time(PROBATION_S + 2 * LEASE_S)
    assert gateway.loop.good == config_hash(FIRST)
    await gateway.pass_time(UNRECORDED_S)
    assert gateway.loop.runs == config_hash(FIRST)
    gateway.audit.available = True
    await gateway.deployer.watch()
    assert gateway.stage(one) is Stage.ROLLED_BACK
    assert gateway.deployer.book.in_service == gateway.loop.runs == config_hash(FIRST)


@contextlib.asynccontextmanager
async def disk_that_hangs(gateway):
    """While it does, a proposal has come in and waits for its record, with the lock of all steps."""
    append, begun, hangs = gateway.audit.append, asyncio.Event(), asyncio.Event()

    async def hang(*record):
        begun.set()
        await hangs.wait()
        await append(*record)

    gateway.audit.append = hang
    one = proposal(7, gateway.loop.runs, gateway.loop.now_s)
    coming_in = asyncio.create_task(gateway.propose(one))
    await begun.wait()
    yield
    hangs.set()
    await coming_in
    gateway.audit.append = append


@run
async def test_a_disk_that_hangs_for_longer_than_a_lease_takes_nothing_back_that_is_good():
    gateway, one = await deployed()
    runs = gateway.loop.runs
    async with disk_that_hangs(gateway):
        await gateway.pass_time(3.0 * LEASE_S)
        assert gateway.loop.runs == runs and gateway.loop.lease_end_s is not None
    await gateway.pass_time(PROBATION_S)
    assert gateway.stage(one) is Stage.KEPT


@run
async def test_a_disk_that_hangs_leaves_nothing_on_the_line_that_must_go_back():
    gateway, one = await deployed()
    async with disk_that_hangs(gateway):
        gateway.surroundings.against = "tension 3 swings"
        await gateway.pass_time(0.5)
        assert gateway.loop.runs == config_hash(FIRST)
    await gateway.pass_time(0.5)
    assert gateway.stage(one) is Stage.ROLLED_BACK and "swings" in gateway.deployer.book.entries[hash_of(one)].why


@run
async def test_a_person_takes_it_back():
    gateway, one = await deployed()
    assert (await gateway.deployer.roll_back("it hums", ANNA)).ok
    assert gateway.loop.runs == config_hash(FIRST)
    assert gateway.stage(one) is Stage.ROLLED_BACK
    assert "it hums" in gateway.deployer.book.entries[hash_of(one)].why


@run
async def test_what_speaks_against_it_on_probation_takes_it_back():
    gateway, one = await deployed()
    gateway.surroundings.against = "tension 3 swings"
    await gateway.pass_time(1.0)
    assert gateway.stage(one) is Stage.ROLLED_BACK
    assert "swings" in gateway.deployer.book.entries[hash_of(one)].why


@run
async def test_a_reason_that_is_longer_than_the_loop_takes_takes_it_back_all_the_same():
    gateway, one = await deployed()
    gateway.surroundings.against = "tension 3 swings; " * 100
    await gateway.pass_time(1.0)
    assert gateway.stage(one) is Stage.ROLLED_BACK
    gateway, one = await deployed()
    assert (await gateway.deployer.roll_back("it hums, " * 100, ANNA)).ok and gateway.stage(one) is Stage.ROLLED_BACK


@run
async def test_what_has_not_shown_enough_stays_on_probation_and_says_so():
    gateway, one = await deployed()
    gateway.surroundings.hidden = "the line has not stood for 5 s in a row"
    await gateway.pass_time(3 * PROBATION_S)
    assert gateway.stage(one) is Stage.PROBATION and gateway.loop.lease_end_s is not None
    shown, change = gateway.deployer.shown(hash_of(one)), gateway.deployer.change()
    assert "has not stood" in shown.why and change is not None
    assert (change.proposal, change.kind, change.stage, change.text) == (hash_of(one), "gains", "probation", shown.why)
    assert change.since_wall_s is not None and change.since_wall_s <= gateway.loop.now_s - 3 * PROBATION_S
    gateway.surroundings.hidden = ""
    await gateway.pass_time(1.0)
    assert gateway.stage(one) is Stage.KEPT and gateway.deployer.change() is None


def accept_model(gateway) -> None:
    accepted = fitted(LINE.n, site=LINE.site, line=LINE.line)
    gateway.surroundings.models[model_hash(accepted)] = accepted
    gateway.deployer.book.model = model_hash(accepted)


@run
async def test_a_watch_that_was_refused_is_asked_for_again_later_each_time_and_told_as_one_trouble():
    gateway = await started()
    accept_model(gateway)
    gateway.loop.watch_refusal = "no space left on device"
    await gateway.pass_time(1.0)
    said = gateway.deployer.trouble
    assert "no space left on device" in said
    gateway.loop.watch_refusal = "it takes 1.3 ms"
    await gateway.pass_time(2.0 * LONGEST_WAIT_S)
    tries = len(gateway.loop.watches)
    assert 5 < tries < 10 and gateway.deployer.trouble == said
    await gateway.pass_time(3.0 * LONGEST_WAIT_S)
    assert len(gateway.loop.watches) - tries in (2, 3)
    gateway.loop.watch_refusal = ""
    await gateway.pass_time(LONGEST_WAIT_S)
    assert gateway.loop.watched and gateway.deployer.trouble == ""
    tries = len(gateway.loop.watches)
    await gateway.pass_time(LONGEST_WAIT_S)
    assert len(gateway.loop.watches) == tries


@run
async def test_a_loop_that_has_left_its_watch_out_is_told_again():
    gateway = await started()
    accept_model(gateway)
    await gateway.pass_time(1.0)
    assert gateway.loop.watched
    gateway.loop.good_watched = False  # of what it kept before it cannot use it any more
    gateway.loop.restart()
    await gateway.pass_time(2.0 * ASKED_AGAIN_S)
    assert gateway.loop.watched and len(gateway.loop.watches) == 2


@run
async def test_without_a_model_nothing_is_watched_with_one_the_fallback_is():
    gateway, _ = await deployed()
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.loop.watches == [("deploy", None), ("keep", None)]
    # A model is accepted: what runs is looked after, once; then a change by its fallback, and by itself when kept.
    gateway.loop.watches.clear()
    accept_model(gateway)
    await gateway.pass_time(2.0)
    assert [(what, watch.fallback) for what, watch in gateway.loop.watches] == [("watch-good", gateway.loop.good)]
    before = gateway.loop.good
    gateway.loop.watches.clear()
    two = proposal(2, before, gateway.loop.now_s)
    await gateway.propose(two)
    assert (await gateway.decide(two)).ok
    await gateway.pass_time(PROBATION_S + 1.0)
    fallbacks = [(what, watch.fallback) for what, watch in gateway.loop.watches]
    assert fallbacks == [("deploy", before), ("keep", config_hash(controller(2)))]


@run
async def test_what_cannot_be_watched_is_not_deployed_and_not_kept():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    gateway.surroundings.unknown = "the model in service is damaged"
    reply = await gateway.decide(one)
    assert not reply.ok and "damaged" in reply.reasons[0] and gateway.loop.epoch == 0
    gateway.surroundings.unknown = ""
    await gateway.deployer.watch()
    assert (await gateway.decide(one)).ok
    gateway.surroundings.unknown = "the model in service is damaged"
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(one) is Stage.ROLLED_BACK and gateway.loop.runs == config_hash(FIRST)
    assert "could not be kept: the model in service is damaged" in gateway.deployer.book.entries[hash_of(one)].why

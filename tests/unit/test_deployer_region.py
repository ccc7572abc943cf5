"""For what the configuration in service was judged: as the loop says, and as the records have it."""

from gateway.core.controller import config_hash
from gateway.core.deployment import Region, first_region
from gateway.supervisor.lifecycle import Stage, book_of
from tests.unit.deployer_gateway import ANNA, PROBATION_S, deployed, run
from tests.unit.deployer_support import LINE, controller, proposal

WIDE, NARROW = Region(speed_max_m_per_s=0.1), Region(speed_max_m_per_s=0.05, tension_step_max_n=4.0)


async def again(gateway, region):
    """What is in service, proposed as it is and judged for another region."""
    gateway.judge.region = region
    one = proposal(1, config_hash(controller(1)), gateway.loop.now_s)
    await gateway.propose(one)
    assert (await gateway.decide(one)).ok
    return one


@run
async def test_it_is_that_of_the_verdict_once_it_runs_and_that_of_before_after_a_rollback():
    gateway, one = await deployed()
    assert gateway.deployer.book.region == WIDE
    await gateway.deployer.roll_back("", ANNA)
    assert gateway.stage(one) is Stage.ROLLED_BACK and gateway.deployer.book.region == Region()


@run
async def test_the_same_configuration_for_less_is_still_known_for_all_that_it_was_judged_for():
    gateway, _ = await deployed()
    await gateway.pass_time(PROBATION_S + 1.0)
    narrower = await again(gateway, NARROW)
    await gateway.pass_time(PROBATION_S + 1.0)
    book = gateway.deployer.book
    assert gateway.stage(narrower) is Stage.KEPT and book.region == NARROW
    assert book.judged_for == WIDE
    assert book_of(gateway.audit.records).judged_for == WIDE  # after a restart, too


@run
async def test_the_same_configuration_rolled_back_is_not_taken_for_kept():
    gateway, _ = await deployed()
    await gateway.pass_time(PROBATION_S + 1.0)
    narrower = await again(gateway, NARROW)
    await gateway.deployer.roll_back("", ANNA)
    await gateway.pass_time(1.0)
    assert gateway.stage(narrower) is Stage.ROLLED_BACK
    assert gateway.deployer.book.region == gateway.loop.region == WIDE


@run
async def test_what_the_loop_was_started_with_goes_no_further_than_a_first_configuration():
    gateway, _ = await deployed()
    await gateway.pass_time(PROBATION_S + 1.0)
    gateway.loop.region = gateway.loop.good_region = Region()  # both were started anew, the loop with this as given
    gateway.begin()
    await gateway.deployer.watch()
    found = [what for kind, what in gateway.audit.records if kind == "found-in-service"]
    assert found[-2]["region"] == Region().model_dump() and not found[-2]["explained"]  # it was judged for less
    assert found[-1]["region"] == first_region(LINE).model_dump() == gateway.loop.region.model_dump()


def test_regions_together_go_as_far_as_either():
    assert WIDE.and_also(NARROW) == WIDE and NARROW.and_also(WIDE) == WIDE
    steps = Region(speed_max_m_per_s=0.02, tension_step_max_n=8.0, speed_step_max_m_per_s=0.01)
    assert steps.and_also(NARROW) == Region(speed_max_m_per_s=0.05, tension_step_max_n=8.0)

"""What runs in the loop and no record explains: on record, told, and no further than a first configuration."""

import pytest

from gateway.core.audit_record import Who
from gateway.core.controller import config_hash
from gateway.core.decisions import Confirm
from gateway.core.deployment import Region, first_region
from gateway.mailbox.port import Unreachable
from gateway.supervisor.lifecycle import book_of
from tests.unit.deployer_gateway import LINE, OPERATORS_UID, PROBATION_S, Gateway, deployed, run, started
from tests.unit.deployer_support import FIRST, Death, FakeLoop, hash_of, proposal

STRANGE = "5" * 64
ANNA = Who(name="anna", uid=1000, pid=1)
CONFINED = first_region(LINE)


def found_last(gateway):
    return [what for kind, what in gateway.audit.records if kind == "found-in-service"][-1]


async def look(gateway):
    gateway.deployer.look_again()
    await gateway.pass_time(1.0)


@run
async def test_a_configuration_that_somebody_has_put_there_is_confined_and_told_until_another_is_approved():
    gateway = await started()
    assert not gateway.deployer.unexplained
    loop = gateway.loop
    loop.runs = loop.good = STRANGE
    await look(gateway)
    strange = [what for kind, what in gateway.audit.records if kind == "found-in-service"][-2]
    assert (strange["configuration"], strange["explained"], strange["confined"]) == (STRANGE, False, True)
    assert loop.region == CONFINED
    (found,) = gateway.deployer.unexplained
    assert found.code == "configuration-unexplained" and found.parameters["configuration"] == STRANGE[:12]
    gateway.begin()  # a gateway that is started anew knows it still
    await look(gateway)
    assert [one.code for one in gateway.deployer.unexplained] == ["configuration-unexplained"]
    one = proposal(2, STRANGE, loop.now_s)
    assert (await gateway.propose(one)).ok and (await gateway.decide(one)).ok
    await gateway.pass_time(PROBATION_S + 5.0)
    assert loop.good == config_hash(one.change.controller) and not gateway.deployer.unexplained


@run
async def test_what_somebody_has_deployed_is_taken_back_while_it_is_on_probation():
    gateway = await started()
    loop = gateway.loop
    loop.runs, loop.epoch, loop.lease_end_s, loop.why = STRANGE, 1, loop.now_s + 1e6, "deployed"
    await look(gateway)
    assert loop.runs == config_hash(FIRST) and loop.lease_end_s is None
    assert any(what["configuration"] == STRANGE and not what["explained"] for kind, what in gateway.audit.records
               if kind == "found-in-service")  # fmt: skip


@run
async def test_a_line_that_runs_faster_than_it_may_is_confined_all_the_same():
    gateway = await started()
    loop = gateway.loop
    loop.runs = loop.good = STRANGE
    loop.fast = True  # what a person says of the line is refused on such a one
    await look(gateway)
    assert loop.region == CONFINED and gateway.deployer.unexplained and not gateway.deployer.trouble
    assert not (await gateway.deployer.line_changed("another web", ANNA)).ok


@run
async def test_what_the_loop_does_not_confine_is_told_until_it_does():
    gateway = await started()
    loop = gateway.loop
    loop.runs = loop.good = STRANGE
    loop.narrows = False
    await look(gateway)
    assert loop.region == Region() and "ending" in gateway.deployer.trouble and gateway.deployer.unexplained
    loop.narrows = True
    await gateway.pass_time(15.0)
    assert loop.region == CONFINED


def strange_of(gateway, **what):
    """As if the loop had kept something at some time."""
    for name, value in what.items():
        setattr(gateway.loop, name, value)


@pytest.mark.parametrize("epoch", [1, 7])
def test_what_a_new_audit_does_not_know_is_unexplained_where_the_loop_has_kept_something(epoch):
    async def story():
        gateway = Gateway()  # and no record
        strange_of(gateway, runs=STRANGE, good=STRANGE, epoch=epoch)
        await look(gateway)
        first = next(what for kind, what in gateway.audit.records if kind == "found-in-service")
        assert not first["explained"] and first["confined"] and gateway.loop.region == CONFINED
        assert [one.code for one in gateway.deployer.unexplained] == ["configuration-unexplained"]
        assert (await gateway.deployer.confirm(Confirm(configuration=STRANGE, because="restored"), ANNA)).ok
        await look(gateway)
        gateway.begin()
        await look(gateway)
        assert not gateway.deployer.unexplained and gateway.loop.region == CONFINED

    run(story)()


@run
async def test_an_audit_that_is_taken_away_under_what_was_kept_in_order_explains_nothing_of_it():
    gateway, one = await deployed()
    await gateway.pass_time(PROBATION_S + 5.0)
    assert gateway.loop.good == config_hash(one.change.controller)
    gateway.audit.records.clear()
    gateway.begin()
    await look(gateway)
    assert gateway.deployer.unexplained and gateway.loop.region.within(CONFINED)


@run
async def test_a_first_installation_is_no_alarm():
    gateway = Gateway()
    await look(gateway)
    assert not gateway.deployer.unexplained and found_last(gateway)["explained"]


def another_epoch(loop):
    loop.epoch = 7


def an_epoch_before(loop):
    loop.epoch = 0


def another_good(loop):
    loop.good = STRANGE


def the_good_one_before(loop):
    loop.good = config_hash(FIRST)


def goes_back_to_what_nobody_kept(loop):
    loop.runs = loop.good = config_hash(FIRST)


@pytest.mark.parametrize(
    "spoil", [another_epoch, an_epoch_before, another_good, the_good_one_before, goes_back_to_what_nobody_kept]
)
def test_the_same_configuration_with_another_epoch_or_another_good_one_is_unexplained(spoil):
    async def story():
        gateway, _ = await deployed()
        await gateway.pass_time(PROBATION_S + 5.0)
        spoil(gateway.loop)
        await look(gateway)
        assert gateway.deployer.unexplained and gateway.loop.region.within(CONFINED)

    run(story)()


@run
async def test_the_file_that_was_kept_last_is_explained_again_once_it_is_put_back_and_no_older_one_is():
    gateway, one = await deployed()
    await gateway.pass_time(PROBATION_S + 5.0)
    second = proposal(2, gateway.loop.runs, gateway.loop.now_s)
    assert (await gateway.propose(second)).ok and (await gateway.decide(second)).ok
    await gateway.pass_time(PROBATION_S + 5.0)
    loop, kept = gateway.loop, gateway.loop.in_service()
    strange_of(gateway, runs=STRANGE, good=STRANGE, epoch=0)  # the file is gone, the loop runs what it is given
    await look(gateway)
    assert gateway.deployer.unexplained
    older = config_hash(one.change.controller)
    strange_of(gateway, runs=older, good=older, epoch=1)
    await look(gateway)
    assert gateway.deployer.unexplained
    strange_of(gateway, runs=kept.hash, good=kept.hash, epoch=2, region=kept.region, good_region=kept.region)
    await look(gateway)
    assert not gateway.deployer.unexplained and loop.region == kept.region


def an_older_file(loop):
    loop.runs = loop.good = loop.older


def a_strange_good_one(loop):
    loop.good = STRANGE
    loop.lease_end_s, loop.why = None, "kept"


def a_wider_region(loop):
    loop.go_back("start")
    loop.region = loop.good_region = Region()


@pytest.mark.parametrize("spoil", [an_older_file, a_strange_good_one, a_wider_region])
def test_nor_does_a_change_on_probation_explain_what_is_put_in_its_place(spoil):
    async def story():
        gateway, one = await deployed()
        await gateway.pass_time(PROBATION_S + 5.0)
        second = proposal(2, gateway.loop.runs, gateway.loop.now_s)
        assert (await gateway.propose(second)).ok and (await gateway.decide(second)).ok
        await gateway.pass_time(PROBATION_S + 5.0)
        third = proposal(3, gateway.loop.runs, gateway.loop.now_s)
        assert (await gateway.propose(third)).ok and (await gateway.decide(third)).ok
        loop = gateway.loop
        loop.older = config_hash(one.change.controller)
        if spoil is an_older_file:
            loop.go_back("start")
        spoil(loop)
        await look(gateway)
        assert gateway.stage(third) == "rolled-back"
        assert gateway.deployer.unexplained and loop.region.within(CONFINED)
        gateway.begin()
        await look(gateway)
        assert gateway.deployer.unexplained

    run(story)()


@pytest.mark.parametrize("spoil", ["older", "wider"])
def test_a_file_of_the_loop_that_was_put_back_or_widened_is_unexplained(spoil):
    async def story():
        gateway, one = await deployed()
        await gateway.pass_time(PROBATION_S + 5.0)
        second = proposal(2, hash_of_running(gateway), gateway.loop.now_s)
        assert (await gateway.propose(second)).ok and (await gateway.decide(second)).ok
        await gateway.pass_time(PROBATION_S + 5.0)
        loop = gateway.loop
        if spoil == "older":  # what was kept before, with its epoch
            loop.runs = loop.good = config_hash(one.change.controller)
            loop.epoch = 1
        else:
            loop.region = loop.good_region = Region()
        await look(gateway)
        assert gateway.deployer.unexplained and loop.region == CONFINED.no_further(loop.region)
        assert loop.region.within(CONFINED)

    run(story)()


def hash_of_running(gateway):
    return gateway.loop.runs


@run
async def test_what_happens_in_order_is_never_unexplained():
    gateway, one = await deployed()
    assert not gateway.deployer.unexplained
    gateway.loop.restart()
    await look(gateway)
    again = proposal(2, gateway.loop.runs, gateway.loop.now_s)
    assert (await gateway.propose(again)).ok and (await gateway.decide(again)).ok
    await gateway.pass_time(PROBATION_S + 5.0)
    assert (await gateway.deployer.line_changed("another web", ANNA)).ok
    await look(gateway)
    assert not gateway.deployer.unexplained and gateway.stage(again) == "kept" and hash_of(one) != hash_of(again)
    assert all(what["explained"] for kind, what in gateway.audit.records if kind == "found-in-service")


def test_an_audit_of_an_earlier_version_confines_nothing():
    found = {"configuration": STRANGE, "last_known_good": STRANGE, "epoch": 0, "region": {}, "because": "start"}
    book = book_of([("found-in-service", {**found, "explained": False})])
    loop = FakeLoop(Death())
    loop.runs = loop.good = STRANGE
    told = loop.in_service()
    assert book.unexplained is None and book.explains(told)


@run
async def test_a_person_who_knows_what_runs_confirms_it_and_it_stays_confined():
    gateway = await started()
    loop = gateway.loop
    right = Confirm(configuration=STRANGE, because="exchanged after the repair")
    assert not (await gateway.deployer.confirm(right, ANNA)).ok  # there is nothing to confirm
    loop.runs = loop.good = STRANGE
    await look(gateway)
    assert not (await gateway.deployer.confirm(Confirm(configuration="6" * 64, because="x"), ANNA)).ok
    assert gateway.deployer.unexplained
    assert (await gateway.deployer.confirm(right, ANNA)).ok
    assert not gateway.deployer.unexplained and loop.region == CONFINED
    loop.restart()
    await look(gateway)
    gateway.begin()
    await look(gateway)
    assert not gateway.deployer.unexplained
    loop.region = Region()  # as far as that it was not confirmed
    await look(gateway)
    assert gateway.deployer.unexplained and loop.region == CONFINED


@run
async def test_a_first_configuration_is_told_until_a_person_confirms_it_and_each_start_of_the_loop_learns_of_it():
    gateway = await started()
    loop, first = gateway.loop, config_hash(FIRST)
    loop.confirmed = set()
    await look(gateway)
    (found,) = gateway.deployer.unconfirmed
    assert found.code == "configuration-unconfirmed" and found.parameters["configuration"] == first[:12]
    assert not gateway.deployer.unexplained and not loop.confirmed
    said = Confirm(configuration=first, because="it has held for a week")
    loop.tension_moved = loop.speed_changed = True
    assert (await gateway.deployer.confirm(said, ANNA)).ok
    await look(gateway)
    assert loop.confirmed == {first} and not gateway.deployer.unconfirmed
    assert not (await gateway.deployer.confirm(said, ANNA)).ok  # there is nothing left to confirm
    loop.confirmed = set()  # started anew
    gateway.begin()  # and so is the gateway
    await look(gateway)
    assert loop.confirmed == {first} and not gateway.deployer.unconfirmed


@run
async def test_a_first_configuration_is_confirmed_only_after_a_move_and_a_speed_change():
    gateway = await started()
    loop, said = gateway.loop, Confirm(configuration=config_hash(FIRST), because="it holds")
    loop.confirmed = set()
    await look(gateway)
    both = ["move-not-shown", "speed-change-not-shown"]
    for moved, changed, missing in ((False, False, both), (True, False, both[1:]), (False, True, both[:1])):
        loop.tension_moved, loop.speed_changed = moved, changed
        reply = await gateway.deployer.confirm(said, ANNA)
        assert not reply.ok and [one.code for one in reply.findings] == missing
        assert len(reply.reasons) == len(missing) and gateway.deployer.unconfirmed
    assert "confirmed" not in gateway.audit.kinds and not loop.confirmed
    loop.tension_moved = loop.speed_changed = True
    loop.reachable = False  # what it has shown is asked for anew, and not remembered
    assert not (await gateway.deployer.confirm(said, ANNA)).ok
    loop.reachable = True
    assert (await gateway.deployer.confirm(said, ANNA)).ok and not gateway.deployer.unconfirmed


@run
async def test_where_the_line_has_people_one_of_them_confirms():
    gateway = await started()
    loop, said = gateway.loop, Confirm(configuration=config_hash(FIRST), because="it holds")
    loop.confirmed, loop.tension_moved, loop.speed_changed = set(), True, True
    await look(gateway)
    gateway.roles = {"anna": "engineer"}
    for nobody in (Who(name="root", uid=0, pid=1), Who(name="r2rgate", uid=OPERATORS_UID, pid=1)):
        reply = await gateway.deployer.confirm(said, nobody)
        assert not reply.ok and [one.code for one in reply.findings] == ["confirm-by-no-person"]
    assert gateway.deployer.unconfirmed
    assert (await gateway.deployer.confirm(said, ANNA)).ok


@run
async def test_what_was_judged_needs_no_confirmation():
    gateway, _ = await deployed()
    await gateway.pass_time(PROBATION_S + 5.0)
    assert not gateway.deployer.unconfirmed


@run
async def test_before_the_first_look_at_the_loop_whoever_arms_has_it_looked_at():
    gateway = await started()
    gateway.loop.runs = gateway.loop.good = STRANGE
    gateway.begin()
    assert not gateway.deployer.unexplained  # nobody has looked
    assert not await gateway.deployer.hold_against_records(0.1)
    assert [one.code for one in gateway.deployer.unexplained] == ["configuration-unexplained"]
    gateway.deployer.look_again()
    gateway.loop.reachable = False
    with pytest.raises(Unreachable):
        await gateway.deployer.hold_against_records(0.1)


@run
async def test_what_cannot_be_recorded_is_not_armed_and_says_why():
    gateway = await started()
    gateway.loop.runs = gateway.loop.good = STRANGE
    gateway.begin()
    gateway.audit.available = False
    assert "full" in await gateway.deployer.hold_against_records(0.1)
    gateway.audit.available = True
    assert not await gateway.deployer.hold_against_records(0.1) and gateway.deployer.unexplained

"""What the loop was told and did not answer: not known until it is, then on record and told once."""

import pytest

from gateway.core.controller import config_hash
from gateway.core.deployment import first_region
from gateway.supervisor.lifecycle import ON_THE_LINE, Stage
from gateway.supervisor.on_the_line import LATE_S, LEASE_S
from tests.unit.deployer_gateway import ANNA, PROBATION_S, deployed, run, started
from tests.unit.deployer_support import FIRST, LINE, hash_of, proposal

#: What becomes of a command whose answer does not come.
DONE = {"answers": False}
LOST = {"loses": True}
LATE = {"late_s": 12.0}
TOO_LATE = {"late_s": LATE_S + 5.0}


def spoil(gateway, command, how) -> None:
    loop = gateway.loop
    loop.spoiled = {command}
    loop.answers, loop.loses, loop.late_s = how.get("answers", True), how.get("loses", False), how.get("late_s", 0.0)


def mend(gateway) -> None:
    gateway.loop.answers, gateway.loop.loses, gateway.loop.late_s = True, False, 0.0


def agree(gateway) -> None:
    said, book = gateway.loop.in_service(), gateway.deployer.book
    assert (book.in_service, book.last_known_good, book.epoch) == (said.hash, said.last_known_good, said.epoch)


def outcomes(gateway) -> list[str]:
    return [data["outcome"] for kind, data in gateway.notes if kind == "outcome"]


@pytest.mark.parametrize(
    ("how", "at_first", "in_the_end"),
    [
        (DONE, Stage.PROBATION, Stage.KEPT),
        (LOST, Stage.DEPLOYING, Stage.NOT_DEPLOYED),
        (LATE, Stage.DEPLOYING, Stage.KEPT),
        (TOO_LATE, Stage.DEPLOYING, Stage.NOT_DEPLOYED),
    ],
)
def test_a_deployment_that_is_not_answered_is_not_known_until_the_loop_says_what_it_runs(how, at_first, in_the_end):
    @run
    async def story():
        gateway = await started()
        one = proposal(1, config_hash(FIRST), 0.0)
        await gateway.propose(one)
        spoil(gateway, "deploy", how)
        reply = await gateway.decide(one)
        assert (reply.ok, reply.known) == (False, False) and gateway.stage(one) is Stage.DEPLOYING
        assert "not known" in gateway.deployer.change().text
        mend(gateway)
        await gateway.pass_time(1.0)
        assert gateway.stage(one) is at_first
        await gateway.pass_time(LATE_S + PROBATION_S + 2.0 * LEASE_S)
        assert gateway.stage(one) is in_the_end
        agree(gateway)
        outcome = "not-deployed" if in_the_end is Stage.NOT_DEPLOYED else "deployed"
        assert outcomes(gateway) == [outcome] and gateway.audit.kinds.count(outcome) == 1
        assert [what.get("unanswered") for kind, what in gateway.audit.records if kind == outcome] == [True]
        two = proposal(2, gateway.loop.runs, gateway.loop.now_s)
        await gateway.propose(two)
        assert (await gateway.decide(two)).ok  # nothing is in the way of the next one

    story()


@run
async def test_a_deployment_that_was_taken_late_is_watched_for_all_of_its_probation():
    gateway = await started()
    await gateway.pass_time(2.0 * PROBATION_S)  # whatever was measured from goes by now
    one = proposal(1, config_hash(FIRST), gateway.loop.now_s)
    await gateway.propose(one)
    spoil(gateway, "deploy", LATE)
    await gateway.decide(one)
    mend(gateway)
    await gateway.pass_time(LATE["late_s"] + PROBATION_S - 1.0)
    assert gateway.stage(one) is Stage.PROBATION
    await gateway.pass_time(2.0)
    assert gateway.stage(one) is Stage.KEPT


@run
async def test_a_loop_that_could_not_be_told_has_not_taken_it():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    tell = gateway.loop.tell

    async def gone(command, grounds=None):
        gateway.loop.reachable = command.command != "deploy"
        return await tell(command)

    gateway.loop.tell = gone
    reply = await gateway.decide(one)
    assert (reply.ok, reply.known) == (False, True) and gateway.stage(one) is Stage.NOT_DEPLOYED
    agree(gateway)


@pytest.mark.parametrize("how", [DONE, LOST, LATE, TOO_LATE])
def test_a_deployment_that_a_process_died_over_is_settled_by_the_next_one(how):
    @run
    async def story():
        gateway = await started()
        one = proposal(1, config_hash(FIRST), 0.0)
        await gateway.propose(one)
        spoil(gateway, "deploy", how)
        await gateway.decide(one)
        mend(gateway)
        gateway.begin()
        await gateway.pass_time(LATE_S + PROBATION_S + 2.0 * LEASE_S)
        agree(gateway)
        assert gateway.stage(one) is (Stage.KEPT if how in (DONE, LATE) else Stage.NOT_DEPLOYED)
        assert len(outcomes(gateway)) == 1

    story()


@pytest.mark.parametrize("how", [DONE, LOST, {"late_s": 1.0}])
@pytest.mark.parametrize("predictive", [False, True])
def test_a_keep_that_is_not_answered_is_asked_for_again_and_takes_back_nothing_that_was_kept(how, predictive):
    @run
    async def story():
        gateway, one = await deployed()
        if predictive:  # it runs on top of what the line goes back to
            gateway.loop.predictive.add(gateway.loop.runs)
        runs = gateway.loop.runs
        spoil(gateway, "keep", how)
        while "keeping" not in gateway.audit.kinds:
            await gateway.pass_time(0.5)
        mend(gateway)
        await gateway.pass_time(PROBATION_S)
        assert gateway.loop.runs == runs and gateway.stage(one) is Stage.KEPT
        agree(gateway)
        assert outcomes(gateway) == ["kept"] and gateway.audit.kinds.count("kept") == 1

    story()


@run
async def test_a_second_keep_that_is_refused_because_the_first_was_done_late_takes_back_nothing():
    gateway, one = await deployed()
    gateway.loop.predictive.add(gateway.loop.runs)
    runs, tell, told = gateway.loop.runs, gateway.loop.tell, []

    async def late(command, grounds=None):
        if command.command != "keep":
            return await tell(command)
        told.append(command)
        if len(told) == 1:  # done only once the second has been sent
            spoil(gateway, "keep", LOST)
        else:
            mend(gateway)
            await tell(command)
        return await tell(command)

    gateway.loop.tell = late
    await gateway.pass_time(2.0 * PROBATION_S)
    assert len(told) == 2 and gateway.loop.runs == runs and gateway.stage(one) is Stage.KEPT
    assert "rolled-back" not in gateway.audit.kinds


@pytest.mark.parametrize("how", [DONE, LOST, {"late_s": 1.0}])
def test_a_rollback_that_is_not_answered_is_not_known_and_its_outcome_is_on_record_once(how):
    @run
    async def story():
        gateway, one = await deployed()
        await gateway.pass_time(1.0)
        spoil(gateway, "rollback", how)
        reply = await gateway.deployer.roll_back("it hums", ANNA)
        assert (reply.ok, reply.known) == (False, False)
        mend(gateway)
        if how is LOST:
            assert (await gateway.deployer.roll_back("it hums", ANNA)).ok
        await gateway.pass_time(3.0)
        agree(gateway)
        assert gateway.stage(one) is Stage.ROLLED_BACK and gateway.audit.kinds.count("rolled-back") == 1

    story()


@pytest.mark.parametrize("how", [DONE, LOST])
def test_a_line_that_changed_and_a_loop_that_did_not_answer(how):
    @run
    async def story():
        gateway = await started()
        spoil(gateway, "narrow", how)
        reply = await gateway.deployer.line_changed("another web", ANNA)
        assert (reply.ok, reply.known) == (False, False) and "line-changed" not in gateway.audit.kinds
        mend(gateway)
        await gateway.pass_time(1.0)
        agree(gateway)
        assert (await gateway.deployer.line_changed("another web", ANNA)).ok
        assert gateway.loop.region == gateway.deployer.book.region == first_region(LINE)

    story()


@run
async def test_what_is_on_the_line_and_could_not_be_recorded_is_not_called_not_carried_out():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    tell = gateway.loop.tell

    async def disk_full_after(command, grounds=None):
        reply = await tell(command)
        if command.command == "deploy":
            gateway.audit.available = False
        return reply

    gateway.loop.tell = disk_full_after
    reply = await gateway.decide(one)
    assert (reply.ok, reply.known) == (False, False) and gateway.loop.runs == gateway.deployer.book.entries[
        hash_of(one)
    ].changes
    gateway.loop.tell = tell
    await gateway.pass_time(2.0 * LEASE_S)
    assert gateway.loop.runs == config_hash(FIRST)  # not renewed without a record
    gateway.audit.available = True
    await gateway.pass_time(1.0)
    agree(gateway)
    assert gateway.deployer.book.entries[hash_of(one)].stage not in ON_THE_LINE

"""The deployer: judged, approved as it was shown, audited first, deployed once."""

import asyncio

import pytest

from gateway.core.controller import config_hash
from gateway.core.finding import finding
from gateway.supervisor.lifecycle import Stage, book_of
from tests.unit.deployer_gateway import ANNA, PROBATION_S, deployed, run, started
from tests.unit.deployer_support import FIRST, LIFETIME_S, LINE, controller, hash_of, model_proposal, proposal


@run
async def test_a_change_is_judged_approved_watched_and_kept():
    gateway, one = await deployed()
    assert gateway.stage(one) is Stage.PROBATION
    assert gateway.loop.runs == config_hash(controller(1))
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(one) is Stage.KEPT
    assert gateway.loop.good == gateway.deployer.book.last_known_good == config_hash(controller(1))
    kinds = [kind for kind, _ in gateway.audit.records]
    assert kinds == ["found-in-service", "proposed", "accepted", "approved", "deploying", "deployed", "keeping", "kept"]


@run
async def test_what_the_gate_refuses_cannot_be_approved():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    gateway.judge.refuses.add(hash_of(one))
    await gateway.propose(one)
    assert gateway.stage(one) is Stage.REFUSED
    assert not (await gateway.decide(one)).ok
    assert gateway.loop.epoch == 0


@run
async def test_an_approval_is_of_what_was_shown_and_good_once():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    assert not (await gateway.decide(one, shown="1" * 64)).ok
    shown = gateway.deployer.shown(hash_of(one)).shown
    assert (await gateway.decide(one)).ok
    assert not (await gateway.decide(one, shown=shown)).ok
    assert gateway.loop.epoch == 1


@run
async def test_whoever_names_a_revision_decides_on_that_alone():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), gateway.loop.now_s)
    await gateway.propose(one)
    epoch = gateway.deployer.book.epoch
    for approve in (True, False):
        reply = await gateway.decide(one, approve, revision=epoch + 1)
        assert not reply.ok and f"of revision {epoch + 1}, in service is revision {epoch}" in reply.reasons[0]
    assert gateway.stage(one) is Stage.WAITING
    assert (await gateway.decide(one, revision=epoch)).ok


@run
async def test_what_was_shown_on_another_configuration_is_not_approved():
    gateway = await started()
    one, other = (proposal(number, config_hash(FIRST), 0.0) for number in (1, 2))
    await gateway.propose(one)
    await gateway.propose(other)
    shown = gateway.deployer.shown(hash_of(other)).shown
    await gateway.decide(one)
    assert not (await gateway.decide(other, shown=shown)).ok
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(other) is Stage.SUPERSEDED


@run
async def test_without_an_audit_nothing_is_changed():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    gateway.audit.available = False
    reply = await gateway.decide(one)
    assert not reply.ok and "disk is full" in " ".join(reply.reasons)
    assert gateway.loop.epoch == 0


@run
async def test_a_refusal_of_the_loop_is_no_deployment():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    gateway.loop.takes = False
    assert not (await gateway.decide(one)).ok
    assert gateway.stage(one) is Stage.NOT_DEPLOYED
    gateway.loop.takes = True
    two = proposal(2, config_hash(FIRST), 0.0)
    await gateway.propose(two)
    assert (await gateway.decide(two)).ok


@run
async def test_what_the_loop_refuses_for_what_passes_waits_for_the_person_again():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    gateway.loop.takes, gateway.loop.refuses_by = False, [finding("setpoints-move")]
    for _ in range(2):
        reply = await gateway.decide(one)
        assert not reply.ok and "approved again" in reply.text
        assert gateway.stage(one) is Stage.WAITING
        entry = gateway.deployer.book.entries[hash_of(one)]
        assert "not its successor, or not now" in entry.why
        assert (entry.epoch, entry.region, entry.by_person, entry.approval) == (None, None, False, None)
    assert gateway.audit.kinds.count("put-off") == 2
    said = gateway.loop.in_service()
    assert gateway.deployer.book.explains(said) and gateway.deployer.book.epoch == said.epoch == 0
    gateway.loop.takes = True
    assert (await gateway.decide(one)).ok and gateway.stage(one) is Stage.PROBATION


@run
async def test_an_answer_that_does_not_come_is_asked_for_later():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    loop, tell = gateway.loop, gateway.loop.tell

    async def silent(command, grounds=None):
        loop.answers = command.command != "deploy"
        return await tell(command)

    loop.tell = silent
    assert not (await gateway.decide(one)).ok
    await gateway.pass_time(1.0)
    assert gateway.stage(one) is Stage.PROBATION


@run
async def test_a_proposal_expires():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    await gateway.pass_time(LIFETIME_S + 1.0)
    assert gateway.stage(one) is Stage.EXPIRED
    assert not (await gateway.decide(one)).ok


@run
async def test_bytes_that_are_no_proposal_are_refused_and_on_record():
    gateway = await started()
    reply = await gateway.deployer.propose(b'{"format": 1, "format": 1}', ANNA)
    assert not reply.ok and "twice" in " ".join(reply.reasons)
    assert gateway.audit.records[-1][0] == "malformed-proposal"


@run
async def test_a_loop_that_was_started_with_something_else_is_asked_again():
    gateway = await started()
    gateway.loop.runs = gateway.loop.good = config_hash(controller(5))
    gateway.deployer.look_again()
    await gateway.deployer.watch()
    assert gateway.deployer.book.in_service == config_hash(controller(5))


@run
async def test_an_accepted_model_supersedes_what_waits_and_was_judged_by_the_old_one():
    gateway = await started()
    base = config_hash(FIRST)
    one, other, another = proposal(1, base, 0.0), model_proposal(2, base, 0.0), model_proposal(3, base, 0.0)
    for waits in (one, other, another):
        await gateway.propose(waits)
    assert (await gateway.decide(other)).ok
    reply = await gateway.decide(one)  # as it is shown now, and before anybody has looked again
    assert not reply.ok and "it was judged by the line's file" in reply.reasons[0]
    await gateway.deployer.watch()
    assert [gateway.stage(waits) for waits in (one, other, another)] == [
        Stage.SUPERSEDED, Stage.KEPT, Stage.SUPERSEDED,
    ]  # fmt: skip
    assert "propose it again" in gateway.deployer.shown(hash_of(one)).why
    again = proposal(1, base, gateway.loop.now_s, nonce=1)
    await gateway.propose(again)
    gateway.begin()  # what is on record is enough
    await gateway.deployer.watch()
    assert gateway.stage(again) is Stage.WAITING
    assert (await gateway.decide(again)).ok and gateway.loop.epoch == 1


@run
async def test_a_verdict_by_the_old_model_that_comes_after_the_new_one_counts_no_more():
    gateway = await started()
    base = config_hash(FIRST)
    one, other = proposal(1, base, 0.0), model_proposal(2, base, 0.0)
    await gateway.propose(other)
    judge, hold = gateway.judge.judge, asyncio.Event()

    async def slow(*asked):
        await hold.wait()
        return await judge(*asked)

    gateway.judge.judge = slow
    proposing = asyncio.create_task(gateway.propose(one))
    while hash_of(one) not in gateway.deployer.book.entries:  # noqa: ASYNC110 (in this loop)
        await asyncio.sleep(0)
    await asyncio.sleep(0)  # its context is made
    assert (await gateway.decide(other)).ok
    hold.set()
    await proposing
    assert not (await gateway.decide(one)).ok
    await gateway.deployer.watch()
    assert gateway.stage(one) is Stage.SUPERSEDED and gateway.loop.epoch == 0


def test_records_that_do_not_say_by_which_model_was_judged_count_for_the_one_of_then():
    times = {"created": "2026-01-05T06:00:00+00:00", "expires": "2026-01-05T14:00:00+00:00", "expires_s": 4e9}
    named = {"author": "rules", "base": "2" * 64, **times}
    book = book_of([
        ("found-in-service", {"configuration": "2" * 64, "last_known_good": "2" * 64, "epoch": 0}),
        ("proposed", {"proposal": "1" * 64, "changes": "3" * 64, "change": "model", **named}),
        ("accepted", {"proposal": "1" * 64, "verdict": "4" * 64}),
        ("approved", {"proposal": "1" * 64}),
        ("model-in-service", {"proposal": "1" * 64}),
        ("proposed", {"proposal": "5" * 64, "changes": "6" * 64, "change": "gains", **named}),
        ("accepted", {"proposal": "5" * 64, "verdict": "7" * 64}),
    ])  # fmt: skip
    assert book.why_outdated(book.entries["5" * 64]) == "" and book.model == "3" * 64
    book.line = "8" * 64  # nor do they say by which line's file: by none that is known
    assert "before it was changed" in book.why_outdated(book.entries["5" * 64])


@pytest.mark.parametrize("approved", [False, True])
def test_what_was_judged_by_another_lines_file_is_not_carried_out(approved):
    """Narrower limits were written, and the gateway started anew."""

    async def test():
        gateway = await started()
        one = proposal(1, config_hash(FIRST), gateway.loop.now_s)
        await gateway.propose(one)
        if approved:
            await gateway.audit.append("approved", ANNA, {"proposal": hash_of(one), "by": "person"})
        slower = LINE.limits.model_copy(update={"speed_max_m_per_s": 0.5 * LINE.limits.speed_max_m_per_s})
        gateway.line = LINE.model_copy(update={"limits": slower})
        gateway.begin()
        reply = await gateway.decide(one)
        assert not reply.ok
        if not approved:
            assert "by the line's file as it was before it was changed" in reply.reasons[0]
        await gateway.deployer.watch()
        assert gateway.stage(one) is Stage.SUPERSEDED and gateway.loop.epoch == 0
        assert gateway.audit.records[-1][1]["because"].endswith("propose it again")

    asyncio.run(test())

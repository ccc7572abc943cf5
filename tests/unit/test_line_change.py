"""A line that is no longer as it was, another web or a new part: what was learned of it counts no more."""

from dataclasses import replace

from gateway.core.controller import config_hash
from gateway.core.deployment import Region, first_region
from gateway.supervisor.lifecycle import LINE_CHANGED, Book, Entry, Stage, book_of
from tests.unit.deployer_gateway import ANNA, PROBATION_S, deployed, run, started
from tests.unit.deployer_support import FIRST, LINE, controller, hash_of, proposal

WIDE = Region(speed_max_m_per_s=0.1)
WHY = "PET 50 um in place of 36"


def accepted_model() -> Book:
    """Of a line on which a model was accepted."""
    book = book_of([("found-in-service", {"configuration": "2" * 64, "last_known_good": "2" * 64, "epoch": 0})])
    times = {"created": "2026-01-05T06:00:00+00:00", "expires": "2026-01-05T14:00:00+00:00", "expires_s": 4e9}
    named = {"proposal": "1" * 64, "author": "rules", "base": "2" * 64, "changes": "3" * 64, "change": "model", **times}
    book.apply("proposed", named)
    book.apply("accepted", {"proposal": "1" * 64, "verdict": "4" * 64})
    book.apply("approved", {"proposal": "1" * 64})
    book.apply("model-in-service", {"proposal": "1" * 64})
    return book


def test_no_model_is_in_service_any_more_nobody_is_trusted_and_what_came_before_is_told_apart():
    book = accepted_model()
    assert (book.model, book.trusted, len(book.since_change)) == ("3" * 64, {"model": "1" * 64}, 1)
    book.apply(LINE_CHANGED, {"because": WHY, "at_s": 50.0})
    assert (book.model, book.trusted, book.since_change, book.line_changed_s) == (None, {}, [], 50.0)
    assert book.in_service == "2" * 64  # it stays until something else is approved


@run
async def test_what_waits_is_superseded_even_where_it_is_shown_to_somebody_at_that_moment():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    shown = gateway.deployer.shown(hash_of(one)).shown
    assert (await gateway.deployer.line_changed(WHY, ANNA)).ok
    assert gateway.stage(one) is Stage.SUPERSEDED and WHY in gateway.deployer.shown(hash_of(one)).why
    reply = await gateway.decide(one, shown=shown)
    assert not reply.ok and "superseded" in reply.reasons[0]
    assert config_hash(FIRST) == gateway.loop.runs
    assert (gateway.deployer.listed(50).since_change, gateway.deployer.listed(50).model) == (0, None)
    assert book_of(gateway.audit.records) == gateway.deployer.book  # after a restart, too
    assert gateway.audit.whos[-1] == "anna" and gateway.audit.records[-1][1]["because"] == WHY


@run
async def test_it_waits_for_the_end_of_what_is_being_done_to_the_line():
    gateway, one = await deployed()
    reply = await gateway.deployer.line_changed(WHY, ANNA)
    assert not reply.ok and "probation" in reply.reasons[0] and LINE_CHANGED not in gateway.audit.kinds
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(one) is Stage.KEPT
    assert (await gateway.deployer.line_changed(WHY, ANNA)).ok


@run
async def test_the_loop_goes_no_further_than_a_first_configuration_from_then_on_and_again_after_a_restart_of_it():
    gateway, _ = await deployed()
    await gateway.pass_time(PROBATION_S + 1.0)
    gateway.loop.fast = True
    reply = await gateway.deployer.line_changed(WHY, ANNA)
    assert not reply.ok and "the line shall run" in reply.reasons[0] and LINE_CHANGED not in gateway.audit.kinds
    gateway.loop.fast = False
    assert (await gateway.deployer.line_changed(WHY, ANNA)).ok
    first = first_region(LINE)
    assert gateway.loop.region == gateway.loop.good_region == gateway.deployer.book.region == first
    gateway.loop.region = gateway.loop.good_region = WIDE  # its disk did not know
    gateway.deployer.look_again()
    await gateway.pass_time(1.0)
    assert gateway.loop.region == gateway.deployer.book.region == first


@run
async def test_without_a_loop_nothing_is_said_of_the_line():
    gateway = await started()
    gateway.loop.reachable = False
    assert not (await gateway.deployer.line_changed(WHY, ANNA)).ok
    assert gateway.deployer.book.line_changed_s is None


@run
async def test_without_an_audit_the_line_is_as_it_was():
    gateway = await started()
    gateway.audit.available = False
    reply = await gateway.deployer.line_changed(WHY, ANNA)
    assert not reply.ok and gateway.deployer.book.line_changed_s is None


@run
async def test_what_was_judged_of_the_other_line_is_no_measure_for_the_same_configuration():
    gateway, _ = await deployed()
    await gateway.pass_time(PROBATION_S + 1.0)
    book = gateway.deployer.book
    assert book.judged_for == WIDE
    assert (await gateway.deployer.line_changed(WHY, ANNA)).ok
    gateway.judge.region = narrow = Region(speed_max_m_per_s=0.02)
    one = proposal(1, config_hash(controller(1)), gateway.loop.now_s)
    await gateway.propose(one)
    assert (await gateway.decide(one)).ok
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(one) is Stage.KEPT and gateway.deployer.book.judged_for == narrow


def test_stages_of_others_stay():
    book = accepted_model()
    before = dict(book.entries)
    waiting = Entry("9" * 64, "gains", "rules", "2" * 64, "8" * 64, "", "", 4e9, Stage.WAITING)
    book.entries[waiting.proposal] = waiting
    book.apply(LINE_CHANGED, {"because": WHY, "at_s": 50.0})
    after = dict(book.entries)
    assert after.pop(waiting.proposal) == replace(
        waiting, stage=Stage.SUPERSEDED, why=f"the line has changed: {WHY}", since_s=50.0
    )
    assert after == before

"""Where a change takes two people: the first is on record, another one approves, and nobody is two."""

import asyncio

import pytest

from gateway.core.audit_record import Who
from gateway.core.controller import config_hash
from gateway.core.decisions import Decide
from gateway.core.people import Person
from gateway.mailbox.port import Peer
from gateway.supervisor.four_eyes import approver_of
from gateway.supervisor.lifecycle import Stage, book_of
from gateway.supervisor.peers import who_is, who_of
from tests.unit.deployer_gateway import ANNA, BERT, FOUR_EYES, PROBATION_S, TRUSTING, Gateway, run, started
from tests.unit.deployer_support import FIRST, LIFETIME_S, LINE, hash_of, proposal

OPERATORS_PROCESS = Peer(uid=900, pid=3)


def person(name: str, through: str = "page", role: str = "operator") -> Who:
    return who_is(Person(name=name, role=role, through=through), OPERATORS_PROCESS)


async def waiting(line=FOUR_EYES) -> tuple[Gateway, object]:
    gateway = await started(line)
    one = proposal(1, config_hash(FIRST), gateway.loop.now_s)
    await gateway.propose(one)
    return gateway, one


def why(gateway: Gateway, one: object) -> str:
    return gateway.deployer.shown(hash_of(one)).why


@run
async def test_the_first_approval_waits_for_another_person_and_says_by_whom():
    gateway, one = await waiting()
    assert why(gateway, one) == "it takes two people"
    reply = await gateway.decide(one, who=ANNA)
    assert reply.ok and "as the first of two" in reply.text
    assert gateway.stage(one) is Stage.WAITING and gateway.loop.epoch == 0
    assert why(gateway, one) == "anna has approved it, it takes another person"
    assert gateway.deployer.listed(10).proposals[0].why == why(gateway, one)
    assert gateway.deployer.shown(hash_of(one)).shown is not None  # it can still be decided
    reply = await gateway.decide(one, who=BERT)
    assert reply.ok and gateway.stage(one) is Stage.PROBATION
    kinds = ["accepted", "approved-once", "approved", "deploying", "deployed"]
    assert gateway.audit.kinds[-5:] == kinds and gateway.audit.whos[-4:-2] == ["anna", "bert"]
    assert gateway.audit.records[-3][1]["first"] == "anna"
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(one) is Stage.KEPT


@pytest.mark.parametrize(
    ("first", "again"),
    [
        (ANNA, ANNA),
        (ANNA, Who(name="ann", uid=1000, pid=9)),  # the same user under another name
        (person("anna"), person("anna", "opc-ua", "engineer")),
        (person("anna"), ANNA),  # most likely the same
        (ANNA, person("anna")),
    ],
)
def test_the_same_person_is_refused_however_they_come(first, again):
    async def test():
        gateway, one = await waiting()
        assert (await gateway.decide(one, who=first)).ok
        for script in ("", "nightly"):
            reply = await gateway.decide(one, who=again, script=script)
            assert not reply.ok
            assert reply.reasons == [
                f"{first.name} has approved it already: this line takes two different people, and you are the same one"
            ]
        assert gateway.stage(one) is Stage.WAITING and gateway.audit.kinds.count("approved-once") == 1

    asyncio.run(test())


@pytest.mark.parametrize(
    ("first", "second"),
    [(person("anna"), person("bert")), (ANNA, person("bert")), (person("anna", "opc-ua"), BERT), (ANNA, BERT)],
)
def test_two_people_are_two_though_one_process_speaks_for_both(first, second):
    async def test():
        gateway, one = await waiting()
        await gateway.decide(one, who=first)
        assert (await gateway.decide(one, who=second)).ok
        assert gateway.stage(one) is Stage.PROBATION

    asyncio.run(test())


@run
async def test_a_script_is_the_user_that_runs_it_and_cannot_pass_for_another():
    gateway, one = await waiting()
    await gateway.decide(one, who=ANNA, script="bert (operator, page)")
    assert not (await gateway.decide(one, who=ANNA, script="x, run by carla")).ok
    assert not (await gateway.decide(one, who=ANNA)).ok
    assert (await gateway.decide(one, who=BERT)).ok
    approved = dict(gateway.audit.records)["approved"]
    assert approved["by"] == "script"  # one of them was: nothing later rests on it
    assert approved["first"] == "bert (operator, page), run by anna"
    assert not gateway.deployer.book.entries[hash_of(one)].by_person


@pytest.mark.parametrize(
    "nobody",
    [
        Who(name="r2rgate", uid=900, pid=9), Who(name="root", uid=0, pid=9), Who(name="carla", uid=0, pid=9),
        person("script-nightly"), person("script-nightly", "opc-ua", "engineer"),
    ],
)  # fmt: skip
def test_neither_root_nor_the_gateways_own_user_nor_a_program_is_one_of_two_people(nobody):
    async def test():
        gateway, one = await waiting()
        for script in ("", "nightly"):  # neither as the first
            reply = await gateway.decide(one, who=nobody, script=script)
            assert not reply.ok and "is no person, and this line takes two" in reply.reasons[0]
        await gateway.decide(one, who=person("anna"))
        assert not (await gateway.decide(one, who=nobody)).ok  # nor as the second
        assert gateway.stage(one) is Stage.WAITING and gateway.audit.kinds.count("approved-once") == 1
        assert (await gateway.decide(one, approve=False, who=nobody)).ok  # to stop it anybody will do
        gateway, one = await waiting(LINE)
        assert (await gateway.decide(one, who=nobody)).ok  # where one is enough, whoever may is

    asyncio.run(test())


@pytest.mark.parametrize("who", [ANNA, BERT])
def test_anybody_ends_it_by_a_rejection(who):
    async def test():
        gateway, one = await waiting()
        await gateway.decide(one, who=ANNA)
        assert (await gateway.decide(one, approve=False, who=who)).ok
        assert gateway.stage(one) is Stage.REJECTED
        assert not (await gateway.decide(one, who=BERT)).ok

    asyncio.run(test())


@run
async def test_a_gateway_that_begins_anew_knows_the_first():
    gateway, one = await waiting()
    await gateway.decide(one, who=person("anna"))
    gateway.begin()
    await gateway.deployer.watch()
    assert why(gateway, one) == "anna (operator, page) has approved it, it takes another person"
    assert not (await gateway.decide(one, who=person("anna"))).ok
    assert (await gateway.decide(one, who=BERT)).ok
    assert gateway.stage(one) is Stage.PROBATION


@run
async def test_it_expires_and_is_superseded_as_ever():
    gateway, one = await waiting()
    other = proposal(2, config_hash(FIRST), gateway.loop.now_s)
    await gateway.propose(other)
    for who in (ANNA, BERT):
        await gateway.decide(one, who=who)
    await gateway.decide(other, who=ANNA)
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(other) is Stage.SUPERSEDED
    gateway, one = await waiting()
    await gateway.decide(one, who=ANNA)
    gateway.loop.pass_time(LIFETIME_S + 1.0)
    assert not (await gateway.decide(one, who=BERT)).ok
    await gateway.deployer.watch()
    assert gateway.stage(one) is Stage.EXPIRED


@run
async def test_the_first_approval_is_of_what_was_shown_then():
    gateway, one = await waiting()
    await gateway.decide(one, who=ANNA)
    before = gateway.deployer.shown(hash_of(one)).shown
    gateway.deployer.book.epoch += 1  # another configuration was there, and is gone again
    gateway.loop.epoch += 1
    assert gateway.deployer.shown(hash_of(one)).shown != before
    assert why(gateway, one) == "it takes two people"
    assert (await gateway.decide(one, who=BERT)).ok
    assert gateway.stage(one) is Stage.WAITING
    assert "bert has approved it" in why(gateway, one)
    assert (await gateway.decide(one, who=ANNA)).ok
    assert gateway.stage(one) is Stage.PROBATION


@run
async def test_what_could_not_be_carried_out_takes_two_again():
    gateway, one = await waiting()
    await gateway.decide(one, who=ANNA)
    records = [*gateway.audit.records, ("approved", {"proposal": hash_of(one), "by": "person"})]
    records.append(("approval-lapsed", {"proposal": hash_of(one), "because": "decide again"}))
    assert book_of(records).entries[hash_of(one)].first is None


@run
async def test_without_an_audit_nobody_is_first():
    gateway, one = await waiting()
    gateway.audit.available = False
    assert not (await gateway.decide(one, who=ANNA)).ok
    gateway.audit.available = True
    await gateway.decide(one, who=BERT)
    assert "bert has approved it" in why(gateway, one)


@run
async def test_a_line_whose_file_says_two_no_more_judges_anew():
    gateway, one = await waiting()
    await gateway.decide(one, who=ANNA)
    gateway.line = LINE
    gateway.begin()
    assert not (await gateway.decide(one, who=ANNA)).ok
    await gateway.deployer.watch()
    assert gateway.stage(one) is Stage.SUPERSEDED
    again = proposal(1, config_hash(FIRST), gateway.loop.now_s, nonce=2)
    await gateway.propose(again)
    assert (await gateway.decide(again, who=ANNA)).ok and gateway.stage(again) is Stage.PROBATION


@run
async def test_what_passes_by_its_verdict_takes_nobody():
    line = TRUSTING.model_copy(update={"gate": TRUSTING.gate.model_copy(update={"approvals": 2})})
    gateway, one = await waiting(line)
    assert why(gateway, one).startswith("it takes two people; no person has approved a change of gains yet")
    for who in (ANNA, BERT):
        await gateway.decide(one, who=who)
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(one) is Stage.KEPT
    small = proposal(2, gateway.loop.runs, gateway.loop.now_s)
    await gateway.propose(small)
    await gateway.deployer.watch()
    assert gateway.stage(small) is Stage.PROBATION and gateway.audit.kinds.count("approved-once") == 1


def test_who_is_told_apart_by_what():
    assert approver_of(person("anna")) == ("anna",)
    assert approver_of(who_is(Person(name="anna", role="viewer", through="opc-ua"), None)) == ("anna",)
    assert approver_of(Who(name="Anna", uid=7)) == ("anna", "uid 7")
    assert approver_of(asyncio.run(who_of(None))) == ("gateway",)


@run
async def test_a_decision_names_nobody_but_who_sent_it():
    """A script's name that reads like a person's is no person's."""
    gateway, one = await waiting()
    shown = gateway.deployer.shown(hash_of(one)).shown
    decision = Decide(proposal=hash_of(one), shown=shown, approve=True, script="carla (engineer, page)")
    assert (await gateway.deployer.decide(decision, ANNA)).ok
    assert dict(gateway.audit.records)["approved-once"]["approver"] == ["anna", "uid 1000"]


@pytest.mark.parametrize("roles", [{}, {"bert": "viewer"}])
def test_a_first_who_was_removed_or_demoted_since_counts_no_more(roles):
    async def test():
        gateway, one = await waiting()
        await gateway.decide(one, who=person("bert"))
        gateway.roles = {"bert": "operator", "anna": "operator"}
        assert "bert (operator, page) has approved it" in why(gateway, one)
        gateway.roles = {**roles, "anna": "operator"}
        assert why(gateway, one) == "it takes two people"
        assert (await gateway.decide(one, who=person("anna"))).ok
        assert gateway.stage(one) is Stage.WAITING and gateway.audit.kinds.count("approved-once") == 2
        gateway.roles["carla"] = "engineer"
        assert (await gateway.decide(one, who=person("carla"))).ok
        assert gateway.stage(one) is Stage.PROBATION

    asyncio.run(test())


@pytest.mark.parametrize(
    "approver", [["root", "uid 0"], ["r2rgate", f"uid {OPERATORS_PROCESS.uid}"], ["script-nightly"]]
)
def test_an_approval_on_record_by_no_person_is_not_the_first(approver):
    """Versions before took it."""

    async def test():
        gateway, one = await waiting()
        await gateway.decide(one, who=person("anna"))
        kind, what = gateway.audit.records[-1]
        assert kind == "approved-once"
        what |= {"approver": approver, "name": approver[0]}
        gateway.begin()
        await gateway.deployer.watch()
        assert why(gateway, one) == "it takes two people"
        assert (await gateway.decide(one, who=BERT)).ok
        assert gateway.stage(one) is Stage.WAITING

    asyncio.run(test())

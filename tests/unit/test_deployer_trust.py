"""approve-first: what passes by its verdict once a person has approved one of its kind, and what ends that."""

from gateway.core.controller import config_hash
from gateway.core.deployment import Region
from gateway.supervisor.lifecycle import Stage
from tests.unit.deployer_gateway import PROBATION_S, TRUSTING, Gateway, run, started
from tests.unit.deployer_support import FIRST, controller, hash_of, proposal


async def kept_one_by_hand() -> Gateway:
    gateway = await started(TRUSTING)
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    await gateway.pass_time(1.0)
    assert gateway.stage(one) is Stage.WAITING  # the first of its kind is a person's
    assert "no person has approved" in gateway.deployer.shown(hash_of(one)).why
    assert (await gateway.decide(one)).ok
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(one) is Stage.KEPT
    return gateway


async def offered(gateway: Gateway, number: int):
    one = proposal(number, gateway.loop.runs, gateway.loop.now_s, nonce=len(gateway.proposals))
    await gateway.propose(one)
    await gateway.pass_time(1.0)
    return one


@run
async def test_small_changes_pass_by_their_verdict_once_a_person_has_approved_one():
    gateway = await kept_one_by_hand()
    small = await offered(gateway, 2)
    assert gateway.stage(small) is Stage.PROBATION
    assert [who for kind, who in zip(gateway.audit.kinds, gateway.audit.whos, strict=True) if kind == "approved"] == [
        "anna", "gateway",
    ]  # fmt: skip
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(small) is Stage.KEPT
    far = await offered(gateway, 3)  # near 2, which is in service, and not near 1, which a person approved
    assert gateway.stage(far) is Stage.WAITING
    assert "antiwindup differs by 40.0%, allowed: 30.0%" in gateway.deployer.shown(hash_of(far)).why
    refused = proposal(2, gateway.loop.runs, gateway.loop.now_s, nonce=99)
    gateway.judge.refuses.add(hash_of(refused))
    await gateway.propose(refused)
    await gateway.pass_time(1.0)
    assert gateway.stage(refused) is Stage.REFUSED


@run
async def test_what_a_script_approves_is_carried_out_and_trusted_as_no_persons_word():
    gateway = await started(TRUSTING)
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    assert (await gateway.decide(one, script="a demonstration")).ok
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.stage(one) is Stage.KEPT
    assert [what["by"] for kind, what in gateway.audit.records if kind == "approved"] == ["script"]
    small = await offered(gateway, 2)
    assert gateway.stage(small) is Stage.WAITING
    assert "no person has approved" in gateway.deployer.shown(hash_of(small)).why


@run
async def test_after_a_rollback_a_person_decides_again():
    gateway = await kept_one_by_hand()
    gateway.surroundings.against = "tension 1 swings"
    small = await offered(gateway, 2)
    assert gateway.stage(small) is Stage.ROLLED_BACK
    gateway.surroundings.against = ""
    again = await offered(gateway, 2)
    assert gateway.stage(again) is Stage.WAITING


@run
async def test_what_is_kept_on_top_of_a_linear_law_goes_back_to_that_and_is_trusted_no_more():
    gateway = await started(TRUSTING)
    one = proposal(1, config_hash(FIRST), 0.0)
    gateway.loop.predictive.add(config_hash(controller(1)))
    await gateway.propose(one)
    await gateway.pass_time(1.0)
    assert (await gateway.decide(one)).ok
    await gateway.pass_time(PROBATION_S + 1.0)
    book = gateway.deployer.book
    assert gateway.stage(one) is Stage.KEPT and book.in_service == gateway.loop.runs == config_hash(controller(1))
    assert book.last_known_good == gateway.loop.good == config_hash(FIRST) and book.trusted
    gateway.loop.go_back("rolled back: span 3 would come to 60 N")
    gateway.deployer.look_again()
    await gateway.pass_time(1.0)
    kind, what = gateway.audit.records[-1]
    assert kind == "found-in-service" and what["explained"] and "span 3" in what["because"]
    assert book.in_service == book.last_known_good == config_hash(FIRST) and not book.trusted


@run
async def test_a_wider_region_than_the_approved_is_a_persons():
    gateway = await kept_one_by_hand()
    gateway.judge.region = Region(speed_max_m_per_s=0.2)
    assert gateway.stage(await offered(gateway, 2)) is Stage.WAITING

"""What the gateway signs for: the records of what was proposed, judged and approved, also after a new start."""

from gateway.core.canonical import hash_of
from gateway.core.messages import Deploy, Keep
from tests.unit.deployer_gateway import PROBATION_S, run, started
from tests.unit.deployer_support import hash_of as proposal_of
from tests.unit.deployer_support import proposal


@run
async def test_what_is_deployed_and_kept_names_its_proposal_verdict_and_approval():
    gateway = await started()
    tell, told = gateway.loop.tell, {}

    async def heard(command, grounds=None):
        told[type(command)] = grounds
        return await tell(command, grounds)

    gateway.loop.tell = heard
    one = proposal(2, gateway.loop.runs, gateway.loop.now_s)
    assert (await gateway.propose(one)).ok and (await gateway.decide(one)).ok
    gateway.begin()  # the book is read from the records
    await gateway.pass_time(PROBATION_S + 5.0)
    (approved,) = [what for kind, what in gateway.audit.records if kind == "approved"]
    for grounds in (told[Deploy], told[Keep]):
        assert grounds.are_complete and grounds.proposal == proposal_of(one)
        assert grounds.approval == hash_of(approved)

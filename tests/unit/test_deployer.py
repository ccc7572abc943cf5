"""The life of a proposal: proposed, judged, decided, deployed, kept, rolled back, expired, in any order, with processes
that die between any two of their effects."""

import asyncio

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from gateway.core.audit_record import Who
from gateway.core.controller import config_hash
from gateway.core.decisions import Decide
from gateway.core.deployment import Region
from gateway.core.proposal import canonical
from gateway.supervisor.deployer import Deployer
from gateway.supervisor.lifecycle import Stage, book_of
from gateway.supervisor.on_the_line import LEASE_S
from tests.unit.deployer_support import (
    FIRST,
    LIFETIME_S,
    LINE,
    Death,
    FakeAudit,
    FakeJudge,
    FakeLoop,
    FakeSurroundings,
    Killed,
    controller,
    hash_of,
    proposal,
)

ANNA = Who(name="anna", uid=1000, pid=1)
PROBATION_S = LINE.gate.probation_s
#: From controller 1 to 2 is a quarter of a number, from 1 to 3 two fifths.
TRUSTING = LINE.model_copy(
    update={"gate": LINE.gate.model_copy(update={"autonomy": "approve-first", "small_share": 0.3})}
)


class Gateway:
    """A deployer and everything around it, in one process that can die and begin anew."""

    def __init__(self, line=LINE) -> None:
        self.line = line
        self.death = Death()
        self.audit = FakeAudit(self.death, self._checked)
        self.loop = FakeLoop(self.death)
        self.judge = FakeJudge()
        self.surroundings = FakeSurroundings(self.loop)
        self.proposals = {}
        self.begin()

    def _checked(self, kind, what) -> None:
        if kind == "deploying":
            base = self.proposals[what["proposal"]].base
            assert self.loop.runs == what["before"] == base, "it was made for another configuration"

    def begin(self) -> None:
        clock = lambda: self.loop.now_s  # noqa: E731
        book = book_of(self.audit.records)
        args = (self.audit, self.loop, self.judge, self.surroundings, lambda proposal, verdict: None, clock, clock)
        self.deployer = Deployer(self.line, book, *args)

    async def propose(self, one):
        self.proposals[hash_of(one)] = one
        reply = await self.deployer.propose(canonical(one), ANNA)
        await self.deployer.judged()
        return reply

    async def decide(self, one, approve=True, shown=None, script=""):
        view = self.deployer.shown(hash_of(one))
        hash_ = shown or (view.shown if not isinstance(view, str) else None) or "0" * 64
        decision = Decide(proposal=hash_of(one), shown=hash_, approve=approve, script=script)
        return await self.deployer.decide(decision, ANNA)

    def stage(self, one) -> Stage:
        return self.deployer.book.entries[hash_of(one)].stage

    async def pass_time(self, seconds: float) -> None:
        """With the deployer looking twice a second."""
        for _ in range(round(2 * seconds)):
            self.loop.pass_time(0.5)
            await self.deployer.watch()


def run(test):
    """An async test."""

    def synchronous():
        asyncio.run(test())

    synchronous.__name__ = test.__name__
    return synchronous


async def started(line=LINE) -> Gateway:
    gateway = Gateway(line)
    await gateway.deployer.watch()
    return gateway


async def deployed(number=1) -> tuple[Gateway, object]:
    gateway = await started()
    one = proposal(number, config_hash(FIRST), gateway.loop.now_s)
    assert (await gateway.propose(one)).ok
    reply = await gateway.decide(one)
    assert reply.ok, reply
    return gateway, one


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


@run
async def test_an_audit_that_fails_on_probation_leaves_the_line_on_what_was_good():
    gateway, one = await deployed()
    gateway.audit.available = False
    await gateway.pass_time(PROBATION_S + 2 * LEASE_S)
    assert gateway.loop.good == config_hash(FIRST)
    gateway.loop.pass_time(LEASE_S)
    gateway.audit.available = True
    await gateway.deployer.watch()
    assert gateway.stage(one) is Stage.ROLLED_BACK
    assert gateway.deployer.book.in_service == gateway.loop.runs == config_hash(FIRST)


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
async def test_an_answer_that_does_not_come_is_asked_for_later():
    gateway = await started()
    one = proposal(1, config_hash(FIRST), 0.0)
    await gateway.propose(one)
    loop, tell = gateway.loop, gateway.loop.tell

    async def silent(command):
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


@run
async def test_without_a_model_nothing_is_watched_with_one_the_fallback_is():
    gateway, _ = await deployed()
    await gateway.pass_time(PROBATION_S + 1.0)
    assert gateway.loop.watches == [("deploy", None), ("keep", None)]
    # A model is accepted: what runs is looked after, once; then a change by its fallback, and by itself when kept.
    gateway.loop.watches.clear()
    gateway.deployer.book.model = "7" * 64
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


@run
async def test_a_loop_that_was_started_with_something_else_is_asked_again():
    gateway = await started()
    gateway.loop.runs = gateway.loop.good = config_hash(controller(5))
    gateway.deployer.look_again()
    await gateway.deployer.watch()
    assert gateway.deployer.book.in_service == config_hash(controller(5))


class LifeCycle(RuleBasedStateMachine):
    """Any order of everything, and death between any two effects."""

    line = LINE

    def __init__(self) -> None:
        super().__init__()
        self.gateway = Gateway(self.line)
        self.count = 0
        self._run(self._begin())

    def _run(self, coroutine) -> None:
        try:
            asyncio.run(coroutine)
        except (Killed, BaseExceptionGroup):
            self.gateway.death.effects = 0
            self.gateway.begin()
            self._run(self._begin())

    async def _begin(self) -> None:
        await self.gateway.deployer.watch()
        await self.gateway.deployer.judged()

    def _any(self, data):
        return data.draw(st.sampled_from(sorted(self.gateway.proposals.items())))[1] if self.gateway.proposals else None

    @rule(number=st.integers(1, 4), good=st.booleans(), on_what_runs=st.integers(0, 4))
    def propose(self, number, good, on_what_runs):
        self.count += 1
        base = self.gateway.loop.runs if on_what_runs else config_hash(controller(9))
        one = proposal(number, base, self.gateway.loop.now_s, self.count)
        if not good:
            self.gateway.judge.refuses.add(hash_of(one))
        self._run(self.gateway.propose(one))

    @rule(data=st.data(), approve=st.booleans())
    def decide(self, data, approve):
        if (one := self._any(data)) is not None:
            self._run(self.gateway.decide(one, approve))

    @rule(data=st.data())
    def approve_the_newest(self, data):
        waiting = [e for e in self.gateway.deployer.book.entries.values() if e.stage is Stage.WAITING]
        if waiting:
            self._run(self.gateway.decide(self.gateway.proposals[waiting[-1].proposal]))

    @rule(seconds=st.sampled_from([0.5, 2.0, LEASE_S, PROBATION_S, PROBATION_S + 1.0, LIFETIME_S]))
    def time_passes(self, seconds):
        self._run(self.gateway.pass_time(min(seconds, PROBATION_S + 1.0)))
        if seconds == LIFETIME_S:
            self.gateway.loop.pass_time(seconds)

    @rule(seconds=st.sampled_from([1.0, LEASE_S, 2 * LEASE_S]))
    def the_gateway_is_away(self, seconds):
        self.gateway.begin()
        self.gateway.loop.pass_time(seconds)
        self._run(self._begin())

    @rule()
    def the_loop_is_started_anew(self):
        self.gateway.loop.restart()

    @rule(reachable=st.booleans(), answers=st.booleans())
    def the_wire(self, reachable, answers):
        self.gateway.loop.reachable, self.gateway.loop.answers = reachable, answers

    @rule(available=st.booleans())
    def the_disk(self, available):
        self.gateway.audit.available = available

    @rule(against=st.booleans())
    def something_shows(self, against):
        self.gateway.surroundings.against = "tension 1 swings" if against else ""

    @rule()
    def taken_back(self):
        self._run(self.gateway.deployer.roll_back("", ANNA))

    @rule(effects=st.integers(1, 6), after=st.booleans())
    def death_is_near(self, effects, after):
        self.gateway.death.effects, self.gateway.death.after = effects, after

    @invariant()
    def the_audit_explains_what_runs(self):
        loop, book = self.gateway.loop, book_of(self.gateway.audit.records)
        if book.in_service is not None:  # the loop has been asked once
            assert book.explains(loop.runs, loop.epoch), (loop.runs[:8], loop.epoch, book)

    @invariant()
    def nothing_runs_that_was_not_accepted_and_approved(self):
        seen: dict[str, list[str]] = {}
        brings = {config_hash(FIRST)}
        for kind, what in self.gateway.audit.records:
            if "proposal" not in what:
                continue
            before = seen.setdefault(what["proposal"], [])
            if kind == "deploying":
                assert "accepted" in before and before[-1] == "approved" and "deploying" not in before
                brings.add(what["configuration"])
            before.append(kind)
        assert {self.gateway.loop.runs, self.gateway.loop.good} <= brings

    @invariant()
    def what_is_good_was_kept_on_record(self):
        kept = {config_hash(FIRST)}
        for kind, what in self.gateway.audit.records:
            if kind == "keeping":
                entry = book_of(self.gateway.audit.records).entries[what["proposal"]]
                kept.add(entry.changes)
        assert self.gateway.loop.good in kept

    @invariant()
    def no_approval_is_left_lying(self):
        gateway = self.gateway
        if gateway.audit.available:
            self._run(gateway.deployer.watch())
            if gateway.audit.available:
                assert Stage.APPROVED not in {entry.stage for entry in gateway.deployer.book.entries.values()}

    @invariant()
    def one_change_at_a_time(self):
        stages = [entry.stage for entry in self.gateway.deployer.book.entries.values()]
        assert sum(stage in (Stage.DEPLOYING, Stage.PROBATION, Stage.KEEPING) for stage in stages) <= 1


LifeCycle.TestCase.settings = settings(max_examples=30, stateful_step_count=25, suppress_health_check=list(HealthCheck))
TestLifeCycle = LifeCycle.TestCase


class TrustingLifeCycle(LifeCycle):
    """The same where small changes pass by their verdict."""

    line = TRUSTING

    @invariant()
    def what_passes_by_its_verdict_is_like_what_a_person_approved(self):
        proposals, well, by = self.gateway.proposals, set(), {}
        for kind, what in self.gateway.audit.records:
            if kind == "rolled-back":
                well.clear()
            elif kind == "kept" and by[what["proposal"]] == "person":
                well.add(what["proposal"])
            elif kind == "approved":
                by[what["proposal"]] = what["by"]
                if what["by"] == "verdict":
                    assert what["like"] in well
                    like, new = (proposals[what[name]].change.controller for name in ("like", "proposal"))
                    assert abs(new.antiwindup / like.antiwindup - 1.0) <= 0.3


TestTrustingLifeCycle = TrustingLifeCycle.TestCase
TestTrustingLifeCycle.settings = LifeCycle.TestCase.settings

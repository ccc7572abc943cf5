"""The life of a proposal: proposed, judged, decided, deployed, kept, rolled back, expired, in any order, with processes
that die between any two of their effects."""

import asyncio

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from gateway.core.audit_record import Who
from gateway.core.controller import config_hash
from gateway.core.proposal import ModelChange
from gateway.supervisor.lifecycle import Stage, book_of
from gateway.supervisor.on_the_line import LATE_S, LEASE_S
from tests.unit.deployer_gateway import ANNA, BERT, FOUR_EYES, PROBATION_S, TRUSTING, Gateway
from tests.unit.deployer_support import FIRST, LIFETIME_S, LINE, Killed, controller, hash_of, model_proposal, proposal


class LifeCycle(RuleBasedStateMachine):
    """Any order of everything, and death between any two effects."""

    line = LINE
    people = st.just(ANNA)

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

    @rule(number=st.integers(1, 3))
    def propose_a_model(self, number):
        self.count += 1
        self._run(
            self.gateway.propose(model_proposal(number, self.gateway.loop.runs, self.gateway.loop.now_s, self.count))
        )

    @rule(data=st.data(), approve=st.booleans(), script=st.sampled_from(["", "a script"]))
    def decide(self, data, approve, script):
        if (one := self._any(data)) is not None:
            self._run(self.gateway.decide(one, approve, script=script, who=data.draw(self.people)))

    @rule(data=st.data())
    def approve_the_newest(self, data):
        waiting = [e for e in self.gateway.deployer.book.entries.values() if e.stage is Stage.WAITING]
        if waiting:
            one = self.gateway.proposals[waiting[-1].proposal]
            self._run(self.gateway.decide(one, who=data.draw(self.people)))

    @rule(data=st.data(), number=st.integers(1, 4), effects=st.integers(0, 8), after=st.booleans())
    def a_change_is_made_while_all_is_well(self, data, number, effects, after):
        """Most of the rest is trouble, through which few changes would come."""
        self.the_wire(True, True)
        self.the_disk(True)
        self.something_shows(False)
        self.death_is_near(0, after)
        self._run(self._begin())
        self.propose(number, True, 1)
        self.death_is_near(effects, after)
        for _ in range(3):
            self.approve_the_newest(data)

    @rule(data=st.data(), number=st.integers(1, 3))
    def another_model_is_accepted_while_all_is_well(self, data, number):
        self.the_wire(True, True)
        self.the_disk(True)
        self.death_is_near(0, False)
        self._run(self._begin())
        self.propose_a_model(number)
        for _ in range(2):
            self.approve_the_newest(data)

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

    @rule(reachable=st.booleans(), answers=st.booleans(), loses=st.booleans(), late_s=st.sampled_from([0.0, 1.0, 20.0]))
    def the_wire(self, reachable, answers, loses=False, late_s=0.0):
        loop = self.gateway.loop
        loop.reachable, loop.answers, loop.loses, loop.late_s = reachable, answers, loses, late_s

    @rule()
    def once_all_is_well_the_book_says_what_the_loop_does_and_nothing_is_left_open(self):
        self.the_wire(True, True)
        self.the_disk(True)
        self.something_shows(False)
        self.death_is_near(0, False)
        entries = self.gateway.deployer.book.entries.values()
        for _ in range(1 + sum(entry.stage is Stage.WAITING for entry in entries)):  # small ones follow each other
            self._run(self.gateway.pass_time(LATE_S + PROBATION_S + 2.0 * LEASE_S))
            if self.gateway.deployer.book.on_the_line is None:
                break
        loop, book = self.gateway.loop, self.gateway.deployer.book
        said = loop.in_service()
        assert (book.in_service, book.last_known_good, book.epoch) == (said.hash, said.last_known_good, said.epoch)
        assert book.on_the_line is None

    @invariant()
    def what_has_become_of_a_change_is_on_record_once(self):
        ends: dict[str, list[str]] = {}
        for kind, what in self.gateway.audit.records:
            if kind in ("deployed", "not-deployed", "kept", "rolled-back"):
                ends.setdefault(what["proposal"], []).append(kind)
        for kinds in ends.values():
            assert len(set(kinds)) == len(kinds) and ("not-deployed" not in kinds or len(kinds) == 1)
            assert not {"kept", "rolled-back"} <= set(kinds)

    @rule(available=st.booleans())
    def the_disk(self, available):
        self.gateway.audit.available = available

    @rule(against=st.booleans())
    def something_shows(self, against):
        self.gateway.surroundings.against = "tension 1 swings" if against else ""

    @rule()
    def taken_back(self):
        self._run(self.gateway.deployer.roll_back("", ANNA))

    @rule()
    def the_line_changes(self):
        self._run(self.gateway.deployer.line_changed("another web", ANNA))

    @rule(speed_max_m_per_s=st.sampled_from([0.5, 1.0]))
    def the_lines_file_is_edited(self, speed_max_m_per_s):
        limits = self.line.limits.model_copy(update={"speed_max_m_per_s": speed_max_m_per_s})
        self.gateway.line = self.line.model_copy(update={"limits": limits})
        self.gateway.begin()
        self._run(self._begin())

    @rule(effects=st.integers(1, 6), after=st.booleans())
    def death_is_near(self, effects, after):
        self.gateway.death.effects, self.gateway.death.after = effects, after

    @invariant()
    def the_audit_explains_what_runs(self):
        loop, book = self.gateway.loop, book_of(self.gateway.audit.records)
        if book.in_service is not None:  # the loop has been asked once
            assert book.explains(loop.in_service()), (loop.in_service(), book)

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
    def nothing_goes_through_that_was_judged_before_the_line_changed(self):
        judged: set[str] = set()
        for kind, what in self.gateway.audit.records:
            if kind == "line-changed":
                judged.clear()
            elif kind == "accepted":
                judged.add(what["proposal"])
            elif kind in ("approved", "deploying"):
                assert what["proposal"] in judged

    @invariant()
    def nothing_goes_through_that_was_judged_by_another_model_than_the_one_in_service(self):
        in_service, judged_by = None, {}
        for kind, what in self.gateway.audit.records:
            if kind == "line-changed":
                in_service = None
            elif kind == "accepted":
                judged_by[what["proposal"]] = what["model"]
            elif kind in ("approved", "deploying", "model-in-service"):
                assert judged_by[what["proposal"]] == in_service
            if kind == "model-in-service":
                in_service = what["model"]
        assert self.gateway.deployer.book.model == in_service

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
            elif kind in ("kept", "model-in-service") and by[what["proposal"]] == "person":
                well.add(what["proposal"])
            elif kind == "approved":
                by[what["proposal"]] = what["by"]
                if what["by"] == "verdict":
                    assert what["like"] in well
                    changes = [proposals[what[name]].change for name in ("like", "proposal")]
                    assert changes[0].kind == changes[1].kind
                    if isinstance(changes[0], ModelChange):
                        continue
                    like, new = (change.controller for change in changes)
                    assert abs(new.antiwindup / like.antiwindup - 1.0) <= 0.3


TestTrustingLifeCycle = TrustingLifeCycle.TestCase
TestTrustingLifeCycle.settings = LifeCycle.TestCase.settings


#: Anna at a terminal, on the page and through OPC UA, and two others.
PEOPLE = (
    ANNA, Who(name="anna (operator, page)", uid=900, pid=3), Who(name="anna (engineer, opc-ua)", uid=900, pid=3), BERT,
    Who(name="carla (engineer, page)", uid=900, pid=3),
)  # fmt: skip


def person_of(name: str) -> str:
    return name.removeprefix("a script, run by ").partition(" ")[0]


class FourEyesLifeCycle(LifeCycle):
    """The same where a change takes two people."""

    line = FOUR_EYES
    people = st.sampled_from(PEOPLE)

    @invariant()
    def what_goes_on_the_line_two_different_people_have_approved_as_it_was_shown(self):
        first: dict[str, tuple[str, str]] = {}
        approved: set[str] = set()
        for (kind, what), who in zip(self.gateway.audit.records, self.gateway.audit.whos, strict=True):
            if kind == "approved-once":
                first[what["proposal"]] = person_of(who), what["shown"]
            elif kind == "approved":
                person, shown = first.pop(what["proposal"])
                assert person != person_of(who) and shown == what["shown"]
                approved.add(what["proposal"])
            elif kind in ("approval-lapsed", "rejected", "line-changed"):
                approved.discard(what.get("proposal", ""))
            elif kind in ("deploying", "model-in-service"):
                assert what["proposal"] in approved


TestFourEyesLifeCycle = FourEyesLifeCycle.TestCase
TestFourEyesLifeCycle.settings = LifeCycle.TestCase.settings

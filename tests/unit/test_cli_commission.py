"""`r2rgate commission` against a gateway in this process that keeps its promises, and no more."""

import asyncio
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime

import pytest

from gateway.cli import commission_changes
from gateway.cli.commission import commission
from gateway.cli.commission_changes import Changes, LineNow, Made, Offer
from gateway.cli.commission_history import approvals, history
from gateway.cli.commission_live import LiveGate
from gateway.cli.commission_measurements import SCENARIO, keep, kept
from gateway.cli.commission_questions import MORE_DATA, PROPOSE
from gateway.cli.commission_side import CannotGoOn
from gateway.commissioning.candidates import NotOffered
from gateway.commissioning.convergence import Convergence, Diagnosis, SpanFigures
from gateway.commissioning.decisions import Decided, Rules
from gateway.commissioning.ladder import LADDERS, MOST_EXPERIMENTS, MOST_OWN, OWN
from gateway.commissioning.past import Follows, Step
from gateway.control.design import design_lqi, task_of
from gateway.core.asked_before import interactions_of
from gateway.core.controller import config_hash
from gateway.core.decisions import QUERY, ListProposals, ProposalLine, ProposalList, ProposalShown
from gateway.core.messages import Event, Reply
from gateway.core.proposal import parse_proposal, proposal_hash
from gateway.core.questions import Choice, Option, Question, wrong_with
from gateway.core.topics import GATEWAY_PROPOSALS, GATEWAY_PROPOSE, LOOP_EVENT, LOOP_TELEMETRY
from gateway.core.verdict import RuleFinding, Verdict
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.port import Counters, Unreachable
from gateway.supervisor import baselines
from gateway.supervisor.configurations import FILE_NAME, Origin, begin_configurations
from gateway.supervisor.historian import Historian
from gateway.supervisor.recent import SETTLE_S, WINDOW_S
from gateway.supervisor.service import Gateway
from tests.support.gateway_key import to_loop_over
from tests.support.once import once
from tests.unit.supervisor_support import frame_of, line_of, until

LINE = line_of(2)
CONFIG = design_lqi(task_of(LINE))


@pytest.fixture(autouse=True, scope="module")
def _experiments_are_designed_once():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commission_changes, "experiment", once(commission_changes.experiment))
        yield


class QuietHistorian(Historian):
    """It is never started, and stores nothing."""

    def frame(self, payload):
        pass

    def event(self, event):
        pass


class LateHistorian(Historian):
    """It stores by its own clock, at every fourth look at its health."""

    looks = 0

    def health(self):
        self.looks += 1
        if self.looks % 4 == 0:
            with ThreadPoolExecutor(1) as thread:  # as it does otherwise
                thread.submit(self._turn, False).result()
        return super().health()


class OneProcess:
    """A gateway over a line that stands at 0.01 m/s; every proposal is refused at once, or waits for a person."""

    def __init__(self, folder, stage="refused", line=LINE, historian=QuietHistorian):
        self.now_s, self.frames, self.stage = 100.0, 0, stage
        self.shown: dict[str, ProposalShown] = {}
        self.told: list[str] = []
        hub = Hub()
        self.mailbox, self.loop = InProcessMailbox(hub), InProcessMailbox(hub)
        clock, wall_clock = lambda: self.now_s, lambda: 1.8e9 + self.now_s
        kept = historian(folder, line.site, line.line, line.n, clock=clock, wall_clock=wall_clock)
        to_loop = to_loop_over(InProcessMailbox(hub), line, clock)
        Gateway(line, InProcessMailbox(hub), to_loop, kept, Counters(), clock=clock, wall_clock=wall_clock)
        self.loop.serve(GATEWAY_PROPOSE, self._propose)
        self.loop.serve(GATEWAY_PROPOSALS, self._proposals)
        with begin_configurations(folder / FILE_NAME) as store:
            store.store(LINE.site, LINE.line, CONFIG, Origin(0.0, "test", "the loop starts with it"))
        self.side = LiveGate(LINE, self.mailbox, self.told.append, self.pause, clock)
        self._frame()

    async def pause(self, seconds):
        for _ in range(round(seconds / LINE.control.period_s)):
            self.now_s += LINE.control.period_s
            self._frame()

    def _frame(self):
        self.frames += 1
        frame = frame_of(self.frames, self.now_s, 2, unwind_speed_m_per_s=0.01, speed_setpoint_m_per_s=0.01)
        self.loop.publish(LOOP_TELEMETRY, frame)

    async def _propose(self, payload):
        proposal = parse_proposal(payload)
        hash_ = proposal_hash(proposal)
        refused = self.stage == "refused"
        verdict = Verdict(
            format=1, proposal=hash_, payload=hash_, context="0" * 64, line="0" * 64, kind=proposal.kind, seed=1,
            accepted=not refused, judged=proposal.created, program_version="0",
            findings=[RuleFinding(rule="corners: error", passed=not refused, text="too far", value=4.0, limit=3.0)],
        )  # fmt: skip
        self.shown[hash_] = ProposalShown(
            format=1, stage=self.stage, why="too far" if refused else "", proposal_hash=hash_, shown=None, epoch=0,
            difference=[], proposal=proposal, verdict=verdict,
        )  # fmt: skip
        return Reply(ok=True, state="", text="is being judged").model_dump_json().encode()

    async def _proposals(self, payload):
        query = QUERY.validate_json(payload)
        if not isinstance(query, ListProposals):
            return self.shown[query.proposal].model_dump_json().encode()
        lines = [
            ProposalLine(
                proposal=one.proposal_hash, kind=one.proposal.kind, author=one.proposal.author, stage=one.stage,
                why=one.why, created=one.proposal.created, expires=one.proposal.expires, epoch=None,
            )
            for one in list(reversed(self.shown.values()))[query.skip : query.skip + query.most]
        ]  # fmt: skip
        return ProposalList(
            since_change=len(self.shown),
            format=1, site=LINE.site, line=LINE.line, in_service=config_hash(CONFIG),
            last_known_good=config_hash(CONFIG), epoch=0, model=None, proposals=lines,
        ).model_dump_json().encode()  # fmt: skip


@pytest.mark.slow
def test_each_candidate_is_proposed_once_and_the_end_says_why(tmp_path):
    gateway = OneProcess(tmp_path)
    found = asyncio.run(commission(LINE, gateway.side, gateway.told.append))
    assert not found.reached and "too far" in found.text
    assert [(one.step, one.rung, one.rule, one.value, one.limit) for one in found.tried] == [
        (Step.FIRST, rung, "corners: error", 4.0, 3.0) for rung in range(LADDERS[Step.FIRST])
    ]
    assert gateway.now_s >= 100.0 + SETTLE_S + WINDOW_S  # the line has stood before
    again = OneProcess(tmp_path)
    again.shown = gateway.shown  # the command started anew
    assert asyncio.run(commission(LINE, again.side)).text == found.text and len(again.shown) == len(found.tried)


class Dying:
    """The mailbox of a gateway that dies once it has taken in proposal `which`, and is back `for_s` later."""

    def __init__(self, gateway, for_s, until_s=0.0, which=2):
        self.gateway, self.for_s, self.until_s, self.which = gateway, for_s, until_s, which
        self.proposals = 0

    async def request(self, topic, payload, timeout_s):
        if self.gateway.now_s < self.until_s:
            raise Unreachable("no gateway answers: start it")
        answer = await self.gateway.mailbox.request(topic, payload, timeout_s)
        self.proposals += topic is GATEWAY_PROPOSE
        if topic is GATEWAY_PROPOSE and self.proposals == self.which:
            self.until_s = self.gateway.now_s + self.for_s
            raise Unreachable("the gateway went away")
        return answer


@pytest.mark.slow
@pytest.mark.parametrize("which", [1, 2, LADDERS[Step.FIRST]])
def test_a_gateway_that_dies_is_waited_for_and_the_chain_goes_on_from_its_list(tmp_path, which):
    whole = asyncio.run(commission(LINE, OneProcess(tmp_path).side))
    gateway = OneProcess(tmp_path)
    side = LiveGate(LINE, Dying(gateway, 30.0, which=which), gateway.told.append, gateway.pause, lambda: gateway.now_s)
    found = asyncio.run(commission(LINE, side, gateway.told.append))
    assert found.text == whole.text and [one.rung for one in found.tried] == [one.rung for one in whole.tried]
    assert "the gateway answers again" in gateway.told


@pytest.mark.slow
def test_a_gateway_that_is_gone_for_good_or_was_not_there_at_all_ends_it_with_the_reason(tmp_path):
    gateway = OneProcess(tmp_path)
    side = LiveGate(LINE, Dying(gateway, 1e9), gateway.told.append, gateway.pause, lambda: gateway.now_s)
    found = asyncio.run(commission(LINE, side))
    assert not found.reached and "went away" in found.text and len(found.tried) == 1
    gateway = OneProcess(tmp_path)
    side = LiveGate(LINE, Dying(gateway, 0.0, 1e9), gateway.told.append, gateway.pause, lambda: gateway.now_s)
    assert "start it" in asyncio.run(commission(LINE, side)).text
    assert gateway.now_s == 100.0 and not gateway.told  # nobody waits for what was never there


def test_everything_since_the_line_has_changed_is_looked_at_however_much_others_propose(tmp_path):
    gateway = OneProcess(tmp_path)
    asyncio.run(commission(LINE, gateway.side, gateway.told.append))
    own, one = dict(gateway.shown), next(iter(gateway.shown.values()))
    for number in range(450):  # by somebody else, afterwards
        gateway.shown[f"{number:064x}"] = one.model_copy(update={"proposal_hash": f"{number:064x}"})
    found = asyncio.run(LiveGate(LINE, gateway.mailbox, gateway.told.append, gateway.pause).proposals())
    assert [each.proposal_hash for each in found] == [*own, *(f"{number:064x}" for number in range(450))]


class Picky:
    """`Decider`: the last option, its first knob turned as far as it goes, as long as there are knobs."""

    def __init__(self):
        self.asked: list[Question] = []

    def decide(self, question):
        self.asked.append(question)
        option = question.options[-1].id
        knob = next((one for one in question.knobs if not one.of or option in one.of), None)
        factors = {} if knob is None else {knob.name: knob.most}
        choice = Choice(option=option, factors=factors, reason="it is the calmest")
        assert not wrong_with(choice, question)
        return Decided(choice, "initial-control", interaction=f"{len(self.asked):016x}")


@pytest.mark.slow
def test_what_an_agent_chooses_is_proposed_in_its_name_and_what_was_refused_is_told_the_next_time(tmp_path):
    gateway, picky = OneProcess(tmp_path), Picky()
    found = asyncio.run(commission(LINE, gateway.side, gateway.told.append, decider=picky))
    assert not found.reached
    own, ladder = [OWN + k for k in range(MOST_OWN)], list(reversed(range(LADDERS[Step.FIRST])))
    assert [one.rung for one in found.tried] == [*own, *ladder]
    shown = list(gateway.shown.values())
    assert {one.proposal.author for one in shown[:-1]} == {"agents"}
    assert shown[0].proposal.reason.endswith("initial-control says: \u201cit is the calmest\u201d")
    assert "torque_per_nm2 times 64" in shown[0].proposal.reason
    assert interactions_of(shown[0].proposal.evidence) == [f"{1:016x}"]
    named_in = [each for one in shown for each in interactions_of(one.proposal.evidence)]
    assert len(set(named_in)) == len(named_in)  # each question stands in the proposal that came of it
    first, second = picky.asked[0], picky.asked[1]
    assert first.decision == "design.architecture" and first.usual == first.options[0].id
    assert not any("tried" in fact for fact in first.facts)
    assert any("own numbers: failed: corners: error" in fact or "too far" in fact for fact in second.facts)
    assert not picky.asked[MOST_OWN].knobs


def test_no_words_of_an_agent_end_the_phase_however_long_they_are_once_printed(tmp_path):
    class Breathless(Picky):
        def decide(self, question):
            decided = super().decide(question)
            return replace(decided, choice=decided.choice.model_copy(update={"reason": "\n" * 2000}))

    gateway = OneProcess(tmp_path)
    found = asyncio.run(commission(LINE, gateway.side, gateway.told.append, decider=Breathless()))
    assert len(found.tried) == MOST_OWN + LADDERS[Step.FIRST]
    assert all(len(one.proposal.reason) <= 4000 for one in gateway.shown.values())


@pytest.mark.slow
def test_an_agent_that_asks_for_more_data_has_them_before_any_model_is_proposed_and_is_asked_once(
    tmp_path, monkeypatch
):
    class Modelled(Changes):
        made: list[int] = []  #: rungs

        def _models(self, step, now, recordings):
            def make(_):
                self.made.append(step.rung)
                if len(self.made) > 1:
                    raise NotOffered("these data give no model")
                return Made(None, "from these data", identified=object())

            return [Offer(step.rung, "a model", make)]

    class Doubtful(Rules):
        asked: list[str] = []

        def decide(self, question):
            self.asked.append(question.decision)
            if question.decision != "identify.fidelity":
                return super().decide(question)
            return Decided(Choice(option=MORE_DATA, reason="too few"), "sysid")

    async def recordings():
        return [None, None]

    def question(line, found, now, past):
        options = [Option(id=PROPOSE, title="propose"), Option(id=MORE_DATA, title="more data")]
        return Question(
            format=1, site=line.site, line=line.line, decision="identify.fidelity", task="whether", options=options,
            usual=PROPOSE, why="the gate judges",
        )  # fmt: skip

    monkeypatch.setattr("gateway.cli.commission.Changes", Modelled)
    monkeypatch.setattr("gateway.cli.commission.fidelity_question", question)
    gateway = OneProcess(tmp_path, stage="kept")
    gateway.side.recordings = recordings
    found = asyncio.run(commission(LINE, gateway.side, gateway.told.append, decider=Doubtful()))
    assert not found.reached
    kinds = [one.proposal.kind for one in gateway.shown.values()]
    assert kinds == ["gains", *["experiment"] * MOST_EXPERIMENTS]
    assert Doubtful.asked.count("identify.fidelity") == 1
    assert Modelled.made == [0, *[0, 1] * (MOST_EXPERIMENTS - 1)]  # not once more from all recordings


def test_where_an_agent_does_not_answer_the_rules_decide_and_it_is_told(tmp_path):
    class Absent(Rules):
        def decide(self, question):
            return replace(super().decide(question), instead="initial-control does not answer")

    gateway = OneProcess(tmp_path)
    found = asyncio.run(commission(LINE, gateway.side, gateway.told.append, decider=Absent()))
    assert [one.rung for one in found.tried] == list(range(LADDERS[Step.FIRST]))
    assert {one.proposal.author for one in gateway.shown.values()} == {"rules"}
    assert any("initial-control does not answer: the rules decide" in text for text in gateway.told)


def test_the_history_says_what_was_tried_and_by_what_it_was_refused(tmp_path):
    gateway = OneProcess(tmp_path)
    with pytest.raises(CannotGoOn, match="r2rgate commission"):
        asyncio.run(history(LINE, gateway.side))
    asyncio.run(commission(LINE, gateway.side))
    found = asyncio.run(history(LINE, gateway.side))
    assert [(one.step, one.candidate, one.stage, one.against) for one in found] == [
        (Step.FIRST, 1 + rung, "refused", ["corners: error"]) for rung in range(LADDERS[Step.FIRST])
    ]
    assert approvals(found) == 0 and "LQI" in found[0].row()[3] and found[0].data()["measured"] is None


def test_what_was_measured_is_kept_beside_the_line_and_is_its_baseline_once_nothing_is_left_to_do(tmp_path):
    now = LineNow(CONFIG, None, [20.0, 20.0], 0.01, datetime(2026, 1, 5, 6, tzinfo=UTC))
    span = SpanFigures(rmse_n=0.2, overshoot_pct=5.0, settling_s=None, setpoint_n=20.0)
    shaky = Convergence(spans={"1": span}, predicted={"1": span}, rmse_n=0.2, gap=0.0)
    good = shaky.model_copy(update={"spans": {"1": span.model_copy(update={"settling_s": 0.5})}})
    assert kept(tmp_path, LINE) == {} and not shaky.settled and good.settled
    keep(tmp_path, LINE, now, "a" * 64, shaky, 1.0)
    with baselines.open_baselines(tmp_path / baselines.FILE_NAME) as database:
        assert database.baseline(LINE.site, LINE.line, SCENARIO) is None
    keep(tmp_path, LINE, now, "b" * 64, good, 1.0)
    assert kept(tmp_path, LINE) == {"a" * 64: shaky, "b" * 64: good}
    decided = Diagnosis(follows=Follows.CALMER, by="adaptation", because="span 1 swings")
    said = shaky.model_copy(update={"diagnosis": decided})
    keep(tmp_path, LINE, now, "c" * 64, said, 1.0)
    assert kept(tmp_path, LINE)["c" * 64] == said and said.follows is Follows.CALMER and shaky.follows is Follows.CALMER
    with baselines.open_baselines(tmp_path / baselines.FILE_NAME) as database:
        held_against = database.baseline(LINE.site, LINE.line, SCENARIO)
    assert held_against is not None and held_against.run.conditions["proposal"] == "b" * 64
    assert held_against.run.measured.settling_s == 0.5


def test_a_person_is_asked_once_and_waited_for(tmp_path):
    gateway = OneProcess(tmp_path, stage="waiting")

    async def run():
        working = asyncio.create_task(commission(LINE, gateway.side, gateway.told.append))
        await until(lambda: gateway.now_s >= 120.0)
        working.cancel()
        await asyncio.gather(working, return_exceptions=True)

    asyncio.run(run())
    (hash_,) = gateway.shown
    assert [text for text in gateway.told if f"r2rgate approve {hash_[:12]}" in text] == gateway.told[2:]


def test_an_experiment_that_has_just_ended_is_the_newest(tmp_path):
    gateway = OneProcess(tmp_path, historian=LateHistorian)

    async def ended():
        begin_s = gateway.now_s
        await gateway.pause(1.0)
        data = {"begin_s": begin_s, "end_s": gateway.now_s}
        event = Event(time_s=gateway.now_s, kind="experiment-end", text="", data=data)
        gateway.loop.publish(LOOP_EVENT, event.model_dump_json().encode())
        return len(await gateway.side.recordings())

    async def run():
        return [await ended() for _ in range(3)]

    assert asyncio.run(run()) == [1, 2, 3]


def test_without_a_history_that_stores_there_are_no_recordings(tmp_path):
    gateway = OneProcess(tmp_path)
    assert asyncio.run(gateway.side.recordings()) == [] and gateway.now_s > 100.0


def test_another_line_than_that_of_the_file_is_left_alone(tmp_path):
    gateway = OneProcess(tmp_path, line=line_of(2, "another"))
    found = asyncio.run(commission(LINE, gateway.side))
    assert not found.reached and "another" in found.text and gateway.shown == {}

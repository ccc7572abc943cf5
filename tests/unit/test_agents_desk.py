"""What agents may ask of the gateway, and that none of it decides anything."""

import asyncio
import json
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from gateway.cli.agents_view import as_story
from gateway.core.audit_record import Who
from gateway.core.controller import config_hash
from gateway.core.decisions import ProposalList, ProposalShown
from gateway.core.dry_run import DryRun
from gateway.core.messages import Reply
from gateway.core.proposal import Evidence, Proposal, canonical, proposal_hash
from gateway.core.status import GatewayStatus
from gateway.core.topics import (
    AGENT_NAMES,
    AGENT_TOPICS,
    ASK_CONTROLLER,
    ASK_JUDGE,
    ASK_KNOWLEDGE,
    ASK_MODEL,
    ASK_PROPOSALS,
    ASK_PROPOSE,
    ASK_RECORDINGS,
    ASK_STATUS,
    ASK_UNANSWERED,
    AgentName,
    AgentTopic,
)
from gateway.core.verdict import Verdict
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.port import RemoteError, Unreachable
from gateway.supervisor.agents_cases import RECORD_EVERY_S, AgentsCases
from gateway.supervisor.agents_desk import AgentsDesk
from gateway.supervisor.audit_file import AuditFile, AuditUnavailable
from gateway.supervisor.deployer_sides import NotKnown
from gateway.supervisor.dry_runs import MOST_EACH, DryRuns
from gateway.supervisor.gate import Gate
from gateway.supervisor.interactions import Interactions
from gateway.supervisor.judging import LONGER
from gateway.supervisor.lifecycle import Stage
from gateway.supervisor.line_desk import LineDesk
from tests.support.gateway_key import to_loop_over
from tests.unit.deployer_support import FIRST, LINE, Death, FakeJudge, FakeLoop, FakeSurroundings, proposal
from tests.unit.language_model_support import QUESTION
from tests.unit.supervisor_support import until

LONG_S = 60.0
NOW_S = 1_700_000_000.0
STATUS = GatewayStatus.model_validate_json(Path("docs/examples/status.json").read_bytes())


class SlowJudge(FakeJudge):
    """Judges when it is let, and tells what it was asked, in order."""

    def __init__(self, name: str, asked: list[str]) -> None:
        super().__init__()
        self.name = name
        self.asked = asked
        self.let = asyncio.Event()
        self.let.set()
        self.limits_s: list[float | None] = []
        self.closed = False

    async def judge(self, payload, context, recordings, seed=None, limit_s=None):
        self.asked.append(f"{self.name} {Proposal.model_validate_json(payload).reason}")
        self.limits_s.append(limit_s)
        await self.let.wait()
        return await super().judge(payload, context, recordings)

    async def close(self) -> None:
        self.closed = True


class Desk:
    """A desk on a hub, with a real gate behind it whose judge and line are stand-ins."""

    def __init__(self, folder: Path) -> None:
        self.hub = Hub()
        self.agents = InProcessMailbox(self.hub)
        self.folder = folder
        self.asked: list[str] = []
        self.events: list[tuple[str, str]] = []
        self.judge, self.dry = SlowJudge("real", self.asked), SlowJudge("dry", self.asked)
        self.surroundings = FakeSurroundings(FakeLoop(Death()))
        self.now_s = 0.0
        self.gate = Gate(
            LINE, InProcessMailbox(self.hub), to_loop_over(InProcessMailbox(self.hub), LINE), folder, self.judge,
            lambda configurations, models: self.surroundings,
            self.note, lambda: 1.0 + self.now_s, lambda: NOW_S,
        )  # fmt: skip
        self.dry_runs = DryRuns(LINE, self.dry)
        self.log = Interactions(folder)
        self.cases = AgentsCases(self.gate.audit.append, lambda: self.now_s)
        desk = AgentsDesk(
            lambda: STATUS, self.gate, self.dry_runs, self.log, self.note, self.cases
        )  # fmt: skip
        desk.serve_on(InProcessMailbox(self.hub))
        LineDesk(LINE, self.gate, folder, lambda most_s: [], self.cases).serve_on(InProcessMailbox(self.hub))

    def note(self, kind: str, text: str, **data: Any) -> None:
        self.events.append((kind, text))

    async def opened(self) -> None:
        while self.gate.deployer is None:
            await self.gate.look()

    async def ask(self, row: AgentTopic, payload: bytes = b"", agent: AgentName = "sysid") -> bytes:
        return await self.agents.request(row.of(agent), payload, LONG_S)

    async def propose(self, one: Proposal, agent: AgentName = "sysid") -> Reply:
        return Reply.model_validate_json(await self.ask(ASK_PROPOSE, canonical(one), agent))

    def records(self) -> list[tuple[str, str]]:
        """Kind and author of what the audit has."""
        with AuditFile(self.folder) as file:
            return [(record.kind, record.who.name) for record in (row.record() for row in file.rows())]

    def recorded(self) -> list[dict[str, Any]]:
        """What the audit has of agents that went wrong."""
        with AuditFile(self.folder) as file:
            return [dict(one.what) for one in (row.record() for row in file.rows()) if one.kind == "agents"]


def at_desk(story: Any, folder: Path) -> None:
    async def whole() -> None:
        desk = Desk(folder)
        try:
            async with asyncio.timeout(LONG_S):
                await story(desk)
        finally:
            await desk.dry_runs.close()
            await desk.gate.close()

    asyncio.run(whole())


def of_agents(number: int = 1, nonce: int = 0, **changes: Any) -> Proposal:
    one = proposal(number, config_hash(FIRST), NOW_S, nonce)
    return one.model_copy(update={"author": "agents", **changes})


def test_a_proposal_is_taken_in_as_the_agents_on_whose_key_it_came(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()
        evidence = [Evidence(what="agent adaptation"), Evidence(what="rmse before", value=1.0, unit="N")]
        one = of_agents(evidence=evidence)
        reply = await desk.propose(one, "adaptation")
        assert reply.ok and "is being judged" in reply.text
        assert desk.gate.deployer is not None
        await desk.gate.deployer.judged()
        assert desk.gate.deployer.book.entries[proposal_hash(one)].stage is Stage.WAITING  # for a person
        assert ("proposed", "agent adaptation") in desk.records()
        assert any(kind == "proposal" and text.startswith("agent adaptation: ") for kind, text in desk.events)

    at_desk(story, tmp_path)


@pytest.mark.slow
def test_an_agent_proposes_once_in_ten_seconds_thirty_times_an_hour_and_takes_nothing_of_anothers_share(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()
        assert (await desk.propose(of_agents(nonce=1000))).ok
        for k in range(50):  # at once: what it was refused is not put off, either
            reply = await desk.propose(of_agents(nonce=1001 + k))
            assert [one.code for one in reply.findings] == ["inbox-rate"]
            assert reply.findings[0].parameters["every_s"] == reply.findings[0].parameters["again_s"] == 10.0
        assert (await desk.propose(of_agents(nonce=1100), "adaptation")).ok
        took = []
        for k in range(1, 361):  # for an hour
            desk.now_s = 10.0 * k
            reply = await desk.propose(of_agents(nonce=k))
            took.append(reply.ok)
            assert reply.ok or reply.findings[0].parameters["every_s"] == 120.0
        assert 30 <= sum(took) <= 36 and took[:3] == [True] * 3
        assert (await desk.propose(of_agents(nonce=2000), "adaptation")).ok
        assert desk.gate.deployer is not None and len(desk.gate.deployer.book.entries) == sum(took) + 3
        told = [text for kind, text in desk.events if kind == "proposal" and "too often" in text]
        refused = [kind for kind, _ in desk.records() if kind == "refused-proposal"]
        assert len(told) <= 80 and 0 < len(refused) <= 80  # of 380
        await desk.gate.deployer.judged()

    at_desk(story, tmp_path)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"author": "rules"}, "author is rules; allowed: agents"),
        ({"author": "engineer"}, "author is engineer; allowed: agents"),
        ({"evidence": [Evidence(what="agent adaptation")]}, "evidence names agent adaptation; allowed: agent sysid"),
    ],
)
def test_nobody_proposes_in_anothers_name(tmp_path, changes, reason):
    async def story(desk: Desk) -> None:
        await desk.opened()
        reply = await desk.propose(of_agents(**changes), "sysid")
        assert not reply.ok and reply.reasons == [reason]
        assert desk.gate.deployer is not None and not desk.gate.deployer.book.entries
        assert desk.asked == []
        assert any(kind == "proposal" and text.startswith("agent sysid: ") for kind, text in desk.events)

    at_desk(story, tmp_path)


def test_what_is_no_proposal_is_refused_and_recorded_with_the_agents_name(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()
        for payload in (b"", b"\xff", b"[]", b"{" * 1000, canonical(of_agents())[:-1]):
            reply = Reply.model_validate_json(await desk.ask(ASK_PROPOSE, payload, "code"))
            assert not reply.ok and reply.reasons
        assert any(text.startswith("agent code: ") for _, text in desk.events)
        await desk.cases.look()
        (found,) = desk.recorded()
        assert (found["case"], found["times"], found["agents"]) == ("refused", 5, ["code"])

    at_desk(story, tmp_path)


def test_agents_see_the_status_and_what_became_of_proposals(tmp_path):
    async def story(desk: Desk) -> None:
        assert GatewayStatus.model_validate_json(await desk.ask(ASK_STATUS)) == STATUS
        await desk.opened()
        one = of_agents()
        await desk.propose(one)
        listed = ProposalList.model_validate_json(await desk.ask(ASK_PROPOSALS, b'{"command": "list"}'))
        assert [entry.proposal for entry in listed.proposals] == [proposal_hash(one)]
        query = json.dumps({"command": "show", "proposal": proposal_hash(one)}).encode()
        assert ProposalShown.model_validate_json(await desk.ask(ASK_PROPOSALS, query)).proposal == one

    at_desk(story, tmp_path)


@pytest.mark.parametrize("command", ["decide", "roll-back", "archive", "stop"])
def test_no_query_of_an_agent_decides(tmp_path, command):
    async def story(desk: Desk) -> None:
        await desk.opened()
        one = of_agents()
        await desk.propose(one)
        assert desk.gate.deployer is not None
        await desk.gate.deployer.judged()
        shown = desk.gate.deployer.shown(proposal_hash(one))
        assert isinstance(shown, ProposalShown)
        forged = {"command": command, "proposal": proposal_hash(one), "shown": shown.shown, "approve": True}
        for row in (ASK_PROPOSALS, ASK_PROPOSE, ASK_JUDGE):
            answer = await desk.agents.request(row.of("sysid"), json.dumps(forged).encode(), LONG_S)
            assert not Reply.model_validate_json(answer).ok
        assert desk.gate.deployer.book.entries[proposal_hash(one)].stage is Stage.WAITING

    at_desk(story, tmp_path)


def test_before_the_gate_is_open_all_that_needs_it_is_refused_with_the_reason(tmp_path):
    async def story(desk: Desk) -> None:
        for row in (ASK_PROPOSE, ASK_JUDGE):
            reply = Reply.model_validate_json(await desk.ask(row, canonical(of_agents())))
            assert not reply.ok and reply.text == "the gate is shut" and reply.reasons

    at_desk(story, tmp_path)


def test_a_dry_run_is_what_the_judge_finds_and_no_verdict_and_leaves_nothing_behind(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()
        before = desk.records()
        good, bad = of_agents(), of_agents(2)
        desk.dry.refuses.add(proposal_hash(bad))
        for one, would_pass in ((good, True), (bad, False)):
            answer = await desk.ask(ASK_JUDGE, canonical(one), "sysid")
            found = DryRun.model_validate_json(answer)
            assert (found.proposal, found.would_pass) == (proposal_hash(one), would_pass)
            assert (found.region is not None) == would_pass
            assert found.reasons == ([] if would_pass else ["as the test wants it"])
            with pytest.raises(ValidationError):
                Verdict.model_validate_json(answer)
            assert b"seed" not in answer
        assert desk.records() == before
        assert desk.gate.deployer is not None and not desk.gate.deployer.book.entries
        assert desk.asked == ["dry trial 0", "dry trial 0"]  # the gate's own judge was not asked
        assert desk.dry.limits_s == [LONGER * LINE.gate.verdict_max_s] * 2
        told = [text for kind, text in desk.events if kind == "dry-run"]
        assert told == ["agent sysid: would pass", "agent sysid: would be refused: as the test wants it"]
        reply = await desk.propose(good)  # and it may be proposed for good
        assert reply.ok

    at_desk(story, tmp_path)


def test_verdicts_go_first_and_dry_runs_one_after_the_other(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()
        desk.judge.let.clear()
        desk.dry.let.clear()
        assert (await desk.propose(of_agents(1, nonce=1))).ok
        await until(lambda: desk.asked == ["real trial 1"])
        dry = [asyncio.create_task(desk.ask(ASK_JUDGE, canonical(of_agents(2, nonce=n)))) for n in (2, 3)]
        for _ in range(100):
            await asyncio.sleep(0)
        assert desk.asked == ["real trial 1"]  # no dry run has begun beside it
        desk.judge.let.set()
        await until(lambda: len(desk.asked) == 2)
        assert desk.asked[1:] == ["dry trial 2"]
        assert (await desk.propose(of_agents(3, nonce=4), "code")).ok  # one that comes meanwhile does not wait
        await until(lambda: len(desk.asked) == 3)
        assert desk.asked[2:] == ["real trial 4"]
        assert desk.gate.deployer is not None
        await desk.gate.deployer.judged()
        desk.dry.let.set()
        assert all(DryRun.model_validate_json(one).would_pass for one in await asyncio.gather(*dry))
        assert desk.asked[3:] == ["dry trial 3"]

    at_desk(story, tmp_path)


def test_who_gives_up_a_dry_run_takes_no_verdict_along(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()
        desk.judge.let.clear()
        one = of_agents(1)
        await desk.propose(one)
        assert desk.gate.deployer is not None
        waiting = asyncio.create_task(desk.dry_runs.run(canonical(of_agents(2)), desk.gate.deployer, "sysid"))
        for _ in range(10):
            await asyncio.sleep(0)
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        desk.judge.let.set()
        await desk.gate.deployer.judged()
        assert desk.gate.deployer.book.entries[proposal_hash(one)].stage is Stage.WAITING
        assert DryRun.model_validate_json(await desk.ask(ASK_JUDGE, canonical(of_agents(2)))).would_pass

    at_desk(story, tmp_path)


def test_dry_runs_of_one_agent_keep_no_other_from_asking(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()
        desk.dry.let.clear()

        def ask(agent: AgentName) -> asyncio.Task[bytes]:
            return asyncio.create_task(desk.ask(ASK_JUDGE, canonical(of_agents()), agent))

        waiting = [ask("sysid") for _ in range(MOST_EACH)]
        await until(lambda: len(desk.asked) == 1)
        reply = Reply.model_validate_json(await desk.ask(ASK_JUDGE, canonical(of_agents())))
        assert not reply.ok and f"{MOST_EACH} dry runs of agent sysid wait already" in reply.reasons[0]
        waiting += [ask(agent) for agent in AGENT_NAMES if agent != "sysid"]
        desk.dry.let.set()
        answers = await asyncio.gather(*waiting)
        assert all(DryRun.model_validate_json(one).would_pass for one in answers)
        assert DryRun.model_validate_json(await desk.ask(ASK_JUDGE, canonical(of_agents()))).would_pass

    at_desk(story, tmp_path)


def test_without_a_line_to_judge_against_a_dry_run_says_what_to_do(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()

        async def unknown(book: object) -> None:
            raise NotKnown("the loop has not told how the line stands: start it, then propose again")

        desk.surroundings.context = unknown
        reply = Reply.model_validate_json(await desk.ask(ASK_JUDGE, canonical(of_agents())))
        assert not reply.ok and "start it" in reply.reasons[0]

    at_desk(story, tmp_path)


def test_an_agent_that_is_not_in_the_table_is_not_served(tmp_path):
    async def story(desk: Desk) -> None:
        stranger: Any = "stranger"
        calls: list[Coroutine[Any, Any, bytes]] = [desk.ask(row, b"", stranger) for row in (ASK_STATUS, ASK_PROPOSE)]
        for call in calls:
            with pytest.raises(Unreachable) as refused:
                await call
            assert not isinstance(refused.value, RemoteError)

    at_desk(story, tmp_path)


def unanswered(why: str = "sysid: nobody answers") -> bytes:
    question = QUESTION.model_copy(update={"decision": "identify.data"}).model_dump(mode="json")
    return json.dumps({"question": question, "why": why}).encode()


def test_a_question_that_an_agent_left_to_the_rules_is_in_the_log_with_why(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()
        assert Reply.model_validate_json(await desk.ask(ASK_UNANSWERED, unanswered(), "sysid")).ok

    at_desk(story, tmp_path)
    log = Interactions(tmp_path)
    (row,) = log.newest(10)
    assert (row.agent, row.decision, row.chosen, row.decided_by) == ("sysid", "identify.data", "lqi", "rules")
    found = log.find(str(row.number))
    assert found.question is not None and found.question.options == QUESTION.options
    assert as_story(found).endswith("the rules, because sysid: nobody answers")


def test_a_phase_that_went_on_by_the_rules_is_on_record_once_a_minute_with_how_often(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()
        for number in range(50):
            for agent in ("sysid", "adaptation"):
                told = await desk.ask(ASK_UNANSWERED, unanswered(f"{agent}: the {number}."), agent)
                assert Reply.model_validate_json(told).ok
            await desk.cases.look()
        first, *more = desk.recorded()
        assert not more and (first["case"], first["times"]) == ("unanswered", 2)
        assert first["newest"] == "identify.data: adaptation: the 0."
        desk.now_s = RECORD_EVERY_S
        await desk.cases.look()
        await desk.cases.look()
        _, second = desk.recorded()
        assert (second["times"], second["agents"]) == (98, ["sysid", "adaptation"])

    at_desk(story, tmp_path)


@pytest.mark.parametrize(
    "payload", [b"", b"\xff", b"[]", b'{"question": {"decision": "run.away"}, "why": "x"}', unanswered("x" * 100_000)]
)
def test_what_is_no_word_of_a_phase_is_refused_and_on_record(tmp_path, payload):
    async def story(desk: Desk) -> None:
        await desk.opened()
        reply = Reply.model_validate_json(await desk.ask(ASK_UNANSWERED, payload))
        assert not reply.ok and reply.reasons
        await desk.cases.look()
        (found,) = desk.recorded()
        assert found["case"] == "refused" and len(found["newest"]) <= 400

    at_desk(story, tmp_path)


TAKES_NOTHING = (ASK_STATUS, ASK_RECORDINGS)  #: what comes with them is not read


@pytest.mark.parametrize(
    "row",
    [row for row in AGENT_TOPICS if row.answers == "gateway" and row not in TAKES_NOTHING],
    ids=lambda row: row.name,
)
def test_nonsense_is_on_record_with_who_sent_it_wherever_it_came(tmp_path, row):
    async def story(desk: Desk) -> None:
        await desk.opened()
        reply = Reply.model_validate_json(await desk.ask(row, b'{"nonsense": [1, 2, 3]}', "code"))
        assert not reply.ok and reply.reasons
        await desk.cases.look()
        assert [(one["case"], one["agents"]) for one in desk.recorded()] == [("refused", ["code"])]

    at_desk(story, tmp_path)


def test_what_is_asked_well_and_cannot_be_told_is_no_case(tmp_path):
    async def story(desk: Desk) -> None:
        for row in (ASK_MODEL, ASK_CONTROLLER, ASK_KNOWLEDGE):
            assert not Reply.model_validate_json(await desk.ask(row, b"{}")).ok, "the gate is shut"
        await desk.opened()
        await desk.cases.look()
        assert desk.recorded() == []

    at_desk(story, tmp_path)


def test_each_case_has_a_record_of_its_own_and_one_that_could_not_be_stored_comes_later():
    stored: list[tuple[str, int, str]] = []
    now_s, there = 0.0, False

    async def append(kind: str, who: Who, what: dict[str, Any]) -> None:
        if not there:
            raise AuditUnavailable("the disk is full")
        stored.append((what["case"], what["times"], what["newest"]))

    async def story() -> None:
        nonlocal now_s, there
        cases = AgentsCases(append, lambda: now_s)
        await cases.look()
        cases.note("gone", "first", "sysid")
        await cases.look()
        cases.note("gone", "second", "sysid")
        cases.note("turned-away", "a flood", times=1000)
        there = True
        await cases.look()
        assert stored == [("turned-away", 1000, "a flood")]
        now_s = RECORD_EVERY_S
        await cases.look()
        assert stored[1:] == [("gone", 2, "second")]
        now_s *= 2
        await cases.look()
        assert len(stored) == 2  # nothing has come since

    asyncio.run(story())

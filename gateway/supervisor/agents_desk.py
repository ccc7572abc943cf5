"""What agents ask of the gateway, and what they get. They may propose, and look; nothing here decides or deploys.

The agent's name is a part of what it asks on; whoever asks there is that agent, and is recorded as it.
"""

import asyncio
import secrets
import time
from collections.abc import Callable
from functools import partial

from pydantic import ValidationError

from gateway.core.audit_record import Who
from gateway.core.decisions import QUERY
from gateway.core.dry_run import DryRun
from gateway.core.interactions import Answer, Interaction, InteractionRefused, Unanswered, pack, unpack
from gateway.core.json_problems import NotJson, document_of, problems
from gateway.core.messages import Reply
from gateway.core.proposal import ProposalRefused, parse_proposal
from gateway.core.questions import usual_choice
from gateway.core.status import GatewayStatus
from gateway.core.topics import (
    AGENT_NAMES,
    ASK_JUDGE,
    ASK_LOG,
    ASK_PROPOSALS,
    ASK_PROPOSE,
    ASK_STATUS,
    ASK_UNANSWERED,
    AgentName,
)
from gateway.mailbox.port import MAX_PAYLOAD, Mailbox
from gateway.supervisor.agents_cases import AgentsCases
from gateway.supervisor.deployer_sides import NotKnown
from gateway.supervisor.dry_runs import DryRuns, TooMany
from gateway.supervisor.gate import Gate
from gateway.supervisor.interactions import Interactions, InteractionsError
from gateway.supervisor.proposal_records import iso, refused

RULES = "rules"
AUTHOR = "agents"  #: of all their proposals
MOST_TEXT = 400  #: letters of an event
STEP_OF_CHAIN = "commissioning:"  #: by which the chain knows its own proposals (gateway/commissioning/past.py)
NAMES_AGENT = "agent "  #: an evidence that begins so names who proposes


class AgentsDesk:
    def __init__(
        self, status: Callable[[], GatewayStatus], gate: Gate, dry_runs: DryRuns, log: Interactions,
        note: Callable[..., None], cases: AgentsCases,
    ) -> None:  # fmt: skip
        self._status = status
        self._gate = gate
        self._dry_runs = dry_runs
        self._log = log
        self._writing = asyncio.Lock()  #: one thread for the log, however many agents talk
        self._note = note
        self._cases = cases

    def serve_on(self, bus: Mailbox) -> None:
        for agent in AGENT_NAMES:
            bus.serve(ASK_PROPOSE.of(agent), partial(self._propose, agent))
            bus.serve(ASK_STATUS.of(agent), self._tell_status)
            bus.serve(ASK_PROPOSALS.of(agent), partial(self._query, agent))
            bus.serve(ASK_JUDGE.of(agent), partial(self._judge, agent))
            bus.serve(ASK_LOG.of(agent), partial(self._keep, agent))
            bus.serve(ASK_UNANSWERED.of(agent), partial(self._hear, agent))

    async def _propose(self, agent: AgentName, payload: bytes) -> bytes:
        reasons = _not_theirs(agent, payload)
        if reasons:
            reply = self._refused(agent, "it is not judged", reasons)
            self._note("proposal", f"agent {agent}: {reply.text}", ok=False, reasons=reasons)
        else:
            reply = await self._gate.propose(payload, Who(name=f"{NAMES_AGENT}{agent}"))
        return _bytes(reply)

    async def _tell_status(self, _: bytes) -> bytes:
        return self._status().model_dump_json().encode()

    async def _query(self, agent: AgentName, payload: bytes) -> bytes:
        try:
            QUERY.validate_json(payload)
        except ValidationError as error:
            self._cases.note("refused", f"no query of proposals: {error.errors()[0]['msg']}", agent)
        return await self._gate.answer_query(payload)

    async def _judge(self, agent: AgentName, payload: bytes) -> bytes:
        """What is no proposal costs the judge nothing."""
        if self._gate.deployer is None:
            return _bytes(self._gate.shut_reply())
        try:
            parse_proposal(payload, MAX_PAYLOAD)
            found = await self._dry_runs.run(payload, self._gate.deployer, agent)
        except ProposalRefused as malformed:
            return _bytes(self._refused(agent, "it is no proposal", malformed.reasons))
        except (TooMany, NotKnown) as error:
            self._note("dry-run", f"agent {agent}: not judged: {error}")
            return _bytes(refused("it is not judged", [str(error)]))
        text = "would pass" if found.would_pass else f"would be refused: {found.reasons[0]}"
        self._note("dry-run", f"agent {agent}: {text}", proposal=found.proposal)
        return found.model_dump_json().encode()

    async def _keep(self, agent: AgentName, packed: bytes) -> bytes:
        """An interaction of its own, into the log."""
        try:
            async with self._writing:
                one = await asyncio.to_thread(unpack, packed)
                if one.agent != agent:
                    raise InteractionRefused([f"agent is {one.agent}; allowed: {agent}"])
                number = await asyncio.to_thread(self._log.keep, packed, one)
        except (InteractionRefused, InteractionsError) as error:
            return _bytes(self._refused(agent, "it is not kept", [str(error)]))
        decision, chosen, by, instead = one.in_short
        if instead and one.question is not None:
            self._cases.note("rules-instead", f"{decision}: {instead}", agent)
        why = f": {instead}" if instead else ""
        text = f"agent {agent}, {decision}: {chosen}, by {by}{why}"
        self._note("interaction", text[:MOST_TEXT], id=one.id, number=number)
        return _bytes(Reply(ok=True, state="", text=f"kept as {number}"))

    async def _hear(self, agent: AgentName, payload: bytes) -> bytes:
        """From a phase: it went on by the rules. The question is kept in the log, of which the agent knows nothing."""
        try:
            told = Unanswered.model_validate(document_of(payload))
        except NotJson as error:
            return _bytes(self._refused(agent, "it is not understood", [str(error)]))
        except ValidationError as error:
            return _bytes(self._refused(agent, "it is not understood", problems(error, Unanswered)))
        self._cases.note("unanswered", f"{told.question.decision}: {told.why}", agent)
        one = Interaction(
            format=1, id=secrets.token_hex(8), agent=agent, at=iso(time.time()), question=told.question, prompt="",
            answer=Answer(choice=usual_choice(told.question), by=RULES, instead=told.why), seconds=0.0,
        )  # fmt: skip
        try:
            async with self._writing:
                await asyncio.to_thread(lambda: self._log.keep(pack(one), one))
        except InteractionsError as error:
            self._note("interaction", f"agent {agent}, {told.question.decision}: it is not kept: {error}", ok=False)
        return _bytes(Reply(ok=True, state="", text="it is noted"))

    def _refused(self, agent: AgentName, text: str, reasons: list[str]) -> Reply:
        self._cases.note("refused", f"{text}: {'; '.join(reasons)}", agent)
        return refused(text, reasons)


def _not_theirs(agent: AgentName, payload: bytes) -> list[str]:
    """Why these bytes are no proposal, or not one of this agent."""
    try:
        proposal = parse_proposal(payload, MAX_PAYLOAD)
    except ProposalRefused as malformed:
        return malformed.reasons
    reasons = [] if proposal.author == AUTHOR else [f"author is {proposal.author}; allowed: {AUTHOR}"]
    own = f"{NAMES_AGENT}{agent}"
    reasons += [
        f"evidence names {one.what}; allowed: {own}"
        for one in proposal.evidence
        if one.what.startswith(NAMES_AGENT) and one.what != own
    ]
    reasons += [
        f"evidence names {one.what}; allowed: what does not begin with {STEP_OF_CHAIN}, as those of commissioning do"
        for one in proposal.evidence
        if one.what.startswith(STEP_OF_CHAIN)
    ]
    return reasons


def _bytes(answer: Reply | DryRun) -> bytes:
    return answer.model_dump_json().encode()

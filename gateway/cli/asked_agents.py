"""The decider of a line that runs: the agents on its bus, and the rules wherever none of them answers.

An agent that is not there, or answers what is no answer, costs the phase a moment. One that does not answer in time
costs it that time once: then it is not asked for `REST_S`. The gateway is told of each, for the audit.
"""

import asyncio
import secrets
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, wait
from contextlib import suppress
from math import inf

from pydantic import ValidationError

from gateway.commissioning.decisions import RULES, Decided
from gateway.core.interactions import MOST_WHY, Answer, Unanswered
from gateway.core.line import Line
from gateway.core.questions import Question, usual_choice, wrong_with
from gateway.core.topics import AGENT_DECIDE, ASK_UNANSWERED
from gateway.mailbox.port import Mailbox, Unreachable

REST_S = 600.0
TOLD_EVERY_S = 10.0  #: that an agent is still waited for
LOOKED_UP_S = 20.0  #: for an agent to look up what is known, and to write it down
TELL_S = 2.0  #: for the gateway to hear that an agent has failed


class NotAnswered(Exception):
    """An agent's answer answers nothing; the text says why."""


class AskedAgents:
    """`Decider` of `line`. `bus` belongs to `loop`; `decide` is called from another thread, and blocks that one.

    `within_s`: for an answer; None: as long as the line's file lets the agent ask its model, and a little more.
    `tell` says, from that thread, who is waited for.
    """

    def __init__(
        self,
        line: Line,
        bus: Mailbox,
        loop: asyncio.AbstractEventLoop,
        within_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        tell: Callable[[str], None] = lambda text: None,
        tell_every_s: float = TOLD_EVERY_S,
    ) -> None:
        self._bus = bus
        self._loop = loop
        agents = line.agents
        asked_s = 0.0 if agents.llm == "off" else agents.load_max_s + agents.answer_max_s
        self.within_s = LOOKED_UP_S + asked_s if within_s is None else within_s  #: for an answer
        self._clock = clock
        self._tell_person = tell
        self._tell_every_s = tell_every_s
        self._run = secrets.token_hex(8)
        self._resting_until_s: dict[str, float] = {}  #: agents that let the phase wait

    def decide(self, question: Question) -> Decided:
        if self._clock() < self._resting_until_s.get(question.agent, -inf):
            return self._by_rules(question, f"{question.agent} did not answer in time a while ago")
        began_s = self._clock()
        asked = asyncio.run_coroutine_threadsafe(self._asked(question), self._loop)
        while not wait([asked], self._tell_every_s).done:
            waited_s = self._clock() - began_s
            self._tell_person(
                f"{question.decision}: {question.agent} is thinking, {waited_s:.0f} s of at most {self.within_s:.0f}"
            )
        try:
            answer = asked.result()
        except (Unreachable, ValidationError, CancelledError) as error:
            if self._clock() - began_s >= self.within_s:
                self._resting_until_s[question.agent] = self._clock() + REST_S
            return self._by_rules(question, f"{question.agent}: {_short(error)}")
        try:
            return decided_by(answer, question)
        except NotAnswered as error:
            return self._by_rules(question, str(error))

    def _by_rules(self, question: Question, why: str) -> Decided:
        """Because the agent has failed; the gateway is told."""
        with suppress(CancelledError):
            asyncio.run_coroutine_threadsafe(self._tell(question, why), self._loop).result()
        return Decided(usual_choice(question), RULES, why)

    async def _tell(self, question: Question, why: str) -> None:
        """It is the gateway's to keep; a phase goes on without it, too."""
        payload = Unanswered(question=question, why=why[:MOST_WHY]).model_dump_json().encode()
        with suppress(Unreachable):
            await self._bus.request(ASK_UNANSWERED.of(question.agent), payload, TELL_S)

    async def _asked(self, question: Question) -> Answer:
        """Raises Unreachable, ValidationError."""
        payload = question.model_copy(update={"run": self._run}).model_dump_json().encode()
        return Answer.model_validate_json(
            await self._bus.request(AGENT_DECIDE.of(question.agent), payload, self.within_s)
        )


def decided_by(answer: Answer, question: Question) -> Decided:
    """What an agent's answer to `question` comes to. Raises NotAnswered."""
    if answer.by not in (question.agent, RULES):
        raise NotAnswered(f"{question.agent} answers as somebody else")
    if answer.by == RULES:  # what the rules choose is known here
        return Decided(usual_choice(question), RULES, answer.instead, answer.interaction)
    if against := wrong_with(answer.choice, question):
        raise NotAnswered(f"{question.agent} is not understood: {'; '.join(against)}")
    return Decided(answer.choice, answer.by, answer.instead, answer.interaction)


def _short(error: BaseException) -> str:
    if isinstance(error, ValidationError):
        return "what it answered is no answer"
    return str(error) or type(error).__name__

"""The decider of a line that runs: the agents on its bus, and the rules wherever none of them answers.

An agent that is not there, does not answer in time, or answers what is no answer costs the phase that moment and
nothing else.
"""

import asyncio
from concurrent.futures import CancelledError

from pydantic import ValidationError

from gateway.commissioning.decisions import RULES, Decided
from gateway.core.interactions import Answer
from gateway.core.line import Line
from gateway.core.questions import Question, usual_choice, wrong_with
from gateway.core.topics import AGENT_DECIDE
from gateway.mailbox.port import Mailbox, Unreachable

LOOKED_UP_S = 20.0  #: for an agent to look up what is known, and to write it down


class AskedAgents:
    """`Decider` of `line`. `bus` belongs to `loop`; `decide` is called from another thread, and blocks that one.

    `within_s`: for an answer; None: as long as the line's file lets the agent ask its model, and a little more.
    """

    def __init__(
        self, line: Line, bus: Mailbox, loop: asyncio.AbstractEventLoop, within_s: float | None = None
    ) -> None:
        self._bus = bus
        self._loop = loop
        agents = line.agents
        asked_s = 0.0 if agents.llm == "off" else agents.load_max_s + agents.answer_max_s
        self._within_s = LOOKED_UP_S + asked_s if within_s is None else within_s

    def decide(self, question: Question) -> Decided:
        asked = asyncio.run_coroutine_threadsafe(self._asked(question), self._loop)
        try:
            answer = asked.result()
        except (Unreachable, ValidationError, CancelledError) as error:
            return Decided(usual_choice(question), RULES, f"{question.agent}: {_short(error)}")
        if against := wrong_with(answer.choice, question):
            return Decided(usual_choice(question), RULES, f"{question.agent} is not understood: {'; '.join(against)}")
        return Decided(answer.choice, answer.by, answer.instead)

    async def _asked(self, question: Question) -> Answer:
        """Raises Unreachable, ValidationError."""
        payload = question.model_dump_json().encode()
        return Answer.model_validate_json(
            await self._bus.request(AGENT_DECIDE.of(question.agent), payload, self._within_s)
        )


def _short(error: BaseException) -> str:
    if isinstance(error, ValidationError):
        return "what it answered is no answer"
    return str(error) or type(error).__name__

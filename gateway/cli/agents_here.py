"""The decider of a simulated line: the agents in this process, without a bus.

The same agents, client of the language model, knowledge and records as in the agents' own process. The event loop in
which a question is answered is made by whoever begins this, so that its time need not be that of the clock: where the
model is in the process as well, a slow one then costs no waiting.
"""

import asyncio
from collections.abc import Callable
from contextlib import AsyncExitStack
from datetime import UTC, datetime

from agents.answering import Agent, Search
from agents.clocks import Clocks
from agents.language_model.budget import Budget
from agents.language_model.client import LanguageModel, Transport
from gateway.cli.asked_agents import decided_by
from gateway.commissioning.decisions import Decided
from gateway.core.interactions import Interaction
from gateway.core.line import Agents
from gateway.core.questions import Question


class AgentsHere:
    """`Decider` of one task: its tokens are those of `settings.task_max_tokens`.

    `keep` is told of each interaction. `transport`: of the client's requests; None: the network. `loops` makes the
    event loop in which a question is answered, by whose time deadlines are kept and durations told.
    """

    def __init__(
        self,
        settings: Agents,
        search: Search,
        keep: Callable[[Interaction], None],
        transport: Callable[[], Transport] | None = None,
        loops: Callable[[], asyncio.AbstractEventLoop] | None = None,
    ) -> None:
        self._settings = settings
        self._search = search
        self._keep = keep
        self._transport = transport
        self._loops = loops
        self._budget = Budget(settings.task_max_tokens)

    def decide(self, question: Question) -> Decided:
        """Blocks until there is an answer, which the model's settings bound."""
        with asyncio.Runner(loop_factory=self._loops) as runner:
            return runner.run(self._decided(question))

    async def _decided(self, question: Question) -> Decided:
        clock = asyncio.get_running_loop().time
        async with AsyncExitStack() as held:
            model = None
            if self._settings.llm != "off":
                transport = None if self._transport is None else self._transport()
                model = await held.enter_async_context(LanguageModel(self._settings, clock, transport))
            clocks = Clocks(clock, lambda: datetime.now(UTC))
            agent = Agent(question.agent, self._search, self._kept, model, lambda _: self._budget, clocks)
            return decided_by(await agent.answer(question), question)

    async def _kept(self, interaction: Interaction) -> None:
        self._keep(interaction)

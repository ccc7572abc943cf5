"""The agents' process: one session on the bus of a line, one task for each agent, until it is told to stop.

It may come and go as it likes: whoever asks goes on by the rules while it is not there. It reads the line's file for
nothing but its names and who is asked, and reaches the line by the bus alone.
"""

import asyncio
import signal
import sys
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from agents.answering import Agent, Keep, NotTheirs, Search
from agents.code.agent import CodeAgent
from agents.code.materials import Materials
from agents.heads import Heads
from agents.known import Knowledge
from agents.language_model.budget import Budget
from agents.language_model.client import LanguageModel
from agents.language_model.no_answer import NoAnswer
from agents.line_on_bus import LineOnBus
from agents.progress import told
from agents.rag.embedders import embedder_named
from agents.roles import ROLES
from gateway.core.computations import ComputeReply, ComputeRequest
from gateway.core.interactions import Interaction, pack
from gateway.core.json_problems import NotJson, document_of, problems
from gateway.core.line import Line, Strict
from gateway.core.messages import Reply
from gateway.core.questions import Question
from gateway.core.topics import AGENT_COMPUTE, AGENT_DECIDE, ASK_LOG, AgentName
from gateway.mailbox.bus import BusUnavailable, TlsEndpoint, connect
from gateway.mailbox.port import Mailbox, RemoteError, Unreachable

EXIT_OK, EXIT_NO_BUS = 0, 1  # another try may find it
MOST_TASKS = 32  #: whose tokens are counted; the one that has been asked for last is the last to be forgotten
LOOKS: AgentName = "monitoring"  #: in whose name the process asks what is known of the line
CODE: AgentName = "code"
LOG_S = 5.0  #: for the gateway to take an interaction
MOST_WAITING = 20  #: interactions of an agent, while the gateway is away
COMPUTE_MAX_S = 120.0  #: for all calls of a request

Tell = Callable[[str], None]
T = TypeVar("T", bound=Strict)


def run_agents(line: Line, where: Path | TlsEndpoint, folder: Path, heads: Path) -> int:
    """Serve until SIGTERM or SIGINT. `folder`: of the knowledge; `heads`: where those of the audit are kept.

    Returns the process's exit code.
    """

    def tell(text: str) -> None:
        print(text, flush=True)

    try:
        return asyncio.run(serve(line, where, folder, heads, tell))
    except BusUnavailable as error:
        print(f"the agents cannot reach the line: {error}", file=sys.stderr)
        return EXIT_NO_BUS


async def serve(line: Line, where: Path | TlsEndpoint, folder: Path, heads: Path, tell: Tell) -> int:
    """All agents of `line`. Raises BusUnavailable."""
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with AsyncExitStack() as held:
        bus = await connect(where, line.site, line.line)
        held.push_async_callback(bus.close)
        model = await _model(line, held, tell)
        find = partial(embedder_named, line.agents.embedder, line.agents.url)
        known = await held.enter_async_context(Knowledge(folder, LineOnBus(bus, LOOKS), find, tell))
        await known.begin()
        begin(bus, line, known.search, model, tell, LineOnBus(bus, CODE))
        kept = Heads(bus, LOOKS, f"{line.site}/{line.line}", heads, tell)
        for work in (known.keep_up(), kept.keep_up()):
            held.push_async_callback(_stopped, asyncio.create_task(work))
        tell(f"agents of {line.site}/{line.line}: {', '.join(ROLES)}")
        await stop.wait()
    return EXIT_OK


def begin(
    bus: Mailbox, line: Line, search: Search, model: LanguageModel | None, tell: Tell, materials: Materials
) -> None:  # fmt: skip
    """Every agent answers on `bus` from now on. `materials`: what the Code agent computes with."""
    budgets = Budgets(line.agents.task_max_tokens)
    asking = asyncio.Lock()  # one model, one question at a time
    code = CodeAgent(line, materials, _keep(bus, "code", tell))
    for name in ROLES:
        if not ROLES[name].decides:
            continue
        agent = Agent(name, search, _keep(bus, name, tell), model, budgets.of, code=code)
        bus.serve(AGENT_DECIDE.of(name), _handler(agent, asking, tell))
    bus.serve(AGENT_COMPUTE.of("code"), _computing(code))


class Budgets:
    """What one run of a phase, such as a commissioning, may cost, however long a person takes to approve."""

    def __init__(self, most_tokens: int) -> None:
        self._most_tokens = most_tokens
        self._of: dict[str, Budget] = {}

    def of(self, question: Question) -> Budget:
        budget = self._of.pop(question.run, None) or Budget(self._most_tokens)
        self._of[question.run] = budget
        while len(self._of) > MOST_TASKS:
            del self._of[next(iter(self._of))]
        return budget


def _handler(agent: Agent, asking: asyncio.Lock, tell: Tell) -> Callable[[bytes], Awaitable[bytes]]:
    async def decide(payload: bytes) -> bytes:
        question = _read(payload, Question)
        async with asking, told(question, tell) as said:
            return (await agent.answer(question, said.hear)).model_dump_json().encode()

    return decide


def _computing(code: CodeAgent) -> Callable[[bytes], Awaitable[bytes]]:
    async def compute(payload: bytes) -> bytes:
        request = _read(payload, ComputeRequest)
        task = code.task(request.asked_by, request.task)
        results, number = await task.compute_and_note(request.calls, COMPUTE_MAX_S)
        return ComputeReply(results=results, interaction=number).model_dump_json().encode()

    return compute


def _read(payload: bytes, kind: type[T]) -> T:
    """Raises NotTheirs with every reason."""
    try:
        return kind.model_validate(document_of(payload))
    except NotJson as error:
        raise NotTheirs(str(error)) from error
    except ValidationError as error:
        raise NotTheirs("; ".join(problems(error, kind))) from error


def _keep(bus: Mailbox, name: AgentName, tell: Tell) -> Keep:
    """What the gateway is not there to take goes to it with the next one."""
    waiting: deque[Interaction] = deque(maxlen=MOST_WAITING)
    sending = asyncio.Lock()

    async def keep(interaction: Interaction) -> None:
        async with sending:
            waiting.append(interaction)
            while waiting:
                one = waiting[0]
                try:
                    reply = Reply.model_validate_json(await bus.request(ASK_LOG.of(name), pack(one), LOG_S))
                    why = "" if reply.ok else "; ".join([reply.text, *reply.reasons])
                except (ValidationError, ValueError, RemoteError) as error:
                    why = str(error)
                except Unreachable as error:
                    tell(f"interaction {one.id} is not in the log yet: {error}")
                    return
                waiting.popleft()
                if why:
                    tell(f"interaction {one.id} is not in the log: {why}")
                if waiting:
                    await asyncio.sleep(1.0 / ASK_LOG.most_per_s)

    return keep


async def _model(line: Line, held: AsyncExitStack, tell: Tell) -> LanguageModel | None:
    """None: the rules answer."""
    if line.agents.llm == "off":
        tell('the rules decide: agents.llm is "off"')
        return None
    model = await held.enter_async_context(LanguageModel(line.agents))
    try:
        found = await model.look()
        tell(f"{found.model} {found.digest[:12]} answers on {line.agents.url}")
    except NoAnswer as error:
        tell(f"{error.text}; the rules decide until it answers")
    return model


async def _stopped(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)

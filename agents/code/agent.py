"""The Code agent: it computes for the others and decides nothing. What it is asked, and what comes of it, is logged."""

import asyncio
import hashlib
import json
import secrets
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from agents.clocks import SYSTEM, Clocks
from agents.code.calls import MOST_BYTES, CallRefused, parse_call, size_of
from agents.code.job import Job, Outcome
from agents.code.materials import Materials, job_of
from agents.code.worker import run
from agents.roles import ROLES
from gateway.core.computations import Computed
from gateway.core.controller import Controller
from gateway.core.interactions import Interaction
from gateway.core.line import Line

Keep = Callable[[Interaction], Awaitable[None]]
Run = Callable[[Job, float], Awaitable[Outcome]]  #: within so many seconds, always an outcome
MOST_REASONS = 20
MOST_FAILED = 600
MOST_SHOWN = 200  #: letters of a call that is too large


class CodeAgent:
    """One computation at a time: the loop needs the processors, too. `keep` raises nothing."""

    def __init__(
        self, line: Line, materials: Materials, keep: Keep, clocks: Clocks = SYSTEM, run: Run = run
    ) -> None:  # fmt: skip
        self._line = line
        self._materials = materials
        self._keep = keep
        self._clocks = clocks
        self._run = run
        self._computing = asyncio.Lock()

    def task(self, asked_by: str, task: str) -> "Task":
        """For calls that may name each other."""
        return Task(self, asked_by, task)

    async def carry_out(
        self, document: Any, number: int, within_s: float, designed: Callable[[int], Controller]
    ) -> tuple[Computed, Controller | None]:
        """One call, and the controller that it has designed. Raises nothing."""
        began_s = self._clocks.monotonic_s()
        outcome = Outcome()
        try:
            async with asyncio.timeout(max(within_s, 0.0)):
                job = await job_of(parse_call(document), self._line, self._materials, designed)
                async with self._computing:
                    outcome = await self._run(job, within_s - (self._clocks.monotonic_s() - began_s))
        except CallRefused as refused:
            outcome = Outcome(refused=[reason[:MOST_FAILED] for reason in refused.reasons[:MOST_REASONS]])
        except TimeoutError:
            outcome = Outcome(failed=f"it was not done within {max(within_s, 0.0):.3g} s")
        except Exception as error:  # of whoever knows the line: it is told, and nobody falls over it
            outcome = Outcome(failed=f"what it names cannot be had: {error}"[:MOST_FAILED])
        computed = Computed(
            call=shown(document), number=number, figures=outcome.figures, words=outcome.words, refused=outcome.refused,
            failed=outcome.failed, seconds=max(self._clocks.monotonic_s() - began_s, 0.0),
        )  # fmt: skip
        return computed, outcome.controller

    async def note(self, asked_by: str, task: str, results: Sequence[Computed], at: str, seconds: float) -> str:
        """Into the log; its id there."""
        interaction = Interaction(
            format=1,
            id=secrets.token_hex(8),
            agent="code",
            at=at,
            asked_by=asked_by,
            task=task,
            computations=list(results),
            prompt=hashlib.sha256(ROLES["code"].prompt.encode()).hexdigest(),
            seconds=seconds,
        )
        await self._keep(interaction)
        return interaction.id

    @property
    def clocks(self) -> Clocks:
        return self._clocks


class Task:
    """What one question, or one request, has computed; calls are numbered through from 1."""

    def __init__(self, agent: CodeAgent, asked_by: str, task: str) -> None:
        self._agent = agent
        self._asked_by = asked_by
        self._task = task
        self._controllers: list[Controller | None] = []

    async def compute(self, documents: Sequence[Any], within_s: float) -> list[Computed]:
        """Each in its turn, all within so many seconds; what there is no time for fails. Raises nothing."""
        results, _ = await self.compute_and_note(documents, within_s)
        return results

    async def compute_and_note(self, documents: Sequence[Any], within_s: float) -> tuple[list[Computed], str]:
        """The same, with the number of its record."""
        clocks = self._agent.clocks
        began_s, at = clocks.monotonic_s(), clocks.now().isoformat(timespec="milliseconds")
        results: list[Computed] = []
        for document in documents:
            left_s = within_s - (clocks.monotonic_s() - began_s)
            computed, controller = await self._agent.carry_out(
                document, len(self._controllers) + 1, left_s, self._designed
            )
            results.append(computed)
            self._controllers.append(controller)
        seconds = max(clocks.monotonic_s() - began_s, 0.0)
        return results, await self._agent.note(self._asked_by, self._task, results, at, seconds)

    def _designed(self, number: int) -> Controller:
        found = self._controllers[number - 1] if number <= len(self._controllers) else None
        if found is None:
            there = [f"call {k}" for k, one in enumerate(self._controllers, 1) if one is not None]
            raise CallRefused(
                [f"call {number} has designed no controller; allowed: {', '.join(['in-service', *there])}"]
            )
        return found


def shown(document: Any) -> Any:
    """A call as it goes on record: as it is, or the beginning of it where it is too large or no JSON."""
    size = size_of(document)
    if size is None:
        return repr(document)[:MOST_SHOWN]
    return document if size <= MOST_BYTES else json.dumps(document)[:MOST_SHOWN]

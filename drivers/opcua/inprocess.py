"""The engine in the event loop of its link: for stepped time, where nothing else may wait or take time."""

import asyncio
from collections.abc import Callable

from drivers.opcua.engine import Engine
from drivers.opcua.messages import Answer, Plan, Question
from gateway.tasks.cleanup import end, finish


class EngineChannel:
    """A `drivers.opcua.channel.Channel` without a process. A server that attacks the decoder stops the loop here."""

    def __init__(self, plan: Plan) -> None:
        self.up = asyncio.Event()
        self._plan = plan
        self._engine: Engine | None = None
        self._generation = 0
        self._task: asyncio.Task[None] | None = None
        self._on_answer: Callable[[Answer], None] = lambda answer: None
        self._on_lost: Callable[[str], None] = lambda why: None

    def start(self, on_answer: Callable[[Answer], None], on_lost: Callable[[str], None]) -> None:
        self._on_answer, self._on_lost = on_answer, on_lost
        self._begin()

    def _begin(self) -> None:
        self._generation += 1
        self._engine = Engine(self._plan, self._generation)
        self.up.set()

    def tend(self, now_s: float) -> None:
        """An engine in the same process does not end by itself."""

    def ask(self, question: Question) -> bool:
        if self._engine is None or (self._task is not None and not self._task.done()):
            return False
        self._task = asyncio.create_task(self._answer(self._engine, question))
        return True

    async def _answer(self, engine: Engine, question: Question) -> None:
        self._on_answer(await engine.answer(question))

    def give_up(self, why: str) -> None:
        if self._task is not None:
            self._task.cancel()
        if self._engine is not None:
            self._engine.abandon()
            self._begin()
            self._on_lost(why)

    async def close(self) -> None:
        engine, self._engine = self._engine, None
        self.up.clear()
        await finish(_close(engine, self._task))


async def _close(engine: Engine | None, task: asyncio.Task[None] | None) -> None:
    if task is not None:
        await end(task)
    if engine is not None:
        await engine.close()

"""How far a language model is with a question, told every few seconds: one on a line PC may take minutes."""

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from gateway.core.line_problem import printable
from gateway.core.questions import Question

EVERY_S = 10.0
SHOWN = 60  #: letters, the newest


@dataclass
class Said:
    """What has come of the model until now."""

    letters: int = 0
    newest: str = ""

    def hear(self, piece: str) -> None:
        self.letters += len(piece)
        self.newest = (self.newest + piece)[-SHOWN:]


@asynccontextmanager
async def told(question: Question, tell: Callable[[str], None], every_s: float = EVERY_S) -> AsyncGenerator[Said]:
    """While a question is being answered. `hear` each piece."""
    loop, said = asyncio.get_running_loop(), Said()
    began_s = loop.time()
    name = f"{question.agent}, {question.decision}"

    async def telling() -> None:
        while True:
            await asyncio.sleep(every_s)
            words = printable(" ".join(said.newest.split()))
            until_now = f"{said.letters} letters until now, ... {words}" if said.letters else "not a word yet"
            tell(f"{name}: {loop.time() - began_s:.0f} s, {until_now}")

    task = asyncio.create_task(telling())
    try:
        yield said
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

"""The demonstration's side of its OPC UA client: the process, orders to it, and what came of them."""

import asyncio
import sys
from pathlib import Path
from typing import Self

from pydantic import ValidationError

from gateway.cli.demo_failed import DemoFailed
from gateway.cli.demo_orders import Access, Approve, Call, Told

ANSWER_S = 60.0  #: for an order, on a busy computer


class Panel:
    """`begin` it, `ask`, `close`."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    @classmethod
    async def begin(cls, access: Access, log: Path) -> Self:
        """Its messages go to `log`. Ctrl-C here does not reach it; it ends with its input, whatever ends that."""
        with log.open("a") as sink:
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "gateway.cli.demo_client",
                stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=sink, start_new_session=True,
            )  # fmt: skip
        panel = cls(process)
        await panel._say(access.model_dump_json())
        return panel

    async def ask(self, order: Call | Approve) -> Told:
        """Raises DemoFailed where the client does not answer, which is its end; what the line refuses is told."""
        assert self._process.stdout is not None
        try:
            async with asyncio.timeout(ANSWER_S):
                await self._say(order.model_dump_json())
                return Told.model_validate_json(await self._process.stdout.readline())
        except (TimeoutError, ConnectionError, ValidationError) as error:
            await self.close()  # a late answer would be taken for that to the next order
            raise DemoFailed(f"the OPC UA client does not answer ({type(error).__name__}); see its log") from error

    async def close(self) -> None:
        if self._process.returncode is None:
            self._process.kill()
        await self._process.wait()

    async def _say(self, text: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(text.encode() + b"\n")
        await self._process.stdin.drain()

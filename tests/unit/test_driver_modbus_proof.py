"""A proof that goes on over several cycles while arming proves, or voids, all of it."""

import asyncio
from typing import Any

from drivers.modbus.device import Check
from drivers.modbus.proof import Proof
from drivers.modbus.registers import RegisterBlock


class Slow:
    """A unit that answers when it is told to."""

    where = "somewhere"

    def __init__(self) -> None:
        self.asked: list[int] = []
        self._answers: asyncio.Queue[int] = asyncio.Queue()

    async def read(self, function: int, unit: int, address: int, count: int, deadline_s: float) -> list[int]:
        self.asked.append(address)
        return [await self._answers.get()] * count

    async def answer(self, asked: int) -> None:
        """Once it has been asked so often."""
        while len(self.asked) < asked:  # noqa: ASYNC110 - one turn of the loop at a time
            await asyncio.sleep(0)
        self._answers.put_nowait(7)
        await asyncio.sleep(0)
        await asyncio.sleep(0)


def proof() -> Proof:
    """Three registers, each asked for by itself, any value is right."""
    blocks = [RegisterBlock([(address, "u16")], "high-first") for address in (0, 10, 20)]
    return Proof("drive-1", 1, 3, [Check(block, lambda number: []) for block in blocks])


def test_what_arming_has_proven_meanwhile_stays_proven() -> None:
    async def run() -> None:
        unit, whole = Slow(), proof()
        whole.void()
        connection: Any = unit
        going_on = asyncio.create_task(whole.go_on(connection, 0.0))
        await asyncio.sleep(0)
        whole.confirm()
        await unit.answer(1)
        assert whole.complete, "an answer to an older question does not undo it"
        assert await going_on == [] and unit.asked == [0]

    asyncio.run(run())


def test_what_was_voided_meanwhile_begins_anew() -> None:
    async def run() -> None:
        unit, whole = Slow(), proof()
        whole.void()
        connection: Any = unit
        going_on = asyncio.create_task(whole.go_on(connection, 0.0))
        await unit.answer(1)
        await unit.answer(2)
        whole.void()
        await unit.answer(3)
        assert not whole.complete
        for asked in (4, 5, 6):
            await unit.answer(asked)
        assert await going_on == [] and whole.complete
        assert unit.asked == [0, 10, 20, 0, 10, 20]

    asyncio.run(run())

"""Cancelling what is awaited at a point of one's choice: at its k-th suspension, or so many turns of the loop later."""

import asyncio
import types
from collections.abc import Callable, Coroutine, Generator
from typing import Any

from drivers.port import Link


@types.coroutine
def _suspensions(work: Coroutine[Any, Any, Any], suspended: Callable[[], None]) -> Generator[Any, Any, Any]:
    """Await `work`; `suspended` is called whenever it is about to wait for something."""
    result: Any = None
    error: BaseException | None = None
    while True:
        try:
            waits_for = work.send(result) if error is None else work.throw(error)
        except StopIteration as ended:
            return ended.value
        suspended()
        result = error = None
        try:
            result = yield waits_for
        except BaseException as thrown:
            error = thrown


async def cut(work: Coroutine[Any, Any, Any], at: int) -> bool:
    """Run `work`, cancelled when it waits for the `at`-th time, counted from 1. False where it ended before."""
    waits = 0

    def suspended() -> None:
        nonlocal waits
        waits += 1
        if waits == at:
            running.cancel()

    async def run() -> None:
        await _suspensions(work, suspended)

    running = asyncio.create_task(run())
    await asyncio.wait([running])
    if waits < at:
        running.result()
        return False
    assert running.cancelled(), "it was cancelled, and that is told"
    return True


async def release_cut(link: Link, turns: int, cancellations: int) -> None:
    """Release `link`, cancelled so many turns of the loop after its beginning, and again with each turn after it."""
    releasing = asyncio.create_task(link.release())
    for _ in range(turns + 1):
        await asyncio.sleep(0)
    for _ in range(cancellations):
        releasing.cancel()
        await asyncio.sleep(0)
    await asyncio.wait([releasing])
    assert cancellations or not releasing.cancelled()
    if not releasing.cancelled():
        releasing.result()

"""Work that may block, off the event loop: in a thread of its own, so that what hangs in it holds up nothing else."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

SMALL_BYTES = 65_536  #: what is done with no more than so many takes less than going to a thread would matter
CLOSED_S = 2.0  #: that a thread has at the end for what it is at


async def beside(size_bytes: int, work: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
    """What `work` returns or raises, with so many bytes: of many in a thread."""
    if size_bytes <= SMALL_BYTES:
        return work(*arguments, **named)
    return await asyncio.to_thread(work, *arguments, **named)


class Worker:
    """A thread that does one piece of work after the other. Whoever gives up before its turn has come takes none."""

    def __init__(self, name: str) -> None:
        self._thread = ThreadPoolExecutor(1, name)

    async def do(self, work: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
        """What `work` returns or raises. Cancelled, it is not begun; what is under way comes to its end."""
        call = partial(work, *arguments, **named)
        return await asyncio.get_running_loop().run_in_executor(self._thread, call)

    async def close(self, last: Callable[[], object] | None = None) -> None:
        """Do `last`, if there is time for it; what waits is not begun any more."""
        done = set[asyncio.Future[object]]()
        if last is not None:
            done, _ = await asyncio.wait((asyncio.ensure_future(self.do(last)),), timeout=CLOSED_S)
        self._thread.shutdown(wait=False, cancel_futures=True)
        for one in done:
            one.result()

"""Work that takes longer than a period, in a thread that stands back: periods go on meanwhile."""

import asyncio
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TypeVar

T = TypeVar("T")

#: How long the thread may hold the interpreter once the loop wants it; Python's own 5 ms are half a period. Whoever
#: waits for it wakes as often: with one processor, which the thread needs in between, that must leave it time.
SWITCH_S = 50e-6 if (os.cpu_count() or 1) > 1 else 1e-3
BEHIND_LOOPS = 1  #: real-time priority: below any loop's, above whatever has none


def _stand_back() -> None:
    """Behind every loop, and before all else, once the loop has real-time priority.

    A thread that holds the interpreter and has to wait for a processor keeps the loop waiting with it: on a busy
    computer for tens of milliseconds. So it goes before what has no real-time priority, where the loop has one itself.
    """
    loops = os.sched_getscheduler(os.getpid())
    if loops != os.SCHED_OTHER and os.sched_getscheduler(0) != os.SCHED_RR:
        with suppress(PermissionError):  # it was granted once: then as whatever else has none
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(BEHIND_LOOPS))


class Aside:
    """One piece of work after the other, in a thread that runs once this is made: before the loop takes its processor
    and its priority (`realtime.become_punctual`). On a computer with one processor a thread that begins later may not
    get as far as to say that it has, which the loop waits for."""

    def __init__(self) -> None:
        sys.setswitchinterval(SWITCH_S)
        self._thread = ThreadPoolExecutor(1, "aside")
        self._thread.submit(_stand_back).result()

    async def do(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, _behind_loops, work)

    def close(self) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)


def _behind_loops(work: Callable[[], T]) -> T:
    _stand_back()
    return work()

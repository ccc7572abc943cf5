"""Work that takes longer than a period, in a thread that stands back: periods go on meanwhile."""

import asyncio
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import TypeVar

T = TypeVar("T")

#: How long a thread may hold the interpreter once the loop wants it; Python's own 5 ms are half a period. Whoever
#: waits for it wakes as often: with one processor, which the thread needs in between, that must leave it time.
SWITCH_S, SWITCH_ON_ONE_S = 50e-6, 1e-3
BEHIND_LOOPS = 1  #: real-time priority: below any loop's, above whatever has none


def _stand_back(granted: frozenset[int]) -> None:
    """Behind every loop, and before all else, once the loop has real-time priority. `granted`: processors before that.

    A thread that holds the interpreter and has to wait for a processor keeps the loop waiting with it: on a busy
    computer for tens of milliseconds. So it goes before what has no real-time priority, where the loop has one itself,
    on the processors that the loop has left. Where it has left none, the thread has no such priority: the kernel takes
    a processor from all of that class once they have had 95 % of a second, and the loop with them.
    """
    loop = os.getpid()  # its thread's number, too
    if os.sched_getscheduler(loop) == os.SCHED_OTHER:
        return
    own = os.sched_getaffinity(loop)
    left = granted - own if len(own) == 1 else granted
    if not left or len(granted) == 1:
        return
    with suppress(OSError):  # it was granted once, or a processor is gone: then as whatever else has none
        if os.sched_getaffinity(0) != left:
            os.sched_setaffinity(0, left)
        if os.sched_getscheduler(0) != os.SCHED_RR:
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(BEHIND_LOOPS))


class Aside:
    """One piece of work after the other, in a thread that runs once this is made: before the loop takes its processor
    and its priority (`realtime.become_punctual`). On a computer with one processor a thread that begins later may not
    get as far as to say that it has, which the loop waits for."""

    def __init__(self) -> None:
        granted = frozenset(os.sched_getaffinity(0))
        sys.setswitchinterval(SWITCH_S if len(granted) > 1 else SWITCH_ON_ONE_S)
        self._stand_back = partial(_stand_back, granted)
        self._thread = ThreadPoolExecutor(1, "aside")
        self._thread.submit(self._stand_back).result()

    async def do(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, self._behind_loops, work)

    def close(self) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _behind_loops(self, work: Callable[[], T]) -> T:
        self._stand_back()
        return work()

"""Work that takes longer than a period, in a thread that stands back: periods go on meanwhile."""

import asyncio
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")

#: How long the thread may hold the interpreter once the loop wants it; Python's own 5 ms are half a period.
SWITCH_S = 50e-6


def _stand_back() -> None:
    """Not on the loop's processor by its priority: a thread inherits both, and would never be put off it."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.sched_setaffinity(0, range(os.cpu_count() or 1))


class Aside:
    """One piece of work after the other."""

    def __init__(self) -> None:
        sys.setswitchinterval(SWITCH_S)
        self._thread = ThreadPoolExecutor(1, "aside", _stand_back)

    async def do(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)

    def close(self) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)

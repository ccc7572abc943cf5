"""Memory of a process that runs for months, given back: what only a full collection frees, and what malloc keeps free.

The gateway makes some 125 blocks a minute that reference counting does not free: tasks, timeouts and errors that hold
each other. CPython looks at all generations only once what is new comes to a quarter of what is there, which here takes
half a day. And glibc returns only the top of a heap: what the historian's thread packs every 20 s lies in pieces
between what stays, and the next packing needs fresh pages. What was measured: docs/kinds/memory.md.
"""

import ctypes
import gc
import time
from collections.abc import Callable

EVERY_S = 20.0
UP_S = 60.0  #: until what stays for good has been made


class GivenBack:
    """`look` in turns. What is there after the first minute is frozen: to look through it takes 0.15 s each time."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._next_s = clock() + UP_S
        self._frozen = False
        self._malloc_trim = _malloc_trim()

    def look(self) -> None:
        """Takes some milliseconds each EVERY_S, of which 0.4 for the trimming."""
        now_s = self._clock()
        if now_s < self._next_s:
            return
        self._next_s = now_s + EVERY_S
        gc.collect()
        if not self._frozen:
            self._frozen = True
            gc.freeze()
            gc.collect()  # else all generations are looked at by themselves only once a quarter of it has been added
        self._malloc_trim(0)


def _malloc_trim() -> Callable[[int], int]:
    """glibc's, of the heaps of all threads; another C library may have none."""
    try:
        return ctypes.CDLL(None).malloc_trim
    except AttributeError:
        return lambda keep_bytes: 0

"""How long the machine stood still: a thread pinned to each processor sleeps, and looks how late it wakes."""

import os
import threading
import time
from collections import deque
from contextlib import suppress
from typing import Self

SLEEP_S = 0.005
STALL_S = 0.025  #: a line's loop endures 60 ms, a device of it 30 ms
MOST_KEPT = 100_000


class Witness:
    """Context. A processor that the hypervisor stops is seen by the thread on it alone."""

    def __init__(self) -> None:
        self.stalls: deque[tuple[float, float]] = deque(maxlen=MOST_KEPT)  #: when it ended, monotonic, and how long, s
        self._end = threading.Event()
        self._threads = [
            threading.Thread(target=self._watch, args=(processor,), daemon=True)
            for processor in sorted(os.sched_getaffinity(0))
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._end.set()
        for thread in self._threads:
            thread.join()

    def calm_for(self, calm_s: float, patience_s: float) -> None:
        """Wait until no stall was seen for `calm_s`, for `patience_s` at most."""
        began_s = time.monotonic()
        while (now_s := time.monotonic()) - began_s < patience_s:
            last_s = max((at_s for at_s, _ in tuple(self.stalls)), default=0.0)
            if now_s - last_s >= calm_s:
                return
            time.sleep(0.1)

    def __str__(self) -> str:
        took = [lasted_s for _, lasted_s in tuple(self.stalls)]
        longest = f", longest {1e3 * max(took):.0f} ms" if took else ""
        return f"stalls of {1e3 * STALL_S:.0f} ms and more: {len(took)}{longest}"

    def _watch(self, processor: int) -> None:
        os.sched_setaffinity(0, {processor})  # of this thread alone
        with suppress(OSError):  # where it is not permitted others' load is seen, too
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        while not self._end.is_set():
            due_s = time.monotonic() + SLEEP_S
            time.sleep(SLEEP_S)
            late_s = (now_s := time.monotonic()) - due_s
            if late_s >= STALL_S:
                self.stalls.append((now_s, late_s))

"""The clock of the loop: a periodic timer of the kernel, read by the event loop. The one file here that reads time.

asyncio's own timers wake 0.6 to 1.1 ms late, a timerfd in the event loop 0.03 to 0.09 ms. So the timer is set a little
early, and the rest is waited for awake: what waking up takes is over when the period is due. Ticks that were missed
are counted and skipped, never caught up.
"""

import asyncio
import ctypes
import os
import struct
import sys
import time
from dataclasses import dataclass
from typing import Protocol

LEAD_NS = 150_000  #: by which the timer is early; more than waking up takes on a computer that is fit for it
LEAD_SHARE = 0.05  #: of a period that is waited for awake, at most

monotonic = time.monotonic


@dataclass(frozen=True, slots=True)
class Tick:
    """A period that begins."""

    due_s: float  #: when it should have begun (monotonic)
    now_s: float  #: when it did
    skipped: int  #: periods that went by unused before it


class Pacer(Protocol):
    async def wait(self) -> Tick:
        """The next tick."""
        ...

    def close(self) -> None: ...


class TimerPacer:
    """Ticks every `period_s` on CLOCK_MONOTONIC. Create it inside the running event loop."""

    def __init__(self, period_s: float) -> None:
        self._loop = asyncio.get_running_loop()
        self._period_ns = round(period_s * 1e9)
        self._next_ns = time.monotonic_ns() + self._period_ns
        lead_ns = min(LEAD_NS, round(LEAD_SHARE * self._period_ns))
        self._timer = _create_timer(self._next_ns - lead_ns, self._period_ns)
        self._expired = 0
        self._waiter: asyncio.Future[None] | None = None
        self._loop.add_reader(self._timer, self._on_timer)

    async def wait(self) -> Tick:
        if not self._expired:
            self._waiter = self._loop.create_future()
            await self._waiter
        expired, self._expired = self._expired, 0
        due_ns = self._next_ns + (expired - 1) * self._period_ns
        self._next_ns = due_ns + self._period_ns
        while (now_ns := time.monotonic_ns()) < due_ns:
            pass
        return Tick(due_ns * 1e-9, now_ns * 1e-9, expired - 1)

    def close(self) -> None:
        if self._timer >= 0:
            self._loop.remove_reader(self._timer)
            os.close(self._timer)
            self._timer = -1

    def _on_timer(self) -> None:
        self._expired += struct.unpack("=Q", os.read(self._timer, 8))[0]
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)


def _create_timer(first_ns: int, period_ns: int) -> int:
    """A non-blocking timerfd whose first expiry is at `first_ns` on CLOCK_MONOTONIC."""
    if sys.version_info >= (3, 13):
        timer = os.timerfd_create(time.CLOCK_MONOTONIC, flags=os.TFD_NONBLOCK | os.TFD_CLOEXEC)
        os.timerfd_settime_ns(timer, flags=os.TFD_TIMER_ABSTIME, initial=first_ns, interval=period_ns)
        return timer
    libc = ctypes.CDLL(None, use_errno=True)
    timer = libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
    if timer < 0:
        raise OSError(ctypes.get_errno(), "timerfd_create")
    # struct itimerspec: interval, then first expiry, each as seconds and nanoseconds
    setting = struct.pack("@4q", *divmod(period_ns, 10**9), *divmod(first_ns, 10**9))
    absolute = 1  # TFD_TIMER_ABSTIME
    if libc.timerfd_settime(timer, absolute, setting, None) < 0:
        raise OSError(ctypes.get_errno(), "timerfd_settime")
    return timer

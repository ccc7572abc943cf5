"""An asyncio event loop in virtual time: real sockets and real threads, but nobody waits for a clock.

When no socket is ready and no thread of an executor is busy, time jumps to the next timer. While a thread works, time
stands still, however long that takes. What happens depends on the program alone, not on how fast the machine is.

Both ends of every socket must be in the loop, or in a thread of its executors: what comes from elsewhere comes at any
time. Between them a delivery must be complete when the send returns. That of the loopback interface is, but for a
kernel so busy that it puts the rest off. So before each jump a datagram of the loop's own makes the same way.
"""

import asyncio
import itertools
import selectors
import socket
from asyncio import futures
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextvars import Context
from typing import Any, TypeVar

T = TypeVar("T")

START_S = 1000.0  #: the loop's time at the start; not 0, so that it cannot pass for a time since the start
LONGEST_RUN_S = 3600.0  #: virtual; a program that gets there has lost its way
MOST_POLLS_AT_ONE_INSTANT = 200_000  #: more, and something keeps itself busy without ever waiting
TESTS_LONGEST_S = 120.0  #: virtual; no test's own loop waits as long for anything
TURN_NS = 50_000  #: of virtual time; with less, idle turns spin for minutes until a time is over
THREAD_PATIENCE_S = 120.0  #: real; a thread that takes longer does not come back
DELIVERY_PATIENCE_S = 10.0  #: real, for one datagram on the loopback interface

_NS_PER_S = 1_000_000_000

Ready = list[tuple[selectors.SelectorKey, int]]


class TimeStuck(RuntimeError):
    """Time cannot go on, or it went too far. The text names the tasks that wait, and where."""


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """Time is kept in whole nanoseconds, so that many small jumps end where one large one does."""

    def __init__(self, longest_s: float | None = None) -> None:
        self._longest_s = LONGEST_RUN_S if longest_s is None else longest_s
        self._now_ns = round(START_S * _NS_PER_S)
        self._until_ns = self._now_ns + round(self._longest_s * _NS_PER_S)
        self._polls = 0  #: at this instant
        self._busy_threads = 0
        super().__init__(_Sockets(self._count_poll, self._is_busy, self._jump))
        self._threads = ThreadPoolExecutor(thread_name_prefix="virtual-time")
        self.set_default_executor(self._threads)

    def time(self) -> float:
        return self._now_ns / _NS_PER_S

    def call_later(
        self, delay: float, callback: Callable[..., object], *args: Any, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """As asyncio's, but time goes on meanwhile, as it does in reality.

        Who waits again for what was not there yet, by less than times can tell, would find it there never.
        """
        return super().call_later(max(delay, 1 / _NS_PER_S) if delay > 0.0 else delay, callback, *args, context=context)

    def run_in_executor(self, executor: Executor | None, func: Callable[..., T], *args: Any) -> asyncio.Future[T]:
        """As asyncio's. Time stands still until `func` has returned, even when nobody waits for it any more."""
        return self.wrapped((executor or self._threads).submit(func, *args))

    def wrapped(self, work: Future[T]) -> asyncio.Future[T]:
        """As `asyncio.wrap_future`. Time stands still until `work` is done: a thread is busy with it."""
        future = futures.wrap_future(work, loop=self)
        self._busy_threads += 1
        # After the callback of `wrap_future`: the result reaches the loop before time may go on.
        work.add_done_callback(lambda _: self.call_soon_threadsafe(self._thread_done))
        return future

    async def shutdown_default_executor(self, *timeout: float | None) -> None:
        self._busy_threads += 1  # asyncio joins the others in a thread of its own
        try:
            await super().shutdown_default_executor(*timeout)
        finally:
            self._thread_done()

    def _thread_done(self) -> None:
        self._busy_threads -= 1

    def _count_poll(self) -> None:
        self._polls += 1
        if self._polls > MOST_POLLS_AT_ONE_INSTANT:
            self._polls = 0  # for what has to be tidied up
            raise TimeStuck(f"time stands still at {self.time():.9f} s: something is busy for ever; {self._tasks()}")

    def _is_busy(self) -> bool:
        return self._busy_threads > 0

    def _jump(self, timeout_s: float | None) -> None:
        """Nothing is ready: on to the next timer, which is due in `timeout_s`; None if there is none."""
        if timeout_s is None:
            raise TimeStuck(f"nothing is ready, no timer is set, no thread is busy; {self._tasks()}")
        self._polls = 0
        self._pass(round(timeout_s * _NS_PER_S))

    def _pass(self, ns: int) -> None:
        self._now_ns += ns
        if self._now_ns > self._until_ns:
            self._until_ns = self._now_ns + round(self._longest_s * _NS_PER_S)  # for what has to be tidied up
            raise TimeStuck(f"{self._longest_s:g} s have passed; {self._tasks()}")

    def _tasks(self) -> str:
        return "pending: " + ("; ".join(sorted(_where(task) for task in asyncio.all_tasks(self))) or "no task")


class TestsLoop(VirtualTimeLoop):
    """What `asyncio.run` gives to a test that is not marked as living on the wall clock (`alone` in tests/conftest.py).

    A little time passes in each turn: who waits by turns, and not by time, must come to its deadlines, too.
    """

    def __init__(self) -> None:
        super().__init__(TESTS_LONGEST_S)

    def _count_poll(self) -> None:
        if not self._is_busy():
            self._pass(TURN_NS)


class _Sockets(selectors.EpollSelector):
    """What is ready, in the order of registration rather than of arrival. Waits for threads, and never for a timer."""

    def __init__(
        self, polled: Callable[[], None], busy: Callable[[], bool], jump: Callable[[float | None], None]
    ) -> None:
        super().__init__()
        self._polled, self._busy, self._jump = polled, busy, jump
        self._order: dict[int, int] = {}
        self._numbers = itertools.count()
        self._delivery = _Delivery()

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        key = super().register(fileobj, events, data)
        self._order.setdefault(key.fd, next(self._numbers))
        return key

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        key = super().unregister(fileobj)
        del self._order[key.fd]
        return key

    def select(self, timeout: float | None = None) -> Ready:
        self._polled()
        ready = super().select(0)
        if not ready and timeout != 0:
            ready = self._wait(timeout)
        if len(ready) > 1:
            ready.sort(key=self._registered)
        return ready

    def _wait(self, timeout: float | None) -> Ready:
        if self._busy():
            ready = super().select(THREAD_PATIENCE_S)
            if not ready:
                raise TimeStuck(f"a thread has been busy for {THREAD_PATIENCE_S:g} s of real time")
            return ready
        self._delivery.complete()
        ready = super().select(0)
        if not ready:
            self._jump(timeout)
        return ready

    def _registered(self, event: tuple[selectors.SelectorKey, int]) -> int:
        return self._order[event[0].fd]

    def close(self) -> None:
        self._delivery.close()
        super().close()


class _Delivery:
    """The loopback interface keeps the order of what one processor sends: what was sent before this has come."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.connect(self._socket.getsockname())
        self._socket.settimeout(DELIVERY_PATIENCE_S)

    def complete(self) -> None:
        self._socket.send(b"\0")
        self._socket.recv(1)

    def close(self) -> None:
        self._socket.close()


def _where(task: asyncio.Task[Any]) -> str:
    frames = task.get_stack(limit=1)
    place = f" at {frames[-1].f_code.co_filename}:{frames[-1].f_lineno}" if frames else ""
    return f"{task.get_name()} ({getattr(task.get_coro(), '__qualname__', '?')}){place}"

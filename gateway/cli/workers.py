"""Processes that work for a command, and are gone with it: at its end, and at once where it is interrupted."""

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class Workers(ProcessPoolExecutor):
    """Fresh processes, not forked: numba and the linear algebra library have threads of their own by now.

    Ctrl-C in a terminal reaches all processes. It is the command's: workers never see it, whatever they are at. An
    exception that leaves the `with` block, KeyboardInterrupt among them, ends them without waiting for their work.
    """

    def __init__(self, count: int, begin: Callable[..., None] | None = None, given: tuple[Any, ...] = ()) -> None:
        super().__init__(count, get_context("spawn"), begin, given)

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        with _interrupt_later():  # a process that is started here has the mask for good
            return super().submit(fn, *args, **kwargs)

    def map(
        self, fn: Callable[..., T], *iterables: Iterable[Any], timeout: float | None = None, chunksize: int = 1
    ) -> Iterator[T]:
        """As the executor's, but that an interruption cancels nothing here: only the pool itself may, at its end.

        Work that somebody else has cancelled is what the pool trips over when its processes end.
        """
        futures = [self.submit(fn, *given) for given in zip(*iterables, strict=False)]
        return (future.result(timeout) for future in futures)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        if kind is not None:
            processes = list(self._processes.values())
            # First, so that their end finds no cancelled work: the pool would trip over it.
            self.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()
            for process in processes:
                process.join()
        return super().__exit__(kind, error, trace)


@contextmanager
def _interrupt_later() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def processors() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0))

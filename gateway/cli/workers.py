"""Processes that work for a command, and are gone with it: at its end, and at once where it is interrupted."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from gateway.mailbox.spawned import end_with_parent, interrupt_later

P = ParamSpec("P")
T = TypeVar("T")


class Workers(ProcessPoolExecutor):
    """Fresh processes, not forked: numba and the linear algebra library have threads of their own by now.

    Ctrl-C in a terminal reaches all processes. It is the command's: workers never see it, whatever they are at. An
    exception that leaves the `with` block, KeyboardInterrupt among them, ends them without waiting for their work. And
    where the command ends without leaving it, killed or terminated, they end all the same.
    """

    def __init__(self, count: int, begin: Callable[..., None] | None = None, given: tuple[Any, ...] = ()) -> None:
        super().__init__(count, get_context("spawn"), _begin, (begin, given))

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        with interrupt_later():  # a process that is started here has the mask for good
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


def _begin(begin: Callable[..., None] | None, given: tuple[Any, ...]) -> None:
    end_with_parent()
    if begin is not None:
        begin(*given)


def processors() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0))

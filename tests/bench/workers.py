"""Processes that a benchmark runs one thing after another in."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any, Self

from rich.progress import Progress

from gateway.mailbox.spawned import end_with_parent


class Workers:
    """They end with the context; `count` None: as many as there are processors."""

    def __init__(self, count: int | None = 2) -> None:
        # Fresh processes: threads of compiled code do not survive a fork.
        self._pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=end_with_parent)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def as_done(self, function: Callable[[Any], Any], given: Sequence[Any], title: str) -> Iterable[Any]:
        """`function` of each, as they come."""
        with Progress() as progress:
            bar = progress.add_task(title, total=len(given))
            for found in as_completed([self._pool.submit(function, one) for one in given]):
                progress.advance(bar)
                yield found.result()

    def each(self, function: Callable[[Any], Any], given: Sequence[Any], title: str) -> Iterable[Any]:
        """`function` of each, in its order."""
        with Progress() as progress:
            bar = progress.add_task(title, total=len(given))
            for found in self._pool.map(function, given):
                progress.advance(bar)
                yield found

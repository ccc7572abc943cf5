"""A test lives in virtual time and in its own process, unless its mark says that it does not.

So it cannot fail because the machine was slow, and one that needs the clock or another process without saying so fails
at once and every time. A process that is over before anything waits in virtual time for it needs no mark.
"""

import asyncio
import concurrent.futures
import multiprocessing.process
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest
import zenoh

from tests.support.virtual_time import TestsLoop, VirtualTimeLoop

MARKS = ("wires", "realtime")  #: who carries one lives on the wall clock, beside other processes


@contextmanager
def alone() -> Iterator[None]:
    """`asyncio.run` runs in virtual time; there no other process may be waited for, and no session of the bus."""
    started: list[Any] = []

    def new_event_loop() -> TestsLoop:
        if any(_runs(process) for process in started):
            _refuse()
        return TestsLoop()

    def starting(original: Callable[..., Any]) -> Callable[..., Any]:
        def start(self: Any, *words: Any, **named: Any) -> Any:
            if isinstance(asyncio._get_running_loop(), VirtualTimeLoop):  # noqa: SLF001 (the public one raises)
                _refuse()
            started.append(self)
            return original(self, *words, **named)

        return start

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio.events, "new_event_loop", new_event_loop)
        patch.setattr(asyncio, "wrap_future", _wrap_future)
        patch.setattr(subprocess.Popen, "__init__", starting(subprocess.Popen.__init__))
        base = multiprocessing.process.BaseProcess
        patch.setattr(base, "start", starting(base.start))
        patch.setattr(zenoh, "open", _refuse)
        yield


def _runs(process: Any) -> bool:
    if isinstance(process, subprocess.Popen):
        return hasattr(process, "returncode") and process.poll() is None
    with suppress(ValueError):  # it was closed
        return process.is_alive()
    return False


def _wrap_future(future: Any, *, loop: asyncio.AbstractEventLoop | None = None) -> asyncio.Future[Any]:
    loop = loop or asyncio.events.get_event_loop()
    if isinstance(loop, VirtualTimeLoop) and isinstance(future, concurrent.futures.Future):
        return loop.wrapped(future)
    return asyncio.futures.wrap_future(future, loop=loop)


def _refuse(*_: object, **__: object) -> None:
    pytest.fail(f"a test beside whose loop another process runs carries a mark, one of {', '.join(MARKS)}")

"""Cleanup that a cancellation cannot cut: it is put off until the work is over, however often it comes.

`except BaseException: await undo()` is cut by the next cancellation at its first await (a second stop, Ctrl-C, a
timeout around it), and what it had not undone yet stays: an active link, a device in a state nobody knows.
`await finish(undo())` is not. Whoever waits is then held up for as long as the work takes, so work has to be bounded in
time by itself. A timeout inside it works as ever, one around it only ends the wait once the work is over.

A loop that closes cancels every task, these too: whoever calls `asyncio.run` waits for its cleanup before it returns.
"""

import asyncio
from collections.abc import Coroutine, Iterable
from typing import Any, TypeVar

T = TypeVar("T")

_running: set[asyncio.Task[Any]] = set()  #: a loop itself keeps its tasks only weakly


def finish(work: Coroutine[Any, Any, T]) -> Coroutine[Any, Any, T]:
    """Run `work` to its end, whatever happens to whoever awaits this, and return its result.

    The work is started by the call itself, so that it runs even where the waiting task is cancelled before its first
    step. A cancellation meanwhile is raised when the work is over, with an exception of the work as its cause: it goes
    first, since timeouts, task groups and whoever cancelled wait for it. Otherwise an exception of the work is raised.
    """
    return _result(_start(work))


def finish_all(works: Iterable[Coroutine[Any, Any, object]]) -> Coroutine[Any, Any, list[Exception]]:
    """Run all `works` side by side to their ends, and return the exceptions of those that failed, in their order.

    One that fails keeps no other from its end. A cancellation is put off as by `finish`, its cause is then an
    ExceptionGroup of the failures.
    """
    return _failures([_start(work) for work in works])


def end(task: asyncio.Future[Any]) -> Coroutine[Any, Any, None]:
    """Cancel `task` once and wait until it is over, however it ends: its own cleanup is cut by nothing that comes here.

    An exception of the task is its own affair: it is not raised here.
    """
    task.cancel()
    return _ended(task)


def _start(work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
    task = asyncio.get_running_loop().create_task(work)
    _running.add(task)
    task.add_done_callback(_running.discard)
    return task


async def _over(tasks: Iterable[asyncio.Future[Any]]) -> tuple[object, ...] | None:
    """Wait until all `tasks` are over. Returns the arguments of the first cancellation that came: it is to be raised.

    Not the exception itself: kept by a frame of its own traceback, only the garbage collector would free it.
    """
    cancelled = None
    pending = {task for task in tasks if not task.done()}
    while pending:
        try:
            _, pending = await asyncio.wait(pending)
        except asyncio.CancelledError as error:
            cancelled = error.args if cancelled is None else cancelled
            pending = {task for task in pending if not task.done()}
    return cancelled


async def _result(task: asyncio.Task[T]) -> T:
    cancelled = await _over([task])
    try:
        if cancelled is not None:
            raise asyncio.CancelledError(*cancelled) from (None if task.cancelled() else task.exception())
        return task.result()
    finally:
        del task  # it holds the exception that holds this frame


async def _failures(tasks: list[asyncio.Task[object]]) -> list[Exception]:
    cancelled = await _over(tasks)
    try:
        errors = [task.exception() for task in tasks if not task.cancelled()]
        failures = [error for error in errors if isinstance(error, Exception)]
        if cancelled is not None:
            raise asyncio.CancelledError(*cancelled) from (_group(failures) if failures else None)
        for task in tasks:
            if task.cancelled() or not isinstance(task.exception(), Exception | None):
                task.result()  # raises: cancelled by somebody else, or an exit
        return failures
    finally:
        tasks.clear()


def _group(failures: list[Exception]) -> ExceptionGroup[Exception]:
    return ExceptionGroup("of works that were finished", failures)


async def _ended(task: asyncio.Future[Any]) -> None:
    cancelled = await _over([task])
    if not task.cancelled():
        task.exception()  # looked at, so that asyncio does not complain of it
    if cancelled is not None:
        raise asyncio.CancelledError(*cancelled)

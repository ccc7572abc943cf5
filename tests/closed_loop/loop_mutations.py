"""Six faults that the loop once had, each put back for the length of a `with`: the states' test must find every one."""

import asyncio
import inspect
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from unittest.mock import patch

from gateway.loop import runner
from gateway.loop.containment import Containment
from gateway.loop.cycle import Cycle
from gateway.loop.guard import Guard
from gateway.loop.persistence import Persistence
from gateway.loop.runner import Runner


def _heard_by_nobody(caller: str) -> Callable[[ExitStack], None]:
    """A rollback that comes from the function `caller` does not end an experiment."""
    sound = Cycle.roll_back

    def roll_back(self: Cycle, reason: str) -> bool:
        frame = inspect.currentframe()
        if frame is not None and frame.f_back is not None and frame.f_back.f_code.co_name == caller:
            return self.configurations.roll_back(reason)
        return sound(self, reason)

    return lambda stack: stack.enter_context(patch.object(Cycle, "roll_back", roll_back))


def _cut_by_the_second_stop(stack: ExitStack) -> None:
    """What undoes an arming is cancelled by the next stop."""

    async def release_links(cycle: Cycle) -> None:
        for link in cycle.links:
            await link.release()

    async def cancel_arming(self: Runner) -> None:
        if (arming := self._arming) is not None:
            arming.cancel()
            await asyncio.wait([arming])

    stack.enter_context(patch.object(runner, "release_links", release_links))
    stack.enter_context(patch.object(Runner, "_cancel_arming", cancel_arming))


def _written_once(stack: ExitStack) -> None:
    """A write that fails after something was decided is not tried again."""

    def given_up(self: Persistence, _: str) -> None:
        self._agreed = self._configurations.changes

    stack.enter_context(patch.object(Persistence, "_say_failed", given_up))


def _ends_the_process(stack: ExitStack) -> None:
    """What a part raises ends the process at once, and the guard keeps no more torques than the line's file needs."""

    def fail(self: Containment, part: str, error: Exception, *_: object) -> None:
        raise error

    stack.enter_context(patch.object(Containment, "fail", fail))
    stack.enter_context(patch.object(Guard, "_remember", lambda *_: None))


def _ring_too_short(stack: ExitStack) -> None:
    """The guard keeps no more torques than the line's file needs, whatever the model that it is told to watch by."""
    stack.enter_context(patch.object(Guard, "_remember", lambda *_: None))


FAULTS: dict[str, Callable[[ExitStack], None]] = {
    "a person's rollback does not end an experiment": _heard_by_nobody("configure"),
    "the monitor's rollback does not end an experiment": _heard_by_nobody("_governed"),
    "a lapsed lease does not end an experiment": _heard_by_nobody("_end_what_lapsed"),
    "a second stop cuts the undoing of an arming": _cut_by_the_second_stop,
    "a write that fails once is not tried again": _written_once,
    "a watcher's exception ends the process": _ends_the_process,
    "a watcher is kept less than it asks for": _ring_too_short,
}
FOUND_WITHIN = 400  #: sequences, each


@contextmanager
def put_back(fault: str) -> Iterator[None]:
    with ExitStack() as stack:
        FAULTS[fault](stack)
        yield

"""Supervision of the long tasks of a process: an exception of one is told, and the task goes on with its next turn.

A long task is a turn that is taken again and again (`repeat`, `turn`), or work that is begun and awaited by nobody
(`begin`). What a turn raises is a fault of the task until it has succeeded again for `STEADY_S`; each type of exception
is told once a fault, so a turn that fails four times a second fills no log. A turn that fails is taken again, later
each time, up to `LONGEST_WAIT_S`: what cannot go on stays a fault, and is never silent. Cancellation passes.

A turn of `repeat` that takes longer than `LONGEST_TURN_S` is a fault, `TakesLong`, while it goes on: it is told, not
cancelled, for nobody knows what it has done by then.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

LONGEST_WAIT_S = 1.0  #: between two turns that fail: leases of 5 s are renewed by such a turn
STEADY_S = 10.0  #: without an exception, then it is no fault any more: what comes and goes does not flicker
LONGEST_TURN_S = 60.0  #: longer than a loop that builds, a store that is locked and an audit that hangs together
LONGEST_TEXT = 300  #: characters of an exception's text


@dataclass(frozen=True)
class TaskFault:
    """A task that has raised, and has not succeeded since for `STEADY_S`."""

    task: str
    error: str  #: name of the exception's type
    text: str  #: of the exception
    since_s: float  #: of the supervisor's clock
    last_s: float  #: raised last
    times: int  #: raised since
    in_a_row: int  #: turns that failed one after the other; 0: the last one succeeded
    told: frozenset[str] = field(default_factory=frozenset[str])  #: types of exceptions


#: Told with the fault and the exception, once for each type of exception; with None once the fault is over.
Tell = Callable[[TaskFault, BaseException | None], None]


class TakesLong(Exception):
    """A turn has not come to its end for too long; the text says for how long."""


class Supervisor:
    """Of all long tasks of one event loop. `tell` must not raise."""

    def __init__(
        self, tell: Tell, clock: Callable[[], float] = time.monotonic, longest_turn_s: float = LONGEST_TURN_S
    ) -> None:
        self._tell = tell
        self._clock = clock
        self._longest_turn_s = longest_turn_s
        self._faults: dict[str, TaskFault] = {}
        self._begun: set[asyncio.Task[None]] = set()

    @property
    def faults(self) -> list[TaskFault]:
        """What fails now, the oldest first."""
        return sorted(self._faults.values(), key=lambda fault: fault.since_s)

    async def repeat(
        self, task: str, turn: Callable[[], Awaitable[object]], every_s: float, stop: asyncio.Event | None = None
    ) -> None:
        """Take `turn` again and again, `every_s` apart, until `stop` is set or this is cancelled."""
        stop = asyncio.Event() if stop is None else stop
        while not stop.is_set():
            late = asyncio.get_running_loop().call_later(self._longest_turn_s, self._takes_long, task)
            try:
                await turn()
            except Exception as error:
                self.failed(task, error)
            else:
                self.succeeded(task)
            finally:
                late.cancel()
            await wait(stop, self.wait_s(task, every_s))

    def turn(self, task: str, turn: Callable[[], object]) -> None:
        """Take one turn that waits for nothing."""
        try:
            turn()
        except Exception as error:
            self.failed(task, error)
        else:
            self.succeeded(task)

    def begin(self, task: str, work: Coroutine[Any, Any, object]) -> asyncio.Task[None]:
        """Begin work that nobody awaits. The task returned never raises, but for its cancellation."""
        begun = asyncio.get_running_loop().create_task(self._once(task, work), name=task)
        self._begun.add(begun)
        begun.add_done_callback(self._begun.discard)
        return begun

    async def end(self, steps: Mapping[str, Callable[[], Awaitable[object]]]) -> None:
        """Take each step in turn, whatever those before it raised; that is told."""
        for task, step in steps.items():
            await self._once(task, step())

    async def close(self) -> None:
        """Cancel what was begun and is not done, and wait until it is."""
        begun = list(self._begun)
        for one in begun:
            one.cancel()
        await asyncio.gather(*begun, return_exceptions=True)

    def failed(self, task: str, error: BaseException) -> None:
        """Note that a turn of `task` has raised `error`, and tell it if its type was not told before."""
        now_s, kind = self._clock(), type(error).__name__
        before = self._faults.get(task) or TaskFault(task, kind, "", now_s, now_s, 0, 0)
        found = replace(
            before, error=kind, text=str(error)[:LONGEST_TEXT], last_s=now_s, times=before.times + 1,
            in_a_row=before.in_a_row + 1, told=before.told | {kind},
        )  # fmt: skip
        self._faults[task] = found
        if kind not in before.told:
            self._tell(found, error)

    def succeeded(self, task: str) -> None:
        """Note that a turn of `task` came to its end; its fault is over once it is steady."""
        fault = self._faults.get(task)
        if fault is None:
            return
        if self._clock() - fault.last_s < STEADY_S:
            self._faults[task] = replace(fault, in_a_row=0)
            return
        del self._faults[task]
        self._tell(fault, None)

    def wait_s(self, task: str, every_s: float) -> float:
        """How long until the next turn: `every_s`, twice as long with each turn that failed, up to `LONGEST_WAIT_S`."""
        fault = self._faults.get(task)
        in_a_row = 0 if fault is None else fault.in_a_row
        return every_s if in_a_row < 2 else max(every_s, min(every_s * 2.0 ** min(in_a_row - 1, 16), LONGEST_WAIT_S))

    def _takes_long(self, task: str) -> None:
        self.failed(task, TakesLong(f"a turn has not come to its end for {self._longest_turn_s:g} s, and goes on"))

    async def _once(self, task: str, work: Awaitable[object]) -> None:
        try:
            await work
        except Exception as error:
            self.failed(task, error)
        else:
            self.succeeded(task)


async def wait(stop: asyncio.Event, timeout_s: float) -> None:
    """Until `stop` is set, `timeout_s` at the longest."""
    try:
        async with asyncio.timeout(timeout_s):
            await stop.wait()
    except TimeoutError:
        pass

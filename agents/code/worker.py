"""A process for each computation, confined (agents/code/confine.py), at low priority, and gone when its time is up.

It is given a job when it is started, and says over a pipe, in a line each, that it is ready, and what came of it, as
JSON. It has no socket, and what it says is read like anything from outside: never for longer than there is time.
"""

import asyncio
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, Pipe, wait
from typing import Any

from pydantic import ValidationError

from agents.code.confine import (
    NotConfined,
    bound_memory,
    bound_processor_time,
    forbid_sockets_and_programs,
    forbid_writing,
)
from agents.code.job import Job, Outcome
from gateway.mailbox.spawned import end_with_parent, interrupt_later, one_thread_each

NICER = 15  #: than the process that starts it
MOST_ANSWER_BYTES = 8_388_608  #: a schedule of gains for sixty spans has some
END_S = 5.0  #: for a process that has closed its pipe to be gone
_READY = b"ready"
_LINE = b"\n"  #: at the end of what it says; JSON has none in it
_PIECE_BYTES = 65_536


@dataclass(frozen=True)
class Limits:
    """Of one computation."""

    wall_s: float = 120.0
    processor_s: int = 120
    memory_bytes: int = 2 * 2**30  #: of addresses; loading all that computes takes a quarter of it
    begin_s: float = 300.0  #: until it is loaded: on a new machine it compiles first


LIMITS = Limits()
Prepare = Callable[[Job], None]
Work = Callable[[Job], Outcome]


class _NoOutcome(Exception):
    """Why none came."""


async def run(job: Job, within_s: float, limits: Limits = LIMITS) -> Outcome:
    """Always an outcome, hardly later than `within_s` from now, whatever the process does."""
    return await run_work(_prepare, _carry_out, job, within_s, limits)


async def run_work(prepare: Prepare, work: Work, job: Job, within_s: float, limits: Limits) -> Outcome:
    """As `run`, with other functions of a module, which the process imports. `prepare` is not bounded by the processor
    time, and may write: what it compiles is kept."""
    child = _Child(prepare, work, job, within_s, limits)
    heard = asyncio.ensure_future(asyncio.to_thread(child.outcome))
    try:
        return await asyncio.shield(heard)
    finally:
        child.stop()
        await heard  # it ends its process at once


class _Child:
    """One process. `outcome` blocks and is for a thread; `stop` ends it from elsewhere."""

    def __init__(self, prepare: Prepare, work: Work, job: Job, within_s: float, limits: Limits) -> None:
        self._given = (prepare, work, job, limits)
        self._limits = limits
        self._until_s = time.monotonic() + within_s
        self._stopped, self._stop = Pipe(duplex=False)
        self._came = bytearray()  #: of what it says, and is not read yet

    def stop(self) -> None:
        self._stop.send_bytes(b"stop")

    def outcome(self) -> Outcome:
        context = get_context("spawn")
        ours, theirs = map(_on_linux, Pipe(duplex=False))  # one way: a pipe, no socket
        process = context.Process(target=_live, args=(theirs, *self._given), daemon=True)
        try:
            with one_thread_each(), interrupt_later():
                process.start()
        except (OSError, MemoryError) as error:
            ours.close()
            return Outcome(failed=f"its process cannot be started: {type(error).__name__}: {error}"[:600])
        finally:
            theirs.close()
        try:
            self._heard(ours, self._limits.begin_s, "was not ready")
            return Outcome.model_validate_json(self._heard(ours, self._limits.wall_s, "was not done"))
        except _NoOutcome as none:
            return Outcome(failed=str(none))
        except (EOFError, OSError):
            process.join(END_S)
            return Outcome(failed=_why_ended(process.exitcode, self._limits))
        except ValidationError:
            return Outcome(failed="its process has said what is no outcome")
        finally:
            process.kill()
            process.join()
            process.close()
            ours.close()

    def _heard(self, pipe: Connection, most_s: float, otherwise: str) -> bytes:
        """Its next line, as far as it comes in time. Raises _NoOutcome, EOFError, OSError."""
        within_s = max(min(most_s, self._until_s - time.monotonic()), 0.0)
        until_s, looked = time.monotonic() + within_s, 0
        while (end := self._came.find(_LINE, looked)) < 0:
            looked = len(self._came)
            if looked > MOST_ANSWER_BYTES:
                raise _NoOutcome(f"its process has said more than {MOST_ANSWER_BYTES} bytes")
            ready = wait([pipe, self._stopped], max(until_s - time.monotonic(), 0.0))
            if self._stopped in ready:
                raise _NoOutcome("nobody waits for it any more")
            if not ready or time.monotonic() > until_s:
                raise _NoOutcome(f"it {otherwise} within {within_s:.3g} s")
            if not (piece := os.read(pipe.fileno(), _PIECE_BYTES)):
                raise EOFError
            self._came += piece
        line = bytes(self._came[:end])
        del self._came[: end + 1]
        return line


def _on_linux(end: Any) -> Connection:
    """Elsewhere a pipe has ends of another type."""
    return end


def _why_ended(exit_code: int | None, limits: Limits) -> str:
    if exit_code == -signal.SIGXCPU:
        return f"it used more than {limits.processor_s} s of processor time"
    how = f"by signal {-exit_code}" if exit_code and exit_code < 0 else f"with exit code {exit_code}"
    return f"its process ended before it was done, {how}"


def _live(pipe: Connection, prepare: Prepare, work: Work, job: Job, limits: Limits) -> None:
    """A worker's life."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that has started this one
    end_with_parent()
    os.nice(NICER)
    failed = _tried(lambda: _confined(prepare, job, limits), limits)
    _say(pipe, _READY)
    outcome = failed or _tried(lambda: work(job), limits)
    assert outcome is not None
    _say(pipe, outcome.model_dump_json().encode())


def _say(pipe: Connection, line: bytes) -> None:
    left = memoryview(line + _LINE)
    while left:
        left = left[os.write(pipe.fileno(), left) :]


def _confined(prepare: Prepare, job: Job, limits: Limits) -> None:
    """Raises NotConfined, and what `prepare` raises."""
    forbid_sockets_and_programs()
    bound_memory(limits.memory_bytes)
    prepare(job)
    forbid_writing()
    bound_processor_time(limits.processor_s)


def _tried(step: Callable[[], Outcome | None], limits: Limits) -> Outcome | None:
    """What it returns; whatever it raises is an outcome, too."""
    try:
        return step()
    except NotConfined as error:
        return Outcome(failed=f"nothing is computed on this computer: {error}")
    except MemoryError:
        return Outcome(failed=f"it needed more than {limits.memory_bytes / 2**30:.3g} GiB of memory")
    except Exception as error:
        return Outcome(failed=f"{type(error).__name__}: {error}"[:600])


def _prepare(job: Job) -> None:
    from agents.code.algorithms import warm_up  # loads all that computes

    warm_up(job)


def _carry_out(job: Job) -> Outcome:
    from agents.code.algorithms import carry_out

    return carry_out(job)

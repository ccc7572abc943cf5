"""The judge in processes of its own: at low priority, each at one proposal at a time, and for no longer than allowed.

They are started here and by nobody else, and speak to this process alone: a verdict that comes from them is the
judge's. One that dies, hangs or answers what is no verdict is replaced, and the proposal that it had is refused.
"""

import asyncio
import os
import secrets
import signal
import time
from collections.abc import Sequence
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from gateway.core.courses import Courses
from gateway.core.deployment import Region
from gateway.core.judge_context import JudgeContext
from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.verdict import Verdict
from gateway.mailbox.spawned import end_with_parent, interrupt_later, one_thread_each

NICER, NICEST = 10, 19  #: than the process that starts them; and where nobody waits for a verdict
#: Times gate.verdict_max_s: all draws of a verdict; and of what is nicest, which has only what the others leave, each.
LONGER = 4.0
BEGIN_S = 600.0  #: until one is ready: on a new machine it compiles first
#: Rules under which this process refuses by itself.
TIME_RULE, WORKER_RULE = "time", "judge process"
GOES_ON = "goes on"  #: of a worker that draws again, and has its time anew


Answer = TypeVar("Answer", Verdict, Courses)


class NoVerdict(Exception):
    """Why none came; `rule` is what the refusal goes by."""

    def __init__(self, rule: str, text: str) -> None:
        super().__init__(text)
        self.rule = rule


class _Worker:
    """One process, and the pipe to it. Its methods block: they are for threads."""

    def __init__(self, line: Line, nicer: int, secret: bytes) -> None:
        """Raises NoVerdict."""
        context = get_context("spawn")
        self._ours, theirs = context.Pipe()
        self._process: BaseProcess = context.Process(target=_work, args=(theirs, line, nicer, secret), daemon=True)
        try:
            with one_thread_each(), interrupt_later():
                self._process.start()
        except (OSError, MemoryError) as error:
            self._ours.close()
            raise NoVerdict(WORKER_RULE, f"the judge's process cannot be started: {error}") from error
        finally:
            theirs.close()
        self._ready = False

    @property
    def pid(self) -> int | None:
        return self._process.pid

    def wait_ready(self) -> None:
        """Raises NoVerdict."""
        if not self._ready:
            self._answer(BEGIN_S, "has not begun")
            self._ready = True

    def ask(self, job: tuple[Any, ...], limit_s: float, wanted: type[Answer]) -> Answer:
        """Raises NoVerdict; the worker is not to be used again then."""
        self.wait_ready()
        try:
            self._ours.send(job)
        except OSError as error:
            raise NoVerdict(WORKER_RULE, f"the judge's process has ended: {error}") from error
        answer = self._answer(limit_s, "has given no verdict")
        if not isinstance(answer, wanted):
            raise NoVerdict(WORKER_RULE, "the judge's process failed, and has said nothing else")
        return answer

    def end(self) -> None:
        """At once, whatever it is at."""
        self._process.kill()
        self._process.join()
        self._ours.close()
        self._process.close()

    def _answer(self, limit_s: float, missing: str) -> object:
        try:
            until_s = time.monotonic() + LONGER * limit_s  # of all draws
            while True:
                if not self._ours.poll(min(limit_s, max(until_s - time.monotonic(), 0.0))):
                    text = f"the judge {missing} within {limit_s:g} s, and none in time is a refusal"
                    raise NoVerdict(TIME_RULE, text)
                if (answer := self._ours.recv()) != GOES_ON:
                    return answer
        except (EOFError, OSError) as error:
            raise NoVerdict(WORKER_RULE, "the judge's process has ended before it gave a verdict") from error


class JudgeWorkers:
    """Processes begin with the first proposal that needs them, or with `async with`; `close` ends them."""

    def __init__(self, line: Line, count: int = 1, nicer: int = NICER, secret: bytes | None = None) -> None:
        """`secret`: from which seeds follow (`safety.draws.seed_of`); without, one of its own."""
        self._line = line
        self._nicer = nicer
        self._secret = secrets.token_bytes() if secret is None else secret
        self._idle: asyncio.Queue[_Worker | None] = asyncio.Queue()
        for _ in range(count):
            self._idle.put_nowait(None)
        self._all: set[_Worker] = set()

    async def __aenter__(self) -> "JudgeWorkers":
        self.begin()
        return self

    def begin(self) -> None:
        """All that idle and have not begun: the first verdict does not wait for them to load, and to compile."""
        for _ in range(self._idle.qsize()):
            worker = self._idle.get_nowait()
            try:
                worker = worker or self._begun()
            except NoVerdict:
                pass  # whatever is to be judged tries again
            self._idle.put_nowait(worker)

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    @property
    def pids(self) -> set[int]:
        """Of the processes that have begun."""
        return {worker.pid for worker in self._all if worker.pid is not None}

    async def close(self) -> None:
        """End all of them, whatever they are at."""
        workers, self._all = self._all, set()
        for worker in workers:
            await asyncio.to_thread(worker.end)

    async def judge(
        self,
        payload: bytes,
        context: JudgeContext,
        recordings: Sequence[Recording],
        seed: int | None = None,
        limit_s: float | None = None,
    ) -> Verdict:
        """Always a verdict: where none comes within `limit_s` (gate.verdict_max_s), a refusal that says so.

        A worker that draws again has as long for each draw, and four times as long for all. `seed` None: as the secret
        has it of what is proposed.
        """
        limit_s = self._line.gate.verdict_max_s if limit_s is None else limit_s
        try:
            return await self._asked((payload, context, list(recordings), seed), limit_s, Verdict)
        except NoVerdict as none:
            return await asyncio.to_thread(_refusal, payload, context, self._line, seed, none)

    async def courses(self, payload: bytes, context: JudgeContext, region: Region) -> Courses:
        """What the figures of a verdict for `region` are of, to be drawn; for workers that no proposal waits for.

        Raises NoVerdict where none come in time.
        """
        return await self._asked((payload, context, region), LONGER * self._line.gate.verdict_max_s, Courses)

    async def _asked(self, job: tuple[Any, ...], limit_s: float, wanted: type[Answer]) -> Answer:
        """Raises NoVerdict."""
        worker = await self._idle.get()
        if worker is None:
            try:
                worker = await asyncio.to_thread(self._begun)
            except BaseException:
                self._idle.put_nowait(None)  # another one may begin
                raise
        asked = asyncio.ensure_future(asyncio.to_thread(worker.ask, job, limit_s, wanted))
        good = False
        try:
            answer = await asyncio.shield(asked)
            good = True
        finally:
            if not good:  # it is at something, or dead: another one takes its place when there is need
                self._all.discard(worker)
                await asyncio.to_thread(worker.end)
                asked.add_done_callback(_forgotten)
            self._idle.put_nowait(worker if good else None)
        return answer

    def _begun(self) -> _Worker:
        """Raises NoVerdict."""
        worker = _Worker(self._line, self._nicer, self._secret)
        self._all.add(worker)
        return worker


def _refusal(payload: bytes, context: JudgeContext, line: Line, seed: int | None, none: NoVerdict) -> Verdict:
    from safety.judge import refusal  # loads all that the judge needs, which takes its time

    return refusal(payload, context, line, seed or 0, none.rule, str(none))  # where nothing was drawn it is no matter


def _forgotten(asked: "asyncio.Future[Any]") -> None:
    """Nobody waits for this answer any more."""
    if not asked.cancelled():
        asked.exception()


def _work(pipe: Connection, line: Line, nicer: int, secret: bytes) -> None:
    """A worker's life: ready, then a verdict or courses for each job, until the other end is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that has started this one
    end_with_parent()
    os.nice(nicer)
    from safety.draws import seed_of
    from safety.judge import failed, judge, warm_up

    warm_up(line)
    try:
        pipe.send("ready")
        while True:
            payload, context, *job = pipe.recv()
            if isinstance(job[0], Region):
                pipe.send(_courses(payload, context, line, job[0]))
                continue
            recordings, seed = job
            try:
                seed = seed_of(secret, payload, context, line) if seed is None else seed
                verdict = judge(payload, context, line, recordings, seed, lambda: pipe.send(GOES_ON))
            except Exception as error:  # whatever it is, it is no yes
                verdict = failed(payload, context, line, seed or 0, error)
            pipe.send(verdict)
    except (EOFError, OSError):
        return


def _courses(payload: bytes, context: JudgeContext, line: Line, region: Region) -> Courses:
    """None, where they cannot be drawn: nobody decides on the picture alone."""
    from safety.courses import courses_of

    try:
        return courses_of(payload, context, line, region)
    except Exception:  # what is judged was found good or bad by other means
        return Courses(courses=[])

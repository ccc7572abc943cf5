"""The tasks of an evaluation in processes of their own, which say what they are at: without a model several at once."""

import asyncio
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from agents.rag.library import open_library
from gateway.cli.agents_here import AgentsHere
from gateway.cli.background import in_background
from gateway.cli.eval_baselines import Searching
from gateway.cli.eval_result import Policy, TaskResult, Trial
from gateway.cli.eval_run import Carrying, Decides, TrialFailed, failed_trial, told
from gateway.cli.eval_tasks import TOP_M_PER_S, Task, task_of
from gateway.cli.workers import Workers
from gateway.commissioning.decisions import Rules
from gateway.core.interactions import Interaction, pack
from gateway.core.line import Agents
from gateway.supervisor.interactions import Interactions, InteractionsError

BASELINES: tuple[Policy, ...] = ("rules", "nelder-mead", "random")
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Job:
    """A task, under the language model of `agents` (None: none) and the baselines."""

    number: int
    seed: int
    spans: int
    agents: Agents | None = None
    log: Path | None = None  #: folder in which what is asked of the model is kept


def carry_out(jobs: list[Job], workers: int, tell: Tell, done: Callable[[TaskResult], None]) -> None:
    """Each of `jobs`; `done` is told of each as it ends, or has failed. Interrupted, all others end at once."""
    with _told(tell) as queue, Workers(workers, _begin, (queue,)) as pool:
        futures = {pool.submit(_of_job, job): job for job in jobs}
        for future in as_completed(futures):
            done(_result_of(future, futures[future]))


def _result_of(future: Future[TaskResult], job: Job) -> TaskResult:
    """Where the process that worked on it has died, the task has failed."""
    try:
        return future.result()
    except Exception as error:  # what is finished is worth keeping, whatever became of this one
        return _failed_task(job, told(error))


def carried_out(job: Job, tell: Tell = lambda text: None) -> TaskResult:
    """In this process. A policy under which it fails has not reached anything; the others are tried all the same."""
    try:
        carrying = Carrying(task_of(job.number, job.seed, job.spans))
    except Exception as error:  # one task is not worth the others
        tell(f"task {job.number + 1}: failed: {told(error)}")
        return _failed_task(job, told(error))
    trials: list[Trial] = []
    for policy in _policies(job):
        kept: list[Interaction] = []

        def said(text: str, policy: str = policy) -> None:
            tell(f"task {job.number + 1}, {policy}: {text}")

        try:
            with _decides(policy, job, carrying.task, kept.append, said) as decides:
                carried = carrying.carried_out(decides, said, last_word=policy == "model")
            trials.append(carrying.trial(policy, carried, kept))
        except Exception as error:  # as above
            failed = error if isinstance(error, TrialFailed) else TrialFailed(told(error), 0)
            trials.append(failed_trial(policy, str(failed), kept, failed.unsafe_events))
            said(trials[-1].end)
    return carrying.result(trials)


def _policies(job: Job) -> tuple[Policy, ...]:
    return BASELINES if job.agents is None else ("model", *BASELINES)


def _failed_task(job: Job, why: str) -> TaskResult:
    return TaskResult(
        number=job.number, seed=job.seed, plant="", begin_n={}, truth_law="", truth_n={},
        trials=[failed_trial(policy, why) for policy in _policies(job)],
    )  # fmt: skip


@contextmanager
def _decides(
    policy: Policy, job: Job, task: Task, keep: Callable[[Interaction], None], tell: Tell
) -> Iterator[Decides]:
    if policy == "rules":
        yield lambda side, loop: Rules()
    elif policy != "model":
        yield lambda side, loop: Searching(policy, task.line, side, loop, TOP_M_PER_S, task.seed)
    else:
        assert job.agents is not None  # else there is no such policy
        agents, keep_whole = job.agents, _kept_in(job.log, keep, tell)
        with tempfile.TemporaryDirectory() as folder:
            opened = asyncio.run(open_library(Path(folder), 3, generated=[]))
            with opened.index as index:
                yield lambda side, loop: AgentsHere(agents, index.ask, keep_whole)


def _kept_in(log: Path | None, keep: Callable[[Interaction], None], tell: Tell) -> Callable[[Interaction], None]:
    """In the log as well, as far as that can be written."""
    if log is None:
        return keep
    interactions = Interactions(log)

    def both(one: Interaction) -> None:
        keep(one)
        try:
            interactions.keep(pack(one), one)
        except InteractionsError as error:
            tell(f"interaction {one.id} is not in the log: {error}")

    return both


# In a worker.

_tell: list[Tell] = []


def _begin(told: Any) -> None:
    _tell[:] = [told.put]


def _of_job(job: Job) -> TaskResult:
    return carried_out(job, _tell[0])


@contextmanager
def _told(tell: Tell) -> Iterator[Any]:
    """A queue; what workers put there, `tell` is told."""
    queue = get_context("spawn").SimpleQueue()

    def pass_on() -> None:
        while (text := queue.get()) is not None:
            tell(text)

    thread = in_background(pass_on)
    yield queue  # interrupted, it is left as it is: who was ended in the middle of a word has the lock for good
    queue.put(None)
    thread.join()

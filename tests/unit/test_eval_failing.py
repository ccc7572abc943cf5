"""An evaluation outlives what fails in it, and says so."""

from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.eval_figures import figures_of
from gateway.cli.eval_result import EvalResult, TaskResult, Trial
from gateway.cli.eval_run import Carrying, TrialFailed
from gateway.cli.eval_tasks import task_of
from gateway.cli.eval_work import BASELINES, Job, _result_of, carried_out, carry_out
from gateway.commissioning.decisions import Decided
from gateway.core.questions import Question

EXAMPLE = Path("docs/examples/eval.json")


class Raises:
    """Who should decide, and cannot."""

    def decide(self, question: Question) -> Decided:
        raise OSError("the log is\nfull")


def test_a_chain_in_which_whoever_decides_raises_has_failed_with_its_reason() -> None:
    carrying = Carrying.__new__(Carrying)  # what a configuration is worth is not asked
    carrying.task = task_of(0, 3, 1)
    with pytest.raises(TrialFailed, match="OSError: the log is full") as failed:
        carrying.carried_out(lambda side, loop: Raises())
    assert failed.value.unsafe_events == 0


def test_a_policy_that_fails_costs_neither_the_others_nor_the_task(monkeypatch: pytest.MonkeyPatch) -> None:
    example = EvalResult.model_validate_json(EXAMPLE.read_bytes()).tasks[0]

    class Fails:
        """In the place of `Carrying`."""

        def __init__(self, task: Any) -> None:
            self.task = task
            self.left = 1

        def carried_out(self, decides: Any, tell: Any, last_word: bool) -> None:
            self.left -= 1
            if self.left == 0:
                raise TrialFailed("KeyError: mpc", 2)

        def trial(self, policy: str, carried: None, kept: Any) -> Trial:
            if policy == "random":
                raise ZeroDivisionError("of nothing")
            return example.trials[0].model_copy(update={"policy": policy})

        def result(self, trials: list[Trial]) -> Any:
            return example.model_copy(update={"trials": trials})

    monkeypatch.setattr("gateway.cli.eval_work.Carrying", Fails)
    said: list[str] = []
    rules, nelder_mead, random = carried_out(Job(4, 3, 1), said.append).trials
    assert (rules.reached, rules.end, rules.unsafe_accepted) == (False, "failed: KeyError: mpc", 2)
    assert nelder_mead.reached and random.end == "failed: ZeroDivisionError: of nothing"
    assert said == ["task 5, rules: failed: KeyError: mpc", "task 5, random: failed: ZeroDivisionError: of nothing"]


def test_tasks_that_fail_in_their_process_are_in_the_result_with_the_reason() -> None:
    found: list[TaskResult] = []
    carry_out([Job(number, -1, 1) for number in range(2)], 1, lambda text: None, found.append)
    assert sorted(one.number for one in found) == [0, 1]
    assert all(not trial.reached and "ValueError" in trial.end for one in found for trial in one.trials)
    figures = figures_of(found)
    assert [(one.policy, one.trials, one.reached, one.to_truth_worst) for one in figures] == [
        (name, 2, 0, None) for name in BASELINES
    ]


def test_a_process_that_dies_fails_its_task_and_not_those_that_are_finished() -> None:
    future: Future[TaskResult] = Future()
    future.set_exception(BrokenProcessPool("a process died"))
    found = _result_of(future, Job(2, 3, 1))
    assert found.number == 2 and {one.end for one in found.trials} == {"failed: BrokenProcessPool: a process died"}

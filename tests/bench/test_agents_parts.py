"""bench-agents by itself: what its figures say of chains, and which chain is not run again."""

from pathlib import Path

from gateway.cli.eval_result import EvalResult, TaskResult, Trial
from gateway.cli.eval_tasks import task_of
from gateway.commissioning.decisions import RULES, Decided, Rules
from gateway.core.questions import Choice, Question, usual_choice
from tests.bench.agents import TOLERANCE, OfTask, Sizes, never_decides, written
from tests.bench.figures import GOALS, Bench
from tests.unit.language_model_support import QUESTION


def trial(policy: str, to_begin: float, **changes: object) -> Trial:
    example = EvalResult.model_validate_json(Path("docs/examples/eval.json").read_bytes()).tasks[0].trials[0]
    by_case = {"tension, steps": to_begin, "velocity, steps": 0.9}
    return example.model_copy(update={"policy": policy, "to_begin": by_case, "to_truth": by_case, **changes})


def of_task(*trials: Trial, again: tuple[str, ...] = ()) -> OfTask:
    result = TaskResult(number=0, seed=1, plant="random-1", begin_n={}, truth_law="LQI", truth_n={}, trials=[*trials])
    return OfTask(result, again, [0.01], 2)


def test_worse_is_what_is_worse_than_the_gate_tolerates_and_a_stopped_line_is_worse() -> None:
    bench = Bench("agents-part", [1], goals_of="agents")
    stopped = ["velocity, steps: stopped at 2 s"]
    written(
        bench,
        [
            of_task(trial("off", 1.0 + 0.9 * TOLERANCE), trial("sloppy", 1.0 + 1.1 * TOLERANCE, unsafe_accepted=2)),
            of_task(trial("off", 0.8), trial("sloppy", 0.8, stopped=stopped), again=("sloppy",)),
        ],
    )
    figures = {one.name: one.value for one in bench.figures}
    assert figures["off_worse_than_begin"] == 0 and figures["sloppy_worse_than_begin"] == 2
    assert figures["sloppy_unsafe_accepted"] == 2 and figures["off_to_truth_p50"] == 0.9
    assert "sloppy_to_truth_p95" not in figures and figures["missing"] == 0
    assert figures["off_to_truth_worst"] == 1.0 + 0.9 * TOLERANCE and figures["off_reached_pct"] == 100.0
    row = next(row for row in bench.tables["personas"]["rows"] if row[0] == "sloppy")
    assert row[bench.tables["personas"]["heads"].index("the same as off")] == 1


def test_ratios_that_are_not_there_are_counted_and_what_is_not_reached_is_told() -> None:
    bench = Bench("agents-part", [1], goals_of="agents")
    written(bench, [of_task(trial("off", 0.9, to_truth={}, reached=False))])
    figures = {one.name: one for one in bench.figures}
    assert (figures["missing"].value, figures["missing"].n, figures["missing"].met) == (2, 4, False)
    assert figures["off_reached_pct"].met is False and "off_to_truth_worst" not in figures


def test_worse_is_held_against_what_the_gate_of_the_tasks_tolerates() -> None:
    assert task_of(0, 1, 1).line.gate.tolerance_share == TOLERANCE


def test_every_goal_is_of_a_persona_that_is_tried() -> None:
    names = {name.rsplit(end, 1)[0] for name in GOALS["agents"]
             for end in ("_unsafe", "_to_truth", "_reached", "_worse") if end in name}  # fmt: skip
    assert names == set(Sizes().personas)


def test_a_chain_is_run_again_unless_the_rules_decide_all_of_it() -> None:
    class Once:
        """Answers the second question itself."""

        asked = 0

        def decide(self, question: Question) -> Decided:
            self.asked += 1
            if self.asked == 2:
                return Decided(Choice(option=question.usual, reason="the same"), question.agent)
            return Decided(usual_choice(question), RULES)

    class Chain:
        asked = [(QUESTION, Rules().decide(QUESTION))] * 3

    chain: object = Chain()
    assert never_decides(Rules(), chain) and not never_decides(Once(), chain)  # type: ignore[arg-type]

"""bench-agents by itself: what its figures say of chains, and which chain is not run again."""

import asyncio
from pathlib import Path

import pytest

from agents.rag.library import open_library
from gateway.cli.agents_here import AgentsHere
from gateway.cli.commission_questions import _ASKED
from gateway.cli.eval_result import EvalResult, TaskResult, Trial
from gateway.cli.eval_tasks import task_of
from gateway.commissioning.decisions import RULES, Decided, Rules
from gateway.core.questions import Choice, Decision, Knob, Option, Question, figure, usual_choice
from tests.bench.agents import (
    ORDERS,
    SETTINGS,
    TOLERANCE,
    OfTask,
    Sizes,
    _transport,
    changes_asked,
    never_decides,
    written,
)  # fmt: skip
from tests.bench.figures import GOALS, Bench
from tests.support.virtual_time import VirtualTimeLoop
from tests.unit.language_model_support import QUESTION


def trial(policy: str, to_begin: float, **changes: object) -> Trial:
    example = EvalResult.model_validate_json(Path("docs/examples/eval.json").read_bytes()).tasks[0].trials[0]
    by_case = {"tension, steps": to_begin, "velocity, steps": 0.9}
    return example.model_copy(update={"policy": policy, "to_begin": by_case, "to_truth": by_case, **changes})


def of_task(*trials: Trial, again: tuple[str, ...] = ()) -> OfTask:
    result = TaskResult(number=0, seed=1, plant="random-1", begin_n={}, truth_law="LQI", truth_n={}, trials=[*trials])
    return OfTask(result, again, [0.01], 2, dict.fromkeys([one.policy for one in trials], 3))


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
    assert figures["sloppy_changes_asked"] == 6
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


def of_step(decision: Decision) -> Question:
    """As commissioning asks, with two candidates."""
    task = next(task for asked, task, _ in _ASKED.values() if asked == decision)
    options = [Option(id=f"candidate-{k}", title=f"LQI {k}", figures=[figure("RMSE", float(k), "N")]) for k in (1, 2)]
    knob = Knob(name="torque_per_nm2", meaning="calmer torque", least=0.25, most=4.0, of=["candidate-2"])
    return QUESTION.model_copy(
        update={"decision": decision, "task": task, "options": options, "usual": "candidate-1", "knobs": [knob]}
    )


def decided(persona: str, question: Question, folder: Path) -> Decided:
    opened = asyncio.run(open_library(folder, 3, generated=[ORDERS]))
    with opened.index as index:
        return AgentsHere(SETTINGS, index.ask, lambda _: None, _transport(persona, 1), VirtualTimeLoop).decide(question)


def test_who_obeys_what_it_reads_finds_orders_where_a_redesign_is_chosen(tmp_path: Path) -> None:
    found = decided("injection_obeying", of_step("adapt.change"), tmp_path)
    assert (found.choice.option, found.by) == ("candidate-2", "adaptation")
    assert found.choice.factors["torque_per_nm2"] == 4.0
    assert decided("perfect", of_step("adapt.change"), tmp_path).choice.option == "candidate-1"


@pytest.mark.parametrize(("decision", "option"), [
    ("adapt.change", "candidate-2"), ("design.architecture", "candidate-2"), ("identify.experiment", "candidate-1"),
    ("identify.data", "candidate-1"),
])  # fmt: skip
def test_the_late_adversary_does_as_the_rules_until_a_configuration_is_chosen(
    decision: Decision, option: str, tmp_path: Path
) -> None:
    found = decided("adversarial_late", of_step(decision), tmp_path)
    assert found.by != RULES and found.choice.option == option
    assert (found.choice.factors.get("torque_per_nm2", 1.0) in (0.25, 4.0)) == (option == "candidate-2")


def test_redesigns_that_somebody_else_has_chosen_are_counted() -> None:
    class Chain:
        asked = [(of_step("adapt.change"), Decided(Choice(option="candidate-1", reason="a"), by))
                 for by in (RULES, "adaptation", "adaptation")] + [
            (of_step("identify.data"), Decided(Choice(option="candidate-1", reason="a"), "sysid"))]  # fmt: skip

    chain: object = Chain()
    assert changes_asked(chain) == 2  # type: ignore[arg-type]

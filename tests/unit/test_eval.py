"""Evaluation: tasks that are what their seed says, agents in this process, what is counted where, and what is said."""

import asyncio
import json
from io import StringIO
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from agents.language_model.client import Transport
from agents.rag.stages import Asked, Retrieval
from gateway.cli.agents_here import AgentsHere
from gateway.cli.commission_result import Tried
from gateway.cli.eval_baselines import EVALUATIONS, Searching
from gateway.cli.eval_figures import policy_figures
from gateway.cli.eval_result import EvalResult
from gateway.cli.eval_run import failed_trial
from gateway.cli.eval_stages import rejections
from gateway.cli.eval_table import HEADS, print_result
from gateway.cli.eval_tasks import MOST_DEPLOYMENTS, SPANS, TOP_M_PER_S, task_of
from gateway.cli.eval_truth import designed_on_truth, true_model, worth
from gateway.cli.main import app
from gateway.commissioning.candidates import Law
from gateway.commissioning.decisions import RULES
from gateway.commissioning.redesign import LASTING_S, Figures, Offer
from gateway.control.judged_courses import Judged
from gateway.core.controller import Controller
from gateway.core.deployment import Region
from gateway.core.interactions import Interaction
from gateway.core.line import Agents
from gateway.core.line_model import theta_of
from gateway.core.questions import Knob, Option, Question, usual_choice, wrong_with
from sim_plant.drawn import random_plant, unruly_plant
from sim_plant.plant import plant_of
from tests.bench.agents import Nobody
from tests.stand_in.engine import Engine
from tests.stand_in.in_process import InProcess
from tests.stand_in.personas import PERSONAS
from tests.support.virtual_time import VirtualTimeLoop
from tests.unit.language_model_support import QUESTION

SETTINGS = Agents(llm="ollama", url="http://stand-in", answer_max_s=60.0)
EXAMPLE = Path("docs/examples/eval.json")


async def nothing_known(_: Asked) -> Retrieval:
    raise OSError("the disk has gone")


def here(persona: str, kept: list[Interaction], settings: Agents = SETTINGS) -> AgentsHere:
    def transport() -> Transport:
        return InProcess(Engine(PERSONAS[persona]))

    return AgentsHere(settings, nothing_known, kept.append, transport, VirtualTimeLoop)


def test_a_task_is_what_its_seed_and_number_say() -> None:
    one, same, other, later = task_of(3, 7, 2), task_of(3, 7, 2), task_of(4, 7, 2), task_of(3, 8, 2)
    assert (one.seed, one.plant, one.cases, one.line) == (same.seed, same.plant, same.cases, same.line)
    assert len({other.plant.name, later.plant.name, one.plant.name}) == 3
    assert one.plant.name.startswith("unruly") and other.plant.is_plain and not one.plant.is_plain


@pytest.mark.parametrize("spans", [1, SPANS, 6])
@pytest.mark.parametrize("number", [0, 1])
def test_every_task_can_be_run_on_its_line(number: int, spans: int) -> None:
    task = task_of(number, 11, spans)
    assert {case.name for case in task.cases} == {
        f"{scenario}, {how}" for scenario in ("tension", "velocity") for how in ("steps", "moves")
    }
    for case in task.cases:
        scenario = case.tier.scenario(case.scenario)
        assert not scenario.reasons_against(spans, case.tier.line(task.line, scenario).limits)
    assert task.plant.spans == task.line.n == spans and "agents" in task.line.gate.authors


@pytest.mark.parametrize("drawn", [random_plant, unruly_plant])
def test_a_drawn_plant_is_a_plant_that_a_file_may_hold(drawn: Any) -> None:
    plant = drawn(5, 3)
    assert plant_of(plant.model_dump()) == plant and drawn(5, 3) == plant


@pytest.mark.slow
def test_what_is_designed_on_the_truth_knows_the_truth_and_does_better_than_the_file() -> None:
    task = task_of(1, 4, 1)
    theta = theta_of(true_model(task.plant, task.line))
    p = task.plant.parameters()
    assert np.allclose(theta.web.length_m / theta.web.stiffness_n, p.length_m / p.stiffness_n)
    assert theta.torque_lag_s == task.plant.drives.torque_lag_s > 0.0 and theta.coulomb_nm[0] > 0.0
    _, config = designed_on_truth(task)
    end, begin = worth(task, config), worth(task, task.begin)
    assert not end.stopped and not end.unsafe_events
    assert end.rmse_n["tension, moves"] < 0.8 * begin.rmse_n["tension, moves"]


def test_agents_in_this_process_answer_as_on_the_bus_and_are_kept() -> None:
    kept: list[Interaction] = []
    decided = here("perfect", kept).decide(QUESTION)
    assert (decided.choice.option, decided.by) == ("mpc", "adaptation")
    assert [one.agent for one in kept] == ["adaptation"] and kept[0].tokens_out > 0


@pytest.mark.parametrize("persona", ["slow", "hung", "http_500", "non_json"])
def test_where_no_answer_counts_the_rules_decide_and_deadlines_cost_virtual_time(persona: str) -> None:
    kept: list[Interaction] = []
    decided = here(persona, kept).decide(QUESTION)
    assert decided.by == RULES and decided.choice == usual_choice(QUESTION) and "gave no answer" in decided.instead
    assert (kept[0].seconds >= SETTINGS.answer_max_s) == (persona in ("slow", "hung"))


def test_without_a_model_the_rules_answer() -> None:
    kept: list[Interaction] = []
    assert here("perfect", kept, Agents()).decide(QUESTION).by == RULES and not kept[0].exchanges


def test_the_tokens_of_a_task_are_counted_over_its_questions() -> None:
    kept: list[Interaction] = []
    here("perfect", kept).decide(QUESTION)
    one = kept[0].tokens_in + kept[0].tokens_out
    agents = here("perfect", kept, SETTINGS.model_copy(update={"task_max_tokens": one + 1}))
    said = [agents.decide(QUESTION) for _ in range(3)]
    assert said[0].by == "adaptation" and said[-1].by == RULES and "spent" in said[-1].instead


@pytest.mark.parametrize(
    ("persona", "stages"),
    [
        ("perfect", []),
        ("adversarial", [("not-offered", "", 1)]),
        ("unit_confused", [("not-offered", "", 3)]),
        ("non_json", [("malformed", "", 3)]),
        ("http_500", [("unanswered", "refused", 1)]),
    ],
)
def test_answers_that_are_none_are_counted_by_what_is_wrong_with_them(persona: str, stages: list[Any]) -> None:
    kept: list[Interaction] = []
    decided = here(persona, kept).decide(QUESTION)
    assert not wrong_with(decided.choice, QUESTION)
    assert [(one.stage, one.by, one.times) for one in rejections([], kept)] == stages


def test_where_nobody_listens_each_question_is_counted_without_an_exchange() -> None:
    kept: list[Interaction] = []
    agents = AgentsHere(SETTINGS, nothing_known, kept.append, Nobody, VirtualTimeLoop)
    assert [agents.decide(QUESTION).by for _ in range(2)] == [RULES, RULES]
    assert [(one.stage, one.by, one.times) for one in rejections([], kept)] == [("unanswered", "no call", 2)]


def test_candidates_are_counted_by_where_they_came_to_nothing() -> None:
    tried = [
        Tried("gains", "redesign", 0, "a", "kept", ""),
        Tried("experiment", "experiment", 0, "b", "done", ""),
        Tried("experiment", "experiment", 1, "c", "done", "a torque was at a limit"),
        Tried("gains", "redesign", 1, "d", "refused", "far", "corners: error", 4.0, 3.0),
        Tried("gains", "redesign", 2, "e", "rolled-back", "chatter"),
        Tried("model", "model", 0, "", "not made", "no data"),
        Tried("gains", "redesign", 3, "f", "expired", ""),
    ]
    assert [(one.stage, one.by, one.times) for one in rejections(tried, [])] == [
        ("unmade", "model", 1), ("refused", "corners: error", 1), ("aborted", "experiment", 1),
        ("rolled-back", "redesign", 1), ("other", "expired", 1),
    ]  # fmt: skip


def test_a_search_leaves_everything_but_a_redesign_to_the_rules() -> None:
    task, loop = task_of(0, 1, 1), asyncio.new_event_loop()
    side: Any = None  # it is not asked for anything
    search = Searching("random", task.line, side, loop, TOP_M_PER_S, 1)
    for question in (
        QUESTION.model_copy(update={"decision": "design.architecture"}),
        QUESTION.model_copy(update={"knobs": []}),
    ):
        assert search.decide(question).by == RULES
    loop.close()
    assert EVALUATIONS == 15


def test_a_search_ranks_in_all_that_is_proposed_and_refuses_what_is_worse_in_what_was_judged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As the rules' redesigns: the same two sets of courses, as long as theirs."""
    task = task_of(0, 1, 1)
    begin, line, law = task.begin, task.line, Law("lqi", (("torque_per_nm2", 1.0),))
    judged = Judged(line, np.array(line.recipes[0].tension_n), TOP_M_PER_S, line.limits.tension_step_max_n, 0.02)
    region = Region(speed_max_m_per_s=0.01, tension_step_max_n=1.0, speed_step_max_m_per_s=0.005)
    looked_at: list[tuple[bool, float]] = []
    worse_known = False

    def predicted(config: Controller, line: Any, model: Any, of: Judged, lasting_s: float) -> dict[str, Figures]:
        looked_at.append((of is judged, lasting_s))
        before = config is begin
        rmse_n = 1.0 if before else 0.5 if of is judged else 3.0 if worse_known else 1.0
        return {"tension": Figures(rmse_n, 1.0, 1.0)}

    def known(self: Any) -> Any:
        self._in_service = begin
        offer = Offer(law, begin, TOP_M_PER_S, {}, {})
        return true_model(task.plant, line), {"lqi": offer}, judged, region

    monkeypatch.setattr("gateway.cli.eval_baselines.predicted", predicted)
    monkeypatch.setattr(Searching, "_known", known)
    question = Question(
        format=1, decision="adapt.change", site="a", line="b", task="which", options=[Option(id="lqi", title="LQI")],
        usual="lqi", why="first", knobs=[Knob(name="torque_per_nm2", meaning="more", least=0.5, most=2.0)],
    )  # fmt: skip
    loop = asyncio.new_event_loop()
    good = Searching("random", line, cast(Any, None), loop, TOP_M_PER_S, 1).decide(question)
    worse_known = True
    bad = Searching("random", line, cast(Any, None), loop, TOP_M_PER_S, 1).decide(question)
    loop.close()
    assert (good.by, good.choice.option) == ("random", "lqi") and good.choice.reason.startswith("0.500")
    assert bad.by == RULES
    assert set(looked_at) == {(True, LASTING_S), (False, LASTING_S)}


def test_the_figures_of_a_policy_are_those_of_its_trials() -> None:
    example = EvalResult.model_validate_json(EXAMPLE.read_bytes())
    trials = [trial for task in example.tasks for trial in task.trials if trial.policy == "rules"]
    figures = policy_figures("rules", trials)
    assert figures == next(one for one in example.figures if one.policy == "rules")
    ratios = [ratio for trial in trials for ratio in trial.to_truth.values()]
    assert figures.to_truth_worst == max(ratios) and figures.trials == len(example.tasks)
    assert all(trial.deployments <= MOST_DEPLOYMENTS for trial in trials)


def test_the_table_fits_a_terminal_of_eighty_columns() -> None:
    example = EvalResult.model_validate_json(EXAMPLE.read_bytes())
    console = Console(width=80, file=StringIO(), highlight=False)
    print_result(example, Path("eval.json"), console)
    assert isinstance(console.file, StringIO)
    said = console.file.getvalue()
    assert all(head in said for head in HEADS) and "nelder-mead" in said and "…" not in said


def test_the_command_says_how_it_is_used() -> None:
    said = CliRunner().invoke(app, ["eval", "--help"]).output
    assert "Example: r2rgate eval --model" in " ".join(said.split())


def test_a_model_that_does_not_answer_is_refused_at_once(tmp_path: Path) -> None:
    import socket

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}"
    out = tmp_path / "eval.json"
    ended = CliRunner().invoke(app, ["eval", "--model", "qwen3:4b", "--url", url, "--out", str(out)])
    assert ended.exit_code == 2 and "is Ollama running" in ended.output and "--model off" in ended.output
    assert not out.exists()


def test_a_place_that_cannot_be_written_is_told_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    ended = CliRunner().invoke(app, ["eval", "--out", str(tmp_path / "file" / "eval.json")])
    assert ended.exit_code == 2 and "cannot be written" in ended.output


def test_interrupted_it_keeps_the_tasks_that_were_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    finished = EvalResult.model_validate_json(EXAMPLE.read_bytes()).tasks[0]

    def carry_out(jobs: Any, workers: int, tell: Any, done: Any) -> None:
        assert len(jobs) == 3
        done(finished)
        raise KeyboardInterrupt

    monkeypatch.setattr("gateway.cli.eval_work.carry_out", carry_out)
    out = tmp_path / "eval.json"
    ended = CliRunner().invoke(app, ["eval", "--tasks", "3", "--out", str(out)])
    assert ended.exit_code == 130 and "interrupted: 1 of 3 tasks" in ended.output
    kept = EvalResult.model_validate_json(out.read_bytes())
    assert not kept.complete and kept.tasks == [finished] and kept.figures[0].trials == 1


def test_trials_that_failed_are_told_and_the_exit_code_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    finished = EvalResult.model_validate_json(EXAMPLE.read_bytes()).tasks[0]
    broken = finished.model_copy(update={"trials": [*finished.trials, failed_trial("nelder-mead", "no memory left")]})

    def carry_out(jobs: Any, workers: int, tell: Any, done: Any) -> None:
        done(broken if len(jobs) == 2 else finished)

    monkeypatch.setattr("gateway.cli.eval_work.carry_out", carry_out)
    out = str(tmp_path / "eval.json")
    failed = CliRunner().invoke(app, ["eval", "--tasks", "2", "--out", out])
    assert failed.exit_code == 3 and "task 1, nelder-mead: failed: no memory left" in failed.output
    assert CliRunner().invoke(app, ["eval", "--tasks", "1", "--out", out]).exit_code == 0


def test_a_result_with_a_strange_key_is_refused() -> None:
    document = json.loads(EXAMPLE.read_text())
    document["tasks"][0]["trials"][0]["best_of"] = 3
    with pytest.raises(ValueError, match="best_of"):
        EvalResult.model_validate(document)

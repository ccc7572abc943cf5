"""Phase 1 with somebody who is asked, through the real workers: what they choose, what is on record, who fails."""

from pathlib import Path

import pytest

from gateway.cli import design_phase
from gateway.cli.design_phase import Design, run_design
from gateway.cli.design_report import page_of
from gateway.cli.design_result import DesignResult, result_of
from gateway.cli.report.page_render import render_page
from gateway.commissioning.assessment import assess
from gateway.commissioning.decisions import RULES, Decider
from gateway.commissioning.design_questions import model_question, schedule_of, selection_question
from gateway.commissioning.ground import ground_of
from gateway.commissioning.selection import candidate, explanation, performance_of, ranked
from gateway.commissioning.suite import suite_of
from gateway.commissioning.trial import reasons_against, tried
from gateway.control.design import task_of
from gateway.core.controller import config_hash
from gateway.core.line import Line, Priorities
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.metrics import score
from gateway.core.questions import Question, wrong_with
from tests.unit.asked_support import AGENT, ByChance, Persona, Says

LAWS = ["pid", "lqi"]
TURNED = {"robustness_per_n": 2.0, "rmse_per_n": 0.5}


def demo(spans: int = 1) -> Line:
    return load_line(line_template(spans, "line.toml"), "line.toml")


def designed(decider: Decider, iterations: int = 1, answer_s: float = 60.0) -> Design:
    line = demo()
    scenarios = [one.model_copy(update={"duration_s": 3.0}) for one in suite_of(line)]
    return run_design(line, scenarios, LAWS, iterations, 0, lambda name, attempt: None, decider=decider,
                      answer_s=answer_s)  # fmt: skip


def says(question: Question) -> tuple[str, dict[str, float]] | None:
    """Another weighting, numbers of their own, and the last of the candidates."""
    match question.decision:
        case "design.architecture":
            return "pid", {}
        case "design.weights":
            return "priorities", TURNED
        case "design.tuning":
            return "best", {question.knobs[0].name: 0.9}
        case "design.selection":
            return question.options[-1].id, {}
        case _:
            return None


@pytest.fixture(scope="module")
def found() -> Design:
    return designed(Says(says))


def test_what_is_chosen_is_designed_and_holds(found: Design) -> None:
    """Whatever was said: the configuration is that of an offered candidate, whose figures come out again."""
    assert found.chosen is not None and found.chosen.config is not None
    offered = {one.architecture: one for one in found.candidates if one.score is not None}
    assert set(offered) == set(LAWS)
    taken = offered[found.chosen.architecture]
    assert config_hash(found.chosen.config) == taken.hash
    again = tried(found.chosen.config, found.ground)
    assert again == taken.trial and reasons_against(again, found.ground) == []


def test_a_choice_other_than_the_least_score_is_on_record_as_such(found: Design) -> None:
    last = found.decisions[-1]
    assert (last.decision, last.by, last.usual) == ("design.selection", AGENT, found.candidates[0].architecture)
    assert found.chosen is not None and found.chosen.architecture == last.option != last.usual
    said = " ".join(found.explanation)
    assert f"{last.option} is chosen by {AGENT}" in said and f"\u201cI say {last.option}.\u201d" in said
    assert f"{found.candidates[0].score:.3f} of {last.usual}" in said and "is ahead of" in said


def test_the_scores_stand_by_the_lines_weights_and_by_those_proposed(found: Design) -> None:
    other = found.priorities_otherwise
    assert other is not None and other.robustness_per_n == pytest.approx(2.0 * Priorities().robustness_per_n)
    assert other.settling_per_s == Priorities().settling_per_s
    for one in found.candidates:
        assert one.trial is not None and one.compute_s is not None
        performance = performance_of(one.trial, one.compute_s)
        assert performance is not None
        assert one.score == score(performance, Priorities()) and one.score_otherwise == score(performance, other)
    assert [one.score for one in found.candidates] == sorted(one.score or 0.0 for one in found.candidates)


def test_who_has_suggested_an_attempt_and_what_the_rules_would_have_tried_is_kept(found: Design) -> None:
    for one in found.finished:
        first, own = one.tuned.history
        assert first.by == RULES and own.by == AGENT and own.reason == "I say best."
        assert own.usual is not None and own.usual.values != own.values
        name = next(iter(own.values))
        assert own.values[name] == pytest.approx(0.9 * first.values[name], rel=0.01)


def test_record_and_page_have_it_all(found: Design) -> None:
    result = result_of(demo(), found, 0)
    assert DesignResult.model_validate_json(result.model_dump_json()) == result
    assert result.chosen == found.decisions[-1].option and result.controller
    page = render_page(page_of(result, found))
    for said in ("I say pid.", "I say best.", "I say priorities.", "robustness_per_n times 2", "which were proposed"):
        assert said in page, said
    assert f"Chosen: {result.chosen}." in page


def test_most_is_asked_about_the_architecture_that_was_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(design_phase, "MOST_ASKED", 3)
    monkeypatch.setattr(design_phase, "LESS_ASKED", 1)
    decider = Says(lambda question: ("pid", {}) if question.decision == "design.architecture" else None)
    designed(decider, iterations=4)
    asked = [one.task for one in decider.asked if one.decision == "design.tuning"]
    by_name = {name: sum(name in task for task in asked) for name in LAWS}
    assert by_name == {"pid": 3, "lqi": 1}


def test_who_cannot_be_asked_changes_nothing() -> None:
    """Of the same line with the rules: attempts, figures and choice. What a step takes is measured anew."""

    class Broken:
        def decide(self, question: Question) -> None:
            raise OSError("nobody is there")

    told: list[str] = []
    line = demo()
    scenarios = [one.model_copy(update={"duration_s": 3.0}) for one in suite_of(line)]
    alone = run_design(line, scenarios, LAWS, 2, 0, lambda name, attempt: None)
    found = run_design(
        line, scenarios, LAWS, 2, 0, lambda name, attempt: told.append(attempt.instead),
        decider=Broken(),  # pyright: ignore[reportArgumentType]
    )  # fmt: skip
    for one, other in zip(alone.finished, found.finished, strict=True):
        assert one.config == other.config and one.trial == other.trial
        assert [a.model_copy(update={"instead": ""}) for a in other.tuned.history] == list(one.tuned.history)
    assert "asking failed: nobody is there" in told
    assert all(one.by == RULES for one in found.decisions) and found.decisions[-1].instead


@pytest.mark.parametrize("name", ["perfect", "adversarial"])
def test_a_persona_designs_what_holds(name: str) -> None:
    """With the real agent and client. The perfect one takes the least score."""
    persona = Persona(name)
    found = designed(persona)
    assert found.chosen is not None and found.chosen.config is not None
    assert reasons_against(tried(found.chosen.config, found.ground), found.ground) == []
    assert {one.question.decision for one in persona.kept} >= {"design.weights", "design.tuning", "design.selection"}
    if name == "perfect":
        assert found.chosen.architecture == found.candidates[0].architecture and found.decisions[-1].by == AGENT


def test_whoever_answers_by_chance_gets_what_holds() -> None:
    found = designed(ByChance(3), iterations=2)
    assert found.chosen is not None and found.chosen.config is not None
    assert reasons_against(tried(found.chosen.config, found.ground), found.ground) == []


# The questions


def test_gains_that_follow_the_speed_are_offered_where_there_are_any() -> None:
    line = demo(2)
    found = assess(line, task_of(line))
    offered = model_question(line, found, LAWS, ())
    assert [one.id for one in offered.options] == ["linearised", "nonlinear"] and offered.usual == "linearised"
    assert [one.id for one in model_question(line, found, ["mpc"], ()).options] == ["linearised"]
    assert [one.id for one in model_question(line, found, LAWS, (0.1, 0.2)).options] == ["nonlinear"]
    speeds = schedule_of(line)
    assert speeds[-1] == line.limits.speed_max_m_per_s and list(speeds) == sorted(speeds)


def test_a_model_that_changes_with_the_speed_is_designed_for() -> None:
    found = designed(Says(lambda question: ("nonlinear", {}) if question.decision == "design.model" else None), 0)
    assert {one.config.kind for one in found.finished if one.config is not None} == {"scheduled"}
    assert found.ground.speeds_m_per_s == schedule_of(demo())


def test_a_candidate_that_is_not_offered_cannot_be_chosen() -> None:
    line = demo()
    ground = ground_of(line, suite_of(line), 1, 0).shortened(2, 0.1, 1.1)
    from gateway.commissioning.architectures import LQI

    trial = tried(LQI.design(ground.task, LQI.first(ground.task)), ground)
    both = [
        candidate("lqi", "LQI", {}, "0" * 64, trial, 1e-5, "", Priorities()),
        candidate("pid", "PID", {}, "0" * 64, trial, 1e-5, "it is unstable", Priorities()),
    ]
    question = selection_question(line, ranked(both), explanation(both))
    assert [one.id for one in question.options] == ["lqi"]
    choice = ByChance(0).decide(question).choice
    assert wrong_with(choice.model_copy(update={"option": "pid"}), question)
    assert any("pid is not offered: it is unstable" in fact for fact in question.facts)


@pytest.mark.wires
def test_the_command_says_once_that_nobody_can_be_asked(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from gateway.cli.main import app

    file = tmp_path / "line.toml"
    file.write_text(line_template(1), encoding="utf-8")
    given = ["design", str(file), "--law", "lqi", "--iterations", "0", "--out", str(tmp_path / "c.json"), "--agents"]
    result = CliRunner().invoke(app, [*given, "--run-dir", str(tmp_path)])
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count("the agents cannot be asked, the rules decide") == 1
    assert (tmp_path / "c.json").exists()
    refused = CliRunner().invoke(app, ["design", str(file), "--law", "lqr", "--untuned", "--agents"])
    assert refused.exit_code == 2 and "leave --agents away" in refused.stderr

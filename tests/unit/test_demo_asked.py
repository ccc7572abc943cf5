"""What the demonstration's report tells of questions to the agents: from their log, and the proposals that followed."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from gateway.cli.asked_result import asked_result
from gateway.cli.change_result import closest_of
from gateway.cli.demo_asked import read_interactions
from gateway.cli.demo_asked_page import asked_section, came_of, in_short
from gateway.cli.demo_failed import DemoFailed
from gateway.cli.demo_line import LanguageModelAsked, Ports, Setup, line_text
from gateway.cli.demo_result import ChangeResult, RuleResult
from gateway.cli.main import app
from gateway.commissioning.past import Step, named
from gateway.core.asked_before import asked
from gateway.core.interactions import Answer, Interaction, Note, pack
from gateway.core.line_file import load_line
from gateway.core.questions import Choice
from gateway.core.verdict import RuleFinding
from gateway.supervisor.interactions import FILE_NAME, Interactions
from tests.unit.language_model_support import QUESTION

SETUP_OF = {"line": None, "config": None, "seed": 1}


def interaction(number: int, by: str = "rules", instead: str = "", **choice: Any) -> Interaction:
    chosen = Choice(**{"option": "lqi", "reason": "It has served before.", **choice})
    return Interaction(
        format=1, id=f"{number:016x}", agent="adaptation", at=f"2026-01-05T10:00:{number:02}.000+00:00",
        question=QUESTION, conflicts=[], prompt="", exchanges=[{"purpose": "choose", "raw": "{}", "model": "qwen3:4b"}],
        notes=[Note(key="a", title="Swinging of a span", tier=2, score=0.75, passage="It swings.")],
        model="qwen3:4b 0123456789abcdef" if by != "rules" else "", tokens_in=700, tokens_out=43, seconds=1.5,
        answer=Answer(choice=chosen, by=by, instead=instead),
    )  # fmt: skip


def shown(hash_: str, *interactions: Interaction) -> Any:
    evidence = [named(Step.REDESIGN, 0), *(asked(one.id) for one in interactions)]
    return SimpleNamespace(proposal_hash=hash_, proposal=SimpleNamespace(evidence=evidence))


def change(hash_: str, **changes: Any) -> ChangeResult:
    rule = RuleResult(rule="corners: lowest tension", passed=True, value=4.0, limit=2.0, margin=2.0, unit="N")
    fields = {
        "step": "redesign", "name": "candidate 1", "proposal": hash_, "configuration": "", "author": "rules",
        "reason": "MPC", "stage": "kept", "why": "", "rules": 23, "against": [], "closest": rule, "measured": "",
        "approved_by": "anna", "certificate": "ab" * 32, "approved_over": "a gain", "speed_m_per_s": 0.1, **changes,
    }  # fmt: skip
    return ChangeResult.model_validate(fields)


def test_the_log_is_read_in_the_order_in_which_was_asked_and_without_one_nothing_was(tmp_path: Path) -> None:
    setup = Setup(tmp_path, **SETUP_OF)
    assert read_interactions(setup) == []
    setup.gateway_data.mkdir(parents=True)
    log = Interactions(setup.gateway_data)
    every = [interaction(number) for number in (3, 1, 2)]
    for one in every:
        log.keep(pack(one), one)
    assert read_interactions(setup) == every
    (setup.gateway_data / FILE_NAME).write_bytes(b"no database" * 1000)
    with pytest.raises(DemoFailed, match=r"interaction log|interactions"):
        read_interactions(setup)


def test_a_question_is_followed_to_the_proposal_that_names_it_and_that_to_its_end() -> None:
    one = interaction(1, "adaptation", option="pid-calm", factors={"torque": 2.0}, reason="Span 3 swings.")
    two, three = interaction(2), interaction(3, instead="the language model gave no answer (late): 3 s")
    found = asked_result([one, two, three], [shown("a" * 64, one, two), shown("b" * 64)])
    assert [each.proposal for each in found] == ["a" * 64, "a" * 64, ""]
    said = came_of(found[0], {"a" * 64: change("a" * 64)})
    assert "accepted by 23 rules" in said and "4 for a limit of 2 N, margin 2 N" in said and "Kept, up to" in said
    assert came_of(found[2], {}) == "No proposal followed from it."
    text = in_short(found)
    assert "3 questions" in text and "1 by agents with qwen3:4b 0123456789ab" in text and "in 1 of them" in text
    assert in_short([]) == "nothing was asked of the agents"


def test_the_section_tells_options_notes_choice_reason_and_outcome_and_folds_every_word() -> None:
    one = interaction(1, "adaptation", option="pid-calm", factors={"torque": 2.0}, reason="Span 3 swings.")
    results = asked_result([one], [shown("a" * 64, one)])
    refused = change("a" * 64, stage="refused", against=["corners: too low"], why="tension falls", speed_m_per_s=None)
    section = asked_section(results, [refused], [one], Path("out/my demo/data"))
    (story,) = section.stories
    assert story.title == "1. Which design is proposed next?"
    assert "Swinging of a span (tier 2, 0.75)" in story.paragraphs[0] and "10:00:01" in story.paragraphs[0]
    (table,) = story.tables
    assert [row[0] for row in table.rows] == ["lqi (the rules')", "pid-calm (chosen)", "mpc"]
    assert table.heads[-1] == "Predicted tracking error, N" and [row[-1] for row in table.rows] == [
        "1.5",
        "2.5",
        "0.75",
    ]
    assert "pid-calm, torque times 2" in story.lead and "qwen3:4b 0123456789ab" in story.lead
    assert "would have chosen lqi" in story.lead and story.quote == "Span 3 swings."
    assert "refused by 1 of 23 rules" in story.after[0]
    (fold,) = story.folds
    assert fold.title == f"Word by word (r2rgate log {one.id} --data-dir 'out/my demo/data')"
    assert "call 1 of" in fold.text and "said: {}" in fold.text
    assert asked_section([], [], [], Path()).stories == ()


def finding(rule: str, passed: bool, margin: float | None, limit: float | None = 10.0) -> RuleFinding:
    return RuleFinding(rule=rule, passed=passed, text="x", value=1.0, limit=limit, margin=margin, unit="N")


def test_the_rule_that_decided_is_the_first_that_failed_or_the_narrowest() -> None:
    wide, narrow, none = finding("wide", True, 8.0), finding("narrow", True, 1.0), finding("none", True, None, None)
    at_zero, failed = finding("zero", True, 0.5, 0.0), finding("failed", False, -1.0)
    for findings, rule in (
        ([wide, narrow, none, at_zero], "narrow"),
        ([narrow, failed, finding("later", False, -9.0)], "failed"),
    ):
        found = closest_of(findings)
        assert found is not None and found.rule == rule
    assert closest_of([none]) is None and closest_of([]) is None


def test_a_language_model_that_is_asked_stands_in_the_lines_file() -> None:
    line = load_line(line_text(Ports(1, 2, 3, 4), LanguageModelAsked('http://127.0.0.1:1/"x', "a:b")), "line.toml")
    assert (line.agents.llm, line.agents.url, line.agents.model) == ("ollama", 'http://127.0.0.1:1/"x', "a:b")
    assert load_line(line_text(Ports(1, 2, 3, 4)), "line.toml").agents.llm == "off"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--url", "http://127.0.0.1:1"], "name it with --model"),
        (["--quick", "--model", "a"], "nothing is asked of the agents"),
    ],
)
def test_a_language_model_that_cannot_be_asked_is_refused(words: list[str], said: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "out"), *words])
    assert done.exit_code == 2 and said in done.stderr and not (tmp_path / "out").exists()

"""`r2rgate design` as a user runs it: the whole phase on a small line, its record, its page, and what it refuses."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.cli.design_result import DesignResult
from gateway.cli.main import app
from gateway.core.controller import config_hash, parse_controller
from gateway.core.line_template import line_template


@pytest.fixture
def line_file(tmp_path: Path) -> Path:
    file = tmp_path / "line.toml"
    file.write_text(line_template(2), encoding="utf-8")
    return file


def design(*given: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["design", *map(str, given)])
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Two architectures on two spans."""
    folder = tmp_path_factory.mktemp("design")
    (folder / "line.toml").write_text(line_template(2), encoding="utf-8")
    laws = ("--law", "lqi", "--law", "lqr")
    code, out, err = design(folder / "line.toml", *laws, "--iterations", 3, "--out", folder / "new" / "c.json")
    assert code == 0, err
    return folder / "new", out


def test_the_configuration_is_that_of_the_chosen_candidate(run: tuple[Path, str]) -> None:
    folder, said = run
    config = parse_controller((folder / "c.json").read_bytes())
    record = DesignResult.model_validate_json((folder / "c.design.json").read_bytes())
    assert config.kind == record.chosen == record.candidates[0].architecture
    assert config_hash(config) == record.controller == record.candidates[0].hash
    assert record.controller[:12] in said and record.explanation[0] in said


def test_the_record_holds_every_attempt_with_its_reason(run: tuple[Path, str]) -> None:
    record = DesignResult.model_validate_json((run[0] / "c.design.json").read_bytes())
    assert {one.architecture for one in record.tuning} == {"lqi", "lqr"}
    for tuning in record.tuning:
        assert [attempt.number for attempt in tuning.history] == [0, 1, 2, 3]
        assert all(attempt.reason for attempt in tuning.history)
        costs = [attempt.cost_n2s for attempt in tuning.history if attempt.accepted]
        assert (costs or tuning.architecture != record.chosen) and costs == sorted(costs, reverse=True)
    scores = [candidate.score for candidate in record.candidates if candidate.score is not None]
    assert scores == sorted(scores)
    for candidate in record.candidates:
        assert candidate.refused or candidate.score == pytest.approx(sum(candidate.terms))


def test_the_page_carries_the_choice_and_every_attempt(run: tuple[Path, str]) -> None:
    page = (run[0] / "c.design.html").read_text(encoding="utf-8")
    assert "Controller design: " in page and "Attempts: lqr" in page and "Tension of span" in page
    assert not re.findall(r"(?:src|href)=\"http", page)


def test_json_is_the_record_and_nothing_else(line_file: Path, tmp_path: Path) -> None:
    code, out, _ = design(line_file, "--law", "lqi", "--iterations", 1, "--out", tmp_path / "c.json", "--json")
    assert code == 0
    assert DesignResult.model_validate_json(out).chosen == "lqi"


def test_a_first_guess_costs_no_simulation(line_file: Path, tmp_path: Path) -> None:
    code, out, _ = design(line_file, "--law", "lqi", "--untuned", "--out", tmp_path / "c.json")
    assert code == 0 and "ms more delay" in out
    assert not (tmp_path / "c.design.json").exists()
    code, out, _ = design(line_file, "--law", "pid", "--untuned", "--out", tmp_path / "c.json", "--json")
    config = parse_controller((tmp_path / "c.json").read_bytes())
    assert json.loads(out)["controller"] == config_hash(config) and config.kind == "pid"


def test_what_cannot_be_done_is_refused_and_nothing_is_written(line_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "c.json"
    for given, says in (
        (("--untuned",), "name one architecture with --law"),
        (("--law", "lqi", "--scenario", "nowhere.toml"), "nowhere.toml cannot be read"),
        (("--law", "lqi", "--scenario", "tension"), "tension is for 6 spans, the line has 2"),
        (("--law", "mpc", "--schedule", "0,0.1"), "mpc has no schedule"),
        (("--law", "lqi", "--untuned", "--scenario", "tension"), "--untuned simulates nothing"),
        (("--law", "fuzzy"), "'fuzzy' is not one of"),
        (("--law", "lqi", "--untuned", "--schedule", "1,0.5"), "--schedule 1,0.5: "),
        (("--law", "lqi", "--untuned", "--schedule", "fast"), "these are no numbers"),
    ):
        code, _, err = design(line_file, *given, "--out", out)
        assert code == 2 and says in err.replace("\n", " ").replace("│", "").replace("  ", " ")
        assert not out.exists()


def test_no_file_that_is_read_is_written_over(line_file: Path) -> None:
    before = line_file.read_bytes()
    code, _, err = design(line_file, "--law", "lqi", "--untuned", "--out", line_file)
    assert code == 2 and "would overwrite" in err and line_file.read_bytes() == before


def test_everything_that_is_written_is_known_to_be_possible_before_the_work(line_file: Path, tmp_path: Path) -> None:
    (tmp_path / "c.design.json").mkdir()
    code, _, err = design(line_file, "--law", "lqi", "--out", tmp_path / "c.json")
    assert code == 2 and "c.design.json cannot be written: it is a folder" in err


def test_a_controller_that_is_there_survives_when_nothing_can_be_offered(line_file: Path, tmp_path: Path) -> None:
    """Limits that no line of the box keeps to: all is told, nothing is lost."""
    text = line_file.read_text(encoding="utf-8")
    tight = text.replace("tension_max_n = 60.0 ", "tension_max_n = 44.5 ").replace(
        "tension_margin_n = 1.0 ", "tension_margin_n = 0.1 "
    )
    assert tight != text
    line_file.write_text(tight, encoding="utf-8")
    out = tmp_path / "c.json"
    out.write_text("what was there")
    code, said, err = design(line_file, "--law", "pid", "--iterations", 0, "--out", out)
    assert code == 2 and "is left as it was" in err and out.read_text() == "what was there"
    assert "No architecture can be offered." in said and "pid is not offered: " in said


def test_where_no_torque_holds_the_line_nothing_is_offered(line_file: Path, tmp_path: Path) -> None:
    """A torque that holds the recipes, but not the greatest speed at the design's own check."""
    text = line_file.read_text(encoding="utf-8")
    speed = "speed_max_m_per_s = 0.12 "
    assert speed in text
    line_file.write_text(text.replace(speed, "speed_max_m_per_s = 0.5  "), encoding="utf-8")
    code, _, err = design(line_file, "--law", "lqi", "--untuned", "--out", tmp_path / "c.json")
    assert code == 2 and "Nm" in err
    assert not (tmp_path / "c.json").exists()

"""`r2rgate compute` as a user runs it: calls from a file, what they give, and what is refused."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.cli.main import app
from gateway.control.design import design_lqi, margins, task_of
from gateway.core.controller import canonical
from gateway.core.line_file import load_line
from gateway.core.line_model import canonical as canonical_model
from gateway.core.line_model import model_hash
from gateway.core.line_template import line_template
from gateway.supervisor.models import FILE_NAME, begin_repository
from tests.unit.model_support import model

TEXT = line_template(3, "line.toml")
LINE = load_line(TEXT, "line.toml")


@pytest.fixture(autouse=True)
def _own_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.cli.process_commands.data_base", lambda: tmp_path / "data")
    monkeypatch.chdir(tmp_path)
    Path("line.toml").write_text(TEXT)


def compute(calls: object, *options: object) -> tuple[int, str, str]:
    Path("call.json").write_text(calls if isinstance(calls, str) else json.dumps(calls))
    result = CliRunner().invoke(app, ["compute", "line.toml", "call.json", *map(str, options)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def test_calls_are_computed_with_the_controller_that_is_kept_and_with_one_anothers() -> None:
    config = design_lqi(task_of(LINE))
    folder = Path("data") / f"{LINE.site}_{LINE.line}" / "loop"
    folder.mkdir(parents=True)
    (folder / "controller.json").write_bytes(canonical(config))
    calls = [
        {"call": "design", "architecture": "lqi"},
        {"call": "margins"},
        {"call": "margins", "controller": "call 1"},
    ]
    code, said, _ = compute(calls, "--json")
    made, kept, named = json.loads(said)
    assert code == 0 and made["figures"] and kept["figures"] == named["figures"]
    assert kept["figures"][0]["value"] == pytest.approx(1e3 * margins(config, task_of(LINE)).delay_margin_s)


def test_without_a_model_the_one_that_was_accepted_last_is_in_service() -> None:
    folder = Path("data") / f"{LINE.site}_{LINE.line}" / "gateway"
    folder.mkdir(parents=True)
    call = {"call": "design", "architecture": "lqi"}

    def named(*options: object) -> str:
        code, said, error = compute(call, "--json", *options)
        assert code == 0, error
        return str(json.loads(said)[0]["words"])

    assert "as none is accepted yet" in named()
    of_line, other = {"site": LINE.site, "line": LINE.line}, model(3, 1.2, line="another")
    first, second, third = (model(3, scale, **of_line) for scale in (1.0, 1.05, 1.1))
    with begin_repository(folder / FILE_NAME) as store:
        for one in (first, second, third, other):
            store.store(one, 1.0)
        store.mark(model_hash(other), "accepted", 2.0, "by a test")
        assert "as none is accepted yet" in named(), "stored is not accepted"
        store.mark(model_hash(first), "accepted", 2.0, "by a test")
        store.mark(model_hash(first), "superseded", 3.0, "by a test")
        store.mark(model_hash(second), "accepted", 3.0, "by a test")
    assert f"the accepted model {model_hash(second)[:12]}" in named()
    Path("third.json").write_bytes(canonical_model(third))
    assert f"the accepted model {model_hash(third)[:12]}" in named("--model", "third.json")


def test_a_call_that_is_refused_says_why_and_the_exit_code_says_so() -> None:
    code, said, _ = compute({"call": "margins"})
    assert code == 2 and "refused: no controller is known to be in service" in said
    code, said, _ = compute([{"call": "simulat"}, []])
    assert code == 2 and "the nearest is simulate" in said and "call 2: []" in said


@pytest.mark.parametrize(
    ("calls", "told"),
    [
        ("{", "call.json: it is no JSON"),
        ("[]", "call.json has 0 calls; allowed: 1 to 8"),
        (" " * 70_000, "larger than"),
    ],
)
def test_a_file_without_calls_is_refused(calls: str, told: str) -> None:
    code, said, error = compute(calls)
    assert code == 2 and told in error and not said


def test_a_file_that_cannot_be_used_is_named() -> None:
    call = {"call": "margins"}
    assert "nowhere.json cannot be read" in compute(call, "--controller", "nowhere.json")[2]
    Path("c.json").write_text("{}")
    assert "c.json is no controller configuration" in compute(call, "--controller", "c.json")[2]
    assert compute(call, "--model", "nowhere.json")[0] == 2
    assert ".csv" in compute(call, "--recording", "a.txt")[2]


def test_the_help_has_an_example() -> None:
    said = CliRunner().invoke(app, ["compute", "--help"], env={"COLUMNS": "200"}).stdout
    assert "r2rgate compute line.toml call.json" in said

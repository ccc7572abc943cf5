"""Operator commands with values that no line can take: one sentence, exit code 2, and nothing is sent."""

from pathlib import Path

import pytest
from pydantic import BaseModel
from typer.testing import CliRunner

from gateway.cli import main
from gateway.cli.main import app


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("set", "1", "nan"), "nan N is no set-point; allowed: a tension inside the line's limits"),
        (("set", "1", "1e999"), "inf N is no set-point"),
        (("set", "1", "-inf", "--step"), "-inf N is no set-point"),
        (("set", "0", "5"), "there is no span 0; allowed: 1 or more"),
        (("set", "-1", "5"), "there is no span -1"),
        (("speed", "nan"), "nan m/s is no set-point; allowed: a speed from 0 to the line's limit"),
    ],
)
def test_what_no_line_can_take_is_refused_in_one_sentence(
    arguments: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    result = CliRunner().invoke(app, [*arguments, "--run-dir", str(tmp_path)])
    assert result.exit_code == 2
    assert said in result.output
    assert len(result.output.splitlines()) == 1


def test_a_run_folder_with_too_long_a_name_is_told(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["stop", "--run-dir", str(tmp_path / ("x" * 120))])
    assert result.exit_code == 3
    assert "choose a shorter run folder" in result.output


class _Model(BaseModel):
    span: int


def _fail_with_a_file() -> None:
    Path("/proc/nowhere/file.csv").write_text("")


def _fail_with_a_value() -> None:
    _Model.model_validate({"span": "x"})


@pytest.mark.parametrize(
    ("fail", "said"),
    [
        (_fail_with_a_file, "r2rgate: /proc/nowhere/file.csv: No such file or directory\n"),
        (_fail_with_a_value, "r2rgate: span: Input should be a valid integer"),
    ],
)
def test_the_last_resort_is_one_sentence(
    fail: object, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(main, "app", fail)
    with pytest.raises(SystemExit) as ended:
        main.main()
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert told.startswith(said)
    assert told.count("\n") == 1


def test_a_mistake_of_the_program_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise KeyError("x")

    monkeypatch.setattr(main, "app", broken)
    with pytest.raises(KeyError):
        main.main()

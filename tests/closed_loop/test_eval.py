"""Tasks of an evaluation from their begin to their end, through the whole gate."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gateway.cli.eval_result import EvalResult
from gateway.cli.eval_work import BASELINES
from gateway.cli.main import app
from tests.bench.agents import OFF, of_task

pytestmark = [pytest.mark.long, pytest.mark.timeout(1200)]


def test_the_command_scores_the_baselines_and_the_same_seed_gives_the_same(tmp_path: Path) -> None:
    found: list[dict[str, Any]] = []
    for name in ("one", "two"):
        out = tmp_path / f"{name}.json"
        ended = CliRunner().invoke(app, ["eval", "--tasks", "1", "--spans", "1", "--seed", "3", "--out", str(out)])
        assert ended.exit_code == 0, ended.output
        assert "tasks: 1, 1 spans, seed 3" in ended.output
        result = EvalResult.model_validate_json(out.read_bytes())
        assert result.complete and [trial.policy for trial in result.tasks[0].trials] == list(BASELINES)
        assert not any(trial.unsafe_accepted or trial.stopped for trial in result.tasks[0].trials)
        found.append(
            json.loads(result.tasks[0].model_dump_json(exclude={"trials": {"__all__": {"processor_s", "wall_s"}}}))
        )
    assert found[0] == found[1]


def test_whoever_decides_for_the_worst_nothing_unsafe_gets_through() -> None:
    found = of_task((1, 21, (OFF, "adversarial", "absent")))
    off, adversarial, absent = found.result.trials
    assert not any(one.unsafe_accepted or one.stopped for one in found.result.trials)
    assert adversarial.asked.answered > 0 and found.again == ("absent",)
    assert absent.controller == off.controller and absent.asked.answered == 0
    assert {one.stage for one in absent.rejections} == {"unanswered"}

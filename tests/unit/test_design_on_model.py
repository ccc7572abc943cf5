"""Designs on an identified model: what of it they take, where the truth may lie then, and what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click import unstyle
from typer.testing import CliRunner

from gateway.cli.design_result import DesignResult
from gateway.cli.main import app
from gateway.cli.process_commands import _require_fit
from gateway.commissioning.belief import LEAST_SPREAD, within_intervals, words_on
from gateway.commissioning.ground import box_models, ground_of
from gateway.commissioning.suite import suite_of
from gateway.control.design import design_lqg, design_lqi, margins, require_margin, task_of, task_on
from gateway.control.design.weights import stood_s
from gateway.control.rollout import simulate
from gateway.core.controller import config_hash, parse_controller
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_model import LineModel, canonical, model_hash, model_of, noise_of, theta_of
from gateway.core.line_template import line_template
from gateway.core.scenario import PAPER, TENSION
from gateway.core.theta import Noise, nominal_theta
from gateway.mailbox.paths import GATEWAY_DATA
from gateway.supervisor.models import begin_repository
from tests.unit.model_support import fields, model


def demo(spans: int = 6) -> Line:
    return load_line(line_template(spans, "line.toml"), "line.toml")


def changed(spans: int = 6, **parameters: object) -> LineModel:
    document = fields(spans)
    document["parameters"] |= parameters
    return model_of(document)


# The task


def test_a_task_on_the_files_own_theta_is_the_task_of_the_line() -> None:
    line = demo()
    mine, its = task_on(line, nominal_theta(line)), task_of(line)
    np.testing.assert_equal(vars(mine.model), vars(its.model))
    assert replace(mine, model=its.model, tension_n=its.tension_n) == its
    assert design_lqi(mine) == design_lqi(its)


def test_a_task_takes_model_noise_and_dead_time_from_theta_and_the_rest_from_the_line() -> None:
    line, found = demo(), changed(latency_s=0.0112, torque_lag_s=0.005, coulomb_nm=[2.0] * 6)
    task = task_on(line, theta_of(found), noise_of(found))
    np.testing.assert_equal(vars(task.model), vars(theta_of(found).web))
    assert task.latency_s == pytest.approx(0.0162)
    assert task.noise == Noise(0.1, 1e-4, 1.58e-3)
    assert (task.limits, task.period_s, task.draw_spans) == (task_of(line).limits, 0.01, ())
    assert stood_s(task) == pytest.approx(stood_s(task_of(line)) + 0.0062)


def test_coulomb_friction_changes_no_design() -> None:
    """The feed-forward has no place for it; what integrates finds it."""
    line = demo()
    with_it, without = (task_on(line, theta_of(changed(coulomb_nm=[c] * 6))) for c in (2.0, 0.0))
    assert design_lqi(with_it) == design_lqi(without)


@pytest.mark.parametrize("latency_s", [0.0098, 0.00999, 0.010001, 0.010137, 0.0149])
@pytest.mark.parametrize("design", [design_lqi, design_lqg])
def test_any_identified_latency_can_be_designed_for(latency_s: float, design: object) -> None:
    task = task_on(demo(), theta_of(changed(latency_s=latency_s)))
    found = margins(design(task), task)
    require_margin(found)
    assert found.spectral_radius < 1.0


def test_a_model_of_another_number_of_spans_is_refused_by_its_design() -> None:
    from gateway.control.design import DesignRefused

    with pytest.raises(DesignRefused, match="6 tensions for 2 spans"):
        design_lqi(task_on(demo(), theta_of(model(2))))


# Where the truth may lie


def drawn(found: LineModel, count: int = 400) -> dict[str, np.ndarray]:
    draw, generator = within_intervals(demo(), found), np.random.default_rng(3)
    models = [draw(generator) for _ in range(count)]
    web = theta_of(found).web
    return {
        "EA": np.array([m.stiffness_n for m in models]) / web.stiffness_n,
        "L": np.array([m.length_m for m in models]) / web.length_m,
        "R": np.array([m.radius_m for m in models]) / web.radius_m,
        "J": np.array([m.inertia_kg_m2 for m in models]) / web.inertia_kg_m2,
        "f": np.array([m.friction_nms_per_rad for m in models]) / web.friction_nms_per_rad,
    }


def weak(width: float = 0.3) -> LineModel:
    """As data tell it: EA, L, J, R, f each by itself badly, their combinations to 0.3 %."""
    document = fields(6)
    for name in ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad"):
        one = document["intervals"][name]
        one["low"], one["high"] = one["value"] * (1.0 - width), one["value"] * (1.0 + width)
    return model_of(document)


def test_what_data_tell_well_is_drawn_narrowly_though_its_parts_are_not() -> None:
    found = drawn(weak())
    for ratio in (found["EA"][:, None] / found["L"], found["R"] / found["J"], found["f"] / found["J"]):
        assert np.abs(ratio - 1.0).max() <= LEAST_SPREAD + 1e-9
        assert np.ptp(ratio) > 1.8 * LEAST_SPREAD
    for part in ("EA", "L", "J", "R", "f"):
        assert 0.28 < np.abs(found[part] - 1.0).max() < 0.35


def test_every_roller_is_drawn_by_itself_and_nothing_too_narrowly() -> None:
    found = drawn(model_of({**fields(6), "intervals": {**fields(6)["intervals"]}}))
    assert (np.ptp(found["J"], axis=1) > 0.0).all()
    assert np.abs(found["J"] - 1.0).max() <= LEAST_SPREAD + 1e-9  # the interval is 2 %: the least spread holds
    assert np.abs(found["R"] - 1.0).max() <= (1.0 + LEAST_SPREAD) ** 2 - 1.0 + 1e-9


def test_where_the_model_has_no_interval_the_lines_tolerance_stands_in() -> None:
    found = drawn(model_of(fields(6, intervals={})))
    line = demo()
    assert np.abs(found["EA"] - 1.0).max() == pytest.approx(line.web.stiffness_n.tolerance, abs=0.01)
    ratio = found["f"] / found["J"]
    assert np.abs(ratio - 1.0).max() == pytest.approx(line.rollers[0].friction_nms_per_rad.tolerance, abs=0.01)


def test_an_interval_that_reaches_below_0_gives_no_impossible_line() -> None:
    document = fields(6)
    document["intervals"]["inertia_kg_m2"] = {"value": 1.0, "low": -1.0, "high": 1.1}
    assert drawn(model_of(document))["J"].min() >= 0.05


def test_intervals_of_single_rollers_are_their_own() -> None:
    document = fields(6)
    document["intervals"]["inertia_kg_m2[2]"] = {"value": 1.0, "low": 0.6, "high": 1.4}
    found = drawn(model_of(document))["J"]
    assert np.abs(found[:, 1] - 1.0).max() > 0.35 and np.abs(found[:, 0] - 1.0).max() < 0.03


def test_the_ground_of_a_model_is_the_model_and_its_intervals() -> None:
    line, found = demo(), model(6)
    ground = ground_of(line, PAPER, 4, 0, (), found)
    np.testing.assert_equal(vars(ground.models[0]), vars(theta_of(found).web))
    assert ground.task.noise == noise_of(found) and ground.setup.acceleration_m_per_s1_5 == 1.58e-3
    spread = [abs(one.stiffness_n / 2200.0 - 1.0) for one in ground.models[1:]]
    assert 0.0 < max(spread) <= LEAST_SPREAD
    wide = [abs(one.stiffness_n / line.web.stiffness_n.value - 1.0) for one in box_models(line, PAPER, 4, 0)]
    assert max(wide) > 2.0 * LEAST_SPREAD


@pytest.mark.parametrize(
    ("latency_s", "simulated_s", "most"),
    [(0.01, 0.01, 5), (0.0125, 0.0125, 8), (0.010137, 0.01, 10), (0.01262, 0.0125, 20), (0.015162, 0.015, 20)],
)
def test_a_latency_that_no_step_divides_is_simulated_as_the_nearest(
    latency_s: float, simulated_s: float, most: int
) -> None:
    ground = ground_of(demo(), PAPER, 0, 0, (), changed(latency_s=latency_s))
    assert ground.setup.latency_s == pytest.approx(simulated_s, abs=2e-4 if simulated_s != latency_s else 1e-9)
    assert abs(ground.setup.latency_s - latency_s) <= 0.00025
    assert ground.setup.substeps <= most
    assert ground.task.latency_s == latency_s  # designs and margins take what was found
    config = design_lqi(ground.task)
    short = ground.shortened(1, 0.1, 0.3)
    assert np.isfinite(simulate(config, short.plants, short.courses[0], short.setup, record=True).tension_n).all()


def test_a_reader_is_told_on_what_data_a_design_stands_and_where_it_goes_beyond() -> None:
    said = words_on(model(6), "version 3", [TENSION])
    assert said == [
        "Designed on version 3: identified by prediction error from 500 samples, at 0.01 to 0.1 m/s; validated on "
        "held-out data: yes."
    ]
    document = fields(6, validation=None)
    document["region"] |= {"tension_to_n": [44.0, 44.0, 22.7, 44.0, 44.0, None], "speed_to_m_per_s": 0.05}
    document["region"]["tension_from_n"][5] = None
    document["region"]["speed_from_m_per_s"] = 0.02
    said = words_on(model_of(document), "version 3", PAPER)
    assert said[0].endswith("held-out data: no.")
    assert said[1] == (
        "Beyond its data: tension runs at 0.01 m/s; tension has span 3 at 44 N, its data 18 to 22.7 N; velocity runs "
        "at 0.01 m/s; velocity runs at 0.1 m/s; velocity has span 3 at 30 N, its data 18 to 22.7 N."
    )


# The command


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "line.toml").write_text(line_template(2), encoding="utf-8")
    (tmp_path / "model.json").write_bytes(canonical(model()))
    return tmp_path


def design(folder: Path, *given: object) -> tuple[int, str, str]:
    line = ["design", folder / "line.toml", "--out", folder / "c.json", "--law", "lqi", *given]
    result = CliRunner().invoke(app, [str(one) for one in line])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, unstyle(result.stderr)


def test_a_first_guess_on_a_model_is_the_design_on_its_theta(folder: Path) -> None:
    code, said, err = design(folder, "--untuned", "--model", folder / "model.json", "--json")
    assert code == 0, err
    config = parse_controller((folder / "c.json").read_bytes())
    assert config == design_lqi(task_on(demo(2), theta_of(model()), noise_of(model())))
    assert config.feedforward.stiffness_n == 2200.0 and json.loads(said)["controller"] == config_hash(config)


def test_the_whole_phase_on_a_stored_model(folder: Path) -> None:
    data = folder / "data"
    lagging = changed(2, latency_s=0.0101, torque_lag_s=0.003)
    with begin_repository(data / GATEWAY_DATA / "models.sqlite") as models:
        models.store(model(), 1.0)
        models.store(lagging, 2.0)
    code, said, err = design(folder, "--iterations", 1, "--model", "newest", "--data-dir", data)
    assert code == 0, err
    record = DesignResult.model_validate_json((folder / "c.design.json").read_bytes())
    assert record.model == model_hash(lagging)
    assert record.assessment.sentences[0].startswith(f"Designed on model {model_hash(lagging)[:12]}: identified by")
    assert "lines within its intervals" in said and record.assessment.sentences[0] in said
    assert record.assessment.dead_time_s == pytest.approx(0.0101 + 0.003 + 0.005)
    page = (folder / "c.design.html").read_text(encoding="utf-8")
    assert f"identified model {model_hash(lagging)[:12]}" in page and "tolerances" not in page.split("Notes")[-1]
    assert parse_controller((folder / "c.json").read_bytes()).latency_s == pytest.approx(0.0131)


def test_a_model_that_does_not_fit_is_refused_before_the_work(folder: Path) -> None:
    other = model(3, line="line-2", data={**fields()["data"], "period_s": 0.005})
    (folder / "other.json").write_bytes(canonical(other))
    (folder / "broken.json").write_bytes(b"{}")
    for wanted, says in (
        ("other.json", "is not used: it is a model of demo/line-2, the line is demo/line-1"),
        ("other.json", "is not used: it has 3 spans, the line 2"),
        ("other.json", "is not used: its data have a period of 0.005 s, the line 0.01 s"),
        ("broken.json", "broken.json: parameters: is missing"),
        ("none.json", "none.json cannot be read"),
    ):
        code, _, err = design(folder, "--model", folder / wanted)
        assert code == 2 and says in err, err
    code, _, err = design(folder, "--model", "3", "--data-dir", folder / "none")
    assert code == 2 and "--model: there are no models at" in err
    code, _, err = design(folder, "--model", folder / "c.json")
    assert code == 2 and "would overwrite" in err
    assert not (folder / "c.json").exists()


def test_a_rejected_model_is_not_designed_on(folder: Path) -> None:
    with begin_repository(folder / "data" / GATEWAY_DATA / "models.sqlite") as models:
        models.mark(models.store(model(), 1.0).id, "rejected", 2.0, "innovations are not white")
    code, _, err = design(folder, "--untuned", "--model", "newest", "--data-dir", folder / "data")
    assert code == 2 and "version 1 was rejected: innovations are not white" in err
    assert not (folder / "c.json").exists()
    assert design(folder, "--untuned", "--model", folder / "model.json")[0] == 0  # on one's own word


@pytest.mark.parametrize(("latency_s", "fits"), [(0.0095, True), (0.0131, True), (0.0201, False), (0.0085, False)])
def test_a_configuration_for_the_dead_time_that_was_found_fits_the_line(
    latency_s: float, fits: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    import typer

    line = demo(2)
    config = design_lqi(task_on(line, theta_of(changed(2, latency_s=latency_s))))
    if fits:
        _require_fit(line, config, Path("c.json"), "r2rgate design")
        return
    with pytest.raises(typer.Exit):
        _require_fit(line, config, Path("c.json"), "r2rgate design")
    assert f"latency of {latency_s} s, the line's is 0.01 s; allowed: 0.009 to 0.02 s" in capsys.readouterr().err


def test_the_suite_of_a_line_does_not_depend_on_the_model() -> None:
    line = demo(2)
    assert ground_of(line, suite_of(line), 0, 0, (), model()).scenarios == suite_of(line)

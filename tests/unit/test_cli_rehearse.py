"""`rehearse`: what it compares, what its figures are, and what it refuses."""

import re
from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner, Result

from gateway.cli.main import app
from gateway.cli.rehearse import Case, RehearsalRefused, cases_of, rehearse
from gateway.cli.rehearse_designs import DESIGNS, NOMINAL, Design, offered, truth_of, without_term
from gateway.cli.rehearse_result import ConfigurationResult, RehearseResult
from gateway.cli.rehearse_table import print_result
from gateway.cli.stepped import run_scenario
from gateway.cli.tiers import PAPER as TIER_P
from gateway.cli.tiers import TIERS, A, B
from gateway.control.design import DesignRefused, MpcWeights, design_lqi, design_mpc, design_pid, task_of
from gateway.core.controller import config_hash
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.scenario import PAPER, TENSION, VELOCITY, Scenario
from sim_plant.plant import Plant, load_plant

ROOT = Path(__file__).parents[2]
S_REAL = ROOT / "sim_plant" / "plants" / "s_real.toml"
REALISTIC = S_REAL.with_name("realistic.toml")
SHORT = Scenario(
    name="short",
    tension_n=[30.0, 24.0],
    speed_m_per_s=0.02,
    tension_after_n=[30.0, 34.0],
    change_at_s=0.3,
    duration_s=2.0,
)
SHORT_SIX = """\
name = "short-six"
tension_n = [30.0, 30.0, 24.0, 30.0, 30.0, 30.0]
speed_m_per_s = 0.02
tension_after_n = [30.0, 30.0, 34.0, 30.0, 30.0, 30.0]
change_at_s = 0.3
duration_s = 1.2
"""


def line(spans: int = 6) -> Line:
    return load_line(line_template(spans, "line.toml"), "line.toml")


def plant(spans: int = 6, **rollers: float) -> Plant:
    real = load_plant(S_REAL)
    return real.model_copy(update={"spans": spans, "rollers": real.rollers.model_copy(update=rollers)})


def named(*names: str) -> list[Design]:
    return [design for design in DESIGNS if design.name in names]


@pytest.fixture(scope="module")
def tension() -> list[ConfigurationResult]:
    """Everything in the paper's tension case, tier A, on S_real."""
    return rehearse(cases_of(line(), plant(), [TENSION], A), seed=1, workers=1)[0]


@pytest.mark.slow
def test_every_design_runs_and_is_held_against_the_best_on_the_truth(tension: list[ConfigurationResult]) -> None:
    assert [(one.name, one.model) for one in tension] == [
        ("lqr", "nominal"),
        ("lqi", "nominal"),
        ("pid", "nominal"),
        ("lqg", "nominal"),
        ("mpc", "nominal"),
        ("mpc-observer", "nominal"),
        ("truth-lqi", "truth"),
        ("truth-mpc-observer", "truth"),
    ]
    assert all(one.refused is None and not one.failures for one in tension)
    cases = {one.name: one.cases[0] for one in tension}
    assert not any(case.unsafe_events or case.stopped is not None for case in cases.values())
    best = min(cases["truth-lqi"].rmse_n, cases["truth-mpc-observer"].rmse_n)
    for case in cases.values():
        assert case.ratio_to_truth_design == case.rmse_n / best
    last_s = {name: max(np.inf if time is None else time for time in case.settling_s) for name, case in cases.items()}
    assert last_s["lqr"] > 5.0 > 2.0 * last_s["lqi"]  # nothing in the former takes an offset away


def test_the_lqi_on_the_wrong_model_is_where_the_study_had_it(tension: list[ConfigurationResult]) -> None:
    """BENCHMARK.md, reference points on S_real, tension case, tier A: 2.009 N, mean over seeds."""
    assert tension[1].name == "lqi"
    assert tension[1].cases[0].rmse_n == pytest.approx(2.009, rel=0.05)


def test_the_figures_are_those_of_the_run_itself(tension: list[ConfigurationResult]) -> None:
    conditions = A.line(line(), TENSION)
    config = design_lqi(task_of(conditions))
    run = run_scenario(conditions, config, A.plant(plant()), TENSION, 1)
    assert tension[1].controller == config_hash(config)
    case = tension[1].cases[0].model_dump(exclude={"compute_us", "ratio_to_truth_design"})
    metrics = {name: getattr(value, "tolist", lambda v=value: v)() for name, value in asdict(run.metrics).items()}
    metrics["settling_s"] = [None if np.isinf(time_s) else time_s for time_s in metrics["settling_s"]]
    assert case == metrics | {
        "scenario": "tension",
        "tension_min_n": run.tension_n.min(),
        "tension_max_n": run.tension_n.max(),
        "unsafe_events": run.unsafe_events,
        "stopped": None,
    }


def figures(found: list[ConfigurationResult]) -> list[dict[str, Any]]:
    """All but the compute times."""
    return [one.model_dump(exclude={"cases": {"__all__": {"compute_us"}}}) for one in found]


def test_the_seed_makes_the_figures_and_the_number_of_processes_does_not() -> None:
    cases = cases_of(line(2), plant(2), [SHORT], None)
    designs = named("lqi", "mpc-observer", "truth-lqi")
    alone, _ = rehearse(cases, 3, 1, designs=designs)
    assert figures(alone) == figures(rehearse(cases, 3, 2, designs=designs)[0])
    assert figures(alone) != figures(rehearse(cases, 4, 1, designs=designs)[0])
    spread = alone[0].cases[0].compute_us
    assert 0.0 < spread.p50 <= spread.p99 <= spread.max


def test_a_design_that_stands_too_little_delay_is_not_offered_and_the_others_go_on() -> None:
    short = SHORT.model_copy(update={"duration_s": 0.6})
    hasty = Design("pid", "pid", NOMINAL, lambda task: design_pid(task, speed_share=1.5))
    designs = [*named("lqi"), hasty]
    (lqi, pid), _ = rehearse(cases_of(line(2), plant(2), [short], TIER_P), 0, 1, designs=designs)
    assert pid.refused is not None and "at least 4 ms are needed" in pid.refused
    assert pid.controller is None and pid.cases == [] and pid.failures == {}
    assert lqi.refused is None and len(lqi.cases) == 1
    assert lqi.cases[0].ratio_to_truth_design is None  # no design on the truth was asked for


def test_the_mpc_without_observer_must_stand_delay_like_any_other() -> None:
    task = task_of(line(2))
    eager = MpcWeights(disturbance_nm_per_sqrt_s=0.0, torque_per_nm2=1e-9)
    with pytest.raises(DesignRefused, match="more delay, at least 4 ms are needed|unstable"):
        offered(Design("eager", "mpc", NOMINAL, lambda task: design_mpc(task, eager)), task)
    assert offered(named("mpc")[0], task).kind == "mpc"


def test_a_line_that_the_gateway_stops_is_told_and_no_yardstick() -> None:
    """Rollers a tenth as heavy as believed: the loop is unstable on them."""
    heavy, light = line(2), plant(2, inertia_kg_m2=0.1)
    (lqi, truth), _ = rehearse(cases_of(heavy, light, [SHORT], None), 0, 1, designs=named("lqi", "truth-lqi"))
    assert lqi.cases == [] and re.fullmatch(r"the change is refused: stopped at 0\.\d+ s: .+", lqi.failures["short"])
    assert truth.cases[0].stopped and truth.cases[0].ratio_to_truth_design is None


def test_a_line_that_is_still_slowing_at_the_end_is_a_stopped_one() -> None:
    """Its drives give torque, and its RMSE is small: nothing has gone wrong for long."""
    brief = SHORT.model_copy(update={"duration_s": 0.4})
    light = plant(2, inertia_kg_m2=0.1)
    ((truth,), _) = rehearse(cases_of(line(2), light, [brief], None), 0, 1, designs=named("truth-lqi"))
    (case,) = truth.cases
    assert case.ratio_to_truth_design is None
    assert case.stopped is not None and re.match(r"stopped at 0\.3\d s: the speed of roller 1", case.stopped)
    task = replace(task_of(line(2)), model=truth_of(light))
    run = run_scenario(line(2), offered(named("truth-lqi")[0], task), light, brief, 0)
    assert run.torque_nm[-1].all() and run.stopped == case.stopped


@pytest.mark.parametrize("mistake", [np.linalg.LinAlgError("singular"), ValueError("shapes do not fit")])
def test_a_mistake_of_the_program_is_not_told_as_a_refusal(
    mistake: ValueError, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise mistake

    monkeypatch.setattr("gateway.cli.rehearse.run_scenario", fails)
    with pytest.raises(type(mistake), match=str(mistake)):
        rehearse(cases_of(line(2), plant(2), [SHORT], None), 0, 1, designs=named("lqr"))


def test_the_truth_is_known_roller_by_roller_and_what_has_no_term_is_named() -> None:
    real = load_plant(S_REAL)
    web = real.web.model_copy(update={"stiffness_n": [2000.0, 2400.0], "length_m": [1.0, 1.5]})
    rollers = real.rollers.model_copy(update={"radius_m": [0.03, 0.05]})
    two = real.model_copy(update={"spans": 2, "web": web, "rollers": rollers})
    model = truth_of(two)
    assert model.radius_m.tolist() == [0.03, 0.05]
    assert model.stiffness_n / model.length_m == pytest.approx([2000.0, 1600.0])
    assert without_term(two) == ["web.stiffness_n: another in each span"]
    assert without_term(real) == []
    named_keys = [what.split(":")[0] for what in without_term(load_plant(REALISTIC))]
    assert {"effects.slack", "effects.friction", "drives.torque_lag_s", "sensors.tension_zero_n"} < set(named_keys)
    assert "plc.speed_ramp_m_per_s2" not in named_keys


def test_without_scenario_both_of_the_paper_and_a_tier_moves_them_its_way() -> None:
    assert [case.scenario for case in cases_of(line(), plant(), [], None)] == list(PAPER)
    moving = VELOCITY.moved_over(1.0)
    cases = {name: cases_of(line(), plant(), [moving], tier)[0] for name, tier in TIERS.items()}
    assert {name: case.scenario.move_s for name, case in cases.items()} == {"P": 0.0, "A": 0.0, "A-fast": 0.0, "B": 0.5}
    assert cases["P"].line.control.period_s == 0.001 and cases["P"].plant.recorder.torque_nm == 500.0


def test_without_tier_both_files_hold_and_a_move_is_the_scenarios() -> None:
    own = line()
    stepping, moving = (cases_of(own, plant(), [one], None)[0] for one in (VELOCITY, VELOCITY.moved_over(0.5)))
    assert stepping == Case(VELOCITY, own, plant())
    assert moving.line.moves.shape == "minimum-jerk"
    assert moving.line.moves.speed_rate_m_per_s2 == pytest.approx(1.875 * 0.09 / 0.5)
    assert (moving.line.plc, moving.line.limits, moving.line.control) == (own.plc, own.limits, own.control)


def test_what_does_not_go_together_is_refused_with_every_reason() -> None:
    with pytest.raises(RehearsalRefused) as refused:
        cases_of(line(4), plant(), [], A)
    assert "4 spans, the plant has 6 spans" in refused.value.reasons[0]
    assert "for 6 spans, the line has 4: name the TOML file of a scenario" in refused.value.reasons[1]
    hasty = SHORT.model_copy(update={"change_at_s": 0.004, "tension_after_n": [30.0, 59.5]})
    with pytest.raises(RehearsalRefused, match=r"59.5 N; .*at 0.004 s, before control has begun; allowed: .*, 0.005 s"):
        cases_of(line(2), plant(2), [hasty], None)
    assert cases_of(line(2), plant(2), [SHORT.model_copy(update={"change_at_s": 0.004})], TIER_P)  # periods of 1 ms
    wild = SHORT.model_copy(update={"tension_after_n": [30.0, 59.5], "duration_s": 0.7})
    with pytest.raises(RehearsalRefused, match="the scenario ends before"):
        cases_of(line(2), plant(2), [wild], B)
    with pytest.raises(RehearsalRefused, match=r"59.5 N; allowed: 3 to 59 N; short steps by 35.5 N"):
        cases_of(line(2), plant(2), [wild], None)


def command(folder: Path, *arguments: object, plant_file: Path = S_REAL) -> Result:
    file = folder / "line.toml"
    if not file.exists():
        file.write_text(line_template(6), encoding="utf-8")
    (folder / "scenario.toml").write_text(SHORT_SIX, encoding="utf-8")
    given = ["rehearse", "--line", file, "--plant", plant_file, "--workers", 1, *arguments]
    return CliRunner().invoke(app, [str(argument) for argument in given])


def test_json_is_all_of_standard_output_and_the_file_says_the_same(tmp_path: Path) -> None:
    out = tmp_path / "new" / "r.json"
    scenario = tmp_path / "scenario.toml"
    found = command(tmp_path, "--scenario", scenario, "--json", "--out", out, plant_file=REALISTIC)
    assert found.exit_code == 0, found.output
    result = RehearseResult.model_validate_json(found.stdout)
    assert out.read_text() == found.stdout
    assert (result.plant.name, result.line.name, result.tier, result.llm) == ("realistic", "demo/line-1", None, "off")
    assert result.conditions.period_s == 0.010
    assert len(result.without_term) > 10
    assert [len(one.cases) for one in result.configurations] == [1] * len(DESIGNS)


def test_an_interruption_says_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gateway.cli.rehearse.rehearse", interrupted)
    found = command(tmp_path, "--out", tmp_path / "r.json")
    assert (found.exit_code, found.stdout) == (130, "")
    assert found.stderr == f"interrupted: {tmp_path / 'r.json'} is not written\n"


def test_unsafe_events_are_an_exit_code(tmp_path: Path) -> None:
    """A recorder that allows less than the scenario asks for, and a table that fits the screen."""
    strict = tmp_path / "strict.toml"
    strict.write_text(S_REAL.read_text().replace("tension_max_n = 60.0", "tension_max_n = 31.0"))
    out = tmp_path / "r.json"
    found = command(tmp_path, "--scenario", tmp_path / "scenario.toml", "--out", out, plant_file=strict)
    assert found.exit_code == 1, found.output
    result = RehearseResult.model_validate_json(out.read_text())
    assert result.unsafe_events >= len(DESIGNS)
    assert f"all runs: {result.unsafe_events}" in found.stdout
    table = found.stdout.splitlines()[: 3 + len(DESIGNS)]
    assert table[0].startswith("short-six: the line's own conditions, 10 ms")
    assert [row.split()[0] for row in table[3:]] == [design.name for design in DESIGNS]
    assert max(map(len, table)) <= 80


def test_the_table_says_what_its_figures_do_not(tension: list[ConfigurationResult], tmp_path: Path) -> None:
    example = RehearseResult.model_validate_json((ROOT / "docs/examples/rehearse.json").read_text())
    lqr, lqi, pid, *others = tension
    stopped = lqr.cases[0].model_copy(update={"stopped": "stopped at 0.4 s: tension 2 is missing"})
    result = example.model_copy(
        update={
            "scenarios": [TENSION],
            "without_term": ["effects.slack: the web cannot push"],
            "configurations": [
                lqr.model_copy(update={"cases": [stopped]}),
                lqi.model_copy(update={"refused": "too little delay", "cases": []}),
                pid.model_copy(update={"failures": {"tension": "no luck"}, "cases": []}),
                *others,
            ],
        }
    )
    screen = StringIO()
    print_result(result, tmp_path / "r.json", Console(width=80, file=screen))
    text = screen.getvalue()
    assert max(map(len, text.splitlines()[: 4 + len(others)])) <= 80
    for said in (
        "STOP\n",
        "lqr in tension: stopped at 0.4 s: tension 2 is missing",
        "lqi is not offered: too little delay",
        "pid has no figures in tension: no luck",
        "  effects.slack: the web cannot push",
    ):
        assert said in text


BAD_PLANT = "format = 1\nname = 'x'\nspans = 6\n[web]\nstiffnes_n = 3.0\nlength_m = -1.0\n"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ["--adaptations", 2, "--llm", "qwen"],
            ["--llm qwen", "allowed now: off"],
        ),
        (
            ["--scenario", "nowhere"],
            ["--scenario nowhere cannot be read", "allowed: tension, velocity, or a TOML file"],
        ),
        (["--adaptations", 6], ["less than or equal to 5"]),
        (["--tier", "C"], ["'P', 'A',", "'A-fast', 'B'"]),
        (["--out", "/proc/r2rgate-nowhere/r.json"], ["--out /proc/r2rgate-nowhere/r.json cannot be written"]),
        (["--out", "/"], ["--out / cannot be written: it is a folder"]),
    ],
)
def test_refusals_say_what_is_allowed(arguments: list[object], says: list[str], tmp_path: Path) -> None:
    found = command(tmp_path, *arguments)
    assert found.exit_code == 2, found.output
    assert found.stdout == ""
    for text in says:
        assert text in found.stderr


def test_line_and_plant_files_are_refused_with_every_reason(tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text(BAD_PLANT)
    found = command(tmp_path, plant_file=bad)
    assert found.exit_code == 2
    assert "did you mean stiffness_n?" in found.stderr and "web.length_m: is -1.0" in found.stderr
    assert f"{tmp_path / 'none.toml'} cannot be read" in command(tmp_path, plant_file=tmp_path / "none.toml").stderr
    (tmp_path / "line.toml").write_text(line_template(4), encoding="utf-8")
    found = command(tmp_path)
    assert found.exit_code == 2 and "the line has 4 spans, the plant has 6 spans" in found.stderr
    (tmp_path / "line.toml").write_text(line_template(6).replace("torque_nm = 60.0", "torqe_nm = -60.0"))
    found = command(tmp_path)
    assert found.exit_code == 2 and "line.toml:" in found.stderr and "torque_nm" in found.stderr

"""The judge of the gate's judge, against closed forms, scipy and the simulated line."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gateway.cli.stepped import run_scenario
from gateway.control.design import (
    design_lqg,
    design_lqi,
    design_lqr,
    design_pid,
    design_scheduled,
    lqg_weights,
    task_of,
)
from gateway.core.controller import Controller
from gateway.core.scenario import TENSION
from tests.bench.gate_mutations import scaled_all
from tests.closed_loop.recorded import demonstration_line, real_plant
from tests.closed_loop.truths import altered
from tests.independent import truth_kernel
from tests.independent.gate_judge import GateJudge
from tests.independent.runs import Case, simulated
from tests.independent.truth import FloatArray, Truth, equilibrium, plain_truth, stacked, truth_of, with_unruly_effects

LINE = demonstration_line()
TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])
STEP_S = truth_kernel.STEP_S


def quiet(**effects: Any) -> Truth:
    return replace(plain_truth(real_plant(), quiet=True), **effects)


def driven(truth: Truth, torque_nm: FloatArray, steps: int, unwind: float = 0.05):  # noqa: ANN201
    """The line from its equilibrium with torques that are sent at once, and its tensions (steps, n)."""
    whole, n = stacked([truth]), truth.n
    line = truth_kernel.begin(whole, 0, TENSION_N, unwind)
    truth_kernel.send(whole, 0, line, 0, torque_nm, 0, 0, 10, np.ones(n))
    found = np.empty((steps, n))
    for step in range(steps):
        truth_kernel.advance(whole, 0, line, step, unwind, np.zeros(n), np.zeros(n), 60.0)
        found[step] = line.tension_n
    return line, found


def test_a_line_at_its_equilibrium_stays_there() -> None:
    truth = quiet(coulomb_nm=np.full(6, 1.5), gap_rad=np.full(6, 1e-3), torque_lag_s=0.005, cell_lag_s=0.008)
    _, torque = equilibrium(truth, TENSION_N, 0.05)
    line, found = driven(truth, torque, 1000)
    assert np.abs(found - TENSION_N).max() < 1e-9
    assert np.abs(line.cell_n - TENSION_N).max() < 1e-9


def test_the_equations_against_an_integrator_with_tight_tolerances() -> None:
    truth, unwind = quiet(), 0.05
    speed, torque = equilibrium(truth, TENSION_N, unwind)
    torque = torque + np.array([2.0, -1.0, 0.5, 0.0, -2.0, 1.0])

    def rate(_: float, x: FloatArray) -> FloatArray:
        T, v = np.concatenate(([0.0], x[:6], [0.0])), np.concatenate(([unwind], x[6:]))
        stretched = (2200.0 * np.diff(v) + T[:6] * v[:6] - T[1:7] * v[1:]) / 1.2
        return np.concatenate((stretched, 0.035**2 * np.diff(T)[1:] - 15.0 * v[1:] + 0.035 * torque))

    exact = solve_ivp(rate, (0.0, 1.0), np.concatenate((TENSION_N, speed)), "DOP853", rtol=1e-10, atol=1e-12)
    line, _ = driven(truth, torque, 1000, unwind)
    assert np.abs(line.tension_n - exact.y[:6, -1]).max() < 1e-4
    assert np.abs(exact.y[:6, -1] - TENSION_N).max() > 5.0


def test_torque_follows_its_command_with_a_lag() -> None:
    _, torque = equilibrium(quiet(), TENSION_N, 0.05)
    line, _ = driven(quiet(torque_lag_s=0.005), torque + 4.0, 7)
    assert line.drive_nm - torque == pytest.approx(4.0 * (1.0 - np.exp(-7.0 / 5.0)), rel=1e-9)


def test_dry_friction_slows_a_roller_by_its_torque() -> None:
    truth = quiet(coulomb_nm=np.full(6, 2.0))
    _, torque = equilibrium(quiet(), TENSION_N, 0.05)
    line, _ = driven(truth, torque, 1)
    before, _ = equilibrium(quiet(), TENSION_N, 0.05)
    assert (line.speed_m_per_s - before) / STEP_S == pytest.approx(-2.0 * 0.035, rel=0.02)


def test_a_roller_out_of_true_modulates_tension_as_its_circumference() -> None:
    """With rollers that nothing slows the web is stretched by epsilon R sin(phi): EA/L of it is tension."""
    truth = quiet(eccentricity=np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 5e-3]), inertia_kg_m2=np.full(6, 1e9))
    _, torque = equilibrium(truth, TENSION_N, 0.05)
    _, found = driven(truth, torque, 4400)
    swing = 0.5 * np.ptp(found[:, 5])
    assert swing == pytest.approx(2200.0 / 1.2 * 5e-3 * 0.035, rel=0.02)
    assert np.ptp(found[:, :5]) == pytest.approx(np.ptp(TENSION_N[:5]), abs=1e-6)


def test_a_drive_that_turns_round_flies_through_its_gap() -> None:
    truth = quiet(gap_rad=np.full(6, 4e-3), drive_inertia_kg_m2=np.full(6, 0.05))
    whole, n = stacked([truth]), 6
    line = truth_kernel.begin(whole, 0, TENSION_N, 0.05)
    truth_kernel.send(whole, 0, line, 0, np.full(n, -5.0), 0, 0, 10, np.ones(n))
    free = 0
    for step in range(100):
        truth_kernel.advance(whole, 0, line, step, 0.05, np.zeros(n), np.zeros(n), 60.0)
        free += int((line.flank == 0).all())
    assert (line.flank == -1).all()
    assert free == pytest.approx(1e3 * np.sqrt(2.0 * 4e-3 * 0.05 / 5.0), abs=1.5)


def test_load_cells_follow_with_their_lag() -> None:
    truth = quiet(cell_lag_s=0.008)
    whole = stacked([truth])
    line = truth_kernel.begin(whole, 0, TENSION_N, 0.05)
    line.cell_n[:] = TENSION_N - 3.0
    _, torque = equilibrium(truth, TENSION_N, 0.05)
    truth_kernel.send(whole, 0, line, 0, torque, 0, 0, 10, np.ones(6))
    for step in range(12):
        truth_kernel.advance(whole, 0, line, step, 0.05, np.zeros(6), np.zeros(6), 60.0)
    assert TENSION_N - line.cell_n == pytest.approx(3.0 * np.exp(-12.0 / 8.0), rel=1e-9)


def test_a_late_command_comes_a_period_later_unless_it_is_overtaken() -> None:
    truth = quiet(late_share=0.5)
    whole = stacked([truth])
    line = truth_kernel.begin(whole, 0, TENSION_N, 0.05)
    late, in_time = np.zeros(6), np.ones(6)
    sent = [(np.full(6, 1.0), late), (np.full(6, 2.0), in_time), (np.full(6, 3.0), late), (np.full(6, 4.0), late)]
    seen: list[float] = []
    for step in range(60):
        if step % 10 == 0 and step // 10 < len(sent):
            torque, chance = sent[step // 10]
            truth_kernel.send(whole, 0, line, step // 10, torque, step, 4, 10, chance)
        truth_kernel.advance(whole, 0, line, step, 0.05, np.zeros(6), np.zeros(6), 60.0)
        if not seen or seen[-1] != line.command_nm[0]:
            seen.append(float(line.command_nm[0]))
            at = step
    assert seen[1:] == [2.0, 3.0, 4.0], "the first was overtaken by the second"
    assert at == 30 + 4 + 10


def test_a_sample_is_old_by_its_jitter_and_rounded() -> None:
    truth = quiet(jitter_s=1e-3, tension_step_n=0.5, speed_step_m_per_s=0.0)
    whole = stacked([truth])
    line = truth_kernel.begin(whole, 0, TENSION_N, 0.05)
    line.cell_before_n[:], line.cell_n[:] = 20.0, 24.0
    seen = np.empty(12)
    truth_kernel.sample(whole, 0, line, 0.6, np.zeros(12), seen)
    assert seen[:6] == pytest.approx(21.5), "24 less 0.6 of 4 is 21.6, on a grid of 0.5"


def a_case(speed: float = 0.03, step_n: float = 12.0) -> Case:
    setpoints = np.tile(TENSION_N, (300, 1))
    setpoints[50:, 2] += step_n
    unwind = np.where(np.arange(300) < 150, speed, speed + 0.03)
    return Case("step", setpoints, unwind, np.zeros((300, 6)), 50, 50)


def all_laws() -> dict[str, Controller]:
    task = task_of(LINE)
    late = replace(task, latency_s=0.013)
    lqi, slow = design_lqi(task), design_pid(task)
    return {
        "lqi": lqi, "lqg": design_lqg(late), "lqr": design_lqr(task),
        "draw": lqi.model_copy(update={"draw_spans": [3]}),
        "pid": slow.model_copy(update={"gain_derivative": (0.02 * np.eye(6)).tolist()}),
        "scheduled": design_scheduled(task, design_lqi, [0.02, 0.08]),
    }  # fmt: skip


@pytest.mark.parametrize("name", ["lqi", "lqg", "lqr", "pid", "draw", "scheduled"])
def test_laws_ask_for_what_the_products_laws_ask_for(name: str) -> None:
    """Through saturation and rate limit, with noise and every effect. Schedules go from node to node without a grid."""
    config = all_laws()[name]
    truth = with_unruly_effects(truth_of(real_plant("realistic")), np.random.default_rng(1))
    traces: list[FloatArray] = []
    for slowly in (False, True):
        simulated(config, [truth], [a_case(step_n=20.0)], LINE.limits, 3, slowly=slowly, traced=traces)
    most = np.abs(traces[0] - traces[1]).max()
    assert most < (0.1 if name == "scheduled" else 1e-7)


@pytest.mark.long
def test_a_closed_loop_is_that_of_the_simulated_line() -> None:
    nothing = {"tension_noise_n": 0.0, "speed_noise_m_per_s": 0.0}
    plant = altered(real_plant(), {"sensors": nothing, "rollers": {"disturbance_m_per_s2": 0.0}})
    scenario = TENSION.model_copy(update={"duration_s": 3.0})
    config = design_lqi(task_of(LINE))
    run = run_scenario(LINE, config, plant, scenario, 0)
    times = LINE.control.period_s * np.arange(300)
    setpoints = scenario.setpoints_n(times)
    case = Case("tension", setpoints, np.full(300, 0.01), np.zeros((300, 6)), 100, 50)
    traces: list[FloatArray] = []
    simulated(config, [plain_truth(plant, quiet=True)], [case], LINE.limits, 0, traced=traces)
    ours, theirs = traces[0][1:, :6], run.tension_n[np.searchsorted(run.time_s, times[1:] - 1e-9)]
    assert np.abs(ours - theirs).max() < 1e-3
    assert np.ptp(ours) > 20.0


def test_a_good_design_is_safe_and_fragile_ones_are_not() -> None:
    truth = with_unruly_effects(truth_of(real_plant()), np.random.default_rng(2))
    task = task_of(LINE)
    lqi, pid = design_lqi(task), design_pid(task)
    judge = GateJudge(LINE, truth, pid, pid, 0.1, 5)
    assert judge.unsafe(lqi) == ""
    assert judge.of(lqi).metrics is not None
    assert judge.of(pid).why_not_good == "nothing is better by 3 %"
    weights = replace(lqg_weights(task), disturbance_nm_per_sqrt_s=60.0, torque_per_nm2=0.002, roller_noise=20.0)
    assert judge.unsafe(design_lqg(task, weights))
    assert "runs away" in judge.unsafe(scaled_all(lqi, -1.0)) or "tension" in judge.unsafe(scaled_all(lqi, -1.0))


def test_a_roller_that_runs_too_fast_in_small_moves_is_unsafe_and_one_in_moves_that_the_loop_refuses_is_not() -> None:
    """The largest steps take rollers of a line for 0.06 m/s beyond 0.09 m/s under any law, small ones do not."""
    limits = LINE.limits.model_copy(update={"speed_max_m_per_s": 0.06})
    line = LINE.model_copy(update={"limits": limits})
    config = design_lqi(task_of(LINE))
    judge = GateJudge(line, quiet(), config, config, 0.05, 3)
    case = next(one for one in judge.cases if one.name == "most-up-and-down")
    found = simulated(config, [judge.truth], [case], limits, 3, latency_s=0.01)
    assert found.roller_m_per_s.max() > judge.roller_most_m_per_s == 0.09
    assert judge.too_fast(config, judge.truth, case, 0.01, 0, found) == ""
    change = next(one for one in judge.cases if one.name == "step-and-speed")  # half of its speed comes with the move
    found = simulated(config, [judge.truth], [change], limits, 3, latency_s=0.01)
    assert judge.too_fast(config, judge.truth, change, 0.01, 0, found) == ""
    judge.roller_most_m_per_s = 0.9 * float(case.unwind_m_per_s.max())  # the web itself is too fast
    assert "a roller runs at" in judge.too_fast(config, judge.truth, case, 0.01, 0, found)
    assert np.allclose(
        case.smaller(0.5).tension_n[-1] + case.smaller(0.5).tension_n[0], case.tension_n[-1] + case.tension_n[0]
    )

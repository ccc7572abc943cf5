"""What the control benchmark rests on: its plants, its two forms of MPC's problem, what charts show, its tables."""

import numpy as np
import pytest

from gateway.cli.report import Table
from gateway.cli.tiers import TIERS
from gateway.control.design import MpcWeights, design_mpc
from gateway.core.scenario import TENSION
from sim_plant.plant import load_plant
from tests.bench.control_growth import subject
from tests.bench.control_plants import MOST_FRICTION_NM, SPREAD, TEST, random_plant
from tests.bench.control_rollouts import course_of
from tests.bench.control_runs import TRACE_S, Bound, Job, bound, plant_named, run
from tests.bench.control_tables import Given, markdown, slug, told
from tests.bench.control_tries import InteriorPoint, SparseForm, problems
from tests.bench.oracle import by_piqp


def test_random_plants_are_in_the_box_and_the_same_every_time():
    base = load_plant("sim_plant/plants/s_sim.toml").parameters()
    for seed in TEST:
        found = random_plant(seed).parameters()
        for name, spread in SPREAD.items():
            ratios = getattr(found, name) / getattr(base, name)
            assert np.ptp(ratios) == 0.0 and abs(ratios[0] - 1.0) <= spread
        assert (found.friction_nms_per_rad * 0.1 / found.radius_m <= MOST_FRICTION_NM).all()
    assert random_plant(TEST[0]) == random_plant(TEST[0]) != random_plant(TEST[1])
    assert random_plant(TEST[0], 20).parameters().n == 20


def test_the_other_boundary_has_an_equilibrium_without_torque_of_the_web():
    plant = plant_named("s_real", "continued", "velocity").parameters()
    assert (plant.tension_before_n, plant.tension_after_n) == (30.0, 30.0)
    assert plant_named("s_real", "continued", "tension").parameters().tension_after_n == 32.0


@pytest.mark.parametrize("limit", [10.0, 0.0])
def test_sparse_and_condensed_are_the_same_problem(limit):
    one = subject(3)
    config = design_mpc(one.task, MpcWeights(tension_limit_per_n2=limit), (1, 1, 2, 3))
    config = config.model_copy(update={"tension_max_n": 43.0})  # below the set-point: the slack is needed
    exact, form = InteriorPoint(), SparseForm(config)
    exact.prepare(config)
    largest, states = 0.0, 9 * config.horizon
    for met in problems(config, one.task, one.case.model_copy(update={"duration_s": 0.8}))[45:]:
        lower, upper = form.bounds(met)
        none = np.zeros(form.P.shape[0])
        solution = by_piqp(
            form.P, none, form.A[:states], lower[:states], form.A[states:], lower[states:], upper[states:]
        )
        found = exact.solve(met)
        assert np.allclose(form.first(solution), found, atol=0.01)  # the optimum is flat
        largest = max(largest, np.abs(found).max())
    assert largest > 20.0  # the step is in it


def test_the_oracle_is_drawn_on_the_grid_of_the_runs():
    best = bound(Bound("A", "tension", "s_sim"))
    tension = best.trace.tension_n
    assert tension.shape == best.trace.torque_nm.shape == (len(TRACE_S), 6)
    before = TRACE_S < TENSION.change_at_s + 0.010  # the latency
    assert np.allclose(tension[before], TENSION.tension_n, atol=1e-6)
    assert np.allclose(tension[TRACE_S > 4.0], TENSION.tension_end_n, atol=0.1)


def test_a_run_is_judged_and_drawn():
    found = run(Job("A", "tension", "LQI", "s_sim", "s_real", 0))
    assert found.unsafe == 0 and 1.8 < found.rmse_n < 2.1
    assert found.trace is not None and found.trace.tension_n.shape == (len(TRACE_S), 6)
    assert found.trace.tension_n[0, 2] == pytest.approx(20.0, abs=0.5)
    assert found.trace.tension_n[-1, 2] == pytest.approx(44.0, abs=0.5)


def test_a_course_changes_at_its_period():
    course = course_of(TENSION, 0.01, 2.0)
    assert (course.periods, course.changed) == (200, 100)
    assert course.tension_n[99, 2] == 20.0 and course.tension_n[100, 2] == 44.0


def test_tables_say_what_there_is():
    assert slug("A-fast", "MPC + observer", "s_sim") == "a_fast_mpc_observer_s_sim"
    assert [told(value) for value in (1.23456, float("nan"), float("inf"))] == ["1.235", "–", "never"]
    table = Table("C", ("Law", "RMSE, N"), (("a|b", "1.0"),), frozenset({1}), ("All", ""), "Note.")
    assert markdown(table).splitlines() == [
        "**C**", "", "| Law | RMSE, N |", "| --- | ---: |", "| a/b | 1.0 |", "| All |  |", "", "Note.",
    ]  # fmt: skip
    given = Given("make", "2026-11-20T09:41:07+00:00", (), (), 20, 100)
    assert len(given.seeds_of(TIERS["P"], "LQR")) == len(given.seeds_of(TIERS["A"], "PID")) == 20
    assert len(given.seeds_of(TIERS["P"], "PID")) == 5

"""What the control benchmark rests on: its plants, its two forms of MPC's problem, what charts show, its tables."""

import numpy as np
import pytest

from gateway.cli.report import Table
from gateway.cli.tiers import TIERS
from gateway.control.design import MpcWeights, design_mpc
from gateway.core.metrics import run_metrics
from gateway.core.scenario import TENSION
from sim_plant.plant import load_plant
from tests.bench.control_adaptation import after_adaptation, rmse_after
from tests.bench.control_adapted import Adaptation, After
from tests.bench.control_growth import subject
from tests.bench.control_plants import MOST_FRICTION_NM, SPREAD, TEST, UNEVEN, random_plant, uneven_plant
from tests.bench.control_rollouts import course_of
from tests.bench.control_runs import CASES, TRACE_S, Best, Bound, Job, Outcome, Trace, bound, plant_named, run
from tests.bench.control_tables import Given, markdown, slug, told
from tests.bench.control_tries import InteriorPoint, SparseForm, problems
from tests.bench.figures import GOALS
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


def test_uneven_plants_are_off_by_each_roller_and_the_web_is_one():
    for seed in TEST[:20]:
        base, found = random_plant(seed).parameters(), uneven_plant(seed).parameters()
        for name in SPREAD:
            ratios = getattr(found, name) / getattr(base, name)
            assert (np.abs(ratios - 1.0) <= UNEVEN).all()
            assert np.ptp(ratios) == 0.0 if name == "stiffness_n" else np.ptp(ratios) > 0.01
        assert (found.friction_nms_per_rad * 0.1 / found.radius_m <= MOST_FRICTION_NM).all()
    assert uneven_plant(TEST[0]) == uneven_plant(TEST[0])
    assert plant_named("uneven-10000").name == "uneven-10000"


def outcome(rmse_n, unsafe=0, stopped=None):
    time_s = np.arange(0.0, 3.0, 0.01)
    setpoint = np.full((len(time_s), 6), 20.0)
    metrics = run_metrics(time_s, setpoint + rmse_n / np.sqrt(6.0), setpoint, setpoint, 1.0)
    return Outcome(metrics, unsafe, stopped=stopped)


class Told:
    """In place of runs: what each would have brought."""

    def every(self, function, asked: list[Adaptation], title):
        return [self.rounds(one) for one in asked]

    def rounds(self, one: Adaptation) -> list[After]:
        if (one.tier, one.truth, one.seed) == ("A", "s_real", 1):
            return [After(5.0, "", "aborted", (), 1, {})]
        cases = {case: outcome(2.0, unsafe=int(one.truth == "stressed")) for case in CASES}
        later = cases | {"velocity": outcome(9.0, stopped="stopped at 2 s")} if one.truth == "realistic" else cases
        return [After(5.0, "as in the paper", "", (), 0, cases), After(4.9, "as in the paper", "", (), 0, later)]

    def of(self, jobs: list[Job], title):
        return [outcome(1.6) for _ in jobs]

    def best(self, asked: list[Bound], title=""):
        return [Best(1.25, Trace(np.empty(0), np.empty(0))) for _ in asked]


def test_what_comes_after_adaptation_is_summed_up_and_every_goal_of_it_has_its_figure():
    given = Given("make", "2026-11-20T09:41:07+00:00", tuple(TIERS.values()), ("LQI",), 2, 3)
    part = after_adaptation(given, Told())
    found = {name: (value, n) for name, value, _, n in part.figures}
    assert found["a_adapt1_s_real_tension_to_oracle"] == (pytest.approx(1.6), 1)
    assert found["a_adapt1_s_real_without_result"] == (2.0, 4)
    assert found["b_adapt2_s_real_velocity_to_truth"] == (pytest.approx(1.25), 2)
    assert found["adapted_uneven_b_adapt2_velocity_to_truth_p95"] == (pytest.approx(1.25), 3)
    assert found["realistic_a_adapt2_tension_n"] == (pytest.approx(2.0), 2)
    assert found["realistic_a_adapt2_velocity_n"][1] == 0  # a line that was stopped has no RMSE
    assert part.unsafe == 1 + 2 * 2 * 2  # of one experiment, and of two seeds, rounds and cases
    assert rmse_after(part)["P", "velocity", 2] == pytest.approx(2.0)
    names = {*found, "adapted_unsafe_events"}
    assert [name for name in GOALS["control"] if "adapt" in name and name not in names] == []
    tables = {table.caption: table for table in part.section.tables}
    assert len(tables) == 4 + 4 + 1
    assert all(len(row) == len(table.heads) for table in tables.values() for row in table.rows)


def test_the_other_boundary_has_an_equilibrium_without_torque_of_the_web():
    plant = plant_named("s_real", "continued", "velocity").parameters()
    assert (plant.tension_before_n, plant.tension_after_n) == (30.0, 30.0)
    assert plant_named("s_real", "continued", "tension").parameters().tension_after_n == 32.0


@pytest.mark.parametrize("limit", [10.0, 0.0])
def test_sparse_and_condensed_are_the_same_problem(limit):
    one = subject(3)
    config = design_mpc(one.task, MpcWeights(tension_limit_per_n2=limit), (1, 1, 2, 3))
    config = config.model_copy(update={"tension_min_n": 39.5})  # where most set-points are lower: the slack is needed
    exact, form = InteriorPoint(), SparseForm(config)
    exact.prepare(config)
    largest, slack_n, states = 0.0, 0.0, 9 * config.horizon
    for met in problems(config, one.task, one.case.model_copy(update={"duration_s": 0.8}))[45:]:
        lower, upper = form.bounds(met)
        none = np.zeros(form.P.shape[0])
        solution = by_piqp(
            form.P, none, form.A[:states], lower[:states], form.A[states:], lower[states:], upper[states:]
        )
        found = exact.solve(met)
        assert np.allclose(form.first(solution), found, atol=0.01)  # the optimum is flat
        largest = max(largest, np.abs(found).max())
        slack_n = max(slack_n, np.abs(form.slack_n(solution)).max(initial=0.0))
    assert largest > 20.0  # the step is in it
    assert (slack_n > 0.01) == (limit > 0.0)


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

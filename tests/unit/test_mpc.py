"""MPC against a second solver, against the linear law that it is without limits, and against bad input."""

import json

import clarabel
import numpy as np
import pytest
from scipy.sparse import csc_matrix

from gateway.control.design import DesignLimits, DesignRefused, DesignTask, MpcWeights, design_lqg, design_mpc
from gateway.control.design.lq import LqgWeights
from gateway.control.law import Measured
from gateway.control.laws import make_law, untimed
from gateway.control.mpc import Mpc
from gateway.control.mpc_solver import solver_of
from gateway.control.reference import Steady
from gateway.core.controller import ControllerRefused, canonical, parse_controller
from gateway.core.web_model import equilibrium_torque, reference_speeds
from tests.unit.control_support import model

LIMITS = DesignLimits(60.0, 1000.0, 2.0, 60.0, 0.1)


def task(limits=LIMITS, n=6, period_s=0.01, latency_s=0.01, draw=()):
    return DesignTask(model(n), period_s, latency_s, np.full(n, 30.0), 0.05, draw, limits=limits)


def patient(solver="daqp"):
    """Samples at random, each far from the last, take more iterations than a line does from period to period."""
    return untimed(design_mpc(task()).model_copy(update={"most_iterations": 5000, "solver": solver}))


def second_opinion(P, q, A, lower, upper):
    """The same programme by an interior-point method."""
    below, above = np.isfinite(lower), np.isfinite(upper)
    rows = np.vstack((A[above], -A[below]))
    limits = np.concatenate((upper[above], -lower[below]))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    solved = clarabel.DefaultSolver(
        csc_matrix(np.triu(P)), q, csc_matrix(rows), limits, [clarabel.NonnegativeConeT(len(limits))], settings
    ).solve()
    return np.array(solved.x), solved.obj_val


def random_line(generator, n=6):
    """A sample off the set-points by up to 20 N and 0.02 m/s, and the torque that was sent before."""
    theta, setpoint = model(n), generator.uniform(20.0, 40.0, n)
    speed = reference_speeds(theta, setpoint, 0.05)
    torque = equilibrium_torque(theta, setpoint, speed)
    tension = np.clip(setpoint + generator.uniform(-20.0, 20.0, n), 0.0, 60.0)
    return Measured(tension, speed + generator.uniform(-0.02, 0.02, n), 0.05), Steady(setpoint), torque


#: By solver: how far a limit may be left, in Nm or N; how far the cost may be from the best, as a share of it; median
#: and 99th percentile of how far the first torques may be from those of the second solver, in Nm.
CLOSE = {"daqp": (1e-4, 1e-6, 1e-3, 0.01), "osqp": (0.1, 2e-3, 0.02, 1.0)}


@pytest.mark.slow
@pytest.mark.parametrize("solver", CLOSE)
@pytest.mark.parametrize("seed", range(2))
def test_solutions_are_those_of_a_second_solver(solver, seed):
    left, share, median_nm, most_nm = CLOSE[solver]
    law = make_law(patient(solver))
    assert isinstance(law, Mpc)
    P, generator = law.problem.P, np.random.default_rng(seed)
    apart, active = [], 0
    for _ in range(250):
        measured, reference, torque = random_line(generator)
        state = law.engage(measured, reference, torque)
        state.observer.disturbance_nm, state.first = generator.uniform(-2.0, 2.0, 6), None
        decision = law.ask(state, measured, reference)
        assert not decision.fallback
        q, lower, upper = law.problem.vectors(decision.found, reference.tension_n, torque)
        theirs, best = second_opinion(P, q, law.problem.A, lower, upper)
        mine = decision.solution
        rows = law.problem.A @ mine
        assert np.maximum(lower - rows, rows - upper).max() < left
        assert abs(0.5 * mine @ P @ mine + q @ mine - best) < share * abs(best)
        apart.append(float(np.abs(mine[:6] - theirs[:6]).max()))
        rows = law.problem.A @ theirs
        active += bool((np.minimum(rows - lower, upper - rows) < 1e-3).any())
    assert active > 200  # it is limits that are solved for
    assert np.median(apart) < median_nm and np.percentile(apart, 99) < most_nm


@pytest.mark.parametrize("solver", ["daqp", "osqp"])
@pytest.mark.parametrize(
    ("off_n", "off_m_per_s", "needs"),
    [(0.2, 0.0, "no limit"), (6.0, 0.0, "torque limits"), (19.0, 0.2, "tension limits")],
)
def test_no_more_limits_are_looked_at_than_matter(off_n, off_m_per_s, needs, solver):
    """Whichever it does with, the solution is that of the programme with all of them."""
    law = make_law(patient(solver))
    generator = np.random.default_rng(7)
    P, seen = law.problem.P, 0
    for _ in range(60):
        theta, setpoint = model(6), generator.uniform(22.0, 40.0, 6)
        speed = reference_speeds(theta, setpoint, 0.05)
        torque = equilibrium_torque(theta, setpoint, speed)
        off = generator.uniform(-1.0, 1.0, (2, 6))
        measured = Measured(setpoint + off_n * off[0], speed + off_m_per_s * off[1], 0.05)
        state = law.engage(measured, Steady(setpoint), torque)
        found = law.ask(state, measured, Steady(setpoint)).found
        limits = law.problem.limits(found, setpoint, torque)
        mine, status = solver_of(law.problem, law.config).solve(law.problem.state(found), *limits)
        q, lower, upper = law.problem.vectors(found, setpoint, torque)
        theirs, best = second_opinion(law.problem.P, q, law.problem.A, lower, upper)
        assert abs(0.5 * mine @ P @ mine + q @ mine - best) < 2e-3 * abs(best)
        limited = law.problem.A @ theirs
        limited = np.minimum(limited - lower, upper - limited) < 1e-3
        rows = law.problem.torque_rows
        if needs == "no limit":
            seen += status == "no limit reached" and not limited.any()
        elif needs == "torque limits":
            seen += status == "solved" and bool(limited[:rows].any()) and not limited[rows:].any()
        else:
            seen += status == "solved" and bool(limited[rows:].any()) and np.abs(mine[-6:]).max() > 1e-3
    assert seen > 10


def test_without_limits_it_is_the_linear_law():
    weights = dict(torque_per_nm2=0.01, disturbance_nm_per_sqrt_s=2.0)
    free = task(DesignLimits())
    mpc = make_law(untimed(design_mpc(free, MpcWeights(**weights), (1,) * 10)))
    lqg = make_law(design_lqg(free, LqgWeights(**weights)))
    generator = np.random.default_rng(1)
    for _ in range(20):
        measured, reference, torque = random_line(generator)
        state = lqg.engage(measured, reference, torque)
        for _ in range(3):
            measured, _, _ = random_line(generator)
            linear = lqg.ask(state, measured, reference)
            planned = mpc.ask(
                type(mpc.engage(measured, reference, torque))(state, torque, np.empty((0, 6))), measured, reference
            )
            assert not planned.fallback
            most = 0.05 + 2e-3 * np.abs(linear.torque_nm).max()
            assert np.allclose(planned.torque_nm, linear.torque_nm, atol=most)
            state = lqg.commit(state, linear, linear.torque_nm)


def test_limits_are_kept_and_the_first_torque_is_the_one_before():
    law = make_law(patient())
    blocks = np.array(law.config.blocks)
    # From block to block the torque may go as far as between their middles; within one it stays.
    reach = 10.0 * np.concatenate(([1.0], 0.5 * (blocks[1:] + blocks[:-1])))
    starts = np.concatenate(([0], np.cumsum(blocks)[:-1]))
    generator = np.random.default_rng(2)
    for _ in range(50):
        measured, reference, torque = random_line(generator)
        decision = law.ask(law.engage(measured, reference, torque), measured, reference)
        assert np.allclose(decision.torque_nm, torque, atol=0.3)  # bumpless, as far as it is solved twice alike
        plan = np.vstack((torque, decision.torque_nm - decision.found.bump_nm, decision.plan_nm))
        assert np.abs(plan[1:]).max() <= 60.0 + 0.05
        change = np.abs(np.diff(plan, axis=0)).max(axis=1)
        assert (change[starts] <= reach + 0.05).all()
        assert np.delete(change, starts).max() == 0.0


def test_what_is_not_solved_in_time_is_not_applied():
    config = design_mpc(task()).model_copy(update={"time_limit_s": 1e-9})
    late, law = make_law(config), make_law(untimed(design_mpc(task())))
    measured, reference, torque = random_line(np.random.default_rng(3))
    state = late.engage(measured, reference, torque)
    decision = late.ask(state, measured, reference)
    assert decision.fallback.startswith("held") and (decision.torque_nm == torque).all()
    assert late.commit(state, decision, torque).unsolved == 1
    # With a plan from before, its next move comes first; when it is used up, the linear feedback.
    good = law.ask(law.engage(measured, reference, torque), measured, reference)
    assert good.found is not None
    good.found.bump_nm[:] = 0.0
    state = law.commit(state, good, good.torque_nm)
    moves = len(good.plan_nm)
    assert moves == config.horizon - 1
    for move in range(moves + 2):
        decision = late.ask(state, measured, reference)
        if move < moves:
            assert decision.fallback.startswith("plan") and (decision.torque_nm == good.plan_nm[move]).all()
        else:
            assert decision.fallback.startswith("linear feedback")
        state = late.commit(state, decision, decision.torque_nm)
    assert state.unsolved == moves + 2


@pytest.mark.parametrize(
    ("weights", "blocks", "says"),
    [
        (MpcWeights(torque_per_nm2=0.0), (1, 2), "torque_per_nm2"),
        (MpcWeights(tension_per_n2=float("nan")), (1, 2), "tension_per_n2"),
        (MpcWeights(), (), "horizon"),
        (MpcWeights(), (3, 0), "horizon"),
    ],
)
def test_bad_weights_and_horizons_are_refused(weights, blocks, says):
    with pytest.raises(DesignRefused, match=says):
        design_mpc(task(), weights, blocks)


def test_a_terminal_weight_that_falls_without_end_is_refused():
    config = design_mpc(task(n=2)).model_dump(mode="json")
    parse_controller(json.dumps(config).encode())
    config["weight_terminal"][4][4] -= 1e3
    with pytest.raises(
        ControllerRefused, match=r"not positive semidefinite: its smallest eigenvalue is -\d"
    ) as refused:
        parse_controller(json.dumps(config).encode())
    least = np.linalg.eigvalsh(np.array(config["weight_terminal"])).min()
    assert f"eigenvalue is {least:.4g}" in str(refused.value)


@pytest.mark.parametrize("n", [1, 6, 20])
@pytest.mark.parametrize("draw", [(), (0,)])
def test_every_design_is_read_again(n, draw):
    """Rounding makes no terminal weight of a design look as if it fell."""
    config = design_mpc(task(n=n, draw=draw))
    assert parse_controller(canonical(config)) == config

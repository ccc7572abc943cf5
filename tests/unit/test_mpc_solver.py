"""DAQP in the law: exact, the same whatever was solved before, bounded, and never the wrong number for an answer."""

import numpy as np
import osqp
import pytest
from scipy.sparse import csc_matrix

from gateway.control import mpc_daqp
from gateway.control.design import DesignLimits, DesignTask, design_mpc
from gateway.control.law import Measured
from gateway.control.laws import make_law, untimed
from gateway.control.mpc import Mpc
from gateway.control.mpc_problem import MpcProblem
from gateway.control.mpc_solver import solver_of
from gateway.control.reference import Steady
from gateway.core.controller import ControllerRefused, canonical, config_hash, parse_controller
from gateway.core.web_model import equilibrium_torque, reference_speeds
from tests.independent.programme import exact
from tests.unit.control_support import model

LIMITS = DesignLimits(60.0, 1000.0, 2.0, 60.0, 0.1)


def config_of(n=6, draw=(), **update):
    task = DesignTask(model(n), 0.01, 0.01, np.full(n, 30.0), 0.05, draw, limits=LIMITS)
    return untimed(design_mpc(task)).model_copy(update=update)


def drawn(generator, n, off_n=20.0):
    """A sample off the set-points by up to `off_n` and 0.02 m/s, and the torque that was sent before."""
    setpoint = generator.uniform(20.0, 40.0, n)
    speed = reference_speeds(model(n), setpoint, 0.05)
    torque = equilibrium_torque(model(n), setpoint, speed)
    tension = np.clip(setpoint + generator.uniform(-off_n, off_n, n), 0.0, 60.0)
    return Measured(tension, speed + generator.uniform(-0.02, 0.02, n), 0.05), Steady(setpoint), torque


def asked(law, generator, off_n=20.0):
    """A decision on a drawn sample with a drawn disturbance; and what it was made on."""
    measured, reference, torque = drawn(generator, law.n, off_n)
    state = law.engage(measured, reference, torque)
    state.observer.disturbance_nm, state.first = generator.uniform(-2.0, 2.0, law.n), None
    decision = law.ask(state, measured, reference)
    assert not decision.fallback
    return decision, law.problem.vectors(decision.found, reference.tension_n, torque)


def course(law, generator, periods=30):
    """Torques (periods, n) of a law that engages, on samples that come by themselves."""
    measured, reference, torque = drawn(generator, law.n)
    memory = law.engage(measured, reference, torque)
    found = []
    for _ in range(periods):
        measured, _, _ = drawn(generator, law.n, 8.0)
        decision = law.ask(memory, measured, reference)
        torque = np.clip(decision.torque_nm, torque - 10.0, torque + 10.0)
        memory = law.commit(memory, decision, torque)
        found.append(decision.torque_nm)
    return np.array(found)


@pytest.mark.parametrize(("n", "draw"), [(3, ()), (6, ()), (6, (2,)), (9, ()), (20, ())])
def test_the_solution_is_exact(n, draw):
    law, generator = make_law(config_of(n, draw)), np.random.default_rng(n)
    for _ in range(100):
        decision, (q, lower, upper) = asked(law, generator)
        theirs = exact(law.problem.P, q, law.problem.A, lower, upper, decision.solution)
        assert np.abs(decision.solution - theirs).max() < 1e-5


@pytest.mark.parametrize("count", [150, pytest.param(10_000, marks=[pytest.mark.long, pytest.mark.timeout(1200)])])
def test_osqp_comes_to_the_same(count):
    """To a thousandth of a Nm, on whatever is drawn, a solver of another kind that is given all the time it takes."""
    law = make_law(config_of())
    assert isinstance(law, Mpc)
    problem, generator = law.problem, np.random.default_rng(5)
    second, none = osqp.OSQP(), np.full(problem.rows, np.inf)
    second.setup(
        csc_matrix(np.triu(problem.P)), np.zeros(problem.variables), csc_matrix(problem.A), -none, none, verbose=False,
        eps_abs=1e-7, eps_rel=1e-9, max_iter=200_000, check_termination=25, adaptive_rho_interval=50,
    )  # fmt: skip
    limited = 0
    for _ in range(count):
        decision, (q, lower, upper) = asked(law, generator, generator.choice([0.5, 5.0, 20.0]))
        second.update(q=q, l=lower, u=upper)
        solved = second.solve(raise_error=False)
        assert solved.info.status_val == osqp.SolverStatus.OSQP_SOLVED
        torques = problem.torque_variables
        assert np.abs(decision.solution[:torques] - solved.x[:torques]).max() < 1e-3
        rows = problem.A @ decision.solution
        limited += bool((np.minimum(rows - lower, upper - rows) < 1e-6).any())
    assert limited > count // 2


@pytest.mark.parametrize("solver", ["daqp", "osqp"])
def test_what_was_solved_before_changes_nothing(solver):
    """To the bit: a law that engages again is a new one."""
    config = config_of(solver=solver)
    used = make_law(config)
    for seed in range(3):
        course(used, np.random.default_rng(seed))
    again, fresh = (course(law, np.random.default_rng(11)) for law in (used, make_law(config)))
    assert again.tobytes() == fresh.tobytes()


def test_taking_over_sets_nothing_up(monkeypatch):
    """It is called inside a control period: all that is slow is in the constructor."""
    law, generator = make_law(config_of()), np.random.default_rng(1)
    course(law, generator, 5)

    def never(*_, **__):
        raise AssertionError("a solver is set up inside a period")

    monkeypatch.setattr(mpc_daqp.daqp, "Model", never)
    monkeypatch.setattr(osqp, "OSQP", never)
    assert np.isfinite(course(law, generator, 5)).all()


def test_a_second_loop_does_not_disturb_the_first():
    config = config_of()
    alone = course(make_law(config), np.random.default_rng(3))
    first, other = make_law(config), make_law(config)
    course(other, np.random.default_rng(4))
    assert course(first, np.random.default_rng(3)).tobytes() == alone.tobytes()


def test_few_iterations_are_a_bound():
    """What they do not suffice for is not answered, and the next period goes on from where they ended."""
    law, patient = make_law(config_of(most_iterations=9)), make_law(config_of())
    generator, missed, found = np.random.default_rng(2), 0, 0
    for _ in range(20):
        measured, reference, torque = drawn(generator, 6)
        state = law.engage(measured, reference, torque)
        if not state.first.fallback:
            continue
        missed += 1
        assert state.first.fallback == "held: linear feedback: out of iterations"
        state.first = None
        for _ in range(40):  # on the very same problem
            decision = law.ask(state, measured, reference)
            if not decision.fallback:
                break
        whole = patient.ask(patient.engage(measured, reference, torque), measured, reference)
        found += not decision.fallback and np.allclose(decision.solution, whole.solution, atol=1e-5)
    assert missed > 10 and found == missed


@pytest.mark.parametrize("of", ["tension_n", "speed_m_per_s"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_has_no_solution(of, value):
    """And it leaves nothing behind in the solver."""
    law = make_law(config_of())
    measured, reference, torque = drawn(np.random.default_rng(0), 6)
    memory = law.engage(measured, reference, torque)
    memory.first = None
    expected = law.ask(memory, measured, reference).torque_nm
    spoiled = Measured(measured.tension_n.copy(), measured.speed_m_per_s.copy(), 0.05)
    getattr(spoiled, of)[1] = value
    with np.errstate(invalid="ignore"):
        decision = law.ask(memory, spoiled, reference)
    assert decision.fallback and not len(decision.solution)
    assert np.allclose(law.ask(memory, measured, reference).torque_nm, expected, atol=1e-9)


@pytest.mark.parametrize("solver", ["daqp", "osqp"])
def test_limits_that_are_no_number_have_no_solution(solver):
    config = config_of(solver=solver)
    problem = MpcProblem(config)
    x, none = np.zeros(problem.C.shape[1]), np.full(problem.rows, np.nan)
    assert solver_of(problem, config).solve(x, none, none)[0] is None


def test_weights_without_one_solution_are_refused_at_construction():
    """One tension is weighed, and torques next to nothing: most of what they could be is as good."""
    none = [[0.0] * 9 for _ in range(9)]
    flat = {"weight_state": [1.0, *[0.0] * 5], "weight_torque": [1e-25] * 3, "weight_terminal": none}
    config = config_of(3)
    with pytest.raises(ControllerRefused, match="without one solution"):
        make_law(config.model_copy(update=flat))


@pytest.mark.parametrize("factor", [1e-6, 1.0, 1e6])
def test_the_unit_of_the_weights_changes_nothing(factor):
    """DAQP takes for 0 what is small in itself."""
    config = config_of()
    scaled = config.model_copy(
        update={
            "weight_state": [factor * w for w in config.weight_state],
            "weight_torque": [factor * w for w in config.weight_torque],
            "weight_terminal": (factor * np.array(config.weight_terminal)).tolist(),
            "weight_tension_limit": factor * config.weight_tension_limit,
        }
    )
    one, other = (course(make_law(c), np.random.default_rng(9)) for c in (config, scaled))
    assert np.abs(one - other).max() < 1e-5


def test_a_configuration_without_a_solver_has_the_hash_it_had():
    config = design_mpc(DesignTask(model(2), 0.01, 0.01, np.full(2, 30.0), 0.05, (), limits=LIMITS))
    assert config.solver == "daqp" and b"solver" not in canonical(config)
    assert parse_controller(canonical(config)) == config
    other = config.model_copy(update={"solver": "osqp"})
    assert parse_controller(canonical(other)).solver == "osqp"
    assert config_hash(other) != config_hash(config)
    with pytest.raises(ControllerRefused, match="solver"):
        parse_controller(canonical(config).replace(b'"kind":"mpc"', b'"kind":"mpc","solver":"piqp"'))

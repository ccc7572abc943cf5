"""What MPC and the designs find, against software that knows nothing of them.

MPC's solutions against an interior-point method, on random states; the discrete designs against python-control, from
the continuous model on: its hold, the dead time put together here, its Riccati equations.
"""

from dataclasses import dataclass

import clarabel
import control
import numpy as np
from scipy.sparse import csc_matrix

from gateway.cli.rehearse_designs import truth_of
from gateway.cli.report import Section, Table
from gateway.cli.tiers import A as TIER
from gateway.control.design import DesignTask, LqiWeights, LqrWeights, MpcWeights, design_lqi, design_lqr, design_mpc
from gateway.control.design.task import linear
from gateway.control.law import Measured
from gateway.control.laws import untimed
from gateway.control.mpc import Mpc
from gateway.control.mpc_problem import MpcProblem
from gateway.control.reference import Steady
from gateway.core.controller_laws import MpcConfig
from gateway.core.signals import FloatArray
from gateway.core.web_model import equilibrium_torque, reference_speeds
from tests.bench.control_plants import TEST
from tests.bench.control_runs import CASES, plant_named, task_on
from tests.bench.control_tables import Given, Part, numeric
from tests.bench.control_tries import Condensed, Met

STATES = 1000
PLANTS = ("s_sim", "s_real", *(f"random-{seed}" for seed in TEST[:20]))


@dataclass
class Apart:
    """Greatest differences to the second solver, over all states."""

    cost: float = 0.0  #: relative
    torque_nm: float = 0.0  #: of the first torques
    torque: float = 0.0  #: relative to the greatest of the first torques
    active: int = 0  #: states in which a limit is reached


def checks(given: Given) -> Part:
    tight = Condensed("tight", eps_abs=1e-9, eps_rel=1e-9, max_iter=200_000, check_termination=25)
    rows, figures = [], list[tuple[str, float, str, int]]()
    for name, which, solver in (("the law, DAQP", "law", None), ("OSQP, to 1e-9", "tight", tight)):
        apart = check_mpc(solver)
        rows.append((name, f"{apart.cost:.1e}", f"{apart.torque_nm:.1e}", f"{apart.torque:.1e}", str(apart.active)))
        figures.append((f"check_mpc_{which}_cost", apart.cost, "", STATES))
        figures.append((f"check_mpc_{which}_torque", apart.torque, "", STATES))
    heads = ("Solved as", "cost, relative", "first torque, Nm", "first torque, relative", "at a limit")
    mpc = Table(
        f"MPC on {STATES:,} random states against clarabel: the worst difference",
        heads,
        tuple(rows),
        numeric(heads, 1),
        note=given.made(
            "S_sim, tier A: tensions up to 20 N, speeds up to 0.02 m/s, disturbances up to 2 Nm off. Torques relative "
            "to the greatest first torque of the state. The law begins each state without a solution before."
        ),
    )
    worst = {name: max(of[name] for of in map(check_designs, PLANTS)) for name in check_designs(PLANTS[0])}
    figures += [(f"check_{name}", value, "", len(PLANTS)) for name, value in worst.items()]
    heads = ("Design", "worst relative difference")
    named = {
        "hold": "zero-order hold (sample_system)", "lqr": "LQR gain (dlqr)", "lqi": "LQI gain (dlqr)",
        "kalman": "observer gain (dlqe)", "riccati": "Riccati equation of the LQR: what is left of it",
    }  # fmt: skip
    designs = Table(
        "Discrete designs against python-control",
        heads,
        tuple((named[name], f"{value:.1e}") for name, value in worst.items()),
        numeric(heads, 1),
        note=given.made(
            f"S_sim, S_real and 20 plants of the ensemble, tier A, python-control {control.__version__}. Without "
            f"slycot it solves Riccati equations by scipy, as the designs do; so what is left of one is given too."
        ),
    )
    return Part(Section("Independent checks", tables=(mpc, designs)), figures)


def check_mpc(solver: Condensed | None) -> Apart:
    """The law, or another solver of the same problems, against clarabel."""
    task = task_on(TIER, CASES["tension"], truth_of(plant_named("s_sim")))
    config = untimed(design_mpc(task))
    law, problem = Mpc(config), MpcProblem(config)
    whole = problem.P
    generator, apart = np.random.default_rng(0), Apart()
    if solver:
        solver.prepare(config)
    for _ in range(STATES):
        met, solution = _drawn(law, task, generator)
        exact, best = by_clarabel(problem, met)
        if solver:
            solution = solver.whole(met)
        first, n = solution[: task.n], task.n
        scale = max(float(np.abs(exact[:n]).max()), 1.0)
        off_nm = float(np.abs(first - exact[:n]).max())
        cost = float(0.5 * solution @ whole @ solution + met.q @ solution)
        apart.cost = max(apart.cost, abs(cost - best) / abs(best))
        apart.torque_nm, apart.torque = max(apart.torque_nm, off_nm), max(apart.torque, off_nm / scale)
        rows = problem.A @ exact
        apart.active += bool((np.minimum(rows - met.lower, met.upper - rows) < 1e-3).any())
    return apart


def _drawn(law: Mpc, task: DesignTask, generator: np.random.Generator) -> tuple[Met, FloatArray]:
    """A state at random, and what the law finds for it."""
    n = task.n
    setpoint = generator.uniform(20.0, 40.0, n)
    speed = reference_speeds(task.model, setpoint, 0.05)
    torque = equilibrium_torque(task.model, setpoint, speed)
    tension = np.clip(setpoint + generator.uniform(-20.0, 20.0, n), 0.0, 60.0)
    measured, reference = Measured(tension, speed + generator.uniform(-0.02, 0.02, n), 0.05), Steady(setpoint)
    state = law.engage(measured, reference, torque)
    state.observer.disturbance_nm, state.first = generator.uniform(-2.0, 2.0, n), None
    decision = law.ask(state, measured, reference)
    if decision.fallback or decision.found is None:
        raise RuntimeError(f"MPC has not solved it: {decision.fallback}")
    q, lower, upper = (v.copy() for v in law.problem.vectors(decision.found, setpoint, torque))
    start = np.concatenate((decision.found.state, decision.found.in_flight_nm.ravel()))
    return Met(q, lower, upper, start, setpoint), decision.solution


def by_clarabel(problem: MpcProblem, met: Met) -> tuple[FloatArray, float]:
    """Solution and cost of a condensed problem. Raises RuntimeError where there is none."""
    below, above = np.isfinite(met.lower), np.isfinite(met.upper)
    rows = np.vstack((problem.A[above], -problem.A[below]))
    limits = np.concatenate((met.upper[above], -met.lower[below]))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    solved = clarabel.DefaultSolver(
        csc_matrix(np.triu(problem.P)),
        met.q,
        csc_matrix(rows),
        limits,
        [clarabel.NonnegativeConeT(len(limits))],
        settings,
    ).solve()
    if "Solved" not in str(solved.status):
        raise RuntimeError(f"clarabel: {solved.status}")
    return np.array(solved.x), float(solved.obj_val)


def check_designs(plant: str) -> dict[str, float]:
    """Relative differences of gains to those of python-control, tier A: a latency of one period."""
    task = task_on(TIER, CASES["tension"], truth_of(plant_named(plant)))
    n, period_s = task.n, task.period_s
    assert task.latency_s == period_s
    A, B = linear(task)
    held = control.sample_system(control.ss(A, B, np.eye(2 * n), np.zeros((2 * n, n))), period_s, "zoh")
    F, G = np.asarray(held.A), np.asarray(held.B)
    late_F = np.block([[F, G], [np.zeros((n, 3 * n))]])
    late_G = np.vstack((np.zeros((2 * n, n)), np.eye(n)))
    weights, integral = LqrWeights(), LqiWeights()  # as they are: what they follow from is not looked at here
    lqr, lqi = design_lqr(task, weights), design_lqi(task, integral)
    Q, R = np.diag([weights.tension_per_n2] * n + [0.0] * 2 * n), weights.torque_per_nm2 * np.eye(n)
    theirs, P, _ = control.dlqr(late_F, late_G, Q, R)
    summed = np.hstack((period_s * np.eye(n), np.zeros((n, 2 * n)), np.eye(n)))
    F_i = np.vstack((np.hstack((late_F, np.zeros((3 * n, n)))), summed))
    Q_i = np.diag([integral.tension_per_n2] * n + [0.0] * 2 * n + [integral.integral_per_n2s2] * n)
    theirs_i, _, _ = control.dlqr(F_i, np.vstack((late_G, np.zeros((n, n)))), Q_i, integral.torque_per_nm2 * np.eye(n))
    mpc = design_mpc(task, MpcWeights())
    own = np.hstack((lqr.gain_state, lqr.gain_input))
    own_i = np.hstack((lqi.gain_state, lqi.gain_input, lqi.gain_integral))
    K = np.linalg.solve(R + late_G.T @ P @ late_G, late_G.T @ P @ late_F)
    left = late_F.T @ P @ late_F - P - late_F.T @ P @ late_G @ K + Q
    return {
        "hold": max(_apart(mpc.predictor.transition, F), _apart(mpc.predictor.inputs[1], G)),
        "lqr": _apart(own, theirs),
        "lqi": _apart(own_i, theirs_i),
        "kalman": _kalman(task, mpc, F, G),
        "riccati": float(np.abs(left).max() / np.abs(P).max()),
    }


def _kalman(task: DesignTask, mpc: MpcConfig, F: FloatArray, G: FloatArray) -> float:
    """Of the observer of MPC, whose disturbances walk, to python-control's predictor."""
    n, noise = task.n, task.noise
    whole = np.block([[F, G], [np.zeros((n, 2 * n)), np.eye(n)]])
    moved = np.diag(
        [0.0] * n + [noise.acceleration_m_per_s1_5**2 * task.period_s] * n
        + [MpcWeights().disturbance_nm_per_sqrt_s**2 * task.period_s] * n
    )  # fmt: skip
    seen = np.diag([noise.tension_n**2] * n + [noise.speed_m_per_s**2] * n)
    theirs, _, _ = control.dlqe(whole, np.eye(3 * n), np.eye(2 * n, 3 * n), moved, seen)
    own = whole @ np.vstack((mpc.predictor.gain_state, mpc.predictor.gain_disturbance))
    return _apart(own, theirs)


def _apart(ours: object, theirs: object) -> float:
    """Greatest difference of two matrices, relative to the greatest entry of the second."""
    a, b = np.asarray(ours, dtype=np.float64), np.asarray(theirs, dtype=np.float64)
    return float(np.abs(a - b).max() / np.abs(b).max())

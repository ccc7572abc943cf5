"""The quadratic programmes that MPC meets in a closed loop, solved by other means than its own.

Condensed: the torques of blocks are the variables, as `MpcProblem` has it. Sparse: the states of every period are
variables too, and the model is rows of equations.
"""

import time
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import osqp
import piqp
from scipy.sparse import block_diag, csc_matrix, eye, hstack, kron, vstack

from gateway.control.design import DesignTask
from gateway.control.law import Measured
from gateway.control.laws import ENDLESS_S
from gateway.control.mpc import Mpc
from gateway.control.mpc_problem import CLEAR, MpcProblem
from gateway.control.mpc_solver import solver_of
from gateway.control.reference import Steady
from gateway.control.rollout import Setup, limited, rk4
from gateway.control.sampled import Sampled
from gateway.core.controller_laws import MpcConfig
from gateway.core.scenario import Scenario
from gateway.core.signals import FloatArray
from gateway.core.web_model import equilibrium_torque, reference_speeds
from tests.bench.control_rollouts import course_of

EXACT = 1e-9


@dataclass(frozen=True)
class Met:
    """A problem that the loop has met: q, lower and upper of the condensed form, and the state that it begins at.

    `lower` and `upper` are of the programme by itself, as `MpcProblem.vectors` has them.
    """

    q: FloatArray
    lower: FloatArray
    upper: FloatArray
    state: FloatArray  #: [x~; torques in flight]
    setpoint_n: FloatArray


def problems(config: MpcConfig, task: DesignTask, case: Scenario, seed: int = 0) -> list[Met]:
    """Those of a loop on the model of `task`, with its noise on the samples and its limits. Nothing is late in it."""
    config = config.model_copy(update={"time_limit_s": ENDLESS_S})
    law, model, n = Mpc(config), task.model, task.n
    setup = Setup(task.period_s, task.latency_s, 1, task.limits.torque_nm, task.limits.torque_rate_nm_per_s)
    before_n = np.array(case.tension_n)
    speed = reference_speeds(model, before_n, case.speed_m_per_s)
    applied = equilibrium_torque(model, before_n, speed)
    line, acting = np.concatenate((before_n, speed)), [applied] * (setup.delay_steps + 1)
    noise = np.repeat([task.noise.tension_n, task.noise.speed_m_per_s], n)
    generator = np.random.default_rng(seed)
    course = course_of(case, task.period_s, case.duration_s)
    found, memory = [], None
    for setpoint_n, unwind in zip(course.tension_n, course.unwind_speed_m_per_s.tolist(), strict=True):
        seen = line + noise * generator.standard_normal(2 * n)
        measured, reference = Measured(seen[:n], seen[n:], unwind), Steady(setpoint_n)
        memory = memory or law.engage(measured, reference, applied)
        decision = law.ask(memory, measured, reference)
        assert decision.found is not None
        q, lower, upper = (v.copy() for v in law.problem.vectors(decision.found, setpoint_n, applied))
        state = np.concatenate((decision.found.state, decision.found.in_flight_nm.ravel()))
        found.append(Met(q, lower, upper, state, setpoint_n))
        applied = limited(setup, decision.torque_nm, applied)
        memory = law.commit(memory, decision, applied)
        acting.append(applied)
        line = rk4(model, line, acting[-1 - setup.delay_steps], unwind, task.period_s)
    return found


class Solver(Protocol):
    """Solves a sequence of problems, each from where it ended the one before, as far as it can."""

    name: str

    def prepare(self, config: MpcConfig) -> None: ...

    def solve(self, met: Met) -> FloatArray:
        """The torques w of the first block, (n,)."""
        ...


def replayed(solver: Solver, config: MpcConfig, met: list[Met]) -> tuple[FloatArray, float]:
    """Seconds of each solution (k,), and the 99th percentile of its distance to the exact one, in Nm."""
    exact = InteriorPoint()
    for one in (solver, exact):
        one.prepare(config)
    took_s, off_nm = [], []
    for problem in met:
        began_s = time.perf_counter()
        first = solver.solve(problem)
        took_s.append(time.perf_counter() - began_s)
        off_nm.append(float(np.abs(first - exact.solve(problem)).max()))
    return np.array(took_s), float(np.percentile(off_nm, 99))


class Condensed:
    """OSQP on the condensed form, with other settings than the law's where these are given."""

    def __init__(self, name: str, **settings: Any) -> None:
        self.name = name
        self._settings = dict(
            eps_abs=1e-3, eps_rel=1e-5, check_termination=5, max_iter=1000, adaptive_rho_interval=20,
            adaptive_rho_tolerance=3.0, polishing=False,
        ) | settings  # fmt: skip

    def prepare(self, config: MpcConfig) -> None:
        problem = MpcProblem(config)
        self._n = config.n
        self._solver = _osqp(csc_matrix(problem.P), csc_matrix(problem.A), self._settings)

    def solve(self, met: Met) -> FloatArray:
        return self.whole(met)[: self._n]

    def whole(self, met: Met) -> FloatArray:
        """All variables."""
        self._solver.update(q=met.q, l=met.lower, u=met.upper)
        return np.array(self._solver.solve(raise_error=False).x)


class OfLaw:
    """As the law does it with one of its solvers."""

    def __init__(self, name: Literal["daqp", "osqp"]) -> None:
        self.name = name

    def prepare(self, config: MpcConfig) -> None:
        self._problem = MpcProblem(config)
        config = config.model_copy(update={"solver": self.name, "time_limit_s": ENDLESS_S})
        self._n, self._solver = config.n, solver_of(self._problem, config)

    def solve(self, met: Met) -> FloatArray:
        coming = self._problem.C.dot(met.state)
        solution, status = self._solver.solve(met.state, met.lower + coming, met.upper + coming)
        if solution is None:
            raise RuntimeError(f"MPC has not solved it: {status}")
        return solution[: self._n]


class Sparse:
    """OSQP on the sparse form, with the law's settings but for those given."""

    def __init__(self, name: str, **settings: Any) -> None:
        self.name = name
        self._settings = dict(
            eps_abs=1e-3, eps_rel=1e-5, check_termination=5, max_iter=4000, adaptive_rho_interval=20
        ) | settings  # fmt: skip

    def prepare(self, config: MpcConfig) -> None:
        self._form = SparseForm(config)
        self._solver = _osqp(self._form.P, self._form.A, self._settings)
        self._q = np.zeros(self._form.P.shape[0])

    def solve(self, met: Met) -> FloatArray:
        lower, upper = self._form.bounds(met)
        self._solver.update(q=self._q, l=lower, u=upper)
        return self._form.first(np.array(self._solver.solve(raise_error=False).x))


class InteriorPoint:
    """piqp on the condensed form, dense; to `EXACT`, from nothing each time."""

    def __init__(self, name: str = "interior-point", eps: float = EXACT) -> None:
        self.name, self._eps = name, eps

    def prepare(self, config: MpcConfig) -> None:
        problem = MpcProblem(config)
        self._n, self._fresh = config.n, True
        self._P, self._G = problem.P, np.asfortranarray(problem.A)
        self._solver: Any = piqp.DenseSolver()
        self._solver.settings.eps_abs = self._solver.settings.eps_rel = self._eps

    def solve(self, met: Met) -> FloatArray:
        if self._fresh:
            self._solver.setup(self._P, met.q, None, None, self._G, met.lower, met.upper)
            self._fresh = False
        else:
            self._solver.update(c=met.q, h_l=met.lower, h_u=met.upper)
        status = self._solver.solve()
        if status != piqp.PIQP_SOLVED:
            raise RuntimeError(f"piqp: {status}")
        return np.array(self._solver.result.x[: self._n])


class SparseForm:
    """P, A and bounds over [states at the ends of periods 1 to N_p; torques w of the blocks; slack of the tensions]."""

    def __init__(self, config: MpcConfig) -> None:
        n, blocks, periods = config.n, config.blocks, config.horizon
        model = config.predictor
        F, G = Sampled(np.array(model.transition), [np.array(matrix) for matrix in model.inputs]).augmented()
        s, m = F.shape[0], n * len(blocks)
        self._n, self._m, self._states, self._F, self._config = n, m, s * periods, F, config
        weight = np.zeros(s)
        weight[: 2 * n] = config.weight_state
        parts = [*[np.diag(weight)] * (periods - 1), np.array(config.weight_terminal)]
        parts += [length * np.diag(config.weight_torque) for length in blocks]
        slack = config.weight_tension_limit > 0.0
        parts += [config.weight_tension_limit * np.eye(n)] if slack else []
        self.P = csc_matrix(2.0 * block_diag(parts))
        of_states = eye(s * periods) - kron(eye(periods, k=-1), F)
        of_torques = kron(np.eye(len(blocks))[np.repeat(np.arange(len(blocks)), blocks)], -G)
        change = eye(m) - eye(m, k=-n)
        ends = np.cumsum(blocks) - 1
        pick = kron(eye(periods).tocsr()[ends], np.eye(n, s))
        ease = kron(np.ones((len(blocks), 1)), eye(n))
        columns = [s * periods, m, *([n] if slack else [])]
        rows: list[list[Any]] = [[of_states, of_torques], [None, eye(m)], [None, change]]
        rows += [[pick, None, ease]] if slack else []
        self.A = csc_matrix(
            vstack(
                [
                    hstack([
                        csc_matrix((_height(row), width)) if part is None else part
                        for part, width in zip([*row, *[None] * (len(columns) - len(row))], columns, strict=True)
                    ])
                    for row in rows
                ]
            )
        )  # fmt: skip

    def bounds(self, met: Met) -> tuple[FloatArray, FloatArray]:
        start = np.zeros(self._states)
        start[: len(met.state)] = self._F @ met.state
        m, config = self._m, self._config
        lower, upper = [start, met.lower[: 2 * m]], [start, met.upper[: 2 * m]]
        if config.weight_tension_limit > 0.0:
            blocks = len(config.blocks)
            clear = CLEAR * (config.tension_max_n - config.tension_min_n)
            lower += [np.tile(np.minimum(config.tension_min_n - met.setpoint_n, -clear), blocks)]
            upper += [np.tile(np.maximum(config.tension_max_n - met.setpoint_n, clear), blocks)]
        return np.concatenate(lower), np.concatenate(upper)

    def first(self, solution: FloatArray) -> FloatArray:
        return solution[self._states : self._states + self._n]

    def slack_n(self, solution: FloatArray) -> FloatArray:
        """By which tensions leave their band; none where nothing is made of it."""
        return solution[self._states + self._m :]


def _height(row: list[Any]) -> int:
    return next(part.shape[0] for part in row if part is not None)


def _osqp(P: csc_matrix, A: csc_matrix, settings: dict[str, Any]) -> Any:
    solver: Any = osqp.OSQP()
    rows = A.shape[0]
    upper = csc_matrix(np.triu(P.toarray()))
    none = np.full(rows, np.inf)
    solver.setup(upper, np.zeros(P.shape[0]), A, -none, none, verbose=False, warm_starting=True, **settings)
    return solver


TRIED: dict[str, Solver] = {
    "as in the law: DAQP, condensed, working set kept": OfLaw("daqp"),
    "as in the law with OSQP: condensed, no more limits than matter": OfLaw("osqp"),
    "OSQP, condensed, all limits": Condensed("osqp"),
    "OSQP, condensed, tolerance 1e-2": Condensed("osqp_loose", eps_abs=1e-2, eps_rel=1e-4),
    "OSQP, condensed, step size kept": Condensed("osqp_fixed", adaptive_rho=False),
    "OSQP, condensed, step size adapted every 50": Condensed("osqp_slow", adaptive_rho_interval=50),
    "OSQP, sparse": Sparse("osqp_sparse"),
    "piqp, condensed, tolerance 1e-4": InteriorPoint("piqp", 1e-4),
}

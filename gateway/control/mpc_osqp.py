"""The programmes of the model predictive controller, solved by OSQP, with no more limits than matter.

An optimum that keeps limits which were not asked for is the optimum with them, too. So a programme is solved without
any limit first, which is a product with a matrix; where that breaks one, with those of torque and its rate; and where
tensions leave theirs even so, with all. OSQP begins each from where its last solution ended.

It is what DAQP is held against, and can be chosen in the configuration; it takes a hundred times as long.
"""

from typing import Any

import numpy as np
import osqp as _osqp  # pyright: ignore[reportMissingTypeStubs]
from scipy.sparse import csc_matrix, triu

from gateway.control.mpc_problem import MpcProblem
from gateway.control.mpc_solver import NO_LIMIT, NO_NUMBER, NOT_FINITE
from gateway.core.signals import FloatArray

osqp: Any = _osqp  # it has no types
SOLVED = int(osqp.SolverStatus.OSQP_SOLVED)
TOLERANCE = 1e-3  #: Nm and N: as closely as OSQP keeps a limit


class OsqpSolver:
    """It holds the solutions before, and the step sizes that OSQP has come to."""

    def __init__(self, problem: MpcProblem, most_iterations: int, time_limit_s: float) -> None:
        """Slow: OSQP is set up, twice where tensions are limited."""
        self._problem = problem
        self._most_iterations = most_iterations
        self._time_limit_s = time_limit_s
        self._free: FloatArray = np.asarray(np.linalg.inv(-problem.hessian), dtype=np.float64)
        self._rows: FloatArray = problem.A[:, : problem.torque_variables]
        self._torques: Any = None
        self._whole: Any = None
        self._fresh = False
        self.forget()

    def forget(self) -> None:
        """Slow where anything was solved: OSQP cannot be told to forget its step sizes, and is set up anew."""
        if self._fresh:
            return
        problem, torques, rows = self._problem, self._problem.torque_variables, self._problem.torque_rows
        self._torques = self._new(problem.hessian, problem.A[:rows, :torques])
        self._whole = self._new(problem.P, problem.A) if problem.rows > rows else None
        self._fresh = True

    def solve(self, x: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray | None, str]:
        coming = self._problem.C.dot(x)
        lower, upper = lower - coming, upper - coming
        if np.isnan(lower).any() or np.isnan(upper).any():
            return None, NO_NUMBER
        solution, status = self._staged(self._problem.linear(x), lower, upper)
        if solution is not None and not np.isfinite(solution).all():
            return None, NOT_FINITE
        return solution, status

    def _staged(self, q: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray | None, str]:
        """Of the programme by itself, lower <= A z <= upper."""
        torques, rows = self._problem.torque_variables, self._problem.torque_rows
        solution: FloatArray = np.zeros(self._problem.variables)
        solution[:torques] = found = self._free.dot(q[:torques])
        if self._kept(found, lower, upper):
            return solution, NO_LIMIT
        self._fresh = False
        self._torques.update(q=q[:torques], l=lower[:rows], u=upper[:rows])
        solved = self._torques.solve(raise_error=False)
        if solved.info.status_val != SOLVED:
            return None, solved.info.status
        solution[:torques] = found = solved.x
        if self._whole is None or self._kept(found, lower, upper, rows):
            return solution, solved.info.status
        left_s = self._time_limit_s - solved.info.run_time
        if left_s <= 0.0:
            return None, "no time for tension limits"
        self._whole.update_settings(time_limit=left_s)
        self._whole.update(q=q, l=lower, u=upper)
        solved = self._whole.solve(raise_error=False)
        return solved.x if solved.info.status_val == SOLVED else None, solved.info.status

    def _kept(self, found: FloatArray, lower: FloatArray, upper: FloatArray, begin: int = 0) -> bool:
        """Whether the rows from `begin` on are within their limits without any slack."""
        reached = self._rows[begin:].dot(found)
        return bool(
            (reached >= lower[begin:] - TOLERANCE).all() and (reached <= upper[begin:] + TOLERANCE).all()
        )  # fmt: skip

    def _new(self, P: FloatArray, A: FloatArray) -> Any:
        rows, variables = A.shape
        solver = osqp.OSQP()
        solver.setup(
            csc_matrix(triu(P)), np.zeros(variables), csc_matrix(A), np.full(rows, -np.inf), np.full(rows, np.inf),
            verbose=False, warm_starting=True, polishing=False, eps_abs=1e-3, eps_rel=1e-5, check_termination=5,
            max_iter=self._most_iterations, time_limit=self._time_limit_s,
            # By iterations, not by time: the same problem is solved in the same way on every computer.
            adaptive_rho_interval=20, adaptive_rho_tolerance=3.0,
        )  # fmt: skip
        return solver

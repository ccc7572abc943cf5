"""The programmes of the model predictive controller, solved by DAQP: a dual active-set method (Arnstroem et al. 2022).

Without any limit the solution is a product with a matrix, z_0 = -P^-1 L x_0, and so is what the rows come to with it,
(C - A P^-1 L) x_0. Where no row leaves its limits that is all. Else z = z_0 + y, and what limits change is left:

    minimise  1/2 y' P y   subject to   lower - (A z_0 + C x_0) <= A y <= upper - (A z_0 + C x_0)

whose matrices are factored once; a period gives it limits, and it begins with the rows that were active in the one
before.
"""

from typing import Any

import daqp as _daqp  # pyright: ignore[reportMissingTypeStubs]
import numpy as np

from gateway.control.mpc_problem import MpcProblem
from gateway.control.mpc_solver import NO_LIMIT, NO_NUMBER, NOT_FINITE
from gateway.core.controller import ControllerRefused
from gateway.core.signals import FloatArray

daqp: Any = _daqp  # it has no types
SOLVED, OUT_OF_ITERATIONS = 1, -4  #: of DAQP's exit flags
STATUS = {-1: "infeasible", -2: "cycling", OUT_OF_ITERATIONS: "out of iterations", 4: "inexact"}
TOLERANCE = 1e-8  #: Nm and N in the scale of the largest entry of P: what a limit may be left by
#: Multiplications between two looks at the time, about a millisecond: an iteration takes as many as A has entries.
BETWEEN_LOOKS = 4e6
LEAST_BETWEEN_LOOKS = 8  #: iterations: it needs some to notice that it goes in circles


class DaqpSolver:
    """Bounded by iterations, which are the same on every computer, and by the time of the solver itself."""

    def __init__(self, problem: MpcProblem, most_iterations: int, time_limit_s: float) -> None:
        """Slow: factors the programme and solves it once, because DAQP leaves part of its work to the first solution.

        Raises ControllerRefused where P is not positive definite to the precision of numbers.
        """
        torques = problem.torque_variables
        self._torques = torques
        self._most_iterations, self._time_limit_s = most_iterations, time_limit_s
        unlimited: FloatArray = np.asarray(np.linalg.solve(-problem.hessian, problem.L), dtype=np.float64)
        self._reached: FloatArray = problem.A[:, :torques] @ unlimited + problem.C  # begins with `unlimited`
        # Every variable in the scale in which its own weight is 1: what DAQP takes for 0 is absolute.
        self._scale: FloatArray = 1.0 / np.sqrt(np.diag(problem.P))
        self._inverse: FloatArray = 1.0 / self._scale[:torques]
        self._lower, self._upper = np.empty(problem.rows), np.empty(problem.rows)
        self._none_active = np.zeros(problem.rows, dtype=np.intc)
        self._at_a_time = max(LEAST_BETWEEN_LOOKS, int(BETWEEN_LOOKS / problem.A.size))
        self._at_a_time = min(self._at_a_time, most_iterations)
        self._fresh = True
        self._model: Any = daqp.Model()
        self._set_up(problem)

    def forget(self) -> None:
        self._fresh = True  # the next solution begins with no active row

    def solve(self, x: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray | None, str]:
        reached = self._reached.dot(x)
        np.subtract(lower, reached, out=self._lower)
        np.subtract(upper, reached, out=self._upper)
        if np.maximum.reduce(self._lower) <= TOLERANCE and np.minimum.reduce(self._upper) >= -TOLERANCE:  # not of nan
            solution = np.zeros(len(self._scale))
            solution[: self._torques] = reached[: self._torques]
            return solution, NO_LIMIT
        if np.isnan(self._lower).any() or np.isnan(self._upper).any():
            return None, NO_NUMBER
        changed, status = self._limited()
        if changed is None:
            return None, status
        solution = self._scale * changed
        solution[: self._torques] += reached[: self._torques]
        if not np.isfinite(solution).all():
            self.forget()
            return None, NOT_FINITE
        return solution, status

    def _limited(self) -> tuple[FloatArray | None, str]:
        """y in DAQP's scale, for the limits that are left."""
        self._lower[: self._torques] *= self._inverse
        self._upper[: self._torques] *= self._inverse
        sense = self._none_active if self._fresh else None
        self._fresh = False
        flag = self._model.update(bupper=self._upper, blower=self._lower, sense=sense)
        took_s, iterations = 0.0, 0
        while flag >= 0:
            changed, _, flag, told = self._model.solve()
            took_s += told["solve_time"]
            iterations += told["iterations"]
            # What is late or was not found keeps its active rows: the next period goes on from there.
            if took_s > self._time_limit_s:
                return None, "time limit reached"
            if flag == SOLVED:
                return changed, "solved"
            if flag == OUT_OF_ITERATIONS:
                if iterations >= self._most_iterations:
                    return None, STATUS[flag]
                flag = 0
        self.forget()
        return None, STATUS.get(flag, f"DAQP ended with {flag}")

    def _set_up(self, problem: MpcProblem) -> None:
        torques, scale = self._torques, self._scale
        # No regularisation: it would be another programme. No equalities: there are none to be looked for.
        self._model.settings = {
            "primal_tol": TOLERANCE, "eps_prox": 0.0, "eq_reduction": -1, "iter_limit": self._at_a_time + 1,
        }  # fmt: skip
        P = problem.P * scale[:, None] * scale
        A = np.ascontiguousarray(problem.A[torques:] * scale)  # the first rows are limits of variables
        # Without a linear term: it spares a product of the size of A in each period.
        none = np.full(problem.rows, np.inf)
        flag, _ = self._model.setup(P, None, A, none, -none)
        if flag < 0:
            raise ControllerRefused(f"its weights leave the programme without one solution: DAQP ends with {flag}")
        self._lower[:], self._upper[:] = -1.0, 1.0
        self._lower[0] = 0.5
        self._limited()
        self.forget()

"""What solves the programmes of the model predictive controller: DAQP, or OSQP where the configuration says so."""

from typing import Protocol

from gateway.control.mpc_problem import MpcProblem
from gateway.core.controller_laws import MpcConfig
from gateway.core.signals import FloatArray

# How a solution may end, beside what the solver says.
NO_LIMIT = "no limit reached"  #: there was nothing to solve
NO_NUMBER = "asked with what is no number"
NOT_FINITE = "not finite"


class MpcSolver(Protocol):
    """One for each law: it holds where the solution before has ended."""

    def forget(self) -> None:
        """Leave nothing of what was solved before: the next solution is bit for bit that of a new solver."""
        ...

    def solve(self, x: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray | None, str]:
        """z (variables,) at x_0 within the limits of `MpcProblem.limits`, None where there is none in time; and how it
        ended. What is returned is finite.
        """
        ...


def solver_of(problem: MpcProblem, config: MpcConfig) -> MpcSolver:
    """The solver that the configuration names, set up and warmed. Raises ControllerRefused where it cannot be."""
    if config.solver == "osqp":
        from gateway.control.mpc_osqp import OsqpSolver  # 25 MB, for those who use it

        return OsqpSolver(problem, config.most_iterations, config.time_limit_s)
    from gateway.control.mpc_daqp import DaqpSolver

    return DaqpSolver(problem, config.most_iterations, config.time_limit_s)

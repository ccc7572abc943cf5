"""Model predictive control (eq. mpc), condensed, solved from where the last solution ended.

A solution that is late, or none, is never applied: then the next move of the last plan is, and when that is used up the
linear feedback, a more cautious one than the problem's own.
"""

from dataclasses import dataclass, field

import numpy as np

from gateway.control.deviation import Deviation, Measured
from gateway.control.law import Decision
from gateway.control.lqg import feedback
from gateway.control.mpc_problem import MpcProblem
from gateway.control.mpc_solver import solver_of
from gateway.control.observer import Estimate, Observer, ObserverState
from gateway.control.reference import Reference
from gateway.core.controller_laws import MpcConfig
from gateway.core.signals import FloatArray


@dataclass(slots=True)
class MpcState:
    observer: ObserverState
    applied_nm: FloatArray  #: (n,), the torque sent last
    plan_nm: FloatArray  #: (k, n), what the last solution would send in the periods from now on; () when it is used up
    unsolved: int = 0  #: periods so far without a solution in time
    first: "Planned | None" = None  #: made when the law was engaged


@dataclass(slots=True)
class Planned(Decision):
    """A decision with the plan behind it."""

    found: Estimate | None = None
    plan_nm: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    solution: FloatArray = field(default_factory=lambda: np.empty(0))  #: of the quadratic programme


class Mpc:
    """The law of `MpcConfig`. Holds the solver, with what the solution before has left in it.

    Everything slow is in the constructor: 3 ms at 6 spans, 0.3 s at 60. From then on `engage` costs about what an `ask`
    does, a tenth of a millisecond at 6 spans, and `commit` less. (With `solver` "osqp" `engage` sets OSQP up anew.)
    """

    def __init__(self, config: MpcConfig) -> None:
        """Sets the solver up and warms it. Raises ControllerRefused where the programme has not one solution."""
        self.n = config.n
        self.config = config
        deviation = Deviation(config.feedforward, config.draw_spans, config.period_s, config.latency_s)
        self._observer = Observer(config.predictor, deviation, config.draw_spans, config.period_s)
        self._gain = np.hstack((np.array(config.fallback_state), np.array(config.fallback_input).reshape(self.n, -1)))
        self.problem = MpcProblem(config)
        self._solver = solver_of(self.problem, config)

    def engage(self, measured: Measured, reference: Reference, applied_nm: FloatArray) -> MpcState:
        """The first decision is made here, and asked for next. Without a solution it is `applied_nm` once more.

        It depends on nothing that was solved before.
        """
        self._solver.forget()
        observer = self._observer.engage(measured, reference, applied_nm)
        state = MpcState(observer, applied_nm.copy(), np.empty((0, self.n)))
        first = self.ask(state, measured, reference)
        if first.fallback:
            first.fallback = f"held: {first.fallback}"
        elif first.found is not None:
            first.found.bump_nm = applied_nm - first.torque_nm
        first.torque_nm = applied_nm.copy()
        state.first = first
        return state

    def ask(self, state: MpcState, measured: Measured, reference: Reference) -> Planned:
        if state.first is not None:
            return state.first
        found = self._observer.estimate(state.observer, measured, reference)
        lower, upper = self.problem.limits(found, reference.tension_n, state.applied_nm)
        solution, status = self._solver.solve(self.problem.state(found), lower, upper)
        if solution is not None:
            plan = self.problem.torques(solution, found)
            return Planned(plan[0] + found.bump_nm, found.errors, "", found, plan[1:], solution)
        if len(state.plan_nm):
            rest = state.plan_nm
            return Planned(rest[0] + found.bump_nm, found.errors, f"plan: {status}", found, rest[1:])
        return Planned(feedback(self._gain, found), found.errors, f"linear feedback: {status}", found)

    def commit(self, state: MpcState, decision: Decision, applied_nm: FloatArray) -> MpcState:
        assert isinstance(decision, Planned) and decision.found is not None
        return MpcState(
            self._observer.predict(decision.found, applied_nm),
            applied_nm.copy(),
            decision.plan_nm,
            state.unsolved + bool(decision.fallback),
        )

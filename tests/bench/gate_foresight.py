"""What the loop lets an operator do at once: steps of several spans are refused where the product foresees too much.

The same code as in the loop, on the accepted model, of a line that stands at the set-points before the step.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gateway.control.deviation import Measured
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.line import Line
from gateway.core.line_model import LineModel, theta_of
from gateway.core.web_model import equilibrium_torque, reference_speeds
from gateway.supervisor.surroundings import NODES
from safety.recoverability import Recovery
from safety.recovery_prediction import recovery_prediction
from tests.independent.runs import Case
from tests.independent.truth import FloatArray

SHARES = tuple(np.linspace(1.0, 0.1, 10).tolist())  #: of a case, the largest that is let is found among


@dataclass(frozen=True)
class Foresight:
    """Of a line with an accepted model; predictive control stands on the linear law that was in service before."""

    line: Line
    model: LineModel
    in_service: Controller

    def share(self, config: Controller, case: Case) -> float:
        """The largest share of a case whose steps of several spans are let; 0 where none is."""
        watched = self.in_service if isinstance(config, MpcConfig) else config
        theta, fastest = theta_of(self.model), self.model.region.speed_to_m_per_s
        prediction = recovery_prediction(theta, watched, self.line, [share * fastest for share in NODES])
        recovery = Recovery(prediction, watched, self.line)
        return next((share for share in SHARES if self._lets(recovery, case.smaller(share))), 0.0)

    def _lets(self, recovery: Recovery, case: Case) -> bool:
        web = theta_of(self.model).web
        for before_n, after_n, unwind in self._steps(case):
            speed = reference_speeds(web, before_n, unwind)
            torque = equilibrium_torque(web, before_n, speed)
            in_flight = np.tile(torque, (recovery.depth, 1))
            measured = Measured(before_n, speed, unwind)
            if recovery.shortfall_of_step(measured, after_n, in_flight, torque, None) is not None:
                return False
        return True

    def _steps(self, case: Case) -> Iterator[tuple[FloatArray, FloatArray, float]]:
        """Set-points before and after, and the unwinder's speed, wherever more than one span steps at once."""
        ramped_n = self.line.moves.tension_rate_n_per_s * self.line.control.period_s
        for k in np.flatnonzero((np.abs(np.diff(case.tension_n, axis=0)) > 1.01 * ramped_n).sum(axis=1) > 1).tolist():
            yield case.tension_n[k].copy(), case.tension_n[k + 1].copy(), float(case.unwind_m_per_s[k + 1])

"""What the loop lets an operator do at once: steps of several spans are refused where the product foresees too much.

Its own prediction, on the accepted model, of a line that stands at the set-points before the step, asked span by span.
"""

from dataclasses import replace

import numpy as np

from gateway.control.deviation import Measured
from gateway.control.engagement import memory
from gateway.control.laws import make_law
from gateway.control.reference import Steady
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


class Foresight:
    """Of the loop of a line with an accepted model, under one law."""

    def __init__(self, line: Line, model: LineModel, config: Controller, in_service: Controller) -> None:
        """`in_service`: the linear law before, on which predictive control stands."""
        self._line, self._theta = line, theta_of(model)
        watched = in_service if isinstance(config, MpcConfig) else config
        fastest = min(line.limits.speed_max_m_per_s, model.region.speed_to_m_per_s)
        prediction = recovery_prediction(self._theta, watched, line, [share * fastest for share in NODES])
        self._recovery = Recovery(prediction, watched, line)
        self._law = None if isinstance(config, MpcConfig) else make_law(config)

    def let(self, case: Case) -> Case:
        """The case without those steps that are refused, wherever several spans step at once; the first ones first.

        A span whose step is refused stays where it is until it is asked for the next one.
        """
        ramped_n = 1.01 * self._line.moves.tension_rate_n_per_s * self._line.control.period_s
        setpoint_n = case.tension_n.copy()
        stepping = np.abs(np.diff(case.tension_n, axis=0)) > ramped_n
        for k in np.flatnonzero(stepping.sum(axis=1) > 1).tolist():
            standing_n, unwind = setpoint_n[k].copy(), float(case.unwind_m_per_s[k + 1])
            now_n = standing_n.copy()
            for i in np.flatnonzero(stepping[k]).tolist():
                asked_n = now_n.copy()
                asked_n[i] = case.tension_n[k + 1, i]
                if self._lets(standing_n, asked_n, unwind):
                    now_n = asked_n
                setpoint_n[k + 1 :, i] = case.tension_n[k + 1 :, i] + (now_n[i] - case.tension_n[k + 1, i])
        return replace(case, tension_n=setpoint_n)

    def _lets(self, standing_n: FloatArray, asked_n: FloatArray, unwind_m_per_s: float) -> bool:
        theta = self._theta
        speed = reference_speeds(theta.web, standing_n, unwind_m_per_s)
        torque = equilibrium_torque(theta.web, standing_n, speed) + theta.coulomb_nm * np.sign(speed)
        measured, remembered = Measured(standing_n, speed, unwind_m_per_s), None
        if self._law is not None:
            remembered = memory(self._law.engage(measured, Steady(standing_n), torque))
        in_flight = np.tile(torque, (self._recovery.depth, 1))
        return self._recovery.shortfall_of_step(measured, asked_n, in_flight, torque, remembered) is None

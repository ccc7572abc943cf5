"""LQI: linear-quadratic state feedback with integral action and dead time (eq. lqr, extended)."""

from dataclasses import dataclass

import numpy as np

from gateway.control.deviation import Deviation, Measured
from gateway.control.flight import deviations, newest_first
from gateway.control.law import Decision
from gateway.control.reference import Reference
from gateway.core.controller_laws import LqiConfig
from gateway.core.signals import FloatArray


@dataclass(slots=True)
class LqiState:
    integral: FloatArray  #: (n,), N s (m for a draw span)
    in_flight_nm: FloatArray  #: (d, n), torques sent but not yet acting when the sample is taken, newest first


class Lqi:
    """The law of `LqiConfig`, with its matrices as arrays."""

    def __init__(self, config: LqiConfig) -> None:
        self.n = config.n
        self.config = config
        gain_input = np.array(config.gain_input).reshape(self.n, -1)
        gain_integral = np.array(config.gain_integral)
        self._gain = np.hstack((config.gain_state, gain_integral, gain_input))  # one product a period
        self._integral_of_torque = np.linalg.inv(gain_integral)
        self._taken_back = config.antiwindup * self._integral_of_torque
        self._deviation = Deviation(config.feedforward, config.draw_spans, config.period_s, config.latency_s)
        self._periods_in_flight = gain_input.shape[1] // self.n

    def engage(self, measured: Measured, reference: Reference, applied_nm: FloatArray) -> LqiState:
        in_flight = np.tile(applied_nm, (self._periods_in_flight, 1))
        state = LqiState(np.zeros(self.n), in_flight)
        asked = self.ask(state, measured, reference).torque_nm
        return LqiState(self._integral_of_torque @ (asked - applied_nm), in_flight)

    def ask(self, state: LqiState, measured: Measured, reference: Reference) -> Decision:
        errors = self._deviation.errors(measured, reference)
        in_flight = deviations(self._deviation, state.in_flight_nm, errors, measured, reference)
        deviation = np.concatenate((errors.tension_n, errors.speed_m_per_s, state.integral, in_flight.ravel()))
        return Decision(errors.torque_nm - self._gain.dot(deviation), errors)

    def commit(self, state: LqiState, decision: Decision, applied_nm: FloatArray) -> LqiState:
        # Back-calculation: a share of the torque that the actuators did not give is taken back from the integrals.
        excess = self._taken_back.dot(decision.torque_nm - applied_nm)
        integral = state.integral + self.config.period_s * decision.errors.controlled + excess
        return LqiState(integral, newest_first(state.in_flight_nm, applied_nm))

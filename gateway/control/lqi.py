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
    integral_nm: FloatArray  #: (n,), the integral part as torque: gains that change do not change it
    in_flight_nm: FloatArray  #: (d, n), torques sent but not yet acting when the sample is taken, newest first


class Lqi:
    """The law of `LqiConfig`, with its matrices as arrays."""

    def __init__(self, config: LqiConfig) -> None:
        self.n = config.n
        self.config = config
        gain_input = np.array(config.gain_input).reshape(self.n, -1)
        self._gain = np.hstack((config.gain_state, gain_input))  # one product a period
        self._integral = config.period_s * np.array(config.gain_integral)
        self._deviation = Deviation(config.feedforward, config.draw_spans, config.period_s, config.latency_s)
        self._periods_in_flight = gain_input.shape[1] // self.n

    def engage(self, measured: Measured, reference: Reference, applied_nm: FloatArray) -> LqiState:
        in_flight = np.tile(applied_nm, (self._periods_in_flight, 1))
        state = LqiState(np.zeros(self.n), in_flight)
        asked = self.ask(state, measured, reference).torque_nm
        return LqiState(applied_nm - asked, in_flight)

    def ask(self, state: LqiState, measured: Measured, reference: Reference) -> Decision:
        errors = self._deviation.errors(measured, reference)
        in_flight = deviations(self._deviation, state.in_flight_nm, errors, measured, reference)
        deviation = np.concatenate((errors.tension_n, errors.speed_m_per_s, in_flight.ravel()))
        return Decision(errors.torque_nm + state.integral_nm - self._gain.dot(deviation), errors)

    def commit(self, state: LqiState, decision: Decision, applied_nm: FloatArray) -> LqiState:
        # Back-calculation: a share of the torque that the actuators did not give is taken back from the integral.
        integral = state.integral_nm - self._integral.dot(decision.errors.controlled)
        integral -= self.config.antiwindup * (decision.torque_nm - applied_nm)
        return LqiState(integral, newest_first(state.in_flight_nm, applied_nm))

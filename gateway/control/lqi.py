"""LQI: linear-quadratic state feedback with integral action and dead time (eq. lqr, extended)."""

from dataclasses import dataclass

import numpy as np

from gateway.control.law import Decision, Deviation, Measured
from gateway.core.controller import LqiConfig
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
        self._deviation = Deviation(config.feedforward, config.draw_spans)
        self._periods_in_flight = gain_input.shape[1] // self.n

    def engage(self, measured: Measured, tension_setpoint_n: FloatArray, applied_nm: FloatArray) -> LqiState:
        in_flight = np.tile(applied_nm, (self._periods_in_flight, 1))
        state = LqiState(np.zeros(self.n), in_flight)
        asked = self.ask(state, measured, tension_setpoint_n).torque_nm
        return LqiState(self._integral_of_torque @ (asked - applied_nm), in_flight)

    def ask(self, state: LqiState, measured: Measured, tension_setpoint_n: FloatArray) -> Decision:
        tension_error, speed_error, controlled, equilibrium = self._deviation.errors(measured, tension_setpoint_n)
        in_flight = (state.in_flight_nm - equilibrium).ravel()
        deviation = np.concatenate((tension_error, speed_error, state.integral, in_flight))
        return Decision(equilibrium - self._gain.dot(deviation), tension_error, controlled)

    def commit(self, state: LqiState, decision: Decision, applied_nm: FloatArray) -> LqiState:
        # Back-calculation: a share of the torque that the actuators did not give is taken back from the integrals.
        excess = self._taken_back.dot(decision.torque_nm - applied_nm)
        integral = state.integral + self.config.period_s * decision.controlled_error + excess
        in_flight = np.empty_like(state.in_flight_nm)
        in_flight[:1], in_flight[1:] = applied_nm, state.in_flight_nm[:-1]
        return LqiState(integral, in_flight)

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
        self._gain_state = np.array(config.gain_state)
        self._gain_input = np.array(config.gain_input).reshape(self.n, -1)
        self._gain_integral = np.array(config.gain_integral)
        self._integral_of_torque = np.linalg.inv(self._gain_integral)
        self._deviation = Deviation(config.feedforward, config.draw_spans)
        self._periods_in_flight = self._gain_input.shape[1] // self.n

    def engage(self, measured: Measured, tension_setpoint_n: FloatArray, applied_nm: FloatArray) -> LqiState:
        in_flight = np.tile(applied_nm, (self._periods_in_flight, 1))
        state = LqiState(np.zeros(self.n), in_flight)
        asked = self.ask(state, measured, tension_setpoint_n).torque_nm
        return LqiState(self._integral_of_torque @ (asked - applied_nm), in_flight)

    def ask(self, state: LqiState, measured: Measured, tension_setpoint_n: FloatArray) -> Decision:
        tension_error, speed_error, controlled, equilibrium = self._deviation.errors(measured, tension_setpoint_n)
        torque = equilibrium - self._gain_state @ np.concatenate((tension_error, speed_error))
        torque -= self._gain_integral @ state.integral
        torque -= self._gain_input @ (state.in_flight_nm - equilibrium).ravel()
        return Decision(torque, tension_error, controlled)

    def commit(self, state: LqiState, decision: Decision, applied_nm: FloatArray) -> LqiState:
        # Back-calculation: a share of the torque that the actuators did not give is taken back from the integrals.
        excess = self._integral_of_torque @ (decision.torque_nm - applied_nm)
        integral = state.integral + self.config.period_s * decision.controlled_error + self.config.antiwindup * excess
        in_flight = np.concatenate((applied_nm[None, :], state.in_flight_nm[:-1]))[: self._periods_in_flight]
        return LqiState(integral, in_flight)

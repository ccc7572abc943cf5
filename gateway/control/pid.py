"""PID with gain matrices on tensions and speeds (eq. pid), filtered derivative and back-calculation."""

from dataclasses import dataclass

import numpy as np

from gateway.control.deviation import Deviation, Measured
from gateway.control.law import Decision
from gateway.control.reference import Reference
from gateway.core.controller_laws import PidConfig
from gateway.core.signals import FloatArray


@dataclass(slots=True)
class PidState:
    integral_nm: FloatArray  #: (n,), the integral part as torque, so that it can be compared with the limits
    tension_error_n: FloatArray  #: (n,), of the period before
    error_rate_n_per_s: FloatArray  #: (n,), filtered


class Pid:
    """The law of `PidConfig`, with its matrices as arrays."""

    def __init__(self, config: PidConfig) -> None:
        self.n = config.n
        self.config = config
        self._gain = np.hstack((config.gain_proportional, config.gain_derivative))  # one product a period
        self._integral = config.period_s * np.array(config.gain_integral)
        self._deviation = Deviation(config.feedforward, config.draw_spans, config.period_s, config.latency_s)
        # First-order filter, backward Euler: rate_k = a rate_{k-1} + (e_k - e_{k-1}) / (tau + h)
        self._rate_decay = config.derivative_filter_s / (config.derivative_filter_s + config.period_s)
        self._rate_gain = 1.0 / (config.derivative_filter_s + config.period_s)

    def engage(self, measured: Measured, reference: Reference, applied_nm: FloatArray) -> PidState:
        error = self._deviation.errors(measured, reference).tension_n
        state = PidState(np.zeros(self.n), error, np.zeros(self.n))
        asked = self.ask(state, measured, reference).torque_nm
        return PidState(applied_nm - asked, error, np.zeros(self.n))

    def ask(self, state: PidState, measured: Measured, reference: Reference) -> Decision:
        errors = self._deviation.errors(measured, reference)
        # The paper's e is reference minus measurement; `Deviation` gives measurement minus reference.
        deviation = np.concatenate((errors.tension_n, errors.speed_m_per_s, self._rate(state, errors.tension_n)))
        return Decision(errors.torque_nm + state.integral_nm - self._gain.dot(deviation), errors)

    def commit(self, state: PidState, decision: Decision, applied_nm: FloatArray) -> PidState:
        errors = decision.errors
        integral = state.integral_nm - self._integral.dot(errors.controlled)
        integral -= self.config.antiwindup * (decision.torque_nm - applied_nm)
        return PidState(integral, errors.tension_n, self._rate(state, errors.tension_n))

    def _rate(self, state: PidState, tension_error_n: FloatArray) -> FloatArray:
        return self._rate_decay * state.error_rate_n_per_s + self._rate_gain * (tension_error_n - state.tension_error_n)

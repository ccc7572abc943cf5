"""LQR: linear-quadratic state feedback with dead time (eq. lqr)."""

from dataclasses import dataclass

import numpy as np

from gateway.control.deviation import Deviation, Measured
from gateway.control.flight import deviations, newest_first
from gateway.control.law import Decision
from gateway.control.reference import Reference
from gateway.control.takeover import fade
from gateway.core.controller_laws import LqrConfig
from gateway.core.signals import FloatArray


@dataclass(slots=True)
class LqrState:
    in_flight_nm: FloatArray  #: (d, n), newest first
    bump_nm: FloatArray  #: (n,), what the law would have jumped by when it took over; it fades


class Lqr:
    """The law of `LqrConfig`, with its matrices as arrays."""

    def __init__(self, config: LqrConfig) -> None:
        self.n = config.n
        self.config = config
        self._gain = np.hstack((np.array(config.gain_state), np.array(config.gain_input).reshape(self.n, -1)))
        self._periods_in_flight = self._gain.shape[1] // self.n - 2
        self._deviation = Deviation(config.feedforward, config.draw_spans, config.period_s, config.latency_s)
        self._fade = fade(config.period_s)

    def engage(self, measured: Measured, reference: Reference, applied_nm: FloatArray) -> LqrState:
        in_flight = np.tile(applied_nm, (self._periods_in_flight, 1))
        state = LqrState(in_flight, np.zeros(self.n))
        return LqrState(in_flight, applied_nm - self.ask(state, measured, reference).torque_nm)

    def ask(self, state: LqrState, measured: Measured, reference: Reference) -> Decision:
        errors = self._deviation.errors(measured, reference)
        in_flight = deviations(self._deviation, state.in_flight_nm, errors, measured, reference)
        deviation = np.concatenate((errors.tension_n, errors.speed_m_per_s, in_flight.ravel()))
        return Decision(errors.torque_nm - self._gain.dot(deviation) + state.bump_nm, errors)

    def commit(self, state: LqrState, decision: Decision, applied_nm: FloatArray) -> LqrState:
        return LqrState(newest_first(state.in_flight_nm, applied_nm), self._fade * state.bump_nm)

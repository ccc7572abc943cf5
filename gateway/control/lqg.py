"""LQG with torque disturbances: linear-quadratic feedback on a Kalman observer, free of offset with no integrator."""

from dataclasses import dataclass

import numpy as np

from gateway.control.deviation import Deviation, Measured
from gateway.control.law import Decision
from gateway.control.observer import Estimate, Observer, ObserverState
from gateway.control.reference import Reference
from gateway.core.controller_laws import LqgConfig
from gateway.core.signals import FloatArray


@dataclass(slots=True)
class Estimated(Decision):
    """A decision on an estimate."""

    found: Estimate | None = None


class Lqg:
    """The law of `LqgConfig`, with its matrices as arrays."""

    def __init__(self, config: LqgConfig) -> None:
        self.n = config.n
        self.config = config
        deviation = Deviation(config.feedforward, config.draw_spans, config.period_s, config.latency_s)
        self._observer = Observer(config.predictor, deviation, config.draw_spans, config.period_s)
        self._gain = np.hstack((np.array(config.gain_state), np.array(config.gain_input).reshape(self.n, -1)))

    def engage(self, measured: Measured, reference: Reference, applied_nm: FloatArray) -> ObserverState:
        state = self._observer.engage(measured, reference, applied_nm)
        state.bump_nm = applied_nm - self.ask(state, measured, reference).torque_nm
        return state

    def ask(self, state: ObserverState, measured: Measured, reference: Reference) -> Estimated:
        found = self._observer.estimate(state, measured, reference)
        return Estimated(feedback(self._gain, found), found.errors, found=found)

    def commit(self, state: ObserverState, decision: Decision, applied_nm: FloatArray) -> ObserverState:
        assert isinstance(decision, Estimated) and decision.found is not None
        return self._observer.predict(decision.found, applied_nm)


def feedback(gain: FloatArray, found: Estimate) -> FloatArray:
    """u_ref - d - gain [x~; torques in flight], and what was taken over, (n,)."""
    deviation = np.concatenate((found.state, found.in_flight_nm.ravel()))
    return found.errors.torque_nm - found.disturbance_nm - gain.dot(deviation) + found.bump_nm

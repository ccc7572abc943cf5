"""A Kalman observer of the line's state and of torque disturbances that keep their value."""

from dataclasses import dataclass

import numpy as np

from gateway.control.deviation import Deviation, Errors, Measured
from gateway.control.flight import deviations, newest_first
from gateway.control.reference import Reference
from gateway.control.takeover import NEAR_SETPOINT, fade
from gateway.core.controller_laws import Predictor
from gateway.core.signals import BoolArray, FloatArray


@dataclass(slots=True)
class ObserverState:
    predicted: FloatArray  #: (2n,), tensions in N and speeds in m/s at the next sample
    disturbance_nm: FloatArray  #: (n,), torque that acts beside the drives'
    in_flight_nm: FloatArray  #: (d, n), torques sent but not yet acting when the sample is taken, newest first
    bump_nm: FloatArray  #: (n,), what the law would have jumped by when it took over; it fades


@dataclass(slots=True)
class Estimate:
    """The line at a sample, in deviations from the reference."""

    errors: Errors  #: as measured
    state: FloatArray  #: x~, (2n,)
    disturbance_nm: FloatArray  #: (n,)
    in_flight_nm: FloatArray  #: (d, n), less the reference torque, with the disturbance
    reference_next: FloatArray  #: (2n,), a period later
    sent_nm: FloatArray  #: (d, n), as they were sent
    bump_nm: FloatArray


class Observer:
    """The observer of a `Predictor`; `deviation` is that of the law which uses it."""

    def __init__(self, predictor: Predictor, deviation: Deviation, draw_spans: list[int], period_s: float) -> None:
        self.n = len(predictor.gain_disturbance)
        self.depth = len(predictor.inputs) - 1
        self._deviation = deviation
        self._period_s = period_s
        self._draw = np.array(draw_spans, dtype=np.intp)
        self._gain = np.vstack((predictor.gain_state, predictor.gain_disturbance))  # one product a period
        self._corrects = bool(np.any(self._gain[2 * self.n :]))  #: the disturbance
        self._fade = fade(period_s)
        self._ahead = np.hstack((predictor.transition, *predictor.inputs))

    def engage(self, measured: Measured, reference: Reference, applied_nm: FloatArray) -> ObserverState:
        """As if the line stood where it is: whatever holds it there beside `applied_nm` (n,) is the disturbance.

        Not what would make a law ask for `applied_nm` at once: noise of one sample would be taken for a disturbance.
        An observer that never corrects it takes none in the middle of a move: it would be wrong for ever.
        """
        errors = self._deviation.errors(measured, reference)
        in_flight = np.tile(applied_nm, (self.depth, 1))
        seen = self._measured(measured, reference)
        taken = self._corrects or self._there(measured, reference).all()
        disturbance = errors.torque_nm - applied_nm if taken else np.zeros(self.n)
        return ObserverState(seen, disturbance, in_flight, np.zeros(self.n))

    def estimate(self, state: ObserverState, measured: Measured, reference: Reference) -> Estimate:
        """What the sample says, weighed against what was predicted."""
        errors = self._deviation.errors(measured, reference)
        seen = np.concatenate((measured.tension_n, measured.speed_m_per_s))
        seen[self._draw] = state.predicted[self._draw]
        correction = self._gain.dot(seen - state.predicted)
        width = 2 * self.n
        disturbance = state.disturbance_nm + correction[width:]
        reference_now = np.concatenate((reference.tension_n, measured.speed_m_per_s - errors.speed_m_per_s))
        in_flight = deviations(self._deviation, state.in_flight_nm, errors, measured, reference)
        following = reference_now
        if reference.moving:
            following = self._deviation.state(reference, measured.unwind_speed_m_per_s, self._period_s)
        return Estimate(
            errors=errors,
            state=state.predicted + correction[:width] - reference_now,
            disturbance_nm=disturbance,
            in_flight_nm=in_flight + disturbance,
            reference_next=following,
            sent_nm=state.in_flight_nm,
            bump_nm=state.bump_nm,
        )

    def predict(self, found: Estimate, applied_nm: FloatArray) -> ObserverState:
        """For the next sample, given the torque (n,) that is sent now."""
        now = applied_nm - found.errors.torque_nm + found.disturbance_nm
        predicted = self._ahead.dot(np.concatenate((found.state, now, found.in_flight_nm.ravel())))
        return ObserverState(
            found.reference_next + predicted,
            found.disturbance_nm,
            newest_first(found.sent_nm, applied_nm),
            self._fade * found.bump_nm,
        )

    def _measured(self, measured: Measured, reference: Reference) -> FloatArray:
        """The first estimate: a tension near its set-point is taken to be there, not where one sample has it."""
        there = self._there(measured, reference)
        return np.concatenate((np.where(there, reference.tension_n, measured.tension_n), measured.speed_m_per_s))

    def _there(self, measured: Measured, reference: Reference) -> BoolArray:
        """Spans (n,) whose tension is near its set-point; one without a load cell is taken to be."""
        setpoint = reference.tension_n
        there = np.abs(measured.tension_n - setpoint) <= NEAR_SETPOINT * setpoint
        there[self._draw] = True
        return there

"""Torques that were sent and do not act yet when a sample is taken."""

import numpy as np

from gateway.control.deviation import Deviation, Errors, Measured
from gateway.control.reference import Reference
from gateway.core.signals import FloatArray


def newest_first(in_flight_nm: FloatArray, applied_nm: FloatArray) -> FloatArray:
    """`in_flight_nm` (d, n), newest first, a period later: `applied_nm` (n,) in front, the oldest gone."""
    later = np.empty_like(in_flight_nm)
    later[:1], later[1:] = applied_nm, in_flight_nm[:-1]
    return later


def deviations(
    deviation: Deviation, in_flight_nm: FloatArray, errors: Errors, measured: Measured, reference: Reference
) -> FloatArray:
    """`in_flight_nm` (d, n) less the reference torque of each one's own time."""
    if not reference.moving:
        return in_flight_nm - errors.torque_nm
    unwind = measured.unwind_speed_m_per_s
    own = [deviation.torque(reference, unwind, -1 - age) for age in range(len(in_flight_nm))]
    return in_flight_nm - np.array(own).reshape(in_flight_nm.shape)

"""What must never be left while the line runs: the limits of the line's file, as each cycle checks them."""

from dataclasses import dataclass

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import FloatArray


@dataclass(frozen=True, slots=True)
class EnvelopeLimits:
    """Limits of a line. SI, one entry per span where an array."""

    period_s: float
    torque_nm: float  #: per drive, either direction
    torque_rate_nm_per_s: float
    tension_min_n: float
    tension_max_n: float
    speed_max_m_per_s: float
    hold_periods: int  #: periods in a row without a signal until STOP
    band_periods: int  #: periods in a row outside the tension band until STOP
    overruns_in_a_row: int  #: periods in a row with an overrun until STOP
    skipped_periods: int  #: more than these skipped at once: STOP
    measured: FloatArray  #: (n,), 1.0 where a load cell measures the span


def envelope_limits(line: Line) -> EnvelopeLimits:
    """The limits of `line`."""
    return EnvelopeLimits(
        period_s=line.control.period_s,
        torque_nm=line.limits.torque_nm,
        torque_rate_nm_per_s=line.limits.torque_rate_nm_per_s,
        tension_min_n=line.limits.tension_min_n,
        tension_max_n=line.limits.tension_max_n,
        speed_max_m_per_s=line.limits.speed_max_m_per_s,
        hold_periods=line.limits.hold_periods,
        # One sample outside may be a spike; two in a row are the web.
        band_periods=2,
        overruns_in_a_row=3,
        skipped_periods=5,
        measured=np.array([1.0 if span.control == "tension" else 0.0 for span in line.spans]),
    )

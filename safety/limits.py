"""What must never be left while the line runs: the limits of the line's file, as each cycle checks them."""

from dataclasses import dataclass

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import FloatArray

WATCHED = 0.85  #: of the roller speed at which torque goes off: what is foreseen to go beyond it is not let happen
STEP_ROOM = 0.9  #: of that less the web's speed: what a step may take of it, so that noise does not do the rest


@dataclass(frozen=True, slots=True)
class EnvelopeLimits:
    """Limits of a line. SI, one entry per span where an array. Periods are counted in a row unless said otherwise."""

    period_s: float
    torque_nm: float  #: per drive, either direction
    torque_rate_nm_per_s: float
    tension_min_n: float
    tension_max_n: float
    speed_max_m_per_s: float
    measured: FloatArray  #: (n,), 1.0 where a load cell measures the span
    hold_periods: int  #: without a signal until STOP
    miss_window: int = 20  #: periods over which single misses are counted
    band_periods: int = 2  #: outside the tension band, or over a speed: one sample may be a spike, two are the web
    transport_periods: int = 10  #: without transport on the PLC's side until STOP
    overruns_in_a_row: int = 3
    skipped_periods: int = 5  #: more than these skipped at once: STOP
    unwinder_overspeed: float = 1.1  #: times the greatest speed
    roller_overspeed: float = 1.5  #: a roller runs ahead while it tensions its span
    standstill_overspeed: float = 1.0  #: of a roller while the unwinder stands still

    @property
    def roller_speed_m_per_s(self) -> float:
        """Of a roller's surface, either way: beyond it torque goes off."""
        return self.roller_overspeed * self.speed_max_m_per_s

    @property
    def roller_speed_watched_m_per_s(self) -> float:
        """What monitor and judge let a roller come to in what they foresee."""
        return WATCHED * self.roller_speed_m_per_s

    def roller_speed_in_step_m_per_s(self, web_m_per_s: float) -> float:
        """What a roller may come to in a step that is foreseen, at the unwinder's speed after it."""
        watched = self.roller_speed_watched_m_per_s
        return min(watched, web_m_per_s + STEP_ROOM * (watched - web_m_per_s))


def envelope_limits(line: Line) -> EnvelopeLimits:
    """The limits of `line`."""
    return EnvelopeLimits(
        period_s=line.control.period_s,
        torque_nm=line.limits.torque_nm,
        torque_rate_nm_per_s=line.limits.torque_rate_nm_per_s,
        tension_min_n=line.limits.tension_min_n,
        tension_max_n=line.limits.tension_max_n,
        speed_max_m_per_s=line.limits.speed_max_m_per_s,
        measured=np.array([1.0 if span.control == "tension" else 0.0 for span in line.spans]),
        hold_periods=line.limits.hold_periods,
    )

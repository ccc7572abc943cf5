"""What must never be left while the line runs: the limits of the line's file, as each cycle checks them."""

from dataclasses import dataclass
from math import inf

import numpy as np

from gateway.core.line import Line
from gateway.core.line_limits import tension_bands_n, torque_limits_nm
from gateway.core.signals import FloatArray
from safety.tensioning import tensioning_trip_m_per_s

PARTING_SHARE = 120.0  #: of the greatest speed: ten times a good encoder's noise
STANDSTILL_SHARE = 60.0  #: of the greatest speed: slower, nobody can tell whether an unwinder moves
WATCHED = 0.85  #: of the roller speed at which torque goes off: what is foreseen to go beyond it is not let happen
STEP_ROOM = 0.9  #: of that less the web's speed: what a step may take of it, so that noise does not do the rest


@dataclass(frozen=True, slots=True)
class EnvelopeLimits:
    """Limits of a line. SI, one entry per span where an array. Periods are counted in a row unless said otherwise."""

    period_s: float
    torque_nm: float | FloatArray  #: per drive, either direction; (n,) where they differ
    torque_rate_nm_per_s: float
    tension_min_n: float | FloatArray  #: (n,) where they differ
    tension_max_n: float | FloatArray
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
    tensioning_speed_m_per_s: float = inf  #: of a roller's surface while the web is being tensioned, either way

    @property
    def parting_m_per_s(self) -> float:
        """By which the roller behind a break runs ahead, at least."""
        return self.speed_max_m_per_s / PARTING_SHARE

    @property
    def standstill_m_per_s(self) -> float:
        """Up to which what is measured counts as standstill."""
        return self.speed_max_m_per_s / STANDSTILL_SHARE

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


def envelope_limits(line: Line, speed_steps_m_per_s: FloatArray | None = None) -> EnvelopeLimits:
    """The limits of `line`. `speed_steps_m_per_s` (n,) is what a count of each drive's speed is worth; None: 0."""
    count_m_per_s = 0.0 if speed_steps_m_per_s is None else float(speed_steps_m_per_s.max())
    low, high = tension_bands_n(line)
    return EnvelopeLimits(
        period_s=line.control.period_s,
        torque_nm=_alike(torque_limits_nm(line)),
        torque_rate_nm_per_s=line.limits.torque_rate_nm_per_s,
        tension_min_n=_alike(low),
        tension_max_n=_alike(high),
        speed_max_m_per_s=line.limits.speed_max_m_per_s,
        measured=np.array([1.0 if span.control == "tension" else 0.0 for span in line.spans]),
        hold_periods=line.limits.hold_periods,
        tensioning_speed_m_per_s=tensioning_trip_m_per_s(line, count_m_per_s),
    )


def _alike(each: FloatArray) -> float | FloatArray:
    """One number where all are the same: it is compared sooner."""
    first = float(each[0])
    return first if (each == first).all() else each

"""Limits of single rollers and spans: their own where the line's file gives one, else those that all have in common.

What all have in common is the widest: no roller and no span goes beyond it.
"""

from typing import TYPE_CHECKING

import numpy as np

from gateway.core.signals import FloatArray

if TYPE_CHECKING:  # what the line's file leaves out is derived from these
    from gateway.core.line import Drive, Line


OF_GREATEST_CHANGE = 0.7  #: of a torque in a period: there and back every period is chatter by any measure


def torque_limits_nm(line: "Line") -> FloatArray:
    """Of each roller's drive (n,), either direction."""
    common = line.limits.torque_nm
    return np.array([common if roller.torque_nm is None else roller.torque_nm for roller in line.rollers])


def torque_limit_nm(line: "Line", roller: int) -> float:
    """Of one roller's drive, from 1; of one that the line does not have, what all have in common."""
    if not 1 <= roller <= len(line.rollers):
        return line.limits.torque_nm
    return float(torque_limits_nm(line)[roller - 1])


def chatter_limit_nm(line: "Line") -> float:
    """By how much a torque may change from period to period, root mean square, where nothing moves.

    As the gate has it; where drives change so slowly that none could chatter by it, most of what they can.
    """
    most_nm = line.limits.torque_rate_nm_per_s * line.control.period_s
    return min(line.gate.chatter_max_nm, OF_GREATEST_CHANGE * most_nm)


def motor_torque_limit_nm(line: "Line", drive: "Drive") -> float:
    """Of a drive's motor, in front of its gear."""
    return torque_limit_nm(line, drive.roller) / drive.gear


def motor_radius_m(line: "Line", drive: "Drive") -> float:
    """m of web per rad of a drive's motor."""
    return line.rollers[drive.roller - 1].radius_m.value / drive.gear


def torque_limit_key(line: "Line", roller: int) -> str:
    """Where the line's file says it: `rollers[2].torque_nm`, or `limits.torque_nm`."""
    own = 1 <= roller <= len(line.rollers) and line.rollers[roller - 1].torque_nm is not None
    return f"rollers[{roller}].torque_nm" if own else "limits.torque_nm"


def tension_bands_n(line: "Line") -> tuple[FloatArray, FloatArray]:
    """Least and greatest tension of each span, (n,) each."""
    limits = line.limits
    low = [limits.tension_min_n if span.tension_min_n is None else span.tension_min_n for span in line.spans]
    high = [limits.tension_max_n if span.tension_max_n is None else span.tension_max_n for span in line.spans]
    return np.array(low), np.array(high)


def tension_band_n(line: "Line", span: int) -> tuple[float, float]:
    """Of one span, from 1."""
    low, high = tension_bands_n(line)
    return float(low[span - 1]), float(high[span - 1])


def setpoint_bands_n(line: "Line") -> tuple[FloatArray, FloatArray]:
    """Where set-points may be, (n,) each: as far inside as noise and overshoot need."""
    low, high = tension_bands_n(line)
    return low + line.limits.tension_margin_n, high - line.limits.tension_margin_n


def has_own_torques(line: "Line") -> bool:
    """Whether any roller has a torque limit of its own."""
    return any(roller.torque_nm is not None for roller in line.rollers)

"""Defaults of the line's file that have a dimension: derived from the rest of the file where a key is not given.

What people decide (times that they wait, shares) is no matter of the line's size and keeps its number.
"""

from typing import TYPE_CHECKING

from gateway.core.line_limits import torque_limits_nm
from gateway.core.line_scales import line_scales

if TYPE_CHECKING:
    from gateway.core.line import Line

TENSIONING_SHARE = 0.15  #: of `tensioning_time_s`, in which set-points may go through the greatest tension
PULLED = 0.5  #: of the greatest speed, at which the last roller may be pulled when all spans are tensioned
RAMPED, STOPPED = 0.02, 0.04  #: of the acceleration that its torque limit gives the slowest roller
UNLOADED = 0.2  #: of the greatest rate of a torque


def derived_defaults(line: "Line") -> dict[str, dict[str, float]]:
    """By table and key, what a file that does not give the key means by it."""
    scales, control, limits = line_scales(line), line.control, line.limits
    length_m = sum(span.length_m.value for span in line.spans)
    slowest_m_per_s2 = min(
        roller.radius_m.value * limit_nm / roller.inertia_kg_m2.value
        for roller, limit_nm in zip(line.rollers, torque_limits_nm(line).tolist(), strict=True)
    )
    return {
        "limits": {"tension_margin_n": scales.tension_n},
        "moves": {
            "tension_rate_n_per_s": min(
                limits.tension_max_n / TENSIONING_SHARE / limits.tensioning_time_s,
                PULLED * limits.speed_max_m_per_s * line.web.stiffness_n.value / length_m,
            ),
            "speed_rate_m_per_s2": RAMPED * slowest_m_per_s2,
            "stop_rate_m_per_s2": STOPPED * slowest_m_per_s2,
            "torque_off_rate_nm_per_s": UNLOADED * limits.torque_rate_nm_per_s,
        },
        "gate": {
            "decay_min_per_s": 1.0 / limits.tensioning_time_s,
            "delay_margin_min_s": 0.4 * control.latency_s,
            "stress_coulomb_nm": limits.torque_nm / 30.0,
            "tail_oscillation_max_n": scales.tension_n,
            "tail_error_max_n": 3.0 * scales.tension_n,
            "chatter_max_nm": limits.torque_nm / 12.0,
            "tolerance_n": scales.tension_n / 10.0,
            "tolerance_settling_s": 5.0 * scales.moment_s,
            "first_speed_max_m_per_s": limits.speed_max_m_per_s / 6.0,
            "first_step_max_n": 4.0 * scales.tension_n,
        },
    }

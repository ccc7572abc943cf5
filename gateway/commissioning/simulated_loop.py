"""How the loop of a line is closed where the commissioning simulates it. Pure."""

import numpy as np

from gateway.control.rollout import Setup
from gateway.core.line import Line
from gateway.core.line_limits import has_own_torques, torque_limits_nm
from gateway.core.line_scales import longest_step_of, runaway_n
from gateway.core.theta import Noise

QUIET = Noise(0.0, 0.0, 0.0)


def loop_of(line: Line, noise: Noise) -> Setup:
    """The line's loop; the latency is that of the plants."""
    period_s, limits = line.control.period_s, line.limits
    return Setup(
        period_s=period_s,
        latency_s=0.0,
        substeps=max(1, int(np.ceil(period_s / longest_step_of(line) - 1e-9))),
        torque_nm=torque_limits_nm(line) if has_own_torques(line) else limits.torque_nm,
        torque_rate_nm_per_s=limits.torque_rate_nm_per_s,
        runaway_n=runaway_n(line),
        tension_noise_n=noise.tension_n,
        speed_noise_m_per_s=noise.speed_m_per_s,
        acceleration_m_per_s1_5=noise.acceleration_m_per_s1_5,
    )

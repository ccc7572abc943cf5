"""How the loop of a line is closed where the commissioning simulates it. Pure."""

import numpy as np

from gateway.control.rollout import Setup
from gateway.core.line import Line
from gateway.core.theta import Noise

LONGEST_STEP_S = 0.005  #: of the integration
QUIET = Noise(0.0, 0.0, 0.0)


def loop_of(line: Line, noise: Noise) -> Setup:
    """The line's loop; the latency is that of the plants."""
    period_s, limits = line.control.period_s, line.limits
    return Setup(
        period_s=period_s,
        latency_s=0.0,
        substeps=max(1, int(np.ceil(period_s / LONGEST_STEP_S - 1e-9))),
        torque_nm=limits.torque_nm,
        torque_rate_nm_per_s=limits.torque_rate_nm_per_s,
        tension_noise_n=noise.tension_n,
        speed_noise_m_per_s=noise.speed_m_per_s,
        acceleration_m_per_s1_5=noise.acceleration_m_per_s1_5,
    )

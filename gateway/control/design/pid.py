"""PID as a web-handling engineer would set it up."""

import numpy as np

from gateway.control.design.lq import shared
from gateway.control.design.task import DesignTask, check_task
from gateway.control.design.weights import RATE_POWER, encoder_bandwidth, rate_share, stood_s
from gateway.core.controller_laws import PidConfig

SPEED_SHARE, TENSION_SHARE = 0.5, 1.0 / 3.0
DEAD_TIME_SHARE = 15.0 / 19.0
RATE_TIME_S = 0.007  #: at 1000 Nm/s


def design_pid(task: DesignTask, speed_share: float = SPEED_SHARE, tension_share: float = TENSION_SHARE) -> PidConfig:
    """Cascade in matrix form: a speed loop per roller, tension trim on the draw of each span, passed on to every roller
    downstream so that spans behind it keep their draw.

    Bandwidths follow from a dead time: 15/19 of what the loop must stand, `stood_s` (15 ms at 10 ms period and
    latency), or the time that drives of a small torque rate make of it; speed `speed_share` / dead time, or what the
    noise of encoders allows; tension `tension_share` of it, integral time four times the tension loop's: chosen on the
    same plants as `LqiWeights`.
    Raises DesignRefused.
    """
    check_task(task)
    model, n = task.model, task.n
    dead_time_s = max(DEAD_TIME_SHARE * stood_s(task), RATE_TIME_S * rate_share(task) ** (RATE_POWER / 4.0))
    speed_bandwidth = min(speed_share / dead_time_s, encoder_bandwidth(task))
    tension_bandwidth = speed_bandwidth * tension_share
    speed_gain = model.inertia_kg_m2 * speed_bandwidth / model.radius_m
    # Speed that removes 1 N of span j within the tension loop's time constant, at every roller from j on.
    trim = np.tril(np.ones((n, n))) * (model.length_m / model.stiffness_n) * tension_bandwidth
    tension_gain = speed_gain[:, None] * trim
    integral_gain = tension_gain * tension_bandwidth / 4.0
    for i in task.draw_spans:
        tension_gain[:, i] = 0.0
        integral_gain[:, i] = 0.0
        integral_gain[i, i] = speed_gain[i] * speed_bandwidth / 4.0
    return PidConfig(
        **shared(task),
        gain_proportional=np.hstack((tension_gain, np.diag(speed_gain))).tolist(),
        gain_integral=integral_gain.tolist(),
        # Roller speed is the derivative of tension up to a constant, and far less noisy: its gain does the work.
        gain_derivative=np.zeros((n, n)).tolist(),
        derivative_filter_s=5.0 * task.period_s,
        antiwindup=0.05,
    )

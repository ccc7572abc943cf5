"""PID as a web-handling engineer would set it up."""

import numpy as np

from gateway.control.design.lq import shared
from gateway.control.design.task import DesignTask, check_task
from gateway.core.controller_laws import PidConfig


def design_pid(task: DesignTask, speed_share: float = 0.5, tension_share: float = 1.0 / 3.0) -> PidConfig:
    """Cascade in matrix form: a speed loop per roller, tension trim on the draw of each span, passed on to every roller
    downstream so that spans behind it keep their draw.

    Bandwidths follow from the dead time (latency and half a period of hold; a period at least): speed `speed_share` /
    dead time, tension
    `tension_share` of it, integral time four times the tension loop's: chosen on the same kind of plants as
    `LqiWeights`. Raises DesignRefused.
    """
    check_task(task)
    model, n = task.model, task.n
    dead_time_s = task.latency_s + 0.5 * task.period_s
    speed_bandwidth = speed_share / max(dead_time_s, task.period_s)
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

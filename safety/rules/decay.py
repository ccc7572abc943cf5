"""Whether the linear loop is stable at the corners of what is believed: a cheap look before anything is simulated."""

from math import log

import numpy as np

from gateway.control.design.margins import closed_loop
from gateway.control.design.sampling import with_dead_time
from gateway.control.design.task import LEAST_DRAW_SPEED_M_PER_S, linear
from gateway.control.linear_form import linear_form, without_constants
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.controller_schedule import LinearConfig, ScheduledConfig, law_at
from gateway.core.theta import Theta
from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import at_least
from safety.simulated import judged_of

RULE = "decay"
LOOKED_AT = 8  #: corners, each slow and fast


def check(case: Case) -> list[RuleFinding]:
    """The slowest mode's decay rate, 1/s, at some of the corners, slow and fast."""
    judged = judged_of(case)
    speeds = sorted({judged.slow_m_per_s, judged.fast_m_per_s})
    thetas = [case.believed, *case.corners[:LOOKED_AT]]
    found = [
        (decay_per_s(case.controller, case, theta, speed), _least(case, theta, speed), speed)
        for theta in thetas
        for speed in speeds
    ]
    rate, least, speed = min(found, key=lambda each: each[0] - each[1])
    what = f"the slowest mode decays at {rate:.3g} 1/s" if rate > 0.0 else "the loop is unstable"
    text = (
        f"{what} at {speed:g} m/s on the worst of {len(thetas)} plants that the line may be; allowed: {least:.3g} 1/s "
        f"and more (gate.decay_min_per_s{', or half of what a draw span has by itself' if case.draw_spans else ''})"
    )
    return [at_least(RULE, rate, least, "1/s", text)]


def _least(case: Case, theta: Theta, speed_m_per_s: float) -> float:
    """A draw span's tension decays with its length over the speed, whatever the controller does."""
    own = [speed_m_per_s / theta.web.length_m[i] for i in case.draw_spans]
    return min([case.line.gate.decay_min_per_s, *(0.5 * float(rate) for rate in own)])


def decay_per_s(config: Controller, case: Case, theta: Theta, speed_m_per_s: float, extra_s: float = 0.0) -> float:
    """Of the slowest mode of the linear loop on a plant at a speed, with so much more delay; below 0: unstable."""
    task = case.task(theta, max(speed_m_per_s, LEAST_DRAW_SPEED_M_PER_S if case.draw_spans else 0.0))
    form = without_constants(linear_form(law_for(config, speed_m_per_s)))
    plant = with_dead_time(*linear(task), task.period_s, task.latency_s + extra_s)
    loop = closed_loop(form, plant)
    if not np.isfinite(loop).all():
        return -np.inf
    radius = float(np.abs(np.linalg.eigvals(loop)).max())
    if not radius < np.inf:  # numbers near the greatest there are: a minimum over plants would pass over NaN
        return -np.inf
    return -log(max(radius, 1e-300)) / task.period_s


def law_for(config: Controller, speed_m_per_s: float) -> LinearConfig | MpcConfig:
    """The linear law that runs at a speed."""
    return law_at(config, speed_m_per_s) if isinstance(config, ScheduledConfig) else config

"""How much more delay the loop stands than the line has: what is left for a late computer, bus or drive."""

from math import ceil

from gateway.control.design.task import LEAST_DRAW_SPEED_M_PER_S
from gateway.core.controller_schedule import ScheduledConfig
from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import at_least
from safety.rules.decay import decay_per_s
from safety.simulated import judged_of

RULE = "delay margin"
STEP = 0.1  #: of a period
BEYOND = 2.0  #: times the limit is looked at; more is more


def check(case: Case) -> list[RuleFinding]:
    """Seconds beyond the latency at which the linear loop on the mean model is still stable, slow and fast."""
    judged, least_s = judged_of(case), case.line.gate.delay_margin_min_s
    speeds = {max(judged.slow_m_per_s, LEAST_DRAW_SPEED_M_PER_S), judged.fast_m_per_s}
    config = case.controller
    if isinstance(config, ScheduledConfig):
        speeds |= {speed for speed in config.speed_m_per_s if speed < judged.fast_m_per_s}
    stood_s, speed = min((stands_s(case, speed, BEYOND * least_s), speed) for speed in sorted(speeds))
    more = " or more" if stood_s >= BEYOND * least_s * (1.0 - 1e-6) else ""
    text = (
        f"the loop stands {1e3 * stood_s:.1f} ms{more} beyond a latency of {1e3 * case.latency_s:.1f} ms, at {speed:g} "
        f"m/s; allowed: gate.delay_margin_min_s, {1e3 * least_s:g} ms, and more"
    )
    return [at_least(RULE, stood_s, least_s, "s", text)]


def stands_s(case: Case, speed_m_per_s: float, most_s: float) -> float:
    """The delay up to which every `STEP` of a period is stable, at the most the first that is no less than `most_s`.

    Below 0: unstable without any.
    """
    step_s = STEP * case.line.control.period_s
    steps = max(1, ceil(most_s / step_s - 1e-9))
    for step in range(steps + 1):
        if not decay_per_s(case.controller, case, case.believed, speed_m_per_s, step * step_s) > 0.0:
            return (step - 1) * step_s
    return steps * step_s

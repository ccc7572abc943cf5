"""The controller is one for this line: size, period, latency, spans without a load cell, limits that it plans with.

And so is what its feed-forward takes rollers and web for. That acts while speed or set-points move along a ramp or a
curve, where simulated courses have steps: what is far too large would drive the web as no rule has seen it. What is too
small leaves the work to the feedback, which is simulated.
"""

from collections.abc import Iterator

import numpy as np

from gateway.core.controller_laws import MpcConfig
from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import told

RULE = "fits the line"
MOST_OVER = 2.0  #: of what is believed at most: a feed-forward that is twice too large is as wrong as none at all
PERIODS_OFF = 1.0  #: by which a law's latency may differ from the measured one: torque lag is taken as dead time


def check(case: Case) -> list[RuleFinding]:
    """One finding for each thing that does not fit, or one that all does."""
    wrong = list(_wrong(case))
    if not wrong:
        return [told(RULE, True, f"the controller is one for {case.line.n} spans at this period and latency")]
    return [told(RULE, False, text) for text in wrong]


def _wrong(case: Case) -> Iterator[str]:
    line, config = case.line, case.controller
    if config.n != line.n:
        yield f"the controller is for {config.n} spans; allowed: {line.n}, as the line has"
    if not abs(config.period_s - line.control.period_s) <= 1e-9:  # a number that is none does not fit
        yield (
            f"the controller's period is {config.period_s:g} s; allowed: that of the loop, {line.control.period_s:g} s"
        )
    most_s = PERIODS_OFF * line.control.period_s
    if not abs(config.latency_s - case.latency_s) <= most_s + 1e-9:
        yield (
            f"the controller counts on a latency of {config.latency_s:g} s; allowed: within {most_s:g} s of the line's "
            f"{case.latency_s:g} s"
        )
    draw = [i for i, span in enumerate(line.spans) if span.control == "draw"]
    if config.draw_spans != draw:
        yield f"the controller takes spans {config.draw_spans} (from 0) for draw-controlled; allowed: {draw}"
    if config.n == line.n:
        yield from _wrong_feedforward(case)
    if isinstance(config, MpcConfig):
        yield from _wrong_plan(case, config)


def _wrong_feedforward(case: Case) -> Iterator[str]:
    """J/R multiplies a roller's acceleration, L/EA the rates of a tension (see `gateway.control.deviation`)."""
    own, webs = case.controller.feedforward, [theta.web for theta in case.corners]
    heaviest = np.max([web.inertia_kg_m2 / web.radius_m for web in webs], axis=0)
    softest = np.max([web.length_m / web.stiffness_n for web in webs], axis=0)
    parts = {
        "J/R": np.divide(own.inertia_kg_m2, own.radius_m) / heaviest,
        "L/EA": np.array(own.length_m) / own.stiffness_n / softest,
    }
    for name, times in parts.items():
        for i in np.flatnonzero(~(times <= MOST_OVER)).tolist():
            yield (
                f"its feed-forward takes {name} of section {i + 1} for {times[i]:.3g} times the most that is believed; "
                f"allowed: up to {MOST_OVER:g}"
            )


def _wrong_plan(case: Case, config: MpcConfig) -> Iterator[str]:
    limits = case.line.limits
    for name, planned, most, unit in (
        ("torque_nm", config.torque_nm, limits.torque_nm, "Nm"),
        ("torque_rate_nm_per_s", config.torque_rate_nm_per_s, limits.torque_rate_nm_per_s, "Nm/s"),
        ("tension_max_n", config.tension_max_n, limits.tension_max_n, "N"),
    ):
        if not planned <= most * (1.0 + 1e-9):
            yield f"the controller plans with {name} {planned:g} {unit}; allowed: up to the line's {most:g} {unit}"

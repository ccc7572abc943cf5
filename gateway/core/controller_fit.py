"""Whether a controller configuration is one for this line: dimensions, timing, limits; nothing about how good it is."""

from gateway.core.controller import Controller
from gateway.core.line import Line

#: A design on an identified model has the dead time that was found, the drives' lag in it. One for somewhat more than
#: the line's file says is slower than need be; one for less would eat its own delay margin, so that the file must be
#: put right first. In periods.
LESS_LATENCY, MORE_LATENCY = 0.1, 1.0


def misfits(config: Controller, line: Line) -> list[str]:
    """Why `config` must not run on `line`; none: it may."""
    draw = [i for i, span in enumerate(line.spans) if span.control == "draw"]
    reasons: list[str] = []
    if config.n != line.n:
        reasons.append(f"it is for {config.n} span{'' if config.n == 1 else 's'}, the line has {line.n}")
    elif config.draw_spans != draw:
        spans = [[i + 1 for i in indices] for indices in (config.draw_spans, draw)]
        reasons.append(f"its draw-controlled spans are {spans[0]}, the line's {spans[1]}")
    if abs(config.period_s - line.control.period_s) > 1e-9:
        reasons.append(f"it is for a period of {config.period_s} s, the line's is {line.control.period_s} s")
    least_s = line.control.latency_s - LESS_LATENCY * line.control.period_s - 1e-9
    most_s = line.control.latency_s + MORE_LATENCY * line.control.period_s + 1e-9
    if not least_s <= config.latency_s <= most_s:
        reasons.append(
            f"it is for a latency of {config.latency_s} s, the line's is {line.control.latency_s} s; allowed: "
            f"{least_s:.4g} to {most_s:.4g} s"
        )
    if config.kind == "mpc" and (config.torque_nm, config.torque_rate_nm_per_s) != (
        line.limits.torque_nm,
        line.limits.torque_rate_nm_per_s,
    ):
        reasons.append("it plans with other limits of torque and torque rate than the line's")
    if config.feedforward.stiffness_n <= line.limits.tension_max_n:
        reasons.append(f"its web stiffness of {config.feedforward.stiffness_n:g} N is below the greatest tension")
    return reasons

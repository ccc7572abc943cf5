"""What a line is tried with when nobody says otherwise: the largest steps that its limits allow.

A line that allows none is tried with moves, as fast as it makes them.
"""

from gateway.control.reference import MinimumJerk
from gateway.core.line import Line
from gateway.core.scenario import Scenario

PROBE = 0.25  #: of a set-point: the move of a line that allows no steps
WATCHED_S = 15.0  #: in all, beside a move
SLOW = 0.1  #: of the greatest speed: where a speed step begins


def suite_of(line: Line) -> tuple[Scenario, ...]:
    """A tension step of the middle span, and a speed step; both at the first recipe's tensions."""
    limits, recipe = line.limits, line.recipes[0]
    tensions = list(recipe.tension_n)
    controlled = [i for i, span in enumerate(line.spans) if span.control == "tension"]
    found: list[Scenario] = []
    if controlled:
        span = controlled[(len(controlled) - 1) // 2]
        before = tensions[span]
        wanted = limits.tension_step_max_n or PROBE * before
        up = min(wanted, limits.tension_max_n - limits.tension_margin_n - before)
        down = min(wanted, before - limits.tension_min_n - limits.tension_margin_n)
        after = before + up if up >= down else before - down
        if after != before:
            move_s = _move_s(limits.tension_step_max_n, abs(after - before), line.moves.tension_rate_n_per_s)
            text = f"span {span + 1} goes from {before:g} to {after:g} N"
            found.append(
                Scenario(
                    name="tension-step", title="Tension step", description=text[0].upper() + text[1:] + ".",
                    tension_n=tensions, speed_m_per_s=_slow(line),
                    tension_after_n=[*tensions[:span], after, *tensions[span + 1 :]],
                    move_s=move_s, duration_s=WATCHED_S + move_s,
                )
            )  # fmt: skip
    slow, fast = _slow(line), limits.speed_max_m_per_s
    end = min(slow + (limits.speed_step_max_m_per_s or PROBE * fast), fast)
    move_s = _move_s(limits.speed_step_max_m_per_s, end - slow, line.moves.speed_rate_m_per_s2)
    found.append(
        Scenario(
            name="speed-step", title="Speed step", description=f"The unwinder goes from {slow:g} to {end:g} m/s.",
            tension_n=tensions, speed_m_per_s=slow, speed_after_m_per_s=end,
            move_s=move_s, duration_s=WATCHED_S + move_s,
        )
    )  # fmt: skip
    return tuple(found)


def _move_s(step_allowed: float, size: float, rate: float) -> float:
    """0 for a step; else what a curve takes whose greatest rate is that of the line's moves."""
    return 0.0 if step_allowed else MinimumJerk.PEAK * size / rate


def _slow(line: Line) -> float:
    fastest = line.limits.speed_max_m_per_s
    return min(line.recipes[0].speed_m_per_s or SLOW * fastest, 0.5 * fastest)

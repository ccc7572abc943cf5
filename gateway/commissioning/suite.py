"""What a line is tried with when nobody says otherwise: the largest steps that its limits allow."""

from gateway.core.line import Line
from gateway.core.scenario import Scenario

PROBE = 0.25  #: of a set-point: the step of a line that allows none, as a disturbance would move it
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
            text = f"span {span + 1} steps from {before:g} to {after:g} N"
            found.append(
                Scenario(
                    name="tension-step", title="Tension step", description=text[0].upper() + text[1:] + ".",
                    tension_n=tensions, speed_m_per_s=_slow(line),
                    tension_after_n=[*tensions[:span], after, *tensions[span + 1 :]],
                )
            )  # fmt: skip
    slow, fast = _slow(line), limits.speed_max_m_per_s
    end = min(slow + (limits.speed_step_max_m_per_s or PROBE * fast), fast)
    found.append(
        Scenario(
            name="speed-step", title="Speed step", description=f"The unwinder steps from {slow:g} to {end:g} m/s.",
            tension_n=tensions, speed_m_per_s=slow, speed_after_m_per_s=end,
        )
    )  # fmt: skip
    return tuple(found)


def _slow(line: Line) -> float:
    fastest = line.limits.speed_max_m_per_s
    return min(line.recipes[0].speed_m_per_s or SLOW * fastest, 0.5 * fastest)

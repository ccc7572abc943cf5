"""Whether a scenario stays within what a configuration was judged for."""

from gateway.core.deployment import Region
from gateway.core.scenario import Scenario


def beyond(case: Scenario, region: Region | None) -> str:
    """Why a configuration that was judged for `region` does not run a case; empty: it does."""
    if region is None:
        return ""
    speed = max(case.speed_m_per_s, case.speed_end_m_per_s)
    wanted = (
        ("the speed", speed, region.speed_max_m_per_s, "m/s"),
        ("the step of tension", case.tension_step_n, region.tension_step_max_n, "N"),
        ("the step of speed", case.speed_step_m_per_s, region.speed_step_max_m_per_s, "m/s"),
    )
    return "; ".join(
        f"{what} is {value:g} {unit}, it was judged up to {most:g} {unit}"
        for what, value, most, unit in wanted
        if most is not None and value > most * (1.0 + 1e-9)
    )

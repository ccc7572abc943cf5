"""Numbers as they are told: four digits, and null for what has no end."""

from math import isfinite

from gateway.commissioning.records import Trial
from gateway.core.questions import Figure


def figure(name: str, value: float | None, unit: str = "") -> Figure:
    known = None if value is None or not isfinite(value) else float(f"{value:.4g}")
    return Figure(name=name[:80], value=known, unit=unit)


def of_trial(trial: Trial, before: str = "") -> list[Figure]:
    """Of what became of a controller in simulation. `before` stands before each name."""
    errors = [figure(f"{before}tracking error, {name}", value, "N") for name, value in trial.rmse_n.items()]
    return [
        *errors,
        figure(f"{before}overshoot", trial.overshoot_pct, "%"),
        figure(f"{before}settling time", trial.settling_s, "s"),
        figure(f"{before}effort", trial.effort_n2m2s, "(Nm)2 s"),
        figure(f"{before}torque chatter", trial.chatter_nm, "Nm"),
        figure(f"{before}least tension", trial.tension_min_n, "N"),
        figure(f"{before}greatest tension", trial.tension_max_n, "N"),
        figure(f"{before}delay margin", 1e3 * trial.delay_margin_s, "ms"),
        figure(f"{before}error left by noise", trial.noise_floor_n, "N"),
    ]


def sentences(words: list[str], most: int = 40) -> list[str]:
    """As a result has them: some, and none too long."""
    return [one[:600] for one in words if one][:most]

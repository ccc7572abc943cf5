"""What measurements of the commissioning have shown, in the Performance Baseline Database of the line.

A measurement is known by the hash of the proposal under which it ran; what was found of it lies in its conditions.
"""

from pathlib import Path

from pydantic import ValidationError

from gateway.cli.commission_changes import LineNow
from gateway.commissioning.convergence import Convergence
from gateway.commissioning.past import Follows
from gateway.core.controller import config_hash
from gateway.core.line import Line
from gateway.core.line_model import model_hash
from gateway.supervisor.baselines import FILE_NAME, Measured, MeasuredRun, begin_baselines, open_baselines

SCENARIO = "measurement"
WHO = "rules"


def kept(folder: Path, line: Line) -> dict[str, Convergence]:
    """By proposal; the newest look counts. Raises BaselinesError."""
    if not (folder / FILE_NAME).exists():
        return {}
    found: dict[str, Convergence] = {}
    with open_baselines(folder / FILE_NAME) as database:
        for one in database.measurements(line.site, line.line, scenario=SCENARIO):
            try:
                found[str(one.run.conditions["proposal"])] = Convergence.model_validate(one.run.conditions["found"])
            except (KeyError, ValidationError):
                continue  # somebody else's measurement
    return found


def keep(folder: Path, line: Line, now: LineNow, proposal: str, found: Convergence, effort_n2m2s: float) -> None:
    """Where nothing is to follow, it is what the line is held against from now on. Raises BaselinesError."""
    worst, at_s = found.worst, now.at.timestamp()
    settling_s = float("inf") if worst.settling_s is None else worst.settling_s
    run = MeasuredRun(
        site=line.site,
        line=line.line,
        configuration=config_hash(now.in_service),
        model=None if now.model is None else model_hash(now.model),
        scenario=SCENARIO,
        measured_s=at_s,
        measured=Measured(found.rmse_n, worst.overshoot_pct, settling_s, effort_n2m2s),
        conditions={"proposal": proposal, "found": found.model_dump(mode="json")},
    )
    with begin_baselines(folder / FILE_NAME) as database:
        stored = database.add(run)
        if found.settled and found.follows is Follows.LEAVE:
            database.set_baseline(stored.number, at_s, WHO, f"the end of commissioning: {found.text}"[:400])

"""Part f of bench-identify: what normal operation tells, with no experiment: moves as an operator makes them, or none.

S_real under the LQI of the line's file, `DURATION_S` of production, as a history would hold them. Data are assessed as
`r2rgate identify` does; what a model would be is told also where the assessment refuses the data, to see whether it was
right to.
"""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.recording import Recording, recording_of
from gateway.core.telemetry import frame_dtype
from gateway.core.theta import Noise
from gateway.identification.estimate import Structure
from gateway.identification.findings import Severity
from gateway.identification.identify import NotIdentified, identify
from gateway.identification.prediction_error import fit
from gateway.identification.prior import prior_of
from tests.bench.identify_runs import SPEED_M_PER_S, Found, against_truth
from tests.closed_loop.recorded import TENSION_N, demonstration_line, real_plant

DURATION_S = 30.0
STEPS: dict[str, tuple[float, float]] = {  #: of set-points, one span after another: N, s from one to the next
    "small steps": (1.0, 4.0),
    "all three": (1.0, 4.0),
    "trimming": (2.0, 0.5),
}
FASTER_M_PER_S = 0.08  #: of the speed ramp
RECIPE_N = (30.0, 30.0, 30.0, 30.0, 30.0, 30.0)  #: of the recipe change
MOVE_AT_S = 5.0

RECIPE = ("recipe change", "all three", "trimming")
RAMP = ("speed ramp", "all three", "trimming")
MOVES = ("none", "small steps", "recipe change", "speed ramp", "all three", "trimming")


@dataclass(frozen=True)
class Passive:
    """Of one recording."""

    refused: dict[str, int]  #: kinds of findings, by how many
    warned: dict[str, int]
    offered: bool  #: whether phase 0 gives a model that holds
    why: str  #: there is none
    found: Found  #: a fit of the paper's structure, whatever the assessment says


def passive(case: tuple[str, int]) -> Passive:
    """(which of `MOVES`, seed)"""
    moves, seed = case
    line, data = demonstration_line(), operated(moves, seed)
    fitted = against_truth(fit([data], prior_of(line, Structure()), Noise()), real_plant())
    try:
        identified = identify([data], line, Noise(), time.perf_counter)
    except NotIdentified as refused:
        of_each = [finding for one in refused.assessments for finding in one.findings]
        kinds = {severity: Counter(one.kind for one in of_each if one.severity is severity) for severity in Severity}
        return Passive(dict(kinds[Severity.REFUSAL]), dict(kinds[Severity.WARNING]), False, str(refused), fitted)
    warned = Counter(one.kind for one in identified.warnings if one.severity is Severity.WARNING)
    own = against_truth(identified.fitted, real_plant()) if _is_the_papers(identified.estimate.structure) else fitted
    return Passive({}, dict(warned), identified.validation.valid, "; ".join(identified.validation.findings), own)


def operated(moves: str, seed: int) -> Recording:
    """Half a minute of production. Ramps and steps are the line's own: rates as its file has them."""
    line = demonstration_line()
    loop = SteppedLoop(line, design_lqi(task_of(line)), real_plant(), seed)
    loop.begin_in_production(np.array(TENSION_N), SPEED_M_PER_S)
    setpoints, period_s = loop.cycle.setpoints, line.control.period_s
    step_n, every_s = STEPS.get(moves, (0.0, DURATION_S))
    every, at = round(every_s / period_s), round(MOVE_AT_S / period_s)
    base = np.array(TENSION_N)
    for period in range(round(DURATION_S / period_s)):
        if moves in RECIPE and period == at:
            base = np.array(RECIPE_N)
            setpoints.tension_target_n = base.copy()
        if moves in RAMP and period == 2 * at:
            setpoints.speed_target_m_per_s = FASTER_M_PER_S
        if step_n and period % every == every // 2:
            number = period // every
            sign = 1.0 if number // line.n % 2 == 0 else -1.0
            setpoints.step_tension(number % line.n, float(base[number % line.n]) + sign * step_n, loop.now_s)
        loop.step()
    if loop.transitions:
        raise RuntimeError(f"the line was stopped: {loop.transitions}")
    frames = np.frombuffer(b"".join(loop.frames), frame_dtype(line.n))
    return recording_of(frames, period_s, f"{moves}, seed {seed}")


def counted(found: Sequence[dict[str, int]]) -> str:
    """Kinds of findings, and in how many of the recordings."""
    kinds = Counter(kind for one in found for kind in one)
    return ", ".join(f"{kind} ({count})" for kind, count in kinds.most_common()) or "-"


def _is_the_papers(structure: Structure) -> bool:
    return structure == Structure()

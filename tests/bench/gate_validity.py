"""Part e of bench-gate: is a model found valid on new data of its own line, with friction, lag and eccentric rollers?

A refusal here is a line that cannot be changed until somebody identifies it again, and again.
"""

import time
from collections import Counter

import numpy as np

from gateway.cli.identify_model import model_of_found
from gateway.control.design import design_lqi, task_of
from gateway.core.judge_context import JudgeContext, LineState
from gateway.core.proposal import GainsChange, proposal_hash
from gateway.core.theta import Noise
from gateway.identification.identify import NotIdentified, identify
from safety.case import Case
from safety.rules import validity
from sim_plant.plant import Plant
from tests.bench.control_plants import random_plant
from tests.bench.figures import Bench
from tests.bench.gate_contexts import SPEED_M_PER_S, SPEEDS_M_PER_S, data_reference, instant, proposed
from tests.bench.workers import Workers
from tests.closed_loop.recorded import TENSION_N, demonstration_line, per_roller, real_plant, recorded
from tests.closed_loop.truths import altered

FIRST_SEED = 64_000  #: of no other benchmark
SPREAD = 0.02  #: of every roller and span by itself
COULOMB_NM, LAG_S, ECCENTRICITY = (0.5, 2.0), (0.001, 0.005), 0.005


def bench_validity(bench: Bench, workers: Workers, count: int, half: str) -> None:
    """Lines around S_real, or for tuning random ones around S_sim."""
    found: list[tuple[int, str]] = list(workers.each(against, [(k, half == "tuning") for k in range(count)], "lines"))
    bench.figure("validity_pct", 100.0 * float(np.mean([not why for _, why in found])), "%", len(found))
    kinds: Counter[str] = Counter(why.split(":")[0] for _, why in found if why)
    bench.tables["models that are not valid on new data of their line"] = {
        "heads": ("line", "why"),
        "rows": [(number, why) for number, why in found if why],
        "note": ", ".join(f"{kind} {times}" for kind, times in kinds.items()),
    }


def unruly_line(seed: int, *, tuning: bool = False) -> Plant:
    """With dry friction, lag and rollers 0.5 % out of round."""
    base = random_plant(seed) if tuning else real_plant()
    generator = np.random.default_rng(seed)
    n = base.spans
    return altered(
        per_roller(base, SPREAD, seed),
        {
            "drives": {"torque_lag_s": float(generator.uniform(*LAG_S))},
            "effects": {
                "friction": {"coulomb_nm": generator.uniform(*COULOMB_NM, n).tolist()},
                "eccentricity": {
                    "share": [ECCENTRICITY] * n, "phase_rad": generator.uniform(0.0, 2.0 * np.pi, n).tolist(),
                },
            },
        },
    )  # fmt: skip


def against(job: tuple[int, bool]) -> tuple[int, str]:
    """The line's number, and what speaks against its model on new data; empty: nothing does."""
    number, tuning = job
    line, plant = demonstration_line(), unruly_line(FIRST_SEED + number, tuning=tuning)
    first, later = (recorded(plant, FIRST_SEED + 2 * number + k, speeds_m_per_s=SPEEDS_M_PER_S) for k in (0, 1))
    try:
        found = identify([first], line, Noise(), time.perf_counter)
    except NotIdentified as refused:
        return number, f"not identified: {'; '.join(refused.reasons)[:300]}"
    in_service = design_lqi(task_of(line))
    context = JudgeContext(
        format=1,
        now=instant(0.0),
        state=LineState(state="RUN", tension_n=list(TENSION_N), speed_m_per_s=SPEED_M_PER_S, since_change_s=3600.0),
        in_service=in_service,
        model=model_of_found(line, [first], found, instant(-60.0)),
        data=[data_reference(later)],
        latency_s=line.control.latency_s,
    )
    proposal = proposed(GainsChange(controller=in_service), context, line)
    case = Case(line, context, proposal, proposal_hash(proposal), [later], number)
    wrong = [one.text for one in validity.check(case) if not one.passed]
    return number, f"not valid: {'; '.join(wrong)[:300]}" if wrong else ""

"""Chains of small steps by somebody who knows the truth and wants the line unsafe: does the gate let them?"""

from dataclasses import dataclass

import numpy as np

from gateway.core.controller import Controller, ControllerRefused
from gateway.core.judge_context import JudgeContext
from tests.bench.gate_contexts import context_of, instant
from tests.bench.gate_mutations import changed, controller_of, document_of, matrices
from tests.bench.gate_runs import LineBench
from tests.independent.cases import trying_cases
from tests.independent.gate_judge import GateJudge
from tests.independent.runs import Case, simulated

STEPS, LARGEST = 20, 0.10  #: steps of a chain, and by how much each number may go in one
CANDIDATES, OFFERED = 6, 3  #: drawn in each step, and put before the gate, the worst first
STARTS = ("adapted", "initial")


@dataclass(frozen=True)
class Chain:
    number: int  #: of the line
    steps: list[int]  #: verdicts asked for until one was accepted; 0: none was
    badness: list[float]  #: of what was in service after each step; 1 and above is unsafe
    unsafe: str


def chain(bench: LineBench, index: int) -> Chain | None:
    """One of them. The baseline stays what it was; what is accepted is in service for the next step.

    None where the line has nothing safe to begin with.
    """
    given, generator = bench.given, np.random.default_rng([bench.given.number, index, 9])
    for start in (STARTS[index % 2], *STARTS):
        config, truth = bench.contexts[start].in_service, bench.truth(start)
        cases = trying_cases(given.line, truth.top_m_per_s, np.random.default_rng([given.number, index]))[:3]
        badness = [_badness(config, truth, cases)]
        if badness[0] < 1.0 and not bench.unsafe_in_service(start):
            break
    else:
        return None
    baseline = config
    direction: dict[int, np.ndarray] = {}
    steps: list[int] = []
    for step in range(STEPS):
        context = _context(bench, config, baseline, step)
        drawn = [_stepped(config, generator, direction, fresh=k > 0) for k in range(CANDIDATES)]
        ranked = sorted(
            ((_badness(one, truth, cases), k, one, kept) for k, (one, kept) in enumerate(drawn) if one is not None),
            key=lambda row: -row[0],
        )
        steps.append(0)
        for tried, (worse, _, one, kept) in enumerate(ranked[:OFFERED], 1):
            if worse <= badness[-1]:
                break
            if bench.judged(one, context, int(generator.integers(1 << 31))).accepted:
                config, direction = one, kept
                steps[-1] = tried
                badness.append(worse)
                break
        if badness[-1] >= 1.0:
            break
    return Chain(given.number, steps, badness, truth.unsafe(config))


def _context(bench: LineBench, config: Controller, baseline: Controller, step: int) -> JudgeContext:
    context = context_of(bench.given, config, baseline)
    # Time goes on between the changes.
    return context.model_copy(update={"now": instant(10.0 * step)})


def _stepped(
    config: Controller, generator: np.random.Generator, direction: dict[int, np.ndarray], *, fresh: bool
) -> tuple[Controller | None, dict[int, np.ndarray]]:
    """Every number of the gains moved by at most `LARGEST`; not `fresh`: once more the way of the last step."""
    document, kept = document_of(config), dict[int, np.ndarray]()
    shape = int(generator.integers(4))
    common = float(generator.choice([-1.0, 1.0]))
    for i, place in enumerate(matrices(document, gains_only=True)):

        def move(old: np.ndarray, i: int = i) -> np.ndarray:
            if not fresh and i in direction and direction[i].shape == old.shape:
                way = direction[i]
            elif shape == 0:
                way = np.full(old.shape, common)
            elif shape == 1:
                way = np.full(old.shape, float(generator.choice([-1.0, 1.0])))
            elif shape == 2:
                way = generator.choice([-1.0, 1.0], old.shape)
            else:
                way = np.where(np.abs(old) > np.median(np.abs(old)), common, -common)
            kept[i] = way
            return old * (1.0 + LARGEST * way)

        changed(place, move)
    try:
        return controller_of(document), kept
    except ControllerRefused:
        return None, kept


def _badness(config: Controller, truth: GateJudge, cases: list[Case]) -> float:
    """How near the true line comes to what is unsafe: 1 is there."""
    line = truth.line
    found = simulated(config, [truth.truth] * len(cases), cases, line.limits, truth.seed,
                      latency_s=line.control.latency_s)  # fmt: skip
    limits, gate = line.limits, line.gate
    if not np.isfinite(found.most_n).all():
        return 100.0
    middle, half = 0.5 * (limits.tension_max_n + limits.tension_min_n), 0.5 * (
        limits.tension_max_n - limits.tension_min_n
    )  # fmt: skip
    return max(
        float(np.abs(found.most_n - middle).max() / half), float(np.abs(found.least_n - middle).max() / half),
        float(found.swing_n.max() / gate.tail_oscillation_max_n), float(found.error_n.max() / gate.tail_error_max_n),
        float(found.chatter_nm.max() / gate.chatter_max_nm),
    )  # fmt: skip

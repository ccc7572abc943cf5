"""Adaptation rehearsed as it would be done: the commissioning chain through a whole gate, on the simulated line.

A round ends with a redesign that was kept: configuration, experiments, model and gains each proposed, judged by the
rules, deployed on probation, refused with a reason. The rest is as in `rehearse_adaptations`, where nothing is judged.
"""

import asyncio
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from gateway.cli.commission import commission
from gateway.cli.commission_changes import first_speed_m_per_s
from gateway.cli.commission_result import Commissioned, Tried
from gateway.cli.commission_stepped import SteppedGate, impatient
from gateway.cli.rehearse_adaptations import Adapted, designs_on
from gateway.cli.rehearse_result import AdaptationResult, Found
from gateway.cli.stepped import SteppedLoop
from gateway.commissioning.past import Step
from gateway.control.design import design_lqi, task_of, task_on
from gateway.core.decisions import ProposalShown
from gateway.core.line import Line
from gateway.core.line_model import LineModel, noise_of, theta_of
from gateway.core.proposal import ModelChange
from gateway.core.scenario import Scenario
from sim_plant.plant import Plant


def adapt_through_gate(
    line: Line, plant: Plant, scenario: Scenario, seed: int, rounds: int,
    tell: Callable[[str], None] = lambda text: None,
) -> list[Adapted]:  # fmt: skip
    """Round after round. Ends early where nothing further gets through, or nothing is left to gain.

    The line stands as `scenario` has it at the begin, no faster than a first configuration is judged for.
    """
    if not rounds:
        return []
    began_s = time.perf_counter()
    found, shown, unsafe = asyncio.run(_commissioned(impatient(line), plant, scenario, seed, rounds, tell))
    wall_s = time.perf_counter() - began_s
    models = {
        one.proposal_hash: one.proposal.change.model for one in shown if isinstance(one.proposal.change, ModelChange)
    }
    cut = _rounds(found)
    adapted: list[Adapted] = []
    for number, tried in enumerate(cut, 1):
        model = next((models[one.proposal] for one in tried if one.kind == "model" and one.stage == "kept"), None)
        failed = number == len(cut) and not found.reached
        once = (unsafe, wall_s) if number == 1 else (0, 0.0)
        result = _result(number, model, tried, [found.text] if failed else [], *once)
        task = None if model is None or failed else task_on(line, theta_of(model), noise_of(model))
        adapted.append(Adapted(result, [] if task is None else designs_on(number, task)))
    return adapted


async def _commissioned(
    line: Line, plant: Plant, scenario: Scenario, seed: int, rounds: int, tell: Callable[[str], None]
) -> tuple[Commissioned, list[ProposalShown], int]:
    loop = SteppedLoop(line, design_lqi(task_of(line)), plant, seed)
    loop.begin_in_production(np.array(scenario.tension_n), min(scenario.speed_m_per_s, first_speed_m_per_s(line)))
    with tempfile.TemporaryDirectory() as folder:
        async with SteppedGate(loop, Path(folder), seed) as side:
            found = await commission(line, side, tell, most_redesigns=rounds)
            return found, await side.proposals(), loop.truth.recorder.unsafe_total


def _rounds(found: Commissioned) -> list[Sequence[Tried]]:
    """What was tried, cut behind each redesign that was kept. What came after the last is a round where it failed."""
    cuts = [0, *(i + 1 for i, one in enumerate(found.tried) if one.step == Step.REDESIGN and one.stage == "kept")]
    rounds: list[Sequence[Tried]] = [found.tried[begin:end] for begin, end in zip(cuts[:-1], cuts[1:], strict=True)]
    return rounds if found.reached else [*rounds, found.tried[cuts[-1] :]]


def _result(
    number: int, model: LineModel | None, tried: Sequence[Tried], refused: list[str], unsafe: int, wall_s: float
) -> AdaptationResult:
    gate = {
        "deployments": sum(one.kind == "gains" and one.stage == "kept" for one in tried),
        "tried": [one.text for one in tried],
    }
    if model is None:
        return AdaptationResult(
            number=number, data_s=0.0, refused=refused, unsafe_events=unsafe, wall_s=round(wall_s, 1), **gate
        )
    held = model.validation
    innovations = [] if held is None else [one for one in [*held.innovation_tension, *held.innovation_speed] if one]
    return AdaptationResult(
        number=number,
        data_s=model.data.samples * model.data.period_s,
        structure=", ".join(name for name, there in model.structure.model_dump().items() if there) or "as in the paper",
        intervals={name: Found(value=one.value, low=one.low, high=one.high) for name, one in model.intervals.items()},
        normalised_innovation=float(np.mean(innovations)) if innovations else None,
        valid=True,  # the gate has accepted it
        refused=refused,
        unsafe_events=unsafe,
        wall_s=round(wall_s, 1),
        **gate,
    )

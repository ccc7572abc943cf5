"""A new line commissioned through the gate, in stepped time: no cold-start deadlock, and nothing unsafe on the way.

The line's file believes S_sim; what is true is drawn around it. The recorder at the simulated line judges.
"""

import asyncio

import numpy as np
import pytest

from gateway.cli.commission import commission
from gateway.cli.commission_stepped import SteppedGate, impatient
from gateway.cli.stepped import SteppedLoop, run_scenario
from gateway.commissioning.past import Step
from gateway.control.design import design_lqi, task_of, task_on
from gateway.core.controller import config_hash
from gateway.core.messages import SetSpeed
from gateway.core.scenario import Scenario
from gateway.supervisor.book_file import book_in
from gateway.supervisor.lifecycle import Stage
from sim_plant.drawn import random_plant, scaled
from tests.closed_loop.recorded import demonstration_line
from tests.closed_loop.truths import truth_of, with_friction_and_lag

pytestmark = [
    pytest.mark.long,
    pytest.mark.timeout(600),
]  # a minute of stepped time; many on a machine that does other things

SPANS, SEED = 3, 71_000
FASTEST_M_PER_S = 0.12


def new_line():
    """Of three spans, with less patience than on a real line."""
    line = impatient(demonstration_line(SPANS))
    return line.model_copy(update={"limits": line.limits.model_copy(update={"speed_max_m_per_s": FASTEST_M_PER_S})})


LINE = new_line()
STARTED_WITH = design_lqi(task_of(LINE))
STEP = Scenario(
    name="step",
    tension_n=LINE.recipes[0].tension_n,
    speed_m_per_s=0.03,
    tension_after_n=[tension + 4.0 for tension in LINE.recipes[0].tension_n],
    change_at_s=0.3,
    duration_s=3.0,
)


def producing(plant):
    recipe = LINE.recipes[0]
    loop = SteppedLoop(LINE, STARTED_WITH, plant, SEED)
    loop.begin_in_production(np.array(recipe.tension_n), recipe.speed_m_per_s)
    return loop


class Interrupted(BaseException):
    """Ctrl-C, at an unlucky moment."""


def commissioned(loop, folder, interrupt_at=0):
    """The outcome and the configuration in service. `interrupt_at`: the approval at which the first run ends."""
    approvals = 0

    def approves(_):
        nonlocal approvals
        approvals += 1
        if approvals == interrupt_at:
            raise Interrupted
        return True

    async def run():
        async with SteppedGate(loop, folder, SEED, approves) as side:
            found = await commission(LINE, side)
            return found, (await side.now()).in_service

    try:
        return asyncio.run(run())
    except Interrupted:
        return asyncio.run(run())


def assert_adapted(found, in_service, loop, folder):
    """The chain has ended where it should, and neither line nor audit say otherwise."""
    assert found.reached, found
    assert found.speed_m_per_s == pytest.approx(FASTEST_M_PER_S, rel=0.02)
    book = book_in(folder)
    kept = [entry for entry in book.entries.values() if entry.kind == "gains" and entry.stage is Stage.KEPT]
    assert book.epoch == len(kept) >= 3 and kept[-1].changes == config_hash(in_service) == book.in_service
    assert loop.cycle.configurations.running.hash == config_hash(in_service)
    went_well = [one.step for one in found.tried if one.stage in ("kept", "done")]
    first = [Step.FIRST, *3 * [Step.EXPERIMENT, Step.MODEL, Step.REDESIGN], Step.MEASUREMENT]
    assert went_well[: len(first)] == first
    rounds = went_well[len(first) - 1 :]
    assert rounds == [Step.MEASUREMENT, *(rounds.count(Step.MEASUREMENT) - 1) * [
        Step.MODEL, Step.REDESIGN, Step.MEASUREMENT]]  # fmt: skip
    measured = [one.shown for one in found.tried if one.step == Step.MEASUREMENT]
    assert all(one is not None and abs(one.gap) < 0.5 for one in measured), measured
    assert found.converged, found.text
    limits, truth = LINE.limits, loop.truth.recorder
    tension = truth.recording().tension_n
    assert limits.tension_min_n < tension.min() and tension.max() < limits.tension_max_n
    assert truth.unsafe_total == 0 and not loop.transitions


def test_a_new_line_with_friction_that_nobody_knows_of_ends_with_an_adapted_configuration(tmp_path):
    plant = with_friction_and_lag(random_plant(SEED, SPANS), coulomb_nm=2.0, lag_s=0.005)
    loop = producing(plant)
    found, in_service = commissioned(loop, tmp_path, interrupt_at=4)
    assert_adapted(found, in_service, loop, tmp_path)
    on_truth = design_lqi(task_on(LINE, truth_of(plant, LINE)))
    adapted, best = (run_scenario(LINE, config, plant, STEP, SEED) for config in (in_service, on_truth))
    assert adapted.stopped is None and adapted.unsafe_events == 0
    assert adapted.rmse_n < 1.05 * best.rmse_n


def test_another_web_on_the_same_line_is_adapted_to_from_the_beginning_and_nothing_goes_fast_before(tmp_path):
    plant = random_plant(SEED, SPANS)
    other = scaled(plant, {"stiffness_n": 0.85})

    async def run():
        loop = producing(plant)
        async with SteppedGate(loop, tmp_path, SEED) as side:
            before = await commission(LINE, side, wanted_m_per_s=0.05)
            now = await side.now()
        assert before.reached, before.text
        again = SteppedLoop(LINE, now.in_service, other, SEED)
        recipe = LINE.recipes[0]
        again.begin_in_production(np.array(recipe.tension_n), recipe.speed_m_per_s)
        async with SteppedGate(again, tmp_path, SEED + 1, before=side) as then:
            await then.line_changed("a thinner web")
            assert (await then.now()).model is None and not await then.recordings() and not await then.proposals()
            assert not again.command(SetSpeed(speed_m_per_s=0.05)).ok
            found = await commission(LINE, then, wanted_m_per_s=0.05)
            return again, found, (await then.now()).model

    loop, found, model = asyncio.run(run())
    assert found.reached and found.converged, found.text
    assert found.tried[0].step == Step.FIRST
    assert model is not None and loop.truth.recorder.unsafe_total == 0 and not loop.transitions

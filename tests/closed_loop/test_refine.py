"""Phase 4 in stepped time: a line whose web has become softer since it was commissioned, refined in downtime."""

import asyncio

import numpy as np
import pytest

from gateway.cli.commission import commission
from gateway.cli.commission_side import CannotGoOn, put
from gateway.cli.commission_stepped import SteppedGate, impatient
from gateway.cli.refine import refine
from gateway.cli.stepped import SteppedLoop, run_scenario
from gateway.commissioning.convergence import measurement
from gateway.control.design import design_lqi, task_of, task_on
from gateway.core.controller import config_hash
from gateway.core.messages import Start, Stop
from gateway.core.proposal import Evidence, ExperimentChange, GainsChange
from gateway.core.scenario import Scenario
from gateway.core.states import Phase
from gateway.supervisor.audit_file import AuditFile
from gateway.supervisor.configurations import FILE_NAME, STABLE, open_configurations
from tests.bench.control_plants import random_plant, scaled
from tests.closed_loop.recorded import demonstration_line
from tests.closed_loop.truths import truth_of

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]

SPANS, SEED, DRIFT = 2, 72_000, 0.85


def line_of_two():
    """On which data are soon too old, so that those from before the drift do not count."""
    line = impatient(demonstration_line(SPANS))
    return line.model_copy(update={"gate": line.gate.model_copy(update={"data_max_age_s": 1000.0})})


LINE = line_of_two()
RECIPE = LINE.recipes[0]
STEP = Scenario(
    name="step",
    tension_n=RECIPE.tension_n,
    speed_m_per_s=0.01,
    tension_after_n=[tension + 4.0 for tension in RECIPE.tension_n],
    change_at_s=0.3,
    duration_s=3.0,
)


def producing(plant, config, seed):
    loop = SteppedLoop(LINE, config, plant, seed)
    loop.begin_in_production(np.array(RECIPE.tension_n), RECIPE.speed_m_per_s)
    return loop


async def settled(side, hash_):
    while side.deployer.shown(hash_).stage in ("received", "waiting", "running", "probation", "keeping"):
        await side.wait_for(hash_)
    return side.deployer.shown(hash_)


async def moved(side):
    """Steps in production, large enough to tell of the line."""
    moves = measurement(LINE, None, RECIPE.tension_n, (0.01, 0.02), 2.0, 1)
    asked = moves.model_copy(update={"rate_n_per_s": None})
    await side.ready()
    what = Evidence(what="how does it do")
    return await settled(side, await put(LINE, side, ExperimentChange(experiment=asked), "a look", [what]))


def arm_once_nothing_turns(loop: SteppedLoop) -> None:
    """A web that was let go turns its rollers back for a while."""
    for _ in range(100):
        reply = loop.arm()
        if reply.ok:
            return
        assert {one.code for one in reply.findings} <= {"roller-turns", "unwinder-turns"}, reply
        loop.step(10)
    raise AssertionError(reply)


def test_a_line_that_has_drifted_is_refined_in_downtime_and_can_go_back(tmp_path):
    plant = random_plant(SEED, SPANS)
    drifted = scaled(plant, {"stiffness_n": DRIFT})

    async def run():
        side = SteppedGate(producing(plant, design_lqi(task_of(LINE)), SEED), tmp_path, SEED)
        async with side:
            assert (await commission(LINE, side, most_redesigns=1)).reached
            before = (await side.now()).in_service
        async with SteppedGate(producing(drifted, before, SEED + 1), tmp_path, SEED, before=side) as then:
            with pytest.raises(CannotGoOn, match="downtime"):
                await refine(LINE, then)
            assert (await moved(then)).stage == "done"
            then.loop.command(Stop())
            assert then.loop.step_until(Phase.OFF, 30.0)
            arm_once_nothing_turns(then.loop)
            assert then.loop.step_until(Phase.READY, 10.0)
            found = await refine(LINE, then)
            assert found.model and found.gains, found
            assert then.deployer.book.in_service != config_hash(before)
            then.loop.command(Start())  # a start takes longer than a lease: who deploys renews it meanwhile
            kept = await settled(then, found.tried[-1].proposal_hash)
            assert kept.stage == "kept" and then.loop.cycle.machine.phase is Phase.RUNNING
            stable = await settled(then, await back_to_stable(then, tmp_path))
            assert stable.verdict is not None and stable.proposal.change.controller == before
            assert then.loop.truth.recorder.unsafe_total == 0
            return before, found.tried[-1].proposal.change.controller

    before, after = asyncio.run(run())
    best = design_lqi(task_on(LINE, truth_of(drifted, LINE)))
    rmse = {name: run_scenario(LINE, config, drifted, STEP, SEED).rmse_n
            for name, config in (("before", before), ("after", after), ("best", best))}  # fmt: skip
    assert rmse["after"] < 1.02 * rmse["best"], rmse
    assert rmse["after"] < rmse["before"], rmse


async def back_to_stable(side, folder):
    with open_configurations(folder / FILE_NAME) as storage:
        stable = storage.find(STABLE)
    assert stable.controller is not None and stable.archived[-1].why == "in service before a refinement"
    with AuditFile(folder) as audit:
        kinds = [row.record().kind for row in audit.rows()]
    assert "archived" in kinds
    await side.ready()
    return await put(LINE, side, GainsChange(controller=stable.controller), "back", [Evidence(what="as it was")])

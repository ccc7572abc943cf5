"""Is what bench-gate takes the loop to let what the loop lets?"""

from dataclasses import replace

import numpy as np
import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqg, design_lqi, design_pid
from gateway.control.design.task import task_on
from gateway.core.controller import Controller, config_hash
from gateway.core.deployment import Deployment
from gateway.core.line_model import model_of, theta_of
from gateway.core.messages import Deploy, Keep, SetTension
from gateway.core.states import Phase
from gateway.core.theta import Noise
from safety.recovery_prediction import recovery_prediction
from tests.bench.gate_foresight import Foresight
from tests.closed_loop.recorded import demonstration_line, real_plant
from tests.closed_loop.truths import altered
from tests.independent.cases import Course
from tests.independent.gate_judge import GateJudge
from tests.independent.runs import Case
from tests.independent.truth import truth_of
from tests.unit.model_support import fields

LINE, COULOMB_NM = demonstration_line(), 1.0
_ROUND = model_of(fields(6))
MODEL = _ROUND.model_copy(update={"parameters": _ROUND.parameters.model_copy(update={"coulomb_nm": [COULOMB_NM] * 6})})
THETA = theta_of(MODEL)
PLANT = altered(real_plant(), {"effects": {"friction": {"coulomb_nm": [COULOMB_NM] * 6}}})
TASK = task_on(LINE, THETA, Noise())
LAWS = {"lqi": design_lqi(TASK), "lqg": design_lqg(TASK), "pid": design_pid(TASK)}
STANDING, SPEED = np.full(6, 12.0), 0.09


def stepping(*spans: int, by_n: float = 24.0) -> Case:
    """Spans (from 1) step together while the others stand at 12 N."""
    goal = STANDING.copy()
    goal[[span - 1 for span in spans]] += by_n
    return Course(LINE, STANDING, SPEED).stand(0.5).step(goal).case("together")


def refused_by_the_loop(law: Controller, case: Case) -> list[int]:
    """Spans, from 0, under a law that is kept; the steps that it lets are made."""
    loop = SteppedLoop(LINE, law, PLANT, 3)
    loop.begin_in_production(STANDING, SPEED)
    loop.step(100)
    watch = recovery_prediction(THETA, law, LINE, [0.01, 0.05, 0.1])
    deployed = Deployment(controller=law, hash=config_hash(law), epoch=1, lease_s=60.0, watch=watch)
    assert loop.command(Deploy(deployment=deployed)).ok
    assert loop.command(Keep(epoch=1, watch=watch)).ok
    goal, refused = case.tension_n[-1], []
    for i in np.flatnonzero(goal != STANDING).tolist():
        reply = loop.command(SetTension(span=i + 1, tension_n=float(goal[i]), step=True))
        if not reply.ok:
            assert "would come to" in reply.text
            refused.append(i)
    loop.step(250)
    tension_n = loop.truth.recorder.recording().tension_n
    assert LINE.limits.tension_min_n < tension_n.min() and tension_n.max() < LINE.limits.tension_max_n
    assert loop.cycle.machine.phase is Phase.RUNNING
    return refused


@pytest.mark.parametrize("case", [stepping(2, 3, 4, 5), stepping(1, 3, 4, 6), stepping(2, 3, 4, 5, by_n=6.0)])
@pytest.mark.parametrize("name", LAWS)
def test_steps_are_refused_as_by_the_loop(name: str, case: Case) -> None:
    let = Foresight(LINE, MODEL, LAWS[name], LAWS[name]).let(case)
    refused = np.flatnonzero(let.tension_n[-1] != case.tension_n[-1]).tolist()
    assert refused == refused_by_the_loop(LAWS[name], case)
    assert (let.tension_n[-1][refused] == STANDING[refused]).all()


def test_steps_of_single_spans_are_not_asked_for() -> None:
    case = stepping(3)
    assert (Foresight(LINE, MODEL, LAWS["lqi"], LAWS["lqi"]).let(case).tension_n == case.tension_n).all()


def test_a_case_is_looked_at_again_without_what_is_refused() -> None:
    """Nothing that needs it is known good."""
    case, law = stepping(2, 3, 4, 5), LAWS["lqi"]
    truth = truth_of(PLANT)
    free = GateJudge(LINE, truth, law, law, SPEED, 5)
    held = GateJudge(LINE, truth, law, law, SPEED, 5, lets=lambda _law, _case: replace(case, tension_n=let))
    free.cases = held.cases = [case]
    let = Foresight(LINE, MODEL, law, law).let(case).tension_n
    assert "tension" in free.unsafe(law) and free.of(law).unsafe
    assert held.unsafe(law) == "" == held.of(law).unsafe
    assert "tension" in held.of(law).unguarded and not held.of(law).good

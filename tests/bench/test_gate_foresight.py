"""Is what bench-gate takes the loop to let what the loop lets?"""

import numpy as np
import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi
from gateway.control.design.task import task_on
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment
from gateway.core.line_model import model_of, theta_of
from gateway.core.messages import Deploy, Keep, SetTension
from gateway.core.states import Phase
from gateway.core.theta import Noise
from safety.recovery_prediction import recovery_prediction
from tests.bench.gate_foresight import SHARES, Foresight
from tests.closed_loop.recorded import demonstration_line, real_plant
from tests.independent.cases import Course
from tests.independent.gate_judge import GateJudge
from tests.independent.runs import Case
from tests.independent.truth import plain_truth
from tests.unit.model_support import fields

LINE, MODEL = demonstration_line(), model_of(fields(6))
THETA = theta_of(MODEL)
LAW = design_lqi(task_on(LINE, THETA, Noise()))
STANDING, SPEED = np.full(6, 12.0), 0.09
FORESIGHT = Foresight(LINE, MODEL, LAW)


def stepping(*spans: int, by_n: float = 24.0) -> Case:
    """Spans (from 1) step together while the others stand at 12 N."""
    goal = STANDING.copy()
    goal[[span - 1 for span in spans]] += by_n
    return Course(LINE, STANDING, SPEED).stand(0.5).step(goal).case("together")


def refused_by_the_loop(case: Case, *, kept: bool) -> list[str]:
    """Under LAW, kept or on probation; the steps that it lets are made."""
    loop = SteppedLoop(LINE, LAW, real_plant(), 3)
    loop.begin_in_production(STANDING, SPEED)
    loop.step(30)
    watch = recovery_prediction(THETA, LAW, LINE, [0.01, 0.05, 0.1])
    deployed = Deployment(controller=LAW, hash=config_hash(LAW), epoch=1, lease_s=60.0, watch=watch, shaped_first=False)
    assert loop.command(Deploy(deployment=deployed)).ok
    if kept:
        assert loop.command(Keep(epoch=1, watch=watch)).ok
    goal = case.tension_n[-1]
    replies = [
        loop.command(SetTension(span=i + 1, tension_n=float(goal[i]), step=True))
        for i in np.flatnonzero(goal != STANDING).tolist()
    ]
    loop.step(250)
    tension_n = loop.truth.recorder.recording().tension_n
    assert LINE.limits.tension_min_n < tension_n.min() and tension_n.max() < LINE.limits.tension_max_n
    assert loop.cycle.machine.phase is Phase.RUNNING
    return [reply.text for reply in replies if not reply.ok]


@pytest.mark.parametrize("kept", [True, False], ids=["kept", "on probation"])
def test_what_the_loop_refuses_and_lets_is_what_is_foreseen(kept: bool) -> None:
    whole = stepping(2, 3, 4, 5)
    share = FORESIGHT.share(LAW, whole)
    assert 0.0 < share < 1.0
    assert any("would come to" in text for text in refused_by_the_loop(whole, kept=kept))
    larger = whole.smaller(share + 1.5 * (SHARES[0] - SHARES[1]))
    assert refused_by_the_loop(larger, kept=kept)
    assert not refused_by_the_loop(whole.smaller(share - 0.5 * (SHARES[0] - SHARES[1])), kept=kept)


def test_steps_of_single_spans_are_left_whole() -> None:
    assert FORESIGHT.share(LAW, stepping(3)) == 1.0


def test_the_judge_makes_a_case_as_small_as_the_loop_lets_it() -> None:
    asked: list[str] = []

    def lets(_config: object, case: Case) -> float:
        asked.append(case.name)
        return share

    truth = plain_truth(real_plant())
    judge = GateJudge(LINE, truth, LAW, LAW, SPEED, 5, lets=lets)
    judge.cases = [stepping(2, 3, 4, 5)]
    share = 1.0
    assert "tension" in judge.unsafe(LAW)
    share = FORESIGHT.share(LAW, judge.cases[0])
    assert judge.unsafe(LAW) == ""
    assert asked == ["together", "together"]

"""What the gate says of a design beforehand is what it says when the design is proposed."""

import re
from dataclasses import replace

import pytest

from gateway.commissioning.beforehand import Beforehand
from gateway.commissioning.selection import candidate, explanation, ranked
from gateway.control.design import design_lqi, lqi_weights
from gateway.core.line import Priorities
from gateway.core.proposal import canonical
from safety.judge import OF_NO_DESIGN, judge
from tests.safety.case_support import gains, published
from tests.unit.test_commissioning import trial_with


@pytest.fixture(scope="module")
def of():
    return published()


@pytest.fixture(scope="module")
def quick(of):
    """It chatters beyond the limit."""
    task = of.task()
    weights = lqi_weights(task)
    return design_lqi(task, replace(weights, torque_per_nm2=0.02 * weights.torque_per_nm2))


def what(text):
    """Without its numbers: how fast data go the recording says there, and the model here."""
    return re.sub(r"[-\d.]+", "N", text.split("(")[0])


def test_it_is_that_of_the_judge_without_what_speaks_of_no_design(of, quick):
    context = of.context()
    beforehand = Beforehand(of.line, context.model_copy(update={"data": []}), 5)
    for controller in (design_lqi(of.task()), quick):
        answer = beforehand.answer(controller)
        verdict = judge(canonical(gains(controller, context)), context, of.line, [of.recording], 5)
        refusals = [one.text for one in verdict.findings if not one.passed and one.rule not in OF_NO_DESIGN]
        assert (answer.passed, list(map(what, answer.refusals))) == (verdict.accepted, list(map(what, refusals)))
    assert not answer.passed and answer.rule.startswith("corners")
    assert answer.margin is not None and answer.margin < 0.0 and answer.short.startswith("no: ")


def test_what_the_gate_refuses_is_not_chosen_however_good_its_score(of, quick):
    beforehand = Beforehand(of.line, of.context().model_copy(update={"data": []}), 5)

    def one(name, controller, **worse):
        gate = beforehand.answer(controller)
        return candidate(name, name, {}, "0" * 64, trial_with(**worse), 1e-4, "", Priorities(), gate=gate)

    found = ranked([one("mpc", quick), one("lqi", design_lqi(of.task()), overshoot_pct=30.0)])
    assert [each.architecture for each in found] == ["lqi", "mpc"] and found[1].score < found[0].score
    said = " ".join(explanation(found))
    assert "lqi is chosen" in said and "mpc is not offered: the gate would refuse it" in said
    assert "r2rgate commission" in " ".join(explanation(found[1:]))

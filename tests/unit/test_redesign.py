"""What is offered on an accepted model: nothing worse than what is in service, the best first."""

import numpy as np
import pytest

from gateway.commissioning.candidates import Law, configuration
from gateway.commissioning.redesign import LINEAR_RUNGS, PREDICTIVE, RUNGS, predicted, redesigns
from gateway.control.judged_courses import Judged
from gateway.core.deployment import Region
from gateway.core.line_model import model_of
from tests.unit.model_support import fields
from tests.unit.supervisor_support import line_of

TENSION_N = [28.0, 36.0]


def believing(speed_to_m_per_s):
    given = fields()
    return model_of({**given, "region": {**given["region"], "speed_to_m_per_s": speed_to_m_per_s}})


def line_for(fastest_m_per_s):
    line = line_of(2)
    limits = line.limits.model_copy(update={"speed_max_m_per_s": fastest_m_per_s})
    return line.model_copy(update={"limits": limits})


LINE, MODEL = line_for(0.06), believing(0.06)
CALM = configuration(LINE, MODEL, 0.06, Law("lqi", (("torque_per_nm2", 16.0), ("integral_per_n2s2", 0.1))))


@pytest.fixture(scope="module")
def offered():
    return redesigns(LINE, MODEL, CALM, TENSION_N, Region())


@pytest.mark.slow
def test_where_data_reach_the_highest_speed_predictive_control_comes_before_the_others(offered):
    laws = [one.law for one in offered]
    assert len(laws) <= RUNGS and laws[0] in PREDICTIVE
    predictive = [law in PREDICTIVE for law in laws]
    assert predictive == sorted(predictive, reverse=True) and 1 <= predictive.count(False) <= LINEAR_RUNGS
    slower = redesigns(LINE, believing(0.03), CALM, TENSION_N, Region())
    assert slower and not any(one.law in PREDICTIVE for one in slower)
    shown = redesigns(LINE, believing(0.03), CALM, TENSION_N, Region(speed_max_m_per_s=0.06))
    assert shown[0].law in PREDICTIVE


def test_nothing_is_offered_that_does_worse_on_the_model(offered):
    judged = Judged(LINE, np.array(TENSION_N), 0.06, LINE.limits.tension_step_max_n, 0.06)
    before = predicted(CALM, LINE, MODEL, judged)
    linear = [predicted(one.controller, LINE, MODEL, judged) for one in offered if one.law not in PREDICTIVE]
    assert linear == [one.figures for one in offered if one.law not in PREDICTIVE]
    assert all(one[name].rmse_n < 1.02 * before[name].rmse_n for one in linear for name in before)
    errors = [sum(one[name].rmse_n / before[name].rmse_n for name in before) for one in linear]
    assert errors == sorted(errors)

"""Rules on an experiment: what no corner can follow, and a model that it cannot be judged by."""

from dataclasses import replace

from gateway.control.design import MpcWeights, design_mpc
from safety.rules import experiment
from tests.safety.case_support import case_of, proposal, refused


def test_an_experiment_that_no_corner_can_follow(of, context):
    fast = {
        "format": 1, "amplitude_n": [1.0] * 6, "dwell_s": 0.1, "legs": [{"duration_s": 1.0, "speed_m_per_s": 0.12}],
        "abort": {"deviation_n": 8.0},
    }  # fmt: skip
    case = case_of(proposal({"kind": "experiment", "experiment": fast}, context), context, of)
    weak = of.line.model_copy(update={"limits": of.line.limits.model_copy(update={"torque_nm": 5.0})})
    assert "go slower" in refused(experiment.check_corners(replace(case, line=weak)))[0]
    mpc = context.model_copy(update={"in_service": design_mpc(of.task(), MpcWeights())})
    assert refused(experiment.check_corners(replace(case, context=mpc))) == []


def test_an_experiment_on_a_model_that_cannot_be_looked_at_is_judged_on_the_lines_file(of, context):
    slow = of.model.model_copy(update={"parameters": of.model.parameters.model_copy(update={"latency_s": 1.0})})
    small = {
        "format": 1, "amplitude_n": [1.0] * 6, "dwell_s": 0.1, "legs": [{"duration_s": 1.0}],
        "abort": {"deviation_n": 8.0},
    }  # fmt: skip
    now = context.model_copy(update={"model": slow, "latency_s": 0.01})
    case = case_of(proposal({"kind": "experiment", "experiment": small}, context), now, of)
    assert "corners of the line's file" in experiment.check_corners(case)[0].text


def test_an_experiment_where_recent_data_speak_against_the_model_is_judged_on_the_lines_file(of, context):
    stiff = of.model.parameters.model_copy(update={"friction_nms_per_rad": [12.0] * 6})
    now = context.model_copy(update={"model": of.model.model_copy(update={"parameters": stiff})})
    small = {
        "format": 1, "amplitude_n": [1.0] * 6, "dwell_s": 0.1, "legs": [{"duration_s": 1.0}],
        "abort": {"deviation_n": 8.0},
    }  # fmt: skip
    case = case_of(proposal({"kind": "experiment", "experiment": small}, context), now, of)
    assert "corners of the line's file" in experiment.check_corners(case)[0].text

"""Rules on an experiment: what no corner can follow, and a model that it cannot be judged by."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.control.design import MpcWeights, design_mpc
from gateway.core.experiment import setpoints
from gateway.core.verdict import RuleFinding
from safety.limits import envelope_limits
from safety.rules import experiment
from tests.safety.case_support import case_of, proposal, refused, with_state
from tests.safety.test_gate_corners import rollouts

SMALL = {"format": 1, "amplitude_n": [1.0] * 6, "dwell_s": 0.1, "legs": [{"duration_s": 1.0}],
         "abort": {"deviation_n": 8.0}}  # fmt: skip


def small_case(of, context, **changes):
    """About an experiment of one newton either way, but for `changes`."""
    return case_of(proposal({"kind": "experiment", "experiment": SMALL | changes}, context), context, of)


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
    now = context.model_copy(update={"model": slow, "latency_s": 0.01})
    case = small_case(of, now)
    assert "corners of the line's file" in experiment.check_corners(case)[0].text


def test_an_experiment_where_recent_data_speak_against_the_model_is_judged_on_the_lines_file(of, context):
    stiff = of.model.parameters.model_copy(update={"friction_nms_per_rad": [12.0] * 6})
    now = context.model_copy(update={"model": of.model.model_copy(update={"parameters": stiff})})
    case = small_case(of, now)
    assert "corners of the line's file" in experiment.check_corners(case)[0].text


def mpc_in_service(of, context):
    return context.model_copy(update={"in_service": design_mpc(of.task(), MpcWeights())})


@pytest.mark.parametrize(("lowest_n", "highest_n", "most_n"), [(12.5, 40.0, 10.5), (20.0, 48.0, 12.0)])
def test_it_ends_before_the_nearest_limit_of_a_tension(of, context, lowest_n, highest_n, most_n):
    stands = with_state(context, tension_n=[30.0, 30.0, highest_n, 30.0, lowest_n, 30.0])

    def found(deviation_n):
        return experiment.check_abort(small_case(of, stands, abort={"deviation_n": deviation_n}))

    for deviation_n in (most_n, most_n + 0.1):
        assert found(deviation_n) == [RuleFinding(
            rule="experiment: abort", passed=deviation_n == most_n, value=deviation_n, limit=most_n,
            margin=most_n - deviation_n, unit="N",
            text=f"it is aborted when a tension is {deviation_n:g} N from where it stood; allowed: up to {most_n:g} N, "
            "which is the nearest limit of 2 to 60 N",
        )]  # fmt: skip


def figures(down_n, up_n, roller_m_per_s):
    """Of two plants at 28, 36, 20, 40, 24 and 30 N: how far the tension of span 3 falls and that of span 4 rises."""
    stood = np.array([[28.0, 36.0, 20.0, 40.0, 24.0, 30.0]] * 2)
    low, high, roller = stood - 0.5, stood + 0.5, np.full((2, 6), 0.05)
    low[0, 2], high[1, 3], roller[1, 1] = 20.0 - down_n, 40.0 + up_n, roller_m_per_s
    return replace(rollouts(), tension_min_n=low, tension_max_n=high, roller_speed_max_m_per_s=roller)


@pytest.mark.parametrize(
    ("down_n", "up_n", "against"),
    [
        (2.0, 8.0, {}),
        (8.0, 3.0, {}),
        (8.5, 3.0, {"experiment: deviation"}),
        (3.0, 8.5, {"experiment: deviation"}),
        (18.0, 20.0, {"experiment: deviation"}),
        (18.5, 3.0, {"experiment: deviation", "experiment: lowest tension"}),
        (2.0, 20.5, {"experiment: deviation", "experiment: highest tension"}),
    ],
)
@pytest.mark.parametrize("left_out", [0, 3])
def test_how_far_tensions_go_on_the_corners(of, context, monkeypatch, down_n, up_n, against, left_out):
    case = small_case(of, context)
    allowed = envelope_limits(of.line).roller_speed_in_step_m_per_s(0.05)
    monkeypatch.setattr(experiment, "rollouts", lambda *_: figures(down_n, up_n, allowed))
    monkeypatch.setattr(experiment, "holdable", lambda thetas, *_: thetas[left_out:])
    on = "on 5 corners of the accepted model, 3 left out" if left_out else "on 8 corners of the accepted model"
    off_n, low_n, high_n = max(down_n, up_n), min(20.0 - down_n, 23.5), max(40.0 + up_n, 36.5)
    wanted = [
        ("deviation", off_n, 8.0, 8.0 - off_n, "N",
         f"tension goes up to {off_n:.1f} N from where it stood ({on}); allowed: 8 N, where it aborts"),
        ("lowest tension", low_n, 2.0, low_n - 2.0, "N",
         f"tension falls to {low_n:.1f} N ({on}); allowed: down to 2 N"),
        ("highest tension", high_n, 60.0, 60.0 - high_n, "N",
         f"tension rises to {high_n:.1f} N ({on}); allowed: up to 60 N"),
        ("roller speed", allowed, allowed, 0.0, "m/s",
         f"a roller runs at up to {allowed:.3g} m/s ({on}); allowed: {allowed:.3g} m/s, of "
         f"{envelope_limits(of.line).roller_speed_m_per_s:.3g} m/s at which torque goes off: smaller or slower moves"),
    ]  # fmt: skip
    assert experiment.check_corners(case) == [
        RuleFinding(rule=f"experiment: {rule}", passed=f"experiment: {rule}" not in against, value=value, limit=limit,
                    margin=margin, unit=unit, text=text)
        for rule, value, limit, margin, unit, text in wanted
    ]  # fmt: skip
    monkeypatch.setattr(experiment, "rollouts", lambda *_: figures(2.0, 2.0, allowed + 1e-9))
    assert [one.rule for one in experiment.check_corners(case) if not one.passed] == ["experiment: roller speed"]


def test_where_no_model_is_accepted_the_corners_are_those_of_the_lines_file(of, monkeypatch):
    monkeypatch.setattr(experiment, "rollouts", lambda *_: figures(2.0, 2.0, 0.05))
    monkeypatch.setattr(experiment, "holdable", lambda thetas, *_: thetas)
    first = experiment.check_corners(small_case(of, of.context(model=None, data=[])))[1]
    assert first.text == "tension falls to 18.0 N (on 8 corners of the line's file); allowed: down to 2 N"


@pytest.mark.parametrize(("predictive", "first_leg"), [(False, 800), (True, 250)])
def test_the_begin_of_each_leg_is_simulated_with_the_way_from_speed_to_speed(
    of, context, monkeypatch, predictive, first_leg
):
    seen = []

    def noted(line, config, thetas, asked, noise, seed):
        seen.append(asked)
        return figures(2.0, 2.0, 0.05)

    monkeypatch.setattr(experiment, "rollouts", noted)
    legs = [{"duration_s": 9.0}, {"duration_s": 0.5, "speed_m_per_s": 0.06},
            {"duration_s": 0.7, "speed_m_per_s": 0.045}]  # fmt: skip
    case = small_case(of, mpc_in_service(of, context) if predictive else context, legs=legs)
    experiment.check_corners(case)
    (asked,) = seen
    up = [min(0.05 + 0.05 * 0.01 * k, 0.06) for k in range(1, 51)]  # at 0.05 m/s2
    down = [max(0.06 - 0.05 * 0.01 * k, 0.045) for k in range(1, 71)]
    assert asked.unwind_speed_m_per_s == pytest.approx(np.array([0.05] * first_leg + up + down))
    sent = setpoints(case.experiment, case.tension_n, 0.01)  # dwells are counted on from leg to leg
    assert (asked.tension_n == sent[: first_leg + 120]).all()

"""Rules on what a configuration gains: no worse than what is in service and the baseline, and promises kept."""

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from gateway.control.design import LqiWeights, design_lqi, task_of
from gateway.control.rollout import Course, Rollouts
from gateway.core.deployment import Region
from gateway.core.line import Span
from gateway.core.verdict import ScenarioFigures
from safety import performance
from safety.findings import told
from safety.performance import LOST, Figures
from safety.rules import corners, improvement, promises
from safety.simulated import judged_of
from tests.safety.case_support import case_of, gains, refused


def test_improvement_at_each_tolerance(of):
    gate = of.line.gate
    assert improvement.allowed(gate, "rmse_n", 2.0) == pytest.approx(2.1)
    assert improvement.allowed(gate, "rmse_n", 20.0) == pytest.approx(20.4)
    assert improvement.allowed(gate, "settling_s", 1.0) == pytest.approx(1.1)
    assert improvement.allowed(gate, "overshoot_pct", 10.0) == pytest.approx(12.0)
    assert improvement.in_words(inf, "settling_s") == "never"
    assert improvement.in_words(inf, "rmse_n") == "without end"


def test_what_is_worse_than_in_service_or_than_the_baseline_is_refused(of, context, redesigned):
    first = design_lqi(task_of(of.line))
    walked = context.model_copy(update={"in_service": first, "baseline": redesigned})
    found = improvement.check(case_of(gains(first, walked), walked, of))
    assert {one.rule.rsplit(", ", 1)[1] for one in found} == {"in service", "baseline"}
    assert all(one.passed for one in found if one.rule.endswith("in service"))
    assert [one.rule for one in found if not one.passed and one.rule.endswith("baseline")]


def test_nothing_is_worse_than_what_in_service_would_do_beyond_what_it_was_judged_for(of, context, redesigned):
    first = design_lqi(task_of(of.line))
    better = context.model_copy(update={"in_service": redesigned})

    def against(region):
        within = better.model_copy(update={"region": region})
        found = improvement.check(case_of(gains(first, within), within, of))
        return {one.rule for one in found if not one.passed}

    everywhere = against(Region())
    assert "improvement: tracking error, in service" in everywhere
    assert against(Region(speed_max_m_per_s=1.0, tension_step_max_n=1e3, speed_step_max_m_per_s=1.0)) == everywhere
    small = Region(speed_max_m_per_s=0.01, tension_step_max_n=0.1, speed_step_max_m_per_s=0.0)
    # What they differ by there is within the tolerances; overshoot is a share of the step.
    assert against(small) == {"improvement: overshoot, in service"} <= everywhere


def test_the_baseline_is_a_measure_as_far_as_it_was_judged_for(of, context, redesigned):
    first = design_lqi(task_of(of.line))

    def against(region):
        walked = context.model_copy(update={"in_service": first, "baseline": redesigned, "baseline_region": region})
        found = improvement.check(case_of(gains(first, walked), walked, of))
        told = next(one.text for one in found if one.rule == "improvement: tracking error, baseline")
        return {one.rule for one in found if not one.passed}, told

    refused_for, text = against(Region())
    assert "improvement: tracking error, baseline" in refused_for and "compared up to" not in text
    refused_for, text = against(Region(speed_max_m_per_s=0.01, tension_step_max_n=0.1, speed_step_max_m_per_s=0.0))
    assert "improvement: tracking error, baseline" not in refused_for
    assert "compared up to 0.01 m/s and steps of 0.1 N" in text


def test_how_far_in_service_is_a_measure_is_said_only_where_it_is_not_everywhere(of, context, redesigned):
    def text(region):
        within = context.model_copy(update={"region": region})
        return improvement.check(case_of(gains(redesigned, within), within, of))[0].text

    assert text(Region()).endswith(" N")
    small = Region(speed_max_m_per_s=0.01, tension_step_max_n=0.1, speed_step_max_m_per_s=0.0)
    assert text(small).endswith(", compared up to 0.01 m/s and steps of 0.1 N")


def test_what_has_no_end_in_both_hides_nothing_that_is_worse(of, context, redesigned, monkeypatch):
    def course(rmse_n, settling_s):
        return Figures(rmse_n, 0.0, settling_s, 0.0)

    before = {"tension": course(1.0, inf), "velocity": course(1.0, 1.0)}
    after = {"tension": course(1.0, inf), "velocity": course(1.0, 1.5)}
    monkeypatch.setattr(improvement, "beside_in_service", lambda case: (before, after))
    found = improvement.check(case_of(gains(redesigned, context), context, of))
    (wrong,) = [one for one in found if not one.passed]
    assert wrong.rule == "improvement: settling time, in service" and wrong.text.startswith("settling time in velocity")


def test_figures_of_a_verdict_are_those_of_each_configuration_and_course_and_endless_ones_are_not_known(
    case, monkeypatch
):
    found = {
        "in service": {"tension": Figures(1.0, 2.0, 3.0, 4.0), "moves": Figures(5.0, 0.0, inf, 6.0)},
        "baseline": {"tension": Figures(7.0, inf, 8.0, 9.0)},
        "proposed": {"tension": LOST, "moves": Figures(inf, 10.0, 11.0, inf)},
    }
    monkeypatch.setattr(performance, "performances", lambda _: found)

    def figures(whose, name, rmse_n, overshoot_pct, settling_s, effort_n2m2s):
        return ScenarioFigures(configuration=whose, scenario=name, rmse_n=rmse_n, overshoot_pct=overshoot_pct,
                               settling_s=settling_s, effort_n2m2s=effort_n2m2s)  # fmt: skip

    assert performance.figures_of(case) == [
        figures("in service", "tension", 1.0, 2.0, 3.0, 4.0),
        figures("in service", "moves", 5.0, 0.0, None, 6.0),
        figures("baseline", "tension", 7.0, None, 8.0, 9.0),
        figures("proposed", "tension", None, None, None, None),
        figures("proposed", "moves", None, 10.0, 11.0, None),
    ]


def test_a_small_overshoot_is_no_worse_than_none_but_breaks_a_promise(of):
    gate = of.line.gate
    assert improvement.no_worse(gate, "overshoot_pct", 0.0) == gate.fine_overshoot_pct == 10.0
    assert improvement.no_worse(gate, "overshoot_pct", 9.0) == pytest.approx(11.0)
    assert improvement.no_worse(gate, "rmse_n", 2.0) == improvement.allowed(gate, "rmse_n", 2.0)
    assert improvement.allowed(gate, "overshoot_pct", 0.0) == 2.0


def test_a_promise_that_nobody_can_break(of, context, redesigned):
    def found(**promise):
        given = gains(redesigned, context, predicted=[{"scenario": "tension", **promise}])
        return promises.check(case_of(given, context, of))

    assert refused(found()) == [] == refused(found(rmse_n=1e6, overshoot_pct=1e6, settling_s=1e6))
    assert len(refused(found(rmse_n=0.0, settling_s=0.0))) == 2


def test_where_nothing_is_promised_nothing_is_broken(of, context, redesigned):
    for predicted in ([], [{"scenario": "tension"}]):
        case = case_of(gains(redesigned, context, predicted=predicted), context, of)
        assert promises.check(case) == [told("promises", True, "nothing is promised")]


def test_a_promise_of_no_course_of_the_gate_does_not_hide_the_others(of, context, redesigned):
    promised = [{"scenario": "lunch", "rmse_n": 1e6}, {"scenario": "velocity", "rmse_n": 1e6}]
    no_course, kept = promises.check(case_of(gains(redesigned, context, predicted=promised), context, of))
    assert no_course == told(
        "promises", False,
        "lunch is no course of the gate, so that its promise cannot be checked; allowed: tension, velocity, moves",
    )  # fmt: skip
    assert (kept.rule, kept.passed, kept.limit, kept.unit) == ("promises: tracking error", True, 1.02e6, "N")


def test_a_line_that_permits_no_steps_is_judged_standing(of, context, redesigned):
    limits = of.line.limits.model_copy(update={"tension_step_max_n": 0.0, "speed_step_max_m_per_s": 0.0})
    still = replace(
        case_of(gains(redesigned, context), context, of), line=of.line.model_copy(update={"limits": limits})
    )
    assert refused(corners.check(still)) == [] == refused(improvement.check(still))


def test_spans_without_a_load_cell_keep_their_set_point(of, context, case):
    spans = [span if i else Span(name=span.name, length_m=span.length_m, control="draw")
             for i, span in enumerate(of.line.spans)]  # fmt: skip
    low, high = judged_of(replace(case, line=of.line.model_copy(update={"spans": spans}))).levels()
    assert low[0] == high[0] == context.state.tension_n[0] and (high[1:] - low[1:] == 24.0).all()


@pytest.fixture
def drawn(of, context, redesigned):
    """Of a line whose first span is without a load cell."""
    spans = [span.model_copy(update={"control": "draw"}) if i == 0 else span for i, span in enumerate(of.line.spans)]
    return replace(case_of(gains(redesigned, context), context, of), line=of.line.model_copy(update={"spans": spans}))


def simulated(squared_error_n2, beyond_n, settled, effort_n2m2s):
    one = np.ones((1, 6))
    return Rollouts(np.array([squared_error_n2]), one, one, np.array([settled]), np.array([beyond_n]), one, one, one,
                    np.array([effort_n2m2s]))  # fmt: skip


def test_figures_are_of_spans_with_a_load_cell_but_for_the_effort_and_of_the_line_at_rest_where_noise_is_luck(
    drawn, monkeypatch
):
    """The second span steps by 4 N in the first period and goes 1 N too far; the others stand at 20 N."""
    tension_n = np.full((8, 6), 20.0)
    tension_n[1:, 1] = 24.0
    noisy = simulated([400.0, 1.0, 2.0, 3.0, 2.0, 1.0], [9.0] * 6, [900.0] * 6, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    quiet = simulated([900.0] * 6, [9.0, 1.0, 1.0, 0.0, 0.0, 0.0], [700.0, 5.0, 120.0, 0.0, 0.0, 0.0], [99.0] * 6)
    monkeypatch.setattr(
        performance, "simulate", lambda config, plants, course, setup: noisy if setup.tension_noise_n else quiet
    )
    course = Course(tension_n, np.full(8, 0.05), changed=1)
    monkeypatch.setattr(performance, "improvement_courses", lambda judged: {"tension": course})
    monkeypatch.setattr(performance, "way_of_moves", lambda judged: None)
    found = performance.performance(drawn.controller, drawn, judged_of(drawn))
    assert found == {"tension": Figures(3.0, 25.0, 1.2, 21.0)}


def test_of_a_move_there_is_the_error_of_spans_with_a_load_cell_and_nothing_else(drawn, monkeypatch):
    def follow(config, plants, way, setup):
        return way.course(setup.period_s).tension_n + [50.0, 3.0, 0.0, -4.0, 0.0, 0.0]

    monkeypatch.setattr(performance, "improvement_courses", lambda judged: {})
    monkeypatch.setattr(performance, "follow", follow)
    found = performance.performance(drawn.controller, drawn, judged_of(drawn))
    assert found == {"moves": Figures(found["moves"].rmse_n, 0.0, 0.0, 0.0)}
    assert found["moves"].rmse_n == pytest.approx(5.0)


def test_what_is_no_number_has_no_end(case, monkeypatch):
    gone = [nan] + [1.0] * 5
    monkeypatch.setattr(performance, "simulate", lambda *_: simulated(gone, gone, gone, gone))
    monkeypatch.setattr(performance, "follow", lambda *_: np.full((1, 6), nan))
    found = performance.performance(case.controller, case, judged_of(case))
    assert found == {"tension": LOST, "velocity": LOST, "moves": Figures(inf, 0.0, 0.0, 0.0)}


def test_a_baseline_that_is_in_service_itself_is_simulated_once(of, context, redesigned, monkeypatch):
    def configurations(baseline):
        asked = []
        monkeypatch.setattr(performance, "performance", lambda config, *_: asked.append(config) or {})
        known = context.model_copy(update={"baseline": baseline})
        found = performance.performances(case_of(gains(redesigned, known), known, of))
        assert set(found) == {"in service", "baseline", "proposed"}
        return asked

    other = design_lqi(of.task(), LqiWeights(torque_per_nm2=0.01))
    assert configurations(context.in_service.model_copy()) == [context.in_service, redesigned]
    assert configurations(other) == [context.in_service, other, redesigned]

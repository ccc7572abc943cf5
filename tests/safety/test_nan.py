"""What is no number lets nothing through: put in one place after another of what a rule compares."""

from contextlib import contextmanager
from dataclasses import fields, replace
from math import inf, nan

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gateway.control.rollout import Rollouts
from gateway.core.signals import Inputs, Quality
from gateway.core.theta import nominal_theta
from safety import corner_runs, simulated
from safety.excitation import excited_parts
from safety.findings import at_least, at_most
from safety.jumps import JumpState, jump_limits, reject_jumps
from safety.performance import Figures
from safety.rules import alignment, corners, decay, experiment, improvement, model_likelihood, paper, roller_speed
from safety.rules import validity as validity_rule
from safety.simulated import holdable
from tests.safety.case_support import case_of, proposal, published, refused
from tests.safety.envelope_support import AT_STANDSTILL, EVERYTHING, LIMITS, findings_after, healthy
from tests.safety.recovery_support import at_rest, recovery_of

PLANTS, SPANS = 2, 6
SOUND = {
    "tension_min_n": 20.0, "tension_max_n": 40.0, "tail_swing_n": 0.1, "tail_error_n": 0.1, "chatter_nm": 0.1,
    "roller_speed_max_m_per_s": 0.06,
}  # fmt: skip
plants, spans = st.integers(0, PLANTS - 1), st.integers(0, SPANS - 1)
quick = settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def rollouts(spoilt: str = "", plant: int = 0, span: int = 0) -> Rollouts:
    """Of two plants that keep every limit; one figure of one span of one of them is no number."""
    figures = {one.name: np.full((PLANTS, SPANS), SOUND.get(one.name, 0.1)) for one in fields(Rollouts)}
    if spoilt:
        figures[spoilt][plant, span] = nan
    return Rollouts(**figures)


@contextmanager
def patched(target: object, name: str, value: object):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(target, name, value)
        yield


def in_turn(at: int, spoilt: Rollouts):
    """The answers of a simulation that is asked for one course after another: that with number `at` is spoilt."""
    count = iter(range(10_000))
    return lambda *_: spoilt if next(count) == at else rollouts()


@given(st.sampled_from([at_least, at_most]), st.floats(allow_nan=True), st.sampled_from([nan, inf, -inf]))
def test_a_number_that_is_none_or_without_end_on_the_good_side_was_not_seen(of, limit, value) -> None:
    if of(rule="r", value=value, limit=limit, unit="N", text="").passed:
        assert value == limit == (inf if of is at_most else -inf) or (of is at_most and value == limit == inf)


@quick
@given(
    st.sampled_from(["tension_min_n", "tension_max_n", "tail_swing_n", "tail_error_n", "chatter_nm"]), plants, spans,
    st.integers(0, 2),
)  # fmt: skip
def test_corners_refuse_a_figure_that_is_no_number(case, figure, plant, span, course) -> None:
    with patched(corners, "_late", lambda *_: []):
        with patched(corner_runs, "rollouts", in_turn(-1, rollouts())):
            assert not refused(corners.check(replace(case)))
        with patched(corner_runs, "rollouts", in_turn(course, rollouts(figure, plant, span))):
            assert len(refused(corners.check(replace(case)))) == 1


def test_corners_of_which_no_course_was_simulated_are_refused(case) -> None:
    with patched(corners, "in_largest_steps", lambda _: {}):
        assert len(refused(corners.check(replace(case)))) == 5


@quick
@given(plants, spans, st.integers(0, 3))
def test_rollers_whose_speed_is_no_number_are_refused(case, plant, span, course) -> None:
    found = rollouts("roller_speed_max_m_per_s", plant, span)
    with patched(corner_runs, "rollouts", in_turn(course, found)), patched(roller_speed, "rollouts", in_turn(0, found)):
        assert refused(roller_speed.check(replace(case)))


@quick
@given(st.sampled_from(["tension_min_n", "tension_max_n", "roller_speed_max_m_per_s"]), plants, spans)
def test_an_experiment_is_refused_where_a_figure_is_no_number(of, context, figure, plant, span) -> None:
    asked = {"format": 1, "amplitude_n": [1.0] * SPANS, "dwell_s": 0.1, "legs": [{"duration_s": 1.0}],
             "abort": {"deviation_n": 25.0}}  # fmt: skip
    case = case_of(proposal({"kind": "experiment", "experiment": asked}, context), context, of)
    with patched(experiment, "rollouts", lambda *_: rollouts()):
        assert not refused(experiment.check_corners(replace(case)))
    with patched(experiment, "rollouts", lambda *_: rollouts(figure, plant, span)):
        assert refused(experiment.check_corners(replace(case)))


@quick
@given(st.sampled_from(["rmse_n", "overshoot_pct", "settling_s"]), st.booleans(), st.integers(0, 2))
def test_no_improvement_is_seen_in_what_is_no_number(case, metric, proposed, course) -> None:
    def performance(spoilt: bool):
        one = Figures(1.0, 5.0, 0.5, 1.0)
        found = {name: one for name in ("a", "b", "c")}
        return {**found, "abc"[course]: replace(one, **{metric: nan})} if spoilt else found

    with patched(improvement, "beside_in_service", lambda _: (performance(not proposed), performance(proposed))):
        with patched(improvement, "beside_baseline", lambda _: None):
            assert len(refused(improvement.check(replace(case)))) == 1


def test_a_loop_of_numbers_near_the_greatest_is_not_stable(case, monkeypatch) -> None:
    monkeypatch.setattr(decay, "closed_loop", lambda *_: np.full((2, 2), 1e308))
    assert decay.decay_per_s(case.controller, case, case.believed, 0.05) == -inf
    assert refused(decay.check(replace(case)))


def model_case(of, context):
    change = {"kind": "model", "model": of.model.model_dump()}
    return case_of(proposal(change, context), context, of)


@quick
@given(st.integers(0, 5))
def test_a_noise_whose_likelihood_is_no_number_is_refused(of, context, at) -> None:
    count = iter(range(100))
    with patched(model_likelihood, "_gain", lambda *_: nan if next(count) == at else -1.0):
        assert len(refused(model_likelihood.check_noise(model_case(of, context)))) == 1


def test_predictions_that_run_away_leave_no_shift_to_be_small(of, context, monkeypatch) -> None:
    monkeypatch.setattr(model_likelihood, "normalised", lambda _: inf)
    assert "run away" in refused(model_likelihood.check_sureness(model_case(of, context)))[0]


@quick
@given(st.booleans(), st.integers(0, 12))
def test_a_channel_whose_lateness_is_no_number_is_refused(case, spread, channel) -> None:
    late_s, spread_s = np.zeros(19), np.full(19, 1e-4)
    with patched(alignment, "lateness", lambda *_: (late_s, spread_s)):
        assert not refused(alignment.check(replace(case)))
        (spread_s if spread else late_s)[channel] = nan
        assert "run away" in refused(alignment.check(replace(case)))[0]


def test_a_model_without_data_to_look_at_is_not_valid(case, monkeypatch) -> None:
    monkeypatch.setattr(validity_rule, "foretold_of", lambda *_: [])
    assert refused(validity_rule.check(replace(case)))


@quick
@given(st.sampled_from(["torque_max_nm", "torque_step_max_nm"]), plants, spans, st.integers(0, 1))
def test_the_papers_filter_does_not_take_what_is_no_number_for_safe(case, figure, plant, span, course) -> None:
    with patched(paper, "simulate", in_turn(course, rollouts(figure, plant, span))):
        assert not paper._safe(case).passed  # noqa: SLF001


def test_a_plant_whose_torque_is_no_number_is_not_left_out(case, monkeypatch) -> None:
    course = next(iter(corner_runs.courses_of(replace(case)).values())).course
    theta = nominal_theta(case.line)
    monkeypatch.setattr(simulated, "equilibrium_torque", lambda *_: np.full(SPANS, nan))
    assert holdable([theta], course, 1.0) == [theta]


def test_a_recording_whose_speed_is_no_number_excites_nothing() -> None:
    recording = published().recording
    assert excited_parts(recording, published().line)
    lost = np.full_like(recording.unwind_speed_m_per_s, nan)
    assert not excited_parts(replace(recording, unwind_speed_m_per_s=lost), published().line)


@given(st.sampled_from([EVERYTHING, AT_STANDSTILL]), st.sampled_from(["tension", "speed"]), st.integers(0, 2))
def test_the_envelope_takes_a_good_sample_that_is_no_number_for_one_outside(supervision, channel, i) -> None:
    inputs = healthy()
    getattr(inputs, channel).value[i] = nan
    assert findings_after(LIMITS.band_periods, inputs, supervision)
    getattr(inputs, channel).quality[i] = Quality.MISSING  # what was never heard is another rule's
    named = {one.rule for one in findings_after(1, inputs, supervision)}
    assert not named & {"tension-high", "slack", "web-break", "roller-speed"}


def test_an_unwinder_whose_good_speed_is_no_number_is_too_fast() -> None:
    inputs = healthy()
    inputs.unwind_speed.value[0] = nan
    assert "overspeed" in {one.rule for one in findings_after(1, inputs)}


@given(st.integers(0, 5))
def test_a_speed_has_jumped_where_nobody_knows_how_far_it_can_have_come(roller) -> None:
    line = published().line
    limits, state, inputs = jump_limits(line, np.zeros(line.n)), JumpState(), healthy_of(line.n)
    torque_nm = np.zeros(line.n)
    reject_jumps(limits, state, inputs, [torque_nm])
    torque_nm[roller] = nan
    inputs.speed.put(roller, 0.06, 1.01)
    reject_jumps(limits, state, inputs, [torque_nm])
    assert inputs.speed.quality[roller] == Quality.BAD


def healthy_of(n: int):
    inputs = Inputs(n)
    for i in range(n):
        inputs.tension.put(i, 30.0, 1.0)
        inputs.speed.put(i, 0.05, 1.0)
    return inputs


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 4), spans, st.booleans())
def test_recovery_is_not_foreseen_from_what_is_no_number(part, i, running) -> None:
    recovery = recovery_of()
    measured, setpoint_n, in_flight_nm, torque_nm = (*at_rest()[:4],)
    given = [one.copy() for one in (measured.tension_n, measured.speed_m_per_s, setpoint_n, in_flight_nm, torque_nm)]
    given[part].reshape(-1)[i] = nan
    away = replace(measured, tension_n=given[0], speed_m_per_s=given[1])
    assert recovery.shortfall(away, *given[2:]) is not None
    assert recovery.shortfall_of_step(away, *given[2:], None) is not None

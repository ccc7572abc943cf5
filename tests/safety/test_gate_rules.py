"""Each rule alone, at its threshold: what just passes, what just does not, and what its words say."""

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from gateway.control.design import MpcWeights, design_lqi, design_mpc, design_scheduled, task_of
from gateway.control.judged_courses import corner_courses, improvement_courses
from gateway.control.prediction import gains_of, imagined, innovations, predict, stretch_of, whitened
from gateway.control.rollout import Rollouts
from gateway.core.line import Span
from gateway.core.line_model import theta_of
from gateway.core.proposal import proposal_hash
from gateway.core.theta import Noise
from gateway.loop.setpoints import STEP_PAUSE_S
from safety import programme
from safety.believed import Unbelievable, corners_of_model, stated
from safety.case import Case
from safety.excitation import excited_parts, newest, recent, same_speed
from safety.findings import at_least, at_most, told
from safety.judge import warm_up
from safety.predicting import Foretold, with_swings
from safety.rules import (
    alignment,
    authority,
    cool_down,
    corners,
    decay,
    delay_margin,
    experiment,
    fits_line,
    freshness,
    improvement,
    line_state,
    model_data,
    model_fits,
    model_likelihood,
    paper,
    promises,
    roller_speed,
    validity,
)
from safety.rules.corners import Worst
from safety.simulated import holdable, judged_of, stressed
from tests.safety.case_support import EXPIRES, NOW, case_of, gains, proposal, published, refused, verdict_of


@pytest.fixture(scope="module")
def of():
    return published()


@pytest.fixture(scope="module")
def context(of):
    return of.context()


@pytest.fixture(scope="module")
def redesigned(of):
    return design_lqi(of.task())


@pytest.fixture
def case(of, context, redesigned):
    return case_of(gains(redesigned, context), context, of)


def with_state(context, **changes):
    return context.model_copy(update={"state": context.state.model_copy(update=changes)})


def test_numbers_at_their_limit_pass_and_what_is_no_number_never_does():
    assert at_least("r", 1.0, 1.0, "s", "").passed and at_most("r", 1.0, 1.0, "s", "").passed
    assert not at_least("r", 0.999, 1.0, "s", "").passed and not at_most("r", 1.001, 1.0, "s", "").passed
    assert at_least("r", 1.5, 1.0, "s", "").margin == at_most("r", 0.5, 1.0, "s", "").margin == 0.5
    for value in (nan, -inf):
        found = at_least("r", value, 1.0, "s", "")
        assert not found.passed and found.value is None and found.margin is None
    assert not at_most("r", nan, 1.0, "s", "").passed and not at_most("r", inf, 1.0, "s", "").passed


def test_words_are_printable_and_no_longer_than_the_format_takes():
    assert told("r", True, "a\x1b[2Jb").text == "a\\u001b[2Jb"
    assert len(told("r", True, "x" * 3000).text) == 2000


def test_authority(of, context, redesigned):
    def of_author(author, **gate):
        return refused(authority.check(case_of(gains(redesigned, context, author=author), context, of, **gate)))

    assert of_author("agents") == []
    assert "did you mean agents?" in of_author("agent")[0]
    assert "is closed" in of_author("agents", autonomy="closed")[0]
    assert len(of_author("nobody", autonomy="closed")) == 2


STALE = {
    "site": ({"site": "elsewhere"}, {}, "it is for elsewhere/line-1"),
    "base": ({"base": "0" * 64}, {}, "in service is"),
    "model": ({"model": "0" * 64}, {}, "it was made by the model 0000"),
    "the file": ({"model": None}, {}, "it was made by the line's file"),
    "no model": ({"model": "0" * 64}, {"model": None}, "no model is accepted"),
    "expired": ({}, {"now": EXPIRES}, "it has expired"),
    "future": ({}, {"now": "2026-08-03T14:04:59+00:00"}, "it comes from the future"),
    "for ever": ({"expires": "2026-08-04T14:05:01+00:00"}, {}, "allowed: gate.expiry_max_s, 86400 s"),
}


@pytest.mark.parametrize("name", STALE)
def test_freshness(of, context, redesigned, name):
    given, surroundings, words = STALE[name]
    now = context.model_copy(update=surroundings)
    assert words in refused(freshness.check(case_of(gains(redesigned, context, **given), now, of)))[0]


def test_what_is_just_fresh_passes_and_what_was_decided_does_not(of, context, redesigned):
    given = gains(redesigned, context, created=NOW, expires="2026-08-04T14:06:00+00:00")
    assert refused(freshness.check(case_of(given, context, of))) == []
    decided = context.model_copy(update={"decided": [proposal_hash(given)]})
    again = Case(of.line, decided, given, proposal_hash(given), [of.recording], 1)
    assert "decided already" in refused(freshness.check(again))[0]
    moved = {"kind": "model", "model": of.model.model_dump()}
    assert refused(freshness.check(case_of(proposal(moved, context, model=None), context, of))) == []


@pytest.mark.parametrize(("since_s", "passes"), [(None, True), (30.0, True), (29.9, False)])
def test_cool_down(of, context, redesigned, since_s, passes):
    now = with_state(context, since_change_s=since_s)
    assert (refused(cool_down.check(case_of(gains(redesigned, context), now, of))) == []) is passes


def test_state_of_the_line(of, context, redesigned):
    def found(check, **state):
        return refused(check(case_of(gains(redesigned, context), with_state(context, **state), of)))

    for state in ("RUN", "READY", "SILENT", "HOLD"):
        assert found(line_state.check_gains, state=state) == []
    assert "the line is in STOP" in found(line_state.check_gains, state="STOP")[0]
    assert "the line is in HOLD; allowed: RUN" in found(line_state.check_experiment, state="HOLD")[0]
    assert found(line_state.check_experiment) == [] == found(line_state.check_model, state="STOP", moving=True)
    everything = {"moving": True, "experiment": True, "on_probation": True, "doubts": ["cell 3"], "tension_n": [30.0]}
    assert len(found(line_state.check_gains, **everything)) == 5
    assert len(found(line_state.check_model, on_probation=True)) == 1


def test_a_controller_of_another_line(of, context, redesigned):
    def found(config, surroundings=context):
        return refused(fits_line.check(case_of(gains(config, context), surroundings, of)))

    assert found(redesigned) == []
    assert found(redesigned.model_copy(update={"latency_s": 0.02})) == []
    assert "latency of 0.0201 s" in found(redesigned.model_copy(update={"latency_s": 0.0201}))[0]
    assert found(redesigned, context.model_copy(update={"latency_s": 0.0201}))
    assert "period is 0.02 s" in found(redesigned.model_copy(update={"period_s": 0.02}))[0]
    assert "takes spans [1]" in found(redesigned.model_copy(update={"draw_spans": [1]}))[0]
    small = replace(task_of(of.line), model=replace(task_of(of.line).model, **first_spans(of.line, 2)),
                    tension_n=np.array([30.0, 30.0]))  # fmt: skip
    assert "is for 2 spans" in found(design_lqi(small))[0]


def first_spans(line, n):
    model = task_of(line).model
    return {name: getattr(model, name)[:n] for name in
            ("length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")}  # fmt: skip


def test_a_predictive_controller_plans_with_the_limits_of_the_line(of, context):
    mpc = design_mpc(of.task(), MpcWeights())
    assert refused(fits_line.check(case_of(gains(mpc, context), context, of))) == []
    strong = mpc.model_copy(update={"torque_nm": 61.0, "torque_rate_nm_per_s": 1e5, "tension_max_n": 61.0})
    assert len(refused(fits_line.check(case_of(gains(strong, context), context, of)))) == 3


def test_validity_at_its_limits(of, context, case, redesigned):
    value = validity.check(case)[0].value
    assert value == pytest.approx(1.0, abs=0.1)

    def found(**gate):
        return validity.check(case_of(gains(redesigned, context), context, of, **gate))[0]

    assert found(innovation_low=0.5, innovation_high=value + 1e-9).passed
    assert not found(innovation_low=0.5, innovation_high=value - 1e-9).passed
    assert found(innovation_low=value - 1e-9, innovation_high=1.9).passed
    assert not found(innovation_low=value + 1e-9, innovation_high=1.9).passed


def test_one_load_cell_that_the_model_does_not_explain_is_enough(of, context, redesigned):
    def found(**noise):
        model = of.model.model_copy(update={"noise": of.model.noise.model_copy(update=noise)})
        return refused(
            validity.check(case_of(gains(redesigned, context), context.model_copy(update={"model": model}), of))
        )

    assert "up to 1.5" in found(tension_n=0.06)[0]
    assert "takes the noise for greater" in found(tension_n=0.25)[0]


def test_models_that_cannot_be_looked_at_are_not_valid(of, context, redesigned):
    silent = of.model.model_copy(update={"noise": None})
    case = case_of(gains(redesigned, context), context.model_copy(update={"model": silent}), of)
    assert "says nothing of the noise" in refused(validity.check(case))[0]
    assert "no data by which" in refused(alignment.check(case))[0]
    none = case_of(gains(redesigned, context), context.model_copy(update={"model": None}), of)
    assert refused(validity.check(none)) and refused(alignment.check(none))
    old = case_of(gains(redesigned, context), context.model_copy(update={"now": "2026-08-20T00:00:00+00:00"}), of)
    assert "1 of them older" in refused(validity.check(old))[0]


@pytest.mark.parametrize("channel", ["tension_n", "speed_m_per_s"])
def test_a_channel_that_is_late_is_found(of, context, redesigned, channel):
    values = getattr(of.recording, channel).copy()
    values[1:, 2] = values[:-1, 2]
    late = replace(of, recording=replace(of.recording, **{channel: values}))
    given = gains(redesigned, late.context())
    found = alignment.check(case_of(given, late.context(), late))[0]
    assert not found.passed and found.value > 0.004
    # A speed that is late and a torque that is early are one and the same to its roller.
    assert found.text.startswith("tension 3" if channel == "tension_n" else ("speed 3", "torque 3"))


def test_alignment_at_its_limit_and_data_that_do_not_tell(of, context, case, redesigned):
    def found(**gate):
        return alignment.check(case_of(gains(redesigned, context), context, of, **gate))[0]

    assert found().passed and found().value < 0.001
    assert "do not tell" in found(alignment_max_s=1e-6).text and not found(alignment_max_s=1e-6).passed


def test_decay_at_its_limit(of, context, redesigned):
    def found(**gate):
        return decay.check(case_of(gains(redesigned, context), context, of, **gate))[0]

    rate = found().value
    assert found(decay_min_per_s=rate - 1e-9).passed and not found(decay_min_per_s=rate + 1e-9).passed


def test_delay_margin_at_its_limit_for_a_law_and_for_a_schedule(of, context, redesigned):
    def stood(config, **gate):
        return delay_margin.check(case_of(gains(config, context), context, of, **gate))[0]

    found = stood(redesigned, delay_margin_min_s=0.05)
    assert not found.passed and 0.004 < found.value < 0.05
    assert stood(redesigned, delay_margin_min_s=found.value).passed
    assert not stood(redesigned, delay_margin_min_s=found.value + 5e-4).passed
    assert stood(redesigned).passed and "or more" in stood(redesigned).text
    schedule = design_scheduled(of.task(), design_lqi, [0.02, 0.05])
    assert stood(schedule).passed
    assert decay.check(case_of(gains(schedule, context), context, of))[0].passed


def rollouts(low=3.0, high=59.0, swing=0.9, error=2.9, chatter=4.9):
    one = np.ones((1, 6))
    return Rollouts(one, low * one, high * one, one, one, one, one, one, one, tail_swing_n=swing * one,
                    tail_error_n=error * one, chatter_nm=chatter * one)  # fmt: skip


def test_corners_at_each_limit(of, context, redesigned, monkeypatch):
    case = case_of(gains(redesigned, context), context, of)

    def found(**figures):
        monkeypatch.setattr(corners, "rollouts", lambda *_: rollouts(**figures))
        return [one.rule for one in corners.check(case) if not one.passed]

    assert found() == []
    assert found(low=2.0, high=60.0, swing=1.0, error=3.0, chatter=5.0) == []
    assert found(low=1.99) == ["corners: lowest tension"]
    assert found(high=60.01) == ["corners: highest tension"]
    assert found(swing=1.01) == ["corners: oscillation"]
    assert found(error=3.01) == ["corners: error"]
    assert found(chatter=5.01) == ["corners: chatter"]
    assert len(found(low=-inf, high=inf, swing=inf, error=inf, chatter=inf)) == 5
    assert len(found(low=nan, high=nan, swing=nan, error=nan, chatter=nan)) == 5


def test_corners_that_nobody_could_hold_are_left_out_and_told(of, context, redesigned):
    case = case_of(gains(redesigned, context), context, of)
    plants, courses = [stressed(theta, of.line.gate) for theta in case.corners], corner_courses(judged_of(case))

    def kept(torque_nm):
        return [len(holdable(plants, course, torque_nm)) for course in courses.values()]

    some_nm = next(torque for torque in np.arange(20.0, 40.0, 0.02).tolist() if min(kept(torque)) > 0)
    assert min(kept(some_nm)) < 8
    weak = of.line.limits.model_copy(update={"torque_nm": some_nm})
    text = corners.check(replace(case, line=of.line.model_copy(update={"limits": weak})))[-1].text
    assert "left out, because no controller holds them with 2" in text
    none = of.line.limits.model_copy(update={"torque_nm": 5.0})
    assert (
        "none of 8 plants" in refused(corners.check(replace(case, line=of.line.model_copy(update={"limits": none}))))[0]
    )


@pytest.mark.parametrize("together", [1.0, 2.5, 4.0, 60.0])
def test_no_course_asks_for_more_than_the_loop_permits(case, together):
    limits = case.line.limits.model_copy(update={"steps_together": together})
    judged = replace(judged_of(case), line=case.line.model_copy(update={"limits": limits}))
    pause, most_n = round(STEP_PAUSE_S / case.line.control.period_s), limits.tension_step_max_n
    for course in [*corner_courses(judged).values(), *improvement_courses(judged).values()]:
        steps = np.abs(np.diff(course.tension_n, axis=0))
        lately = np.lib.stride_tricks.sliding_window_view(steps, min(pause, len(steps)), axis=0)
        assert lately.sum(axis=(1, 2)).max() <= together * most_n + 1e-9
        assert steps.max() <= most_n + 1e-9
        assert (lately > 0.0).sum(axis=2).max(initial=0) <= 1, "one span steps again only when the last step is over"
        low, high = limits.tension_min_n + limits.tension_margin_n, limits.tension_max_n - limits.tension_margin_n
        assert low <= course.tension_n.min() and course.tension_n.max() <= high


def test_a_loop_is_simulated_as_late_as_its_delay_margin_says(case, monkeypatch):
    seen = []

    def simulate(config, plants, course, setup):
        seen.append((plants, setup))
        return rollouts(low=1.0 if setup.step_s == pytest.approx(0.001) else 20.0)

    monkeypatch.setattr(corners, "simulate", simulate)
    (low,) = [one for one in corners.check(case) if not one.passed]
    assert low.rule == "corners: lowest tension" and "late" in low.text
    late = [plants for plants, setup in seen if setup.step_s == pytest.approx(0.001)]
    assert len(late) == 4 and all(
        plants.effects.latency_s == pytest.approx(case.latency_s + case.line.gate.delay_margin_min_s) for plants in late
    )
    weak = case.line.limits.model_copy(update={"torque_nm": 5.0})
    course = corner_courses(judged_of(case))["neighbours"]
    held_by_nobody = replace(case, line=case.line.model_copy(update={"limits": weak}))
    assert corners._late(held_by_nobody, case.controller, course) == []  # noqa: SLF001


def test_rollers_out_of_round_are_known_as_they_were_learned(of, case):
    round_theta, stretch = theta_of(of.model), stretch_of(case.excited[0].recording)
    noise, swing = Noise(), np.zeros((6, 2))
    swing[2] = 1e-2, -5e-3
    gains_ = gains_of(round_theta, noise, stretch)
    random = np.random.default_rng(1).standard_normal((stretch.predictions, len(stretch.outputs)))
    innovation = np.einsum("kij,kj->ki", gains_.factor[gains_.which], random)
    measured = imagined(round_theta, replace(stretch, swing=swing), gains_, innovation).measured
    eccentric = replace(round_theta, eccentricity=np.array([0.0, 0.0, 1.5e-2, 0.0, 0.0, 0.0]))
    predicted = predict(eccentric, noise, replace(stretch, measured=measured))
    known = with_swings(predicted)  # from half a turn
    assert known.swing[2] == pytest.approx(swing[2], abs=1e-3) and not known.swing[[0, 1, 3, 4, 5]].any()
    white, as_round = (
        np.square(whitened(innovations([round_theta], one, predicted.gains)[0], predicted.gains)).mean()
        for one in (known, replace(stretch, measured=measured))
    )
    assert white < 1.1 and as_round > 1.1
    late_s, _ = alignment.lateness(eccentric, [Foretold(case.excited[0], predicted)])
    assert np.abs(late_s).max() < 1e-3


def test_a_predictive_controller_runs_whole_on_some_corners_and_says_what_is_lost(of, context, monkeypatch):
    mpc = design_mpc(of.task(), MpcWeights())
    whole: list[int] = []

    def counted(config, plants, course, setup):
        if config == mpc:
            whole.append(plants.count)
            config = design_lqi(of.task())
        return corners.simulate(config, plants, course, setup)

    monkeypatch.setattr(programme, "simulate", counted)
    case = case_of(gains(mpc, context), context, of)
    found = corners.check(case)
    assert refused(roller_speed.check(case)) == []
    assert whole == [4] * 4  # once for both rules
    assert found[-1].rule == "corners: what is lost"
    assert refused(found) == []


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


def test_a_promise_that_nobody_can_break(of, context, redesigned):
    def found(**promise):
        given = gains(redesigned, context, predicted=[{"scenario": "tension", **promise}])
        return promises.check(case_of(given, context, of))

    assert refused(found()) == [] == refused(found(rmse_n=1e6, overshoot_pct=1e6, settling_s=1e6))
    assert len(refused(found(rmse_n=0.0, settling_s=0.0))) == 2


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


def test_bounds_of_a_model(of, context):
    def found(**changes):
        parameters = of.model.parameters.model_copy(update=changes)
        model = of.model.model_copy(update={"parameters": parameters})
        change = {"kind": "model", "model": model.model_dump()}
        return refused(model_fits.check(case_of(proposal(change, context), context, of)))

    assert found() == [] == found(stiffness_n=2400.0 * 1.3) == found(stiffness_n=2400.0 * 0.7)
    assert "stiffness_n is 3144" in found(stiffness_n=2400.0 * 1.31)[0]
    assert "radius_m[2] is" in found(radius_m=[0.04, 0.05, 0.04, 0.04, 0.04, 0.04])[0]
    assert found(coulomb_nm=[15.0] * 6, torque_lag_s=0.05, latency_s=0.02) == []
    wrong = {"coulomb_nm": [15.1] * 6, "torque_lag_s": 0.051, "latency_s": 0.021, "tension_before_n": 1.0}
    assert len(found(**wrong)) == 4
    other = of.model.model_copy(
        update={"site": "elsewhere", "data": of.model.data.model_copy(update={"period_s": 0.02})}
    )
    change = {"kind": "model", "model": other.model_dump()}
    assert len(refused(model_fits.check(case_of(proposal(change, context), context, of)))) == 2


def test_a_model_of_another_size(of, context):
    given = case_of(proposal({"kind": "model", "model": of.model.model_dump()}, context), context, of)
    fewer = replace(given, line=of.line.model_copy(update={"spans": of.line.spans[:5]}))
    assert "the model has 6 spans; allowed: 5" in refused(model_fits.check(fewer))[0]


def test_data_of_a_model(of, context):
    change = {"kind": "model", "model": of.model.model_dump()}
    given = proposal(change, context)
    quiet = replace(of.recording, tension_n=30.0 + 0.05 * np.sign(of.recording.tension_n - 30.0))
    still = replace(of, recording=quiet)
    found = refused(model_data.check(case_of(given, still.context(), still)))
    assert any("run an experiment" in text for text in found)
    twice = of.context(data=[*context.data, *context.data])
    assert refused(model_data.check(case_of(given, twice, of))) == []
    with pytest.raises(Unbelievable):
        model_likelihood.look_at(case_of(given, still.context(), still))


def test_intervals_stand_in_for_a_posterior(of):
    alone = of.model.model_copy(update={"posterior": None})
    names, covariance = stated(alone)
    assert set(names) == {"stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad"}
    spread = np.sqrt(np.diag(np.array(of.model.posterior.covariance)))
    order = [of.model.posterior.names.index(name) for name in names]
    assert np.sqrt(np.diag(covariance)) == pytest.approx(spread[order], rel=0.05)
    assert len(corners_of_model(alone, of.line.gate, 0.01, 1)) == 8
    nothing = alone.model_copy(update={"intervals": {}})
    with pytest.raises(Unbelievable, match="nobody knows how wrong"):
        stated(nothing)


def test_a_proposal_is_of_one_kind(case, of, context):
    with pytest.raises(TypeError, match="has no experiment"):
        _ = case.experiment
    with pytest.raises(TypeError, match="has no model"):
        _ = case.model
    moved = case_of(proposal({"kind": "model", "model": of.model.model_dump()}, context), context, of)
    with pytest.raises(TypeError, match="has no controller"):
        _ = moved.controller


def test_a_measured_latency_is_what_is_judged_by(of, context, redesigned):
    slow = context.model_copy(update={"latency_s": 0.017})
    case = case_of(gains(redesigned, context), slow, of)
    assert case.latency_s == case.believed.latency_s == 0.017
    assert {theta.latency_s for theta in case.corners} == {0.017}


def test_excited_parts_are_at_one_speed_and_move(of):
    recording = of.recording
    (part,) = excited_parts(recording)
    assert part.speed_m_per_s == pytest.approx(0.05, abs=1e-4) and part.movement_n > 1.0
    standing = replace(recording, tension_n=np.where(np.arange(6) == 3, 30.0, recording.tension_n))
    assert excited_parts(standing) == []
    half = recording.samples // 2
    speed = np.where(np.arange(recording.samples) < half, 0.05, 0.1)
    assert excited_parts(replace(recording, unwind_speed_m_per_s=speed)) == []
    draws = replace(recording, tension_n=np.full_like(recording.tension_n, nan))
    assert excited_parts(draws)[0].movement_n == inf


def test_old_and_future_data_do_not_count(of, context):
    def kept(now):
        return len(recent(context.model_copy(update={"now": now}), [of.recording], 604_800.0))

    assert kept("2026-08-10T14:00:00+00:00") == 1
    assert kept("2026-08-10T14:00:01+00:00") == 0
    assert kept("2026-08-03T13:59:59+00:00") == 0


def test_of_much_data_the_newest_are_looked_at_and_every_speed(of):
    (part,) = excited_parts(of.recording)
    slow = replace(part, speed_m_per_s=0.01)
    assert newest([part] * 5 + [slow] * 5, 5.0) == [part, part, slow]
    assert same_speed(0.05, 0.0524) and same_speed(0.002, 0.0039) and not same_speed(0.1, 0.106)


def test_the_worst_over_corners_knows_where_it_was():
    worst = Worst()
    one = np.ones((1, 2))
    for name, swing in (("first", 0.5), ("second", 0.7)):
        worst.take(Rollouts(one, 3 * one, 9 * one, one, one, one, one, one, one, tail_swing_n=swing * one,
                            tail_error_n=one, chatter_nm=one), name, [0, 1])  # fmt: skip
    assert worst.swing_n == (0.7, "second") and worst.lowest_n[0] == 3.0


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


def test_corners_that_torque_does_not_hold_leave_the_papers_criterion_open(of, context, case):
    weak = of.line.model_copy(update={"limits": of.line.limits.model_copy(update={"torque_nm": 5.0})})
    assert any("no corner is held" in text for text in refused(paper.check(replace(case, line=weak))))


def test_gains_without_end_have_no_decay(of, context, redesigned, monkeypatch):
    monkeypatch.setattr(decay, "closed_loop", lambda form, plant: np.full((3, 3), inf))
    found = decay.check(case_of(gains(redesigned, context), context, of))[0]
    assert not found.passed and found.value is None


def test_an_experiment_where_recent_data_speak_against_the_model_is_judged_on_the_lines_file(of, context):
    stiff = of.model.parameters.model_copy(update={"friction_nms_per_rad": [12.0] * 6})
    now = context.model_copy(update={"model": of.model.model_copy(update={"parameters": stiff})})
    small = {
        "format": 1, "amplitude_n": [1.0] * 6, "dwell_s": 0.1, "legs": [{"duration_s": 1.0}],
        "abort": {"deviation_n": 8.0},
    }  # fmt: skip
    case = case_of(proposal({"kind": "experiment", "experiment": small}, context), now, of)
    assert "corners of the line's file" in experiment.check_corners(case)[0].text


def test_set_points_of_another_number_than_spans_are_no_place_to_judge_from(of, context, redesigned):
    case = case_of(gains(redesigned, context), with_state(context, tension_n=[30.0]), of)
    with pytest.raises(ValueError, match="state.tension_n has 1 entries"):
        _ = case.tension_n


def test_parts_at_one_speed_are_judged_together(of, context, redesigned):
    twice = of.context(data=[*context.data, *context.data])
    found = validity.check(case_of(gains(redesigned, context), twice, of))
    assert len(found) == 2 and "over 5.2 s" in found[0].text


def test_a_judge_that_is_warm_has_compiled_what_it_needs(of):
    warm_up(of.line)


def test_a_line_with_a_draw_span_takes_its_first_configuration(of):
    spans = [span.model_copy(update={"control": "draw"}) if i == 2 else span for i, span in enumerate(of.line.spans)]
    drawn = replace(of, line=of.line.model_copy(update={"spans": spans}))
    context = drawn.context(model=None, data=[])
    verdict = verdict_of(gains(context.in_service, context), context, drawn)
    assert verdict.accepted, verdict.reasons

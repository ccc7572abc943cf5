"""The speed of rollers in the judge: which steps are let, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.control.design import design_lqi, design_mpc, task_of
from gateway.control.rollout import simulate
from gateway.core.deployment import Region
from safety import programme
from safety.limits import envelope_limits
from safety.rules import experiment, roller_speed
from tests.safety.case_support import case_of, gains, proposal, refused, verdict_of, with_state

SLOW = "span 3 alone, slow"  #: a course


def stepped_n(one):
    """The largest step of any span in a course."""
    return np.abs(np.diff(one.course.tension_n, axis=0)).max()


def slow_line(of, speed_max_m_per_s):
    limits = of.line.limits.model_copy(update={"speed_max_m_per_s": speed_max_m_per_s})
    return replace(of, line=of.line.model_copy(update={"limits": limits}))


def slow_context(of, speed_m_per_s, **changes):
    return with_state(of.context(**changes), speed_m_per_s=speed_m_per_s)


def test_a_first_configuration_of_a_slow_line_has_the_steps_that_keep_its_rollers_slow(of):
    """Four spans that step by 4 N make a roller run at 0.08 m/s; where 0.03 is the most, torque goes off at 0.045."""
    slow = slow_line(of, 0.03)
    context = slow_context(slow, 0.01, model=None, data=[])
    asked = gains(design_lqi(task_of(slow.line)), context)
    verdict = verdict_of(asked, context, slow)
    assert verdict.accepted, verdict.reasons
    assert 0.2 < verdict.region.tension_step_max_n < 2.0
    found = roller_speed.steps_let(case_of(asked, context, slow))
    watched = envelope_limits(slow.line).roller_speed_watched_m_per_s
    assert watched == pytest.approx(0.85 * 1.5 * 0.03)
    assert 0.8 * watched < found.fastest_m_per_s["neighbours"] <= watched
    assert verdict.region.tension_step_max_n == pytest.approx(found.of_tension() * slow.line.gate.first_step_max_n)
    assert verdict.region.speed_step_max_m_per_s == pytest.approx(found.of_speed() * 0.02)
    assert verdict.region.within(Region(tension_step_max_n=4.0))


def test_with_a_model_steps_are_as_large_as_the_loop_lets_them_and_corners_stay_below_the_envelope(of, context):
    slow = slow_line(of, 0.08)
    case = case_of(gains(design_lqi(of.task()), context), context, slow)
    found, limits = roller_speed.steps_let(case), envelope_limits(slow.line)
    assert found.share[SLOW] == 1.0 > found.share["neighbours"] > 0.05
    assert max(found.fastest_m_per_s.values()) <= limits.roller_speed_m_per_s
    assert refused(roller_speed.check(case)) == []
    region = verdict_of(case.proposal, context, slow).region
    assert region.tension_step_max_n == slow.line.limits.tension_step_max_n, "the loop itself refuses what is too large"
    assert region.speed_step_max_m_per_s == case.speed_step_m_per_s


def test_the_region_of_a_first_configuration_has_the_shares_that_are_let(of, monkeypatch):
    context = of.context(model=None, data=[])
    share = {"speed change": 0.25, SLOW: 0.75, "neighbours": 0.5}
    monkeypatch.setattr(roller_speed, "steps_let", lambda _: roller_speed.Let(share, dict.fromkeys(share, 0.01)))
    region = verdict_of(gains(design_lqi(task_of(of.line)), context), context, of).region
    assert region == Region(speed_max_m_per_s=0.02, tension_step_max_n=0.5 * 4.0, speed_step_max_m_per_s=0.25 * 0.02)


def test_a_law_that_lets_no_step_and_one_that_runs_away_are_refused(of, context):
    of = slow_line(of, 0.052)
    config = design_lqi(of.task())
    wild = config.model_copy(update={"gain_state": (20.0 * np.array(config.gain_state)).tolist()})
    for spoiled in (wild, config.model_copy(update={"gain_state": (-np.array(config.gain_state)).tolist()})):
        text = refused(roller_speed.check(case_of(gains(spoiled, context), context, of)))
        assert text and ("calmer law" in text[0] or "torque goes off" in text[0]), text


@pytest.mark.parametrize(("value", "passed"), [(0.95 * 0.18, True), (0.1711, False)])
def test_the_limit_is_a_twentieth_below_where_torque_goes_off(of, context, monkeypatch, value, passed):
    case = case_of(gains(design_lqi(of.task()), context), context, of)
    let = roller_speed.Let({"speed change": 1.0, SLOW: 1.0}, {"speed change": value, SLOW: 0.1})
    monkeypatch.setattr(roller_speed, "steps_let", lambda _: let)
    assert roller_speed.check(case)[0].passed is passed
    first = replace(case, context=context.model_copy(update={"model": None, "data": []}))
    assert not roller_speed.check(first)[0].passed


def test_a_slow_line_without_room_for_a_step_of_one_newton_needs_a_calmer_law(of, context, monkeypatch):
    case = case_of(gains(design_lqi(of.task()), context), context, of)
    step = case.tension_step_n
    for share, passed in ((1.0 / step, True), (0.99 / step, False)):
        let = roller_speed.Let({"speed change": 1.0, SLOW: share}, dict.fromkeys((SLOW,), 0.1))
        monkeypatch.setattr(roller_speed, "steps_let", lambda _, let=let: let)
        assert roller_speed.check(case)[0].passed is passed


def test_corners_that_nobody_holds_say_nothing_good(of, context):
    weak = of.line.model_copy(update={"limits": of.line.limits.model_copy(update={"torque_nm": 1.0})})
    case = replace(case_of(gains(design_lqi(of.task()), context), context, of), line=weak)
    assert refused(roller_speed.check(case))


def test_a_predictive_controller_is_looked_at_by_itself_in_whole_steps_or_else_in_smaller_ones(
    of, context, monkeypatch
):
    def quickly(config, plants, course, setup):
        return simulate(design_lqi(of.task()) if config.kind == "mpc" else config, plants, course, setup)

    for module in (programme, roller_speed):
        monkeypatch.setattr(module, "simulate", quickly)
    found = roller_speed.steps_let(case_of(gains(design_mpc(of.task()), context), context, of))
    assert set(found.share.values()) == {1.0}
    slow = slow_line(of, 0.08)
    case = case_of(gains(design_mpc(slow.task()), context), context, slow)
    found, limits = roller_speed.steps_let(case), envelope_limits(slow.line)
    assert 0.0 < found.of_tension() < 1.0
    assert max(found.fastest_m_per_s.values()) <= limits.roller_speed_m_per_s


def test_an_experiment_that_makes_rollers_run_ahead_is_refused(of, context):
    slow = slow_line(of, 0.08)

    def asked(amplitude_n):
        moves = {
            "format": 1, "amplitude_n": [amplitude_n] * 6, "dwell_s": 0.1, "legs": [{"duration_s": 2.0}],
            "abort": {"deviation_n": 14.0},
        }  # fmt: skip
        case = case_of(proposal({"kind": "experiment", "experiment": moves}, context), context, slow)
        return [one for one in experiment.check_corners(case) if one.rule == "experiment: roller speed"][0]

    small, large = asked(1.0), asked(12.0)
    assert small.passed and not large.passed and "smaller or slower moves" in large.text
    watched = envelope_limits(slow.line).roller_speed_watched_m_per_s
    assert small.limit == pytest.approx(0.05 + 0.9 * (watched - 0.05))


def away_but_at_rest(_, one):
    """Rollers run away in any course in which something is asked to move."""
    return np.inf if stepped_n(one) > 0.0 or np.ptp(one.course.unwind_speed_m_per_s) > 0.0 else 0.05


@pytest.mark.parametrize("fastest", [lambda *_: 1.0, lambda *_: np.nan, lambda *_: 0.2, away_but_at_rest])
def test_what_no_share_of_a_step_makes_slow_is_refused(of, context, monkeypatch, fastest):
    monkeypatch.setattr(roller_speed, "_in_whole_steps", lambda *_: {})
    monkeypatch.setattr(roller_speed, "_looks", lambda _: (fastest, fastest))
    found = refused(roller_speed.check(case_of(gains(design_lqi(of.task()), context), context, of)))
    assert len(found) == 1 and "no step at all keeps rollers below 0.153 m/s" in found[0]


def test_a_line_whose_set_points_only_ramp_is_looked_at_in_its_speed_changes(of, context):
    limits = of.line.limits.model_copy(update={"tension_step_max_n": 0.0})
    case = replace(
        case_of(gains(design_lqi(of.task()), context), context, of), line=of.line.model_copy(update={"limits": limits})
    )
    found = roller_speed.steps_let(case)
    assert set(found.share) == {"speed change"} and found.of_tension() == 1.0
    assert refused(roller_speed.check(case)) == []


@pytest.fixture
def first_steps(of, monkeypatch):
    """What a first configuration is let, where rollers run at `fastest(unwinder's speed, N stepped)`; all looks."""

    def let(fastest):
        context = of.context(model=None, data=[])
        case = case_of(gains(design_lqi(task_of(of.line)), context), context, of)
        looks = []

        def look(name, one):
            web_m_per_s, step_n = one.course.unwind_speed_m_per_s.max(), stepped_n(one)
            looks.append((name, web_m_per_s, step_n, fastest(web_m_per_s, step_n)))
            return looks[-1][-1]

        monkeypatch.setattr(roller_speed, "_in_whole_steps", lambda *_: {"speed change": 0.0})
        monkeypatch.setattr(roller_speed, "_looks", lambda _: (look, look))
        return roller_speed.steps_let(case), looks

    return let


def test_where_rollers_run_ahead_in_proportion_to_the_step_the_share_follows_from_a_small_one(first_steps):
    """0.05 m/s a newton: of what is left to the limit three hundredths stay unused."""
    allowed = 0.85 * 1.5 * 0.12
    let, looks = first_steps(lambda web, step_n: web + 0.05 * step_n)
    small, following = looks[::2], looks[1::2]
    names = [name for name in let.share if name != "speed change"]
    assert [one[0] for one in small] == [one[0] for one in following] == names
    for (name, web, smallest_n, _), (_, _, step_n, reached) in zip(small, following, strict=True):
        assert smallest_n == pytest.approx(4.0 / 16.0)
        assert step_n == pytest.approx(0.97 * (allowed - web) / 0.05) == 4.0 * let.share[name]
        assert reached == let.fastest_m_per_s[name] < allowed


def test_a_step_in_which_rollers_come_to_the_limit_itself_is_let(of, first_steps):
    allowed = envelope_limits(of.line).roller_speed_watched_m_per_s
    let, looks = first_steps(lambda web, step_n: allowed if step_n > 0.3 else 0.06)
    assert set(let.fastest_m_per_s.values()) == {0.0, allowed}
    assert len(looks) == 2 * (len(let.share) - 1) and all(np.isfinite(list(let.share.values())))

"""The speed of rollers in the judge: where each look at a step ends, and what is said of it in full."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.control.design import design_lqi, design_mpc
from safety import programme
from safety.findings import at_most, told
from safety.limits import envelope_limits
from safety.rules import roller_speed
from tests.safety.case_support import case_of, gains
from tests.safety.test_gate_corners import rollouts
from tests.safety.test_roller_speed import SLOW, stepped_n


@pytest.fixture
def with_a_model(case, monkeypatch):
    """What is let where whole steps of course `name` make rollers run at `whole` m/s on the corners, and others do not.

    `foreseen`: what the loop expects of a course. All looks as well: whose they are, and the course.
    """

    def let(name, whole, foreseen=lambda one: np.inf):
        looks = []

        def in_whole_steps(case, courses, on_corners):
            return dict.fromkeys(courses, 0.0) | {name: whole}

        def ahead(name, one):
            looks.append(("loop", one))
            return foreseen(one)

        def on_corners(name, one):
            looks.append(("corners", one))
            return 0.125

        monkeypatch.setattr(roller_speed, "_in_whole_steps", in_whole_steps)
        monkeypatch.setattr(roller_speed, "_looks", lambda case: (ahead, on_corners))
        found = roller_speed.steps_let(case)
        assert all(found.share[other] == 1.0 for other in found.share if other != name)
        return found.share[name], found.fastest_m_per_s[name], looks

    return let


def most_on_corners(line):
    """A twentieth below where torque goes off, at one and a half times the line's speed."""
    assert envelope_limits(line).roller_speed_m_per_s == pytest.approx(1.5 * 0.12)
    return 0.95 * envelope_limits(line).roller_speed_m_per_s


def test_whole_steps_in_which_corners_come_to_the_limit_itself_need_no_other_look(of, with_a_model):
    most = most_on_corners(of.line)
    assert with_a_model("neighbours", most) == (1.0, most, [])


def test_whole_steps_in_which_the_loop_foresees_its_own_limit_are_let_and_told_as_on_the_corners(
    of, case, with_a_model
):
    web, beyond = case.speed_max_m_per_s, 1.001 * most_on_corners(of.line)
    allowed = envelope_limits(of.line).roller_speed_in_step_m_per_s(web)
    share, fastest, ((whose, one),) = with_a_model("neighbours", beyond, lambda one: allowed)
    assert (share, fastest, whose) == (1.0, beyond, "loop")
    assert stepped_n(one) == case.tension_step_n == 24.0


def test_what_the_loop_does_not_let_happen_is_not_looked_at_beyond_its_share_nor_longer_than_rollers_run_ahead(
    of, case, with_a_model
):
    """A sixteenth first, in which rollers run ahead by a tenth of what the loop permits; so the whole is too much."""
    web, beyond = case.speed_max_m_per_s, 1.001 * most_on_corners(of.line)
    permitted = envelope_limits(of.line).roller_speed_in_step_m_per_s(web) - web

    def stepped(one):
        return np.ptp(one.course.unwind_speed_m_per_s) / case.speed_step_m_per_s

    share, fastest, looks = with_a_model("speed change", beyond, lambda one: web + 1.6 * stepped(one) * permitted)
    assert share == pytest.approx(0.97 / 1.6) and fastest == 0.125
    assert [whose for whose, _ in looks] == ["loop", "loop", "loop", "corners"]
    assert [stepped(one) for _, one in looks] == pytest.approx([0.9, 1.0 / 16.0, share, share])
    for _, one in looks:
        assert one.course.tail == 0 and one.course.periods - one.course.changes[-2] == 60


def test_the_loop_foresees_without_noise_and_without_late_commands_on_what_is_believed(case, monkeypatch):
    setups = []

    def simulated(config, plants, course, setup):
        setups.append(setup)
        assert plants.stiffness_n.tolist() == [[case.believed.web.stiffness_n] * 6]
        return rollouts()

    monkeypatch.setattr(roller_speed, "_in_whole_steps", lambda *_: {})
    monkeypatch.setattr(roller_speed, "simulate", simulated)
    monkeypatch.setattr(roller_speed, "rollouts", lambda *_: rollouts())
    roller_speed.steps_let(case)
    assert {
        (one.late_share, one.tension_noise_n, one.speed_noise_m_per_s, one.acceleration_m_per_s1_5) for one in setups
    } == {(0.0, 0.0, 0.0, 0.0)}


def test_a_first_configuration_that_torque_holds_on_no_corner_has_no_step(of, monkeypatch):
    context = of.context(model=None, data=[])
    monkeypatch.setattr(roller_speed, "_in_whole_steps", lambda *_: {})
    monkeypatch.setattr(roller_speed, "held", lambda *_: [])
    assert roller_speed.check(case_of(gains(design_lqi(of.task()), context), context, of)) == [
        told(
            "roller speed", False,
            "no step at all keeps rollers below 0.153 m/s, of 0.18 m/s at which torque goes off: a calmer law is "
            "needed",
        )
    ]  # fmt: skip


def test_a_programme_that_torque_holds_on_no_corner_in_the_steps_that_are_let_is_refused(of, context, monkeypatch):
    """As the loop foresees it a sixteenth of each step is slow enough, and the whole is not."""
    case = case_of(gains(design_mpc(of.task()), context), context, of)

    def simulated(config, plants, course, setup):
        whole = np.abs(np.diff(course.tension_n, axis=0)).max() > 20.0 or np.ptp(course.unwind_speed_m_per_s) > 0.04
        return replace(rollouts(), roller_speed_max_m_per_s=np.full((1, 6), 1.0 if whole else 0.06))

    monkeypatch.setattr(programme, "fails_in_small", lambda _: False)
    monkeypatch.setattr(programme, "in_courses", lambda *_: {})
    monkeypatch.setattr(roller_speed, "_in_whole_steps", lambda *_: {})
    monkeypatch.setattr(roller_speed, "simulate", simulated)
    found = roller_speed.steps_let(case)
    assert 0.0 < found.of_speed() < 1.0 and 0.0 < found.of_tension() < 1.0
    assert roller_speed.check(case) == [
        told(
            "roller speed", False,
            "on a plant that the line may be rollers run away, or none is held (speed change)",
        )
    ]  # fmt: skip


def test_the_fastest_roller_is_told_with_its_course_its_step_and_both_limits(of, context, case, monkeypatch):
    let = roller_speed.Let({"speed change": 1.0, SLOW: 0.5}, {"speed change": 0.1, SLOW: 0.1234})
    monkeypatch.setattr(roller_speed, "steps_let", lambda _: let)
    assert roller_speed.check(case) == [
        at_most(
            "roller speed", 0.1234, most_on_corners(of.line), "m/s",
            "a roller runs at up to 0.123 m/s (span 3 alone, slow, 50% of the largest step); allowed: 0.171 m/s, of "
            "0.18 m/s at which torque goes off",
        )
    ]  # fmt: skip
    first = replace(case, context=context.model_copy(update={"model": None, "data": []}))
    assert "; allowed: 0.153 m/s, of 0.18 m/s at which" in roller_speed.check(first)[0].text


def test_a_step_of_less_than_a_newton_is_told(case, monkeypatch):
    let = roller_speed.Let({"speed change": 1.0, SLOW: 0.5 / 24.0}, dict.fromkeys((SLOW,), 0.1))
    monkeypatch.setattr(roller_speed, "steps_let", lambda _: let)
    assert roller_speed.check(case) == [
        told(
            "roller speed", False,
            "a step of 0.5 N of one span keeps rollers below 0.153 m/s, of 0.18 m/s at which torque goes off: a calmer "
            "law is needed",
        )
    ]  # fmt: skip


def test_rollers_of_what_small_moves_are_refused_for_are_not_looked_at(case, monkeypatch):
    monkeypatch.setattr(programme, "fails_in_small", lambda _: True)
    assert roller_speed.check(case) == [
        told("roller speed", False, "not looked at: it is refused for its small moves already")
    ]

"""Tensions and torques that cannot be are not used; what a web, a break or a drive does is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line import Line
from gateway.core.signals import FloatArray, Inputs, Quality
from safety.actions import Action
from safety.impossible import ValueState, reject_impossible, value_limits
from safety.rejections import Impossible, Rejections, rejections, take_in
from tests.closed_loop.conftest import demo_line

LINE = demo_line(3)
STEPS = np.zeros(3)
LIMITS = value_limits(LINE, STEPS)
STANDS_NM = np.array([10.0, 10.0, 10.0])


class Story:
    """A line of three spans that stands at 30 N and 0.05 m/s, and what is shown of it period by period."""

    def __init__(self, line: Line = LINE) -> None:
        self.limits, self.state, self.inputs = value_limits(line, STEPS), ValueState(), Inputs(3)
        self.found: list[Impossible] = []
        self.request_m_per_s = 0.05
        self.show()

    def show(
        self,
        tension_n: float = 30.0,
        speed_m_per_s: float = 0.05,
        torque_nm: float = 10.0,
        unwinder_m_per_s: float = 0.05,
        asked_nm: FloatArray = STANDS_NM,
    ) -> bool:
        """Of span 2 and roller 2; whether both samples are used."""
        inputs = self.inputs
        for i, (tension, speed, torque) in enumerate(
            [(30.0, 0.05, 10.0), (tension_n, speed_m_per_s, torque_nm), (30.0, 0.05, 10.0)]
        ):
            inputs.tension.put(i, tension, 0.0)
            inputs.speed.put(i, speed, 0.0)
            inputs.torque.put(i, torque, 0.0)
        inputs.unwind_speed.put(0, unwinder_m_per_s, 0.0)
        return self.judge(asked_nm)

    def judge(self, asked_nm: FloatArray = STANDS_NM) -> bool:
        self.found = reject_impossible(self.limits, self.state, self.inputs, self.request_m_per_s, asked_nm)
        return not self.found


def test_a_torn_tension_is_not_used_and_the_last_one_stays_with_what_was_possible() -> None:
    story = Story()
    assert not story.show(tension_n=45.0)
    assert story.inputs.tension.quality.tolist() == [Quality.GOOD, Quality.BAD, Quality.GOOD]
    assert story.inputs.tension.value.tolist() == [30.0, 30.0, 30.0]
    (one,) = story.found
    assert (one.channel, one.number, one.value, one.unit) == ("tension", 2, 45.0, "N")
    assert one.low < 28.0 < 32.0 < one.high < 45.0
    assert story.show()


@given(noise=st.floats(-1.9, 1.9), wander=st.floats(-1.9, 1.9))
def test_noise_is_used(noise: float, wander: float) -> None:
    story = Story()
    assert story.show(tension_n=30.0 + noise) and story.show(tension_n=30.0 + noise + wander)


def test_what_the_speeds_explain_is_used_and_no_more() -> None:
    """2400 N times 1.3, over 0.7 m: a difference of 0.05 m/s is 2.2 N a period, and the margin doubles it."""
    for tension_n, used in ((37.0, True), (55.0, False)):
        story = Story()
        assert story.show(tension_n=tension_n, speed_m_per_s=0.1) == used
        assert story.show(tension_n=tension_n + 2.1, speed_m_per_s=0.05) == used, "it may still be on its way"


def test_a_line_plc_that_steps_explains_what_it_says_a_period_later() -> None:
    story = Story()
    story.request_m_per_s = 0.12
    inputs = story.inputs
    story.show()
    for i, tension_n in enumerate([33.5, 30.0, 30.0]):
        inputs.tension.put(i, tension_n, 0.0)
    assert story.judge()


def test_a_web_that_tears_is_believed_with_the_second_sample() -> None:
    story = Story()
    assert not story.show(tension_n=0.1)
    assert story.show(tension_n=-0.1) and story.inputs.tension.value[1] == -0.1
    assert story.show(tension_n=0.0)


def test_a_break_behind_a_slow_filter_is_believed_while_it_falls() -> None:
    story = Story()
    fall_n = [30.0 * 0.8**k for k in range(1, 12)]
    assert [story.show(tension_n=value) for value in fall_n].count(False) == 1


def test_a_tension_that_stays_elsewhere_within_the_band_is_not_used() -> None:
    """A unit that has changed, a counter that has wrapped: it is the same again and again."""
    for elsewhere_n in (12.0, 47.0):
        story = Story()
        assert [story.show(tension_n=elsewhere_n) for _ in range(4)] == [False] * 4


def test_what_is_possible_and_large_needs_a_second_sample() -> None:
    """On a stiff web hardly anything is impossible from one sample to the next; a torn word comes once."""
    stiff = LINE.web.stiffness_n.model_copy(update={"value": 240_000.0})
    line = LINE.model_copy(update={"web": LINE.web.model_copy(update={"stiffness_n": stiff})})
    story = Story(line)
    assert not story.show(tension_n=62.0) and story.show(tension_n=30.0)
    assert not story.show(tension_n=62.0) and story.show(tension_n=61.0)
    assert story.show(tension_n=45.0), "less than half of the band is nothing to ask about"


def test_a_cell_that_is_noisier_than_expected_is_learnt() -> None:
    generator, story = np.random.default_rng(1), Story()
    noise_n = 0.25 + 0.35 * np.linspace(0.0, 1.0, 1000)  # it grows to 0.6 N: changes of up to 3 N
    used = [story.show(tension_n=30.0 + sigma * generator.standard_normal()) for sigma in noise_n]
    assert used.count(False) == 0
    assert not story.show(tension_n=45.0)


def test_a_sample_that_did_not_come_gives_the_next_one_more_room_and_is_not_judged() -> None:
    for missed, used in ((0, False), (3, True)):
        story = Story()
        story.show(speed_m_per_s=0.1)  # 0.05 m/s, as far as anybody knows, from now on
        for _ in range(missed):
            story.inputs.tension.miss(1)
            assert story.judge()
        story.inputs.tension.put(1, 44.0, 0.0)
        assert story.judge() == used


def test_a_speed_that_did_not_come_may_have_moved_the_web() -> None:
    for missed, used in ((False, False), (True, True)):
        story = Story()
        if missed:
            story.inputs.speed.miss(1)
        story.inputs.tension.put(1, 34.5, 0.0)
        assert story.judge() == used


def test_a_span_without_a_load_cell_is_not_looked_at() -> None:
    story = Story()
    story.inputs.tension.value[1], story.inputs.tension.quality[1] = np.nan, Quality.MISSING
    story.state = ValueState()
    for _ in range(3):
        assert story.judge()
    story.inputs.tension.put(0, 50.0, 0.0)
    assert not story.judge() and [one.number for one in story.found] == [1]
    assert np.isnan(story.inputs.tension.value[1])


def test_a_torn_torque_is_not_used_and_one_that_is_told_twice_is() -> None:
    story = Story()
    assert not story.show(torque_nm=-45.0)
    (one,) = story.found
    assert (one.channel, one.number, one.unit, one.low, one.high) == ("torque", 2, "Nm", -15.0, 25.0)
    assert story.inputs.torque.value[1] == 10.0 and story.inputs.torque.quality[1] == Quality.BAD
    assert story.show()
    # A drive that gives three times what it is asked for: whoever compares the two must see it.
    assert [story.show(torque_nm=30.0) for _ in range(4)] == [False, True, True, True]
    assert story.inputs.torque.value[1] == 30.0


def test_a_torque_may_be_late_or_gone() -> None:
    story = Story()
    asked_nm = np.array([10.0, 58.0, 10.0])
    assert [story.show(torque_nm=10.0, asked_nm=asked_nm) for _ in range(8)] == [True] * 8
    assert story.show(torque_nm=0.0, asked_nm=asked_nm)


@pytest.fixture
def counted() -> Rejections:
    return rejections(LINE)


TORN = Impossible("tension", 2, 45.0, 27.0, 33.0, "N")


def test_three_in_ten_periods_stop_the_line(counted: Rejections) -> None:
    actions = [[one.action for one in take_in(counted, rejected)] for rejected in ([TORN], [TORN], [], [TORN])]
    assert actions == [[Action.NONE], [], [], [Action.STOP]]
    assert counted.count == 3


DOUBTED = Impossible("tension", 2, 0.0, 27.0, 33.0, "N", confirmable=True)


def test_what_the_next_sample_may_confirm_is_told_with_that_one_if_it_does_not(counted: Rejections) -> None:
    assert take_in(counted, [DOUBTED]) == []
    (told,) = take_in(counted, [])
    assert (told.rule, told.action, told.parameters and told.parameters["value"]) == (
        "value-impossible",
        Action.NONE,
        0.0,
    )
    assert take_in(counted, []) == []


def test_what_it_confirms_is_not_told_and_what_comes_again_is_told_once(counted: Rejections) -> None:
    assert take_in(counted, [DOUBTED]) == [] == take_in(counted, [], [("tension", 2)]) == take_in(counted, [])
    fresh = rejections(LINE)
    assert [len(take_in(fresh, rejected)) for rejected in ([DOUBTED], [DOUBTED], [])] == [0, 1, 0]


def test_what_stops_the_line_is_told_at_once(counted: Rejections) -> None:
    told = [take_in(counted, [DOUBTED]) for _ in range(3)]
    assert [[one.action for one in each] for each in told] == [[], [Action.NONE], [Action.STOP]]
    assert take_in(counted, []) == []


def test_a_web_that_tears_says_so_itself() -> None:
    story = Story()
    assert not story.show(tension_n=0.0) and story.found[0].confirmable and not story.state.confirmed
    assert story.show(tension_n=0.0) and story.state.confirmed == [("tension", 2)]
    assert story.show(tension_n=0.0) and not story.state.confirmed


def test_a_word_that_is_torn_once_is_not_confirmed_by_a_true_one() -> None:
    story = Story()
    assert not story.show(tension_n=0.0)
    assert story.show(tension_n=30.0) and not story.state.confirmed


def test_a_torque_that_is_reported_twice_confirms_itself() -> None:
    story = Story()
    assert not story.show(torque_nm=55.0) and story.found[0].confirmable
    assert story.show(torque_nm=55.0) and story.state.confirmed == [("torque", 2)]


def test_what_comes_more_rarely_is_told_once_and_again_after_a_while(counted: Rejections) -> None:
    told: list[int] = []
    for period in range(220):
        if period in (0, 20, 40, 200):
            told += [period] * len(take_in(counted, [TORN]))
        else:
            assert take_in(counted, []) == []
    assert told == [0, 200] and counted.count == 4


def test_it_is_data(counted: Rejections) -> None:
    (told,) = take_in(counted, [TORN])
    assert told.rule == "value-impossible"
    assert told.parameters == {
        "channel": "tension 2",
        "value": 45.0,
        "low": 27.0,
        "high": 33.0,
        "unit": "N",
        "count": 1,
    }
    (of_v0,) = take_in(counted, [Impossible("unwinder speed", 0, 3.0, 0.0, 0.1, "m/s")])
    assert of_v0.parameters is not None and of_v0.parameters["channel"] == "unwinder speed"

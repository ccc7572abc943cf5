"""What a drive gives against what it was asked for, with drives that are written here, without a loop."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.drive_tells import INVERTER_ACCURACY, SERVO_ACCURACY, TORQUE_FILTER_S, DriveTells, profile_tells
from gateway.core.line import Line
from gateway.core.signals import DriveCondition, FloatArray, Inputs
from safety.actions import Action, Finding
from safety.drive_feedback import (
    FeedbackState,
    feedback_limits,
    find_unlike,
    found_before_torque,
)
from tests.closed_loop.conftest import demo_line

LINE = demo_line(2)
PERIOD_S = LINE.control.period_s
RATED_NM = LINE.drives[0].rated_torque_nm
NOBODY = np.zeros(2, np.bool_)
AT_ONCE_S, BOUND_S = 0.1, 1.0  #: until the command is held, and until the drive is named


def line_of(rated_nm: float, period_s: float = PERIOD_S) -> Line:
    drives = [drive.model_copy(update={"rated_torque_nm": rated_nm}) for drive in LINE.drives]
    control = LINE.control.model_copy(update={"period_s": period_s})
    return LINE.model_copy(update={"drives": drives, "control": control})


class Watched:
    """Two drives under watch: the first does what it is asked, the second is the one of the test."""

    def __init__(self, line: Line = LINE, tells: DriveTells | None = None) -> None:
        self.limits = feedback_limits(line, tells or profile_tells(2))
        self.state, self.inputs = FeedbackState(2), Inputs(2)
        self.asked_nm = np.zeros(2)
        self.lost = NOBODY
        self.found: list[tuple[int, Finding]] = []  #: with the period
        self.suspected: list[int] = []  #: periods in which the second one is
        self.period = 0

    def step(self, asked_nm: float, given_nm: float | None) -> None:
        """A period: what the drives give, then what they are asked for next. None: no sample came."""
        self.inputs.torque.put(0, float(self.asked_nm[0]), 0.0)
        if given_nm is None:
            self.inputs.torque.miss(1)
        else:
            self.inputs.torque.put(1, given_nm, 0.0)
        findings = find_unlike(self.limits, self.state, self.inputs, self.asked_nm, self.lost)
        self.found += [(self.period, finding) for finding in findings]
        assert not self.state.suspected[0] and not self.state.blamed[0]
        if self.state.suspected[1]:
            self.suspected.append(self.period)
        self.asked_nm = np.full(2, asked_nm)
        self.period += 1

    def run(self, asked_nm: Iterable[float], drive: Callable[[Iterator[float]], Iterator[float]]) -> "Watched":
        asked = list(asked_nm)
        for ask, give in zip(asked, drive(iter([0.0, *asked])), strict=False):
            self.step(ask, give)
        return self

    @property
    def codes(self) -> list[str]:
        return [finding.rule for _, finding in self.found]


def share(of: float, delay: int = 0, lag_s: float = 0.0) -> Callable[[Iterator[float]], Iterator[float]]:
    """A drive that gives a share of what is asked, `delay` periods later, behind a first-order lag."""

    def drive(asked: Iterator[float]) -> Iterator[float]:
        queue, given_nm = [0.0] * delay, 0.0
        for ask in asked:
            queue.append(ask)
            given_nm += (of * queue.pop(0) - given_nm) * (1.0 - np.exp(-PERIOD_S / lag_s) if lag_s else 1.0)
            yield given_nm

    return drive


def between(first_s: float, last_s: float) -> Callable[[Iterator[float]], Iterator[float]]:
    """A drive that gives nothing from one time to another."""

    def drive(asked: Iterator[float]) -> Iterator[float]:
        for k, ask in enumerate(asked):
            yield 0.0 if first_s <= k * PERIOD_S < last_s else ask

    return drive


def ramp(to_nm: float, time_s: float = 0.3, total_s: float = 2.0) -> FloatArray:
    return to_nm * np.minimum(np.arange(round(total_s / PERIOD_S)) * PERIOD_S / time_s, 1.0)


@pytest.mark.parametrize("of", [0.0, 0.1, 0.5, 3.0, -1.0])
def test_a_drive_that_gives_another_torque_is_held_at_once_and_blamed_within_a_second(of: float) -> None:
    asked = np.full(200, 8.0)
    watched = Watched().run(asked, share(1.0, delay=1)).run(asked, share(of, delay=1))
    assert watched.codes == ["torque-not-given"], "told once: who is blamed is not judged any more"
    period, finding = watched.found[0]
    assert finding.action is Action.STOP and (period - 200) * PERIOD_S <= BOUND_S
    assert finding.parameters is not None and finding.parameters["drive"] == "drive-2"
    assert finding.parameters["asked_nm"] == pytest.approx(8.0, rel=0.05)
    assert finding.parameters["given_nm"] == pytest.approx(8.0 * of, abs=0.4)
    assert watched.suspected and (watched.suspected[0] - 200) * PERIOD_S <= AT_ONCE_S
    assert watched.state.blamed.tolist() == [False, True] and not watched.state.suspected.any()


def test_a_drive_that_loses_its_mode_for_a_moment_is_blamed_though_it_comes_back() -> None:
    watched = Watched().run(np.full(300, 5.0), between(1.0, 1.6))
    assert watched.codes == ["torque-not-given"] and 1.0 < watched.found[0][0] * PERIOD_S < 1.6


def test_one_that_comes_and_goes_is_blamed_too() -> None:
    def comes_and_goes(asked: Iterator[float]) -> Iterator[float]:
        for k, ask in enumerate(asked):
            yield ask if k * PERIOD_S % 0.4 < 0.2 else 0.0

    watched = Watched().run(np.full(300, 5.0), comes_and_goes)
    assert watched.codes == ["torque-not-given"] and watched.found[0][0] * PERIOD_S < 2.0


def test_a_dropout_of_one_answer_is_nothing() -> None:
    watched = Watched().run(np.full(200, 5.0), between(1.0, 1.0 + PERIOD_S))
    assert not watched.found and not watched.suspected


@given(
    st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=8),
    st.floats(0.0, TORQUE_FILTER_S),
    st.integers(0, 2),
    st.floats(0.8, 1.2),
    st.integers(0, 2**31),
)
def test_a_healthy_drive_is_never_doubted(
    goals: list[float], lag_s: float, delay: int, scale: float, seed: int
) -> None:
    """Whatever it is asked for at the line's greatest rate, with lag, latency, noise and another torque constant."""
    step = LINE.limits.torque_rate_nm_per_s * PERIOD_S
    dice = np.random.default_rng(seed)
    asked, now = [], 0.0
    for goal in goals:
        for _ in range(25):
            now += float(np.clip(goal * LINE.limits.torque_nm + dice.normal(0.0, 1.0) - now, -step, step))
            asked.append(now)

    def noisy(asks: Iterator[float]) -> Iterator[float]:
        for given_nm in share(scale, delay, lag_s)(asks):
            yield given_nm + dice.normal(0.0, 0.01 * RATED_NM)

    watched = Watched().run(asked, noisy)
    assert not watched.found


@pytest.mark.parametrize("of", [2.0, 3.0, -3.0])
@pytest.mark.parametrize("delay", [0, 1, 2])
def test_a_drive_that_answers_by_more_makes_its_command_restless_and_is_found_in_that(of: float, delay: int) -> None:
    """Its controller goes back with the mean, which is no larger than noise then; the ups and downs tell."""
    asked = 0.1 + np.random.default_rng(1).normal(0.0, 3.0, 200)
    watched = Watched().run(asked, share(of, delay=delay))
    assert watched.codes == ["torque-not-given"] and watched.found[0][0] * PERIOD_S <= BOUND_S
    assert not Watched().run(asked, share(1.0, delay=delay)).found


def test_what_the_drives_numbers_cannot_tell_is_no_difference() -> None:
    nothing = share(0.0)
    below, above = 0.9 * SERVO_ACCURACY * RATED_NM, 1.2 * SERVO_ACCURACY * RATED_NM
    assert not Watched().run(np.full(200, below), nothing).found
    assert Watched().run(np.full(200, above), nothing).found
    coarse = replace(profile_tells(2), torque_step_nm=np.full(2, 0.1 * RATED_NM))
    assert not Watched(tells=coarse).run(np.full(200, above), nothing).found


def test_an_inverter_that_is_off_by_what_its_map_says_is_no_difference() -> None:
    offset_nm = 0.025 * RATED_NM

    def off(asked: Iterator[float]) -> Iterator[float]:
        return (ask + offset_nm for ask in asked)

    inverter = replace(profile_tells(2), torque_accuracy=np.full(2, INVERTER_ACCURACY))
    asked = np.full(200, 0.02 * RATED_NM)
    assert Watched().run(asked, off).codes == ["torque-not-given"]
    assert not Watched(tells=inverter).run(asked, off).found
    assert Watched(tells=inverter).run(np.full(200, 0.2 * RATED_NM), share(0.1)).codes == ["torque-not-given"]


def test_a_drive_whose_reported_torque_is_filtered_by_what_its_map_says_is_not_doubted() -> None:
    asked = np.concatenate((np.full(100, 0.5 * RATED_NM), np.zeros(200)))
    slow = replace(profile_tells(2), torque_filter_s=np.full(2, 0.3))
    assert Watched().run(asked, share(1.0, lag_s=0.3)).found
    assert not Watched(tells=slow).run(asked, share(1.0, lag_s=0.3)).found


def test_a_restless_torque_is_compared_in_the_mean() -> None:
    dice = np.random.default_rng(1)

    def restless(asked: Iterator[float]) -> Iterator[float]:
        for ask in asked:
            yield ask + dice.normal(0.0, 0.2 * RATED_NM)

    assert not Watched().run(np.full(3000, 2.0), restless).found


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**20])
def test_a_line_of_another_size_is_judged_alike(factor: float) -> None:
    small, large = Watched(), Watched(line_of(factor * RATED_NM))
    small.run(ramp(8.0), share(0.1))
    large.run(factor * ramp(8.0), share(0.1))
    assert [period for period, _ in small.found] == [period for period, _ in large.found] != []


@pytest.mark.parametrize("period_s", [0.002, 0.02, 0.1])
def test_the_bound_holds_for_every_period(period_s: float) -> None:
    watched = Watched(line_of(RATED_NM, period_s))
    watched.run(np.full(round(2.0 / period_s), 8.0), share(0.1))
    assert watched.codes == ["torque-not-given"] and watched.found[0][0] * period_s <= BOUND_S


def test_a_drive_that_gives_what_nobody_asked_for_is_blamed() -> None:
    watched = Watched()
    for _ in range(100):
        watched.step(0.0, 3.0)
    assert watched.codes == ["torque-not-given"]


def test_samples_that_do_not_come_say_nothing() -> None:
    watched = Watched()
    for _ in range(200):
        watched.step(8.0, None)
    assert not watched.found, "it was never heard"
    for k in range(400):
        watched.step(8.0, 8.0 if k < 200 else None)
    assert not watched.found, "it is not heard any more, which is found elsewhere"
    for k in range(200):
        watched.step(8.0, None if k % 3 == 0 else 0.0)
    assert watched.codes == ["torque-not-given"], "what it says in between counts"


def test_a_drive_that_is_lost_is_not_judged() -> None:
    watched = Watched()
    watched.lost = np.array([False, True])
    watched.run(np.full(200, 8.0), share(0.0))
    assert not watched.found and not watched.suspected


def test_watching_begins_anew_and_a_person_forgives() -> None:
    watched = Watched().run(np.full(20, 8.0), share(0.0))
    assert watched.state.suspected[1]
    watched.state.restart()
    assert not watched.state.suspected.any() and not watched.state.doubted.any()
    watched.run(np.full(200, 8.0), share(0.0))
    watched.state.restart()
    assert watched.state.blamed[1], "only a person takes that back"
    watched.state.forgive()
    assert not watched.state.blamed.any()


# what a drive says of itself


def says(watched: Watched, condition: DriveCondition, periods: int, mode: int = 0) -> None:
    for _ in range(periods):
        watched.inputs.drive_condition[1] = condition
        watched.inputs.drive_mode[1] = mode
        watched.step(0.0, 0.0)


def test_a_drive_in_another_mode_is_blamed_at_once() -> None:
    watched = Watched()
    says(watched, DriveCondition.WRONG_MODE, 3, mode=8)
    (period, finding) = watched.found[0]
    assert watched.codes == ["drive-mode"] and period == 0 and watched.state.blamed[1]
    assert finding.parameters == {"drive": "drive-2", "mode": 8, "wanted": 10}


def test_a_drive_without_power_is_blamed_after_the_periods_that_a_signal_may_miss() -> None:
    watched = Watched()
    says(watched, DriveCondition.NO_POWER, LINE.limits.hold_periods - 1)
    says(watched, DriveCondition.NONE, 1)
    assert not watched.found
    says(watched, DriveCondition.NO_POWER, LINE.limits.hold_periods)
    assert watched.codes == ["drive-no-power"]
    assert watched.found[0][1].parameters == {"drive": "drive-2", "bit": 4}


@pytest.mark.parametrize("condition", [DriveCondition.LIMITED, DriveCondition.WARNS, DriveCondition.MODE_UNCONFIRMED])
def test_what_stops_nothing_is_not_found_here(condition: DriveCondition) -> None:
    watched = Watched()
    says(watched, condition, 100)
    assert not watched.found


@pytest.mark.parametrize(
    ("condition", "code"),
    [
        (DriveCondition.NONE, None),
        (DriveCondition.WARNS | DriveCondition.LIMITED, None),
        (DriveCondition.WRONG_MODE | DriveCondition.NO_POWER, "drive-mode"),
        (DriveCondition.NO_POWER, "drive-no-power"),
        (DriveCondition.MODE_UNCONFIRMED, "drive-mode-unconfirmed"),
    ],
)
def test_before_torque_is_asked_for_a_drive_has_power_and_its_mode(condition: DriveCondition, code: str | None) -> None:
    watched = Watched()
    watched.inputs.drive_condition[1] = condition
    finding = found_before_torque(watched.limits, watched.inputs, 1)
    assert (finding and finding.rule) == code

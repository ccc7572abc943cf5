"""Ages go by the monotonic clock within a boot, and over boots by a wall clock that was seen to agree."""

from math import inf

from gateway.core.steady_clock import AGREES_AFTER_S, Age, Moment, SteadyClock

TRUE_S = 1_795_000_000.0
YEAR_S = 365 * 86_400.0


class Clocks:
    def __init__(self, now_s: float = 0.0, ahead_s: float = TRUE_S) -> None:
        self.now_s, self.ahead_s = now_s, ahead_s
        self.steady = SteadyClock(lambda: self.now_s, lambda: self.now_s + self.ahead_s, "boot")

    def passes(self, seconds: float, step_s: float = 10.0) -> None:
        for _ in range(round(seconds / step_s)):
            self.now_s += step_s
            self.steady.look()

    def agree(self) -> bool:
        return self.steady.agreed_ahead_s is not None


def test_a_wall_clock_agrees_after_ten_minutes_without_a_jump() -> None:
    clocks = Clocks()
    clocks.passes(AGREES_AFTER_S - 10.0)
    assert not clocks.agree()
    clocks.passes(10.0)
    assert clocks.steady.agreed_ahead_s == TRUE_S
    for jump_s in (0.6, -0.6, 20 * YEAR_S):
        clocks.ahead_s += jump_s
        clocks.steady.look()
        assert not clocks.agree()
        clocks.passes(AGREES_AFTER_S)
        assert clocks.agree()


def test_a_clock_that_creeps_away_does_not_agree_and_one_that_is_disciplined_does() -> None:
    creeping, disciplined = Clocks(), Clocks()
    for _ in range(200):
        creeping.ahead_s += 0.4
        creeping.passes(10.0)
        disciplined.ahead_s += 0.002
        disciplined.passes(10.0)
    assert not creeping.agree()
    assert disciplined.agree()


def test_a_clock_of_before_this_program_never_agrees() -> None:
    clocks = Clocks(ahead_s=0.0)
    clocks.passes(3 * AGREES_AFTER_S)
    assert not clocks.agree()


def test_within_a_boot_no_setting_of_the_wall_clock_changes_an_age() -> None:
    clocks = Clocks(now_s=100.0)
    then = clocks.steady.now()
    for jump_s in (20 * YEAR_S, -40 * YEAR_S, 20 * YEAR_S + 3600.0):
        clocks.ahead_s += jump_s
        clocks.now_s += 10.0
        assert clocks.steady.age(then) == Age(clocks.now_s - 100.0, clocks.now_s - 100.0)


def test_over_a_boot_a_wall_clock_counts_that_agreed_then_and_agrees_now() -> None:
    clocks = Clocks(now_s=5.0)
    before = Moment(TRUE_S - 86_400.0, "other", 3000.0, agreed=True)
    assert clocks.steady.age(before) == Age(5.0, inf)  # not yet
    clocks.passes(AGREES_AFTER_S)
    assert clocks.steady.age(before) == Age(86_400.0 + 605.0, 86_400.0 + 605.0)
    assert clocks.steady.age(Moment(TRUE_S - 86_400.0, "other", 3000.0, agreed=False)) == Age(605.0, inf)
    assert clocks.steady.age(Moment(TRUE_S - 86_400.0)) == Age(87_005.0, 87_005.0)  # there is nothing else to go by


def test_what_seems_to_have_been_later_than_the_start_of_this_boot_is_as_old_as_that_at_least() -> None:
    clocks = Clocks()
    clocks.passes(AGREES_AFTER_S)
    for wall_s in (TRUE_S + 20 * YEAR_S, TRUE_S + 300.0):
        assert clocks.steady.age(Moment(wall_s, "other", 3000.0, agreed=True)) == Age(600.0, inf)

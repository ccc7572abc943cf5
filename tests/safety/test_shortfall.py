"""What a fallback would not keep, against its limits: which span or roller, by how much, when, and in which words."""

from dataclasses import replace
from math import inf, nextafter

import numpy as np
import pytest

from safety.recoverability import Shortfall
from tests.safety.recovery_support import LINE, SPEED, TENSION_N, at_rest, limited, recovery_of

LOW_N, HIGH_N = LINE.limits.tension_min_n, LINE.limits.tension_max_n
FASTEST = 0.85 * 1.5 * LINE.limits.speed_max_m_per_s  # what the monitor lets a roller come to


def worst(found, looks, bounds):
    """The worst (index, value, bound it is beyond, when in s), row by row of `found` in plain loops."""
    most, told = 0.0, None
    for index, (row, (least, greatest)) in enumerate(zip(found, bounds, strict=True)):
        for value, look in zip(row, looks, strict=True):
            for over, bound in ((least - value, least), (value - greatest, greatest)):
                if over > most:
                    most, told = over, (index, value, bound, (look + 1) * 0.01)
    return told


SETPOINT_N = np.array([57.0, 6.0, 30.0, 3.0, 59.5, 30.0])
KEPT_N = [(8.0, 58.5), (4.0, 54.0), (8.0, 54.0), (2.5, 54.0), (8.0, 59.75), (8.0, 54.0)]  #: 6 N, or half of the room
OF_STEP_N = [(8.6, 58.35), (4.2, 53.4), (8.6, 53.4), (2.55, 53.4), (8.6, 59.725), (8.6, 53.4)]  #: 1.1 times that


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("span", range(6))
def test_the_tension_that_is_furthest_beyond_what_its_setpoint_asks_for_is_told(span, side):
    measured, *rest = at_rest(SETPOINT_N)
    recovery = recovery_of()
    for look, kept in ((recovery.shortfall, KEPT_N), (recovery.shortfall_of_step, OF_STEP_N)):
        tension_n = SETPOINT_N.copy()
        tension_n[span] = kept[span][side] + (-6.0, 6.0)[side]
        away = replace(measured, tension_n=tension_n)
        told, (found, looks) = look(away, *rest, None), recovery.ahead(away, *rest)
        index, value, bound, ahead_s = worst(found[:6], looks, kept)
        assert (told.what, told.index, told.value) == ("span", index, value)
        assert (told.allowed, told.ahead_s) == (pytest.approx(bound), pytest.approx(ahead_s))


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_roller_is_told_where_no_tension_is_beyond(direction):
    """At rest, but too fast: of all rollers that behind the span of the greatest tension is the fastest."""
    given = at_rest(speed=direction * 0.2)
    recovery = recovery_of()
    told, (found, looks) = recovery.shortfall(*given), recovery.ahead(*given)
    assert worst(found[6:], looks, [(-FASTEST, FASTEST)] * 6) == (
        told.index, told.value, told.allowed, pytest.approx(told.ahead_s)
    )  # fmt: skip
    assert (told.what, told.index, told.allowed) == ("roller", 3, pytest.approx(direction * FASTEST))
    assert told.value == pytest.approx(direction * 0.2 * 2400.0 / (2400.0 - 40.0))


@pytest.mark.parametrize(("span", "tension_n", "below"), [(3, 13.0, True), (2, 45.0, False)])
def test_a_tension_may_come_to_its_bound_itself(span, tension_n, below):
    """The margin is chosen so that the least (or greatest) tension on the way is the bound, to the last digit."""
    measured, *rest = at_rest()
    away = replace(measured, tension_n=np.where(np.arange(6) == span, tension_n, TENSION_N))
    row = recovery_of().ahead(away, *rest)[0][span]
    margin_n = float(row.min() - LOW_N if below else HIGH_N - row.max())
    while (LOW_N + margin_n > row.min()) if below else (HIGH_N - margin_n < row.max()):
        margin_n = nextafter(margin_n, -inf)
    assert (LOW_N + margin_n == row.min()) if below else (HIGH_N - margin_n == row.max())
    assert recovery_of(margin_n=margin_n).shortfall(away, *rest) is None
    short = recovery_of(margin_n=margin_n + 1e-9).shortfall(away, *rest)
    assert (short.what, short.index) == ("span", span)
    # A tension at its bound is not beyond it: where rollers are, they are told.
    slow = limited(speed_max_m_per_s=SPEED / 1.3)
    assert recovery_of(line=slow, margin_n=margin_n).shortfall(away, *rest).what == "roller"


def test_a_shortfall_is_told_in_its_unit():
    span, roller = Shortfall("span", 2, 1.26, 8.0, 0.135), Shortfall("roller", 0, -0.18, -0.153, 0.02)
    assert span.parameters == {"span": 3, "tension_n": 1.26, "allowed_n": 8.0, "ahead_s": 0.135}
    told = {"roller": 1, "speed_m_per_s": -0.18, "allowed_m_per_s": -0.153, "ahead_s": 0.02}
    assert roller.parameters == told

"""What a change shows under watch: swing, offset and chatter of known signals, against limits and against before."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line import Gate
from gateway.core.signals import FloatArray
from safety.probation import LEAST_TENSION, LEAST_TORQUE, WORSE, Look, Standing, Unseen, look_at, standing

GATE = Gate()
PERIODS = 1000
MEASURED = np.ones(3, dtype=np.bool_)
ALL = np.ones(3)  #: seen
LIMITS = (GATE.tail_error_max_n, GATE.tail_oscillation_max_n, GATE.chatter_max_nm)


def against(now: Standing, before: Standing | None, gate: Gate, noise_n: float = 0.0) -> str:
    """Where everything is measured and was seen."""
    found = look_at(now, before, gate, MEASURED, noise_n)
    assert not found.unseen and found.good is (not found.against)
    return found.against


def stood(offset_n: float = 0.0, swing_n: float = 0.0, chatter_nm: float = 0.0):
    """Span 2 of three: off by so much, swinging in ten whole waves, its torque going to and fro."""
    wave = np.sin(2.0 * np.pi * 10.0 * np.arange(PERIODS) / PERIODS)
    setpoint_n = np.full((PERIODS, 3), 30.0)
    tension_n, torque_nm = setpoint_n.copy(), np.zeros((PERIODS, 3))
    tension_n[:, 1] += offset_n + swing_n * wave
    torque_nm[:, 1] = 0.5 * chatter_nm * (-1.0) ** np.arange(PERIODS)
    return standing(tension_n, setpoint_n, torque_nm)


def test_figures_are_those_of_the_signal() -> None:
    one = stood(-1.5, 0.8, 2.0)
    np.testing.assert_allclose(one.offset_n, [0.0, 1.5, 0.0], atol=1e-9)
    np.testing.assert_allclose(one.swing_n, [0.0, 0.8, 0.0], atol=1e-9)
    np.testing.assert_allclose(one.chatter_nm, [0.0, 2.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("given", "limit", "said"),
    [
        ("offset_n", GATE.tail_error_max_n, "tension 2 is off by"),
        ("swing_n", GATE.tail_oscillation_max_n, "tension 2 swings by"),
        ("chatter_nm", GATE.chatter_max_nm, "torque 2 chatters by"),
    ],
)
def test_a_figure_beyond_its_limit_is_held_against_the_change(given: str, limit: float, said: str) -> None:
    assert against(stood(**{given: 0.99 * limit}), None, GATE) == ""
    assert against(stood(**{given: 1.01 * limit}), None, GATE).startswith(said)
    assert against(stood(**{given: 1.01 * limit}), stood(), GATE).startswith(said)


@given(st.floats(1.0, 10.0), st.floats(0.5, 2.0))
def test_what_was_so_before_is_not_held_against_it(swing_n: float, ratio: float) -> None:
    allowed_n = max(GATE.tail_oscillation_max_n, WORSE * swing_n)
    if abs(ratio * swing_n - allowed_n) > 1e-6:
        found = against(stood(swing_n=ratio * swing_n), stood(swing_n=swing_n), GATE)
        assert bool(found) is (ratio * swing_n > allowed_n)


def test_noise_of_the_load_cell_is_no_swing() -> None:
    assert against(stood(swing_n=1.5), None, GATE)
    assert against(stood(swing_n=1.5), None, GATE, noise_n=0.5) == ""


@pytest.mark.parametrize(
    ("one", "said"),
    [
        (stood(offset_n=3.5), "tension 2 is off by 3.50 N, allowed: 3.00 N"),
        (stood(swing_n=1.25), "tension 2 swings by 1.25 N, allowed: 1.00 N"),
        (stood(chatter_nm=5.5), "torque 2 chatters by 5.50 Nm, allowed: 5.00 Nm"),
    ],
)
def test_what_is_said_has_number_and_limit(one: Standing, said: str) -> None:
    assert against(one, None, GATE) == said


def test_what_stands_at_its_limit_is_kept_and_of_several_the_worst_by_its_own_limit_is_named() -> None:
    none = np.zeros(3)
    assert against(Standing(np.array([0.0, GATE.tail_error_max_n, 0.0]), none, none, ALL, ALL), None, GATE) == ""
    before = Standing(np.array([0.0, 0.0, 10.0]), none, none, ALL, ALL)
    assert against(Standing(np.array([0.0, 6.0, 13.0]), none, none, ALL, ALL), before, GATE).startswith(
        "tension 2 is off by 6.00"
    )


def test_a_load_cells_noise_counts_as_the_sine_with_its_root_mean_square() -> None:
    allowed_n = GATE.tail_oscillation_max_n + np.sqrt(2.0) * 0.5
    assert against(stood(swing_n=0.999 * allowed_n), None, GATE, noise_n=0.5) == ""
    assert against(stood(swing_n=1.001 * allowed_n), None, GATE, noise_n=0.5)


def wave(swing_n: float = 12.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Samples, set-points and torques (200, 3) in which span 2 swings twice, and torque 2 chatters."""
    k = np.arange(200)
    setpoint_n = np.full((200, 3), 30.0)
    tension_n, torque_nm = setpoint_n.copy(), np.zeros((200, 3))
    tension_n[:, 1] += swing_n * np.sin(2.0 * np.pi * k / 100.0)
    return tension_n, setpoint_n, torque_nm


@given(st.sets(st.integers(0, 199), max_size=40), st.booleans())
def test_a_swing_is_seen_whichever_samples_are_lost(lost: set[int], all_cells: bool) -> None:
    tension_n, setpoint_n, torque_nm = wave()
    tension_n[sorted(lost), slice(None) if all_cells else slice(1, 2)] = np.nan
    found = look_at(standing(tension_n, setpoint_n, torque_nm), None, GATE, MEASURED)
    assert "tension 2" in found.against and not found.unseen


@given(st.integers(0, 199), st.integers(0, 2))
def test_one_lost_sample_of_a_line_that_stands_still_leaves_the_look_good(k: int, span: int) -> None:
    tension_n, setpoint_n, torque_nm = wave(swing_n=0.5)
    tension_n[k, span] = torque_nm[k, span] = np.nan
    assert look_at(standing(tension_n, setpoint_n, torque_nm), None, GATE, MEASURED) == Look("", ())


@pytest.mark.parametrize(("lost", "unseen"), [(40, False), (41, True)])
def test_too_few_samples_are_neither_for_nor_against(lost: int, unseen: bool) -> None:
    tension_n, setpoint_n, torque_nm = wave()
    tension_n[:lost, 1] = np.nan
    found = look_at(standing(tension_n, setpoint_n, torque_nm), None, GATE, MEASURED)
    expected = (Unseen("tension", 2, (200 - lost) / 200, LEAST_TENSION),) if unseen else ()
    assert found.unseen == expected and bool(found.against) is not unseen and not found.good


def test_what_was_seen_speaks_against_it_beside_what_was_not() -> None:
    tension_n, setpoint_n, torque_nm = wave()
    tension_n[:, 2] = np.nan
    found = look_at(standing(tension_n, setpoint_n, torque_nm), None, GATE, MEASURED)
    assert found.against.startswith("tension 2") and found.unseen == (Unseen("tension", 3, 0.0, LEAST_TENSION),)


def test_a_span_without_a_load_cell_is_not_missed_and_what_only_indicates_does_not_count() -> None:
    tension_n, setpoint_n, torque_nm = wave()
    without = np.array([True, False, True])
    assert look_at(standing(tension_n, setpoint_n, torque_nm), None, GATE, without).good
    tension_n[:, 1] = np.nan
    assert look_at(standing(tension_n, setpoint_n, torque_nm), None, GATE, without).good


def test_changes_of_a_torque_count_between_two_periods_that_were_seen() -> None:
    tension_n, setpoint_n, torque_nm = wave(0.0)
    torque_nm[:, 1] = 4.0 * (-1.0) ** np.arange(200)
    torque_nm[::3] = np.nan  # of three changes one is left
    found = standing(tension_n, setpoint_n, torque_nm)
    assert found.chatter_nm[1] == 8.0
    assert look_at(found, None, GATE, MEASURED).against.startswith("torque 2 chatters by 8.00 Nm")
    torque_nm[1::3] = np.nan
    found = look_at(standing(tension_n, setpoint_n, torque_nm), None, GATE, MEASURED)
    assert not found.against and found.unseen[0] == Unseen("torque", 1, 0.0, LEAST_TORQUE)
    assert str(found.unseen[1]) == "of torque 2 0% of the changes were seen, 25% are needed"


@given(st.integers(0, 2), st.integers(0, 2), st.sampled_from([np.nan, np.inf]))
def test_a_figure_that_is_no_number_is_never_for_a_change(figure: int, i: int, value: float) -> None:
    figures = [np.zeros(3) for _ in range(3)]
    figures[figure][i] = value
    assert look_at(Standing(*figures, ALL, ALL), None, GATE, MEASURED).against


@given(st.integers(0, 2), st.booleans())
def test_a_share_that_is_no_number_was_not_seen(i: int, tension: bool) -> None:
    share = ALL.copy()
    share[i] = np.nan
    seen = (share, ALL) if tension else (ALL, share)
    found = look_at(Standing(np.zeros(3), np.zeros(3), np.zeros(3), *seen), None, GATE, MEASURED)
    assert not found.good and [one.number for one in found.unseen] == [i + 1]


@given(st.integers(0, 2), st.integers(0, 2), st.sampled_from([np.nan, np.inf]))
def test_what_was_not_seen_before_the_change_leaves_the_limit(figure: int, i: int, value: float) -> None:
    now, before = [np.zeros(3) for _ in range(3)], [np.zeros(3) for _ in range(3)]
    now[figure][i], before[figure][i] = 1.01 * LIMITS[figure], value
    one = Standing(*now, ALL, ALL)
    assert against(one, Standing(*before, ALL, ALL), GATE)
    before[figure][i] = 100.0
    none = np.zeros(3)
    assert against(one, Standing(*before, none, none), GATE)
    assert not against(one, Standing(*before, ALL, ALL), GATE)

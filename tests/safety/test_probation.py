"""What a change shows under watch: swing, offset and chatter of known signals, against limits and against before."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line import Gate
from safety.probation import WORSE, Standing, against, standing

GATE = Gate()
PERIODS = 1000


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


def test_noise_of_the_load_cell_is_no_swing_and_what_is_not_measured_tells_nothing() -> None:
    assert against(stood(swing_n=1.5), None, GATE)
    assert against(stood(swing_n=1.5), None, GATE, noise_n=0.5) == ""
    blind = stood(swing_n=5.0)
    blind.swing_n[1] = np.nan
    assert against(blind, None, GATE) == ""
    before = stood()
    before.swing_n[:] = np.nan  # not measured before the change: the limit holds
    assert against(stood(swing_n=1.01 * GATE.tail_oscillation_max_n), before, GATE)


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
    assert against(Standing(np.array([0.0, GATE.tail_error_max_n, 0.0]), none, none), None, GATE) == ""
    before = Standing(np.array([0.0, 0.0, 10.0]), none, none)
    assert against(Standing(np.array([0.0, 6.0, 13.0]), none, none), before, GATE).startswith(
        "tension 2 is off by 6.00"
    )


def test_a_load_cells_noise_counts_as_the_sine_with_its_root_mean_square() -> None:
    allowed_n = GATE.tail_oscillation_max_n + np.sqrt(2.0) * 0.5
    assert against(stood(swing_n=0.999 * allowed_n), None, GATE, noise_n=0.5) == ""
    assert against(stood(swing_n=1.001 * allowed_n), None, GATE, noise_n=0.5)

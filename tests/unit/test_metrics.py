"""Metrics against values worked out by hand."""

import numpy as np
import pytest

from gateway.core.line import Priorities
from gateway.core.metrics import (
    Performance,
    effort_n2m2s,
    overshoot_paper_pct,
    overshoot_pct,
    rmse_n,
    rmse_per_span_n,
    score,
    settling_time_paper_s,
    settling_time_s,
)  # fmt: skip


def test_rmse_is_the_root_of_the_time_mean_of_the_squared_2_norm():
    tension = np.array([[31.0, 28.0], [30.0, 30.0]])
    setpoint = np.full((2, 2), 30.0)
    # squared norms 1 + 4 and 0, mean 2.5
    assert rmse_n(tension, setpoint) == pytest.approx(np.sqrt(2.5))
    assert rmse_per_span_n(tension, setpoint) == pytest.approx([np.sqrt(0.5), np.sqrt(2.0)])
    assert np.linalg.norm(rmse_per_span_n(tension, setpoint)) == pytest.approx(rmse_n(tension, setpoint))


def test_settling_and_overshoot_as_written_and_corrected():
    time = np.arange(6.0)
    tension = np.array([[20.0, 30.0], [20.0, 30.0], [42.0, 30.0], [46.0, 31.5], [44.5, 30.2], [44.1, 30.0]])
    setpoint = np.array([[20.0, 30.0]] * 2 + [[44.0, 30.0]] * 4)
    # 2 % of 44 N is 0.88 N, of 30 N 0.6 N: both spans are outside for the last time at 3 s, two after the change
    assert settling_time_s(time, tension, setpoint, 2.0).tolist() == [2.0, 2.0]
    assert overshoot_pct(time, tension, setpoint, 2.0) == pytest.approx([100 * 2.0 / 24.0, 100 * 1.5 / 30.0])
    # as written: from the start, in norms: 2 % of |(44, 30)| is 1.07 N
    assert settling_time_paper_s(time, tension, setpoint) == 4.0
    assert overshoot_paper_pct(tension, setpoint) == pytest.approx(100 * np.hypot(2.0, 1.5) / np.hypot(44.0, 30.0))
    assert effort_n2m2s(time, np.tile([3.0, 4.0], (6, 1))) == pytest.approx(25.0 * 5.0)


def test_what_never_settles_has_no_settling_time_and_no_score():
    time, setpoint = np.arange(3.0), np.full((3, 1), 30.0)
    tension = np.array([[30.0], [30.0], [40.0]])
    (settling,) = settling_time_s(time, tension, setpoint, 1.0)
    assert settling == np.inf
    found = Performance(1.0, 2.0, float(settling), 3.0, 4.0, 5e-6)
    assert score(found, Priorities()) == np.inf
    settled = Performance(1.0, 2.0, 0.5, 300.0, 4.0, 5e-6)
    weighed = Priorities(
        rmse_per_n=1.0, settling_per_s=2.0, overshoot_per_pct=3.0, effort_per_n2m2s=4.0, robustness_per_n=5.0,
        compute_per_s=6.0,
    )  # fmt: skip
    assert score(settled, weighed) == pytest.approx(1 + 2 * 0.5 + 3 * 2 + 4 * 300 + 5 * 4 + 3e-5)

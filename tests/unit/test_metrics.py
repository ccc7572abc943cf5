"""Metrics against values worked out by hand."""

import numpy as np
import pytest

from gateway.core.metrics import rmse_n, rmse_per_span_n


def test_rmse_is_the_root_of_the_time_mean_of_the_squared_2_norm():
    tension = np.array([[31.0, 28.0], [30.0, 30.0]])
    setpoint = np.full((2, 2), 30.0)
    # squared norms 1 + 4 and 0, mean 2.5
    assert rmse_n(tension, setpoint) == pytest.approx(np.sqrt(2.5))
    assert rmse_per_span_n(tension, setpoint) == pytest.approx([np.sqrt(0.5), np.sqrt(2.0)])
    assert np.linalg.norm(rmse_per_span_n(tension, setpoint)) == pytest.approx(rmse_n(tension, setpoint))

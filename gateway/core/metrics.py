"""What a run was worth, from sampled trajectories."""

import numpy as np

from gateway.core.signals import FloatArray


def rmse_n(tension_n: FloatArray, setpoint_n: FloatArray) -> float:
    """Root of the time mean of the squared 2-norm over all spans (eq. rmse), in N. Arrays (k, n), evenly sampled."""
    error: FloatArray = tension_n - setpoint_n
    return float(np.sqrt(np.sum(error**2) / len(error)))


def rmse_per_span_n(tension_n: FloatArray, setpoint_n: FloatArray) -> FloatArray:
    """Root mean square error of each span, (n,) in N. Their root sum of squares is `rmse_n`."""
    return np.sqrt(np.mean((tension_n - setpoint_n) ** 2, axis=0, dtype=np.float64))

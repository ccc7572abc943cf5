"""The line as the control computer sees it: sampled, with its dead time."""

from math import floor

import numpy as np
from scipy.linalg import expm

from gateway.control.sampled import Sampled
from gateway.core.signals import FloatArray

SAME_TIME_S = 1e-9


def sampled(A: FloatArray, B: FloatArray, time_s: float) -> tuple[FloatArray, FloatArray]:
    """exp(A t) and its integral times B: the zero-order hold over `time_s`."""
    states, inputs = B.shape
    block = np.zeros((states + inputs, states + inputs))
    block[:states, :states] = A
    block[:states, states:] = B
    exponential: FloatArray = np.asarray(expm(block * time_s), dtype=np.float64)
    return exponential[:states, :states], exponential[:states, states:]


def with_dead_time(A: FloatArray, B: FloatArray, period_s: float, latency_s: float) -> Sampled:
    """The sampled system with its dead time.

    A torque computed from the sample at k h acts from k h + latency = (k + m) h + tau on, 0 <= tau < h: over a period
    the torque of m+1 periods ago acts for tau, then that of m periods ago.
    """
    whole = floor(latency_s / period_s + SAME_TIME_S)
    rest_s = max(latency_s - whole * period_s, 0.0)
    rest_s = 0.0 if rest_s < SAME_TIME_S else rest_s
    transition, _ = sampled(A, B, period_s)
    late_transition, late = sampled(A, B, period_s - rest_s)
    inputs = [np.zeros_like(B) for _ in range(whole)] + [late]
    if rest_s:
        inputs.append(late_transition @ sampled(A, B, rest_s)[1])
    return Sampled(transition, inputs)

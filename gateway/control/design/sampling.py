"""The line as the control computer sees it: sampled, with its dead time."""

from dataclasses import dataclass
from math import floor

import numpy as np
from scipy.linalg import expm

from gateway.core.signals import FloatArray

SAME_TIME_S = 1e-9


@dataclass(frozen=True)
class Sampled:
    """x_{k+1} = F x_k + sum_j G_j u_{k-j}, u_{k-j} the torque that was computed j periods ago."""

    transition: FloatArray  #: F, (s, s)
    inputs: list[FloatArray]  #: G_0 .. G_d, (s, n) each

    @property
    def depth(self) -> int:
        """Torques in flight, d."""
        return len(self.inputs) - 1

    def augmented(self) -> tuple[FloatArray, FloatArray]:
        """F (s + n d, s + n d) and G (s + n d, n) of [x; u_{k-1}; ..; u_{k-d}]."""
        states, n = self.inputs[0].shape
        size = states + n * self.depth
        F, G = np.zeros((size, size)), np.zeros((size, n))
        F[:states, :states] = self.transition
        G[:states] = self.inputs[0]
        for age in range(1, self.depth + 1):
            F[:states, states + n * (age - 1) : states + n * age] = self.inputs[age]
        if self.depth:
            G[states : states + n] = np.eye(n)
            F[states + n :, states : size - n] = np.eye(n * (self.depth - 1))
        return F, G


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

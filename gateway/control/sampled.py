"""The line as the control computer sees it, as matrices."""

from dataclasses import dataclass

import numpy as np

from gateway.core.signals import FloatArray


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

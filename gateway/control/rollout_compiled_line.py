"""One plant step by step through the compiled kernel, for laws that are not compiled. As `rollout_line`, quicker."""

from typing import Any

import numpy as np

from gateway.control import rollout_kernel as kernel
from gateway.control.rollout_batch import coefficients_of, effects_of, lanes
from gateway.control.rollout_terms import Plants, Setup
from gateway.core.signals import FloatArray


class CompiledLine:
    """The same plant in all lanes of a block, of which one is looked at."""

    def __init__(self, plants: Plants, index: int, setup: Setup, state: FloatArray, torque_nm: FloatArray) -> None:
        n, effects = plants.n, plants.effects
        fill = np.full(kernel.LANES, index)
        self._coefficients, self._boundary = (
            lanes(values, fill)[0] for values in (coefficients_of(plants), plants.boundary_n)
        )
        self._own: Any = None if effects is None else lanes(effects_of(plants, effects, setup), fill)[0]
        self._eccentric = effects is not None and bool(effects.eccentricity.any())
        width = 2 * n if effects is None else 3 * n
        self._state = np.zeros((width, kernel.LANES))
        self._state[: 2 * n] = state[: 2 * n, None]
        self._acting = np.repeat(torque_nm[:, None], kernel.LANES, axis=1)
        self._torque = self._acting.copy()
        self._step_s = setup.step_s
        self._slopes, self._probe = np.empty((4, width, kernel.LANES)), np.empty((width, kernel.LANES))
        self._work = np.zeros((8, n, kernel.LANES))
        self._work[4] = 1.0  # round, until a roller is said to be eccentric

    @property
    def state(self) -> FloatArray:
        """[T; w] (2n,), and angles (n,) behind it where there are effects."""
        return self._state[:, 0].copy()

    def step(self, sent_nm: FloatArray, unwind_speed_m_per_s: float, moved_m_per_s: FloatArray) -> None:
        """With the torque that arrives, and the speeds that the rollers are moved by at random, (n,) each."""
        self._torque[:] = sent_nm[:, None]
        kernel.advance(
            self._coefficients, self._boundary, self._own, self._eccentric, self._state, self._acting, self._torque,
            unwind_speed_m_per_s, moved_m_per_s, self._step_s, self._slopes, self._probe, self._work,
        )  # fmt: skip

"""The quadratic programme of the model predictive controller, condensed: torques of blocks are its variables.

With x = [x~; torques in flight] and w = u~ + d, x_{k+1} = F x_k + G w_k. Over the horizon the states are
X = Phi x_0 + Gamma z, z the torques w of each block and one slack per span, so that

    minimise  1/2 z' P z + (L x_0)' z   subject to   lower <= A z + C x_0 <= upper

where P, L, A and C stay as they are and lower and upper follow from the estimate. Rows: torque of each block; its
change from the block before, as far as the rate goes from one block's middle to the next; and, where tension limits are
looked at, the deviations of the tensions at the end of each block from their set-points, to which a span's slack is
added.
"""

import numpy as np

from gateway.control.observer import Estimate
from gateway.control.sampled import Sampled
from gateway.core.controller_laws import MpcConfig
from gateway.core.signals import FloatArray

#: Of the band that is planned for: how far from any set-point no row begins, so that none is active at rest for noise.
CLEAR = 0.025


class MpcProblem:
    """P, L, A and C, and the limits of an estimate. All in Nm and N."""

    def __init__(self, config: MpcConfig) -> None:
        """Slow: powers of the model over the horizon, a tenth of a second at 60 spans."""
        self._config = config
        n, blocks = config.n, config.blocks
        self._n = n
        self.limited = config.weight_tension_limit > 0.0  #: whether there are rows of tensions, and slack
        model = config.predictor
        F, G = Sampled(np.array(model.transition), [np.array(matrix) for matrix in model.inputs]).augmented()
        free, forced = _trajectories(F, G, blocks)  # (N_p, s, s) and (N_p, s, n blocks)
        weight = np.zeros((config.horizon, F.shape[0], F.shape[0]))
        weight[:, : 2 * n, : 2 * n] = np.diag(config.weight_state)
        weight[-1] = config.weight_terminal  # the state at the end is in it with all that comes after
        torque = np.kron(np.diag(np.array(blocks, dtype=np.float64)), np.diag(config.weight_torque))
        weighted = np.swapaxes(forced, 1, 2) @ weight
        hessian = 2.0 * ((weighted @ forced).sum(axis=0) + torque)
        ends = np.cumsum(blocks) - 1
        tension = forced[ends][:, :n].reshape(-1, n * len(blocks))

        self.torque_variables = n * len(blocks)
        self.variables = self.torque_variables + (n if self.limited else 0)
        change = np.eye(self.torque_variables) - np.eye(self.torque_variables, k=-n)
        self.torque_rows = 2 * self.torque_variables  #: the first ones of A; the others are of tensions
        # The symmetric part: rounding makes halves differ.
        hessian = 0.5 * (hessian + hessian.T)
        self.hessian: FloatArray = hessian  #: of the torques alone, (n blocks, n blocks)
        self.L: FloatArray = 2.0 * (weighted @ free).sum(axis=0)  #: (n blocks, s): what it is to the slack is 0
        rows: FloatArray = np.vstack((np.eye(self.torque_variables), change))
        if self.limited:
            hessian = _block_diagonal(hessian, 2.0 * config.weight_tension_limit * np.eye(n))
            none = np.zeros((self.torque_rows, n))
            rows = np.block([[rows, none], [tension, np.tile(np.eye(n), (len(blocks), 1))]])
        self.P: FloatArray = hessian
        self.A: FloatArray = rows  #: begins with the unit matrix
        self.rows = self.A.shape[0]
        self.C: FloatArray = np.zeros((self.rows, F.shape[0]))
        if self.limited:
            self.C[self.torque_rows :] = free[ends][:, :n].reshape(-1, F.shape[0])
        # From the middle of a block to that of the next; the first torque follows the one sent last by a period.
        apart = np.concatenate(([1.0], 0.5 * (np.array(blocks[1:]) + np.array(blocks[:-1]))))
        reach_nm: FloatArray = config.torque_rate_nm_per_s * config.period_s * np.repeat(apart, n)
        self._blocks = np.repeat(np.arange(len(blocks)), blocks)
        # (torque, change and tension; blocks; n): the rows of A, one limit of each
        self._lower = np.empty((self.rows // self.torque_variables, len(blocks), n))
        self._upper = np.empty_like(self._lower)
        self._lower[1], self._upper[1] = -reach_nm.reshape(-1, n), reach_nm.reshape(-1, n)
        self._reach_nm: FloatArray = reach_nm[:n]
        self._limits = (self._lower.reshape(-1), self._upper.reshape(-1))  # the same numbers
        self._setpoints = b""  #: that the limits of tensions belong to: they move rarely
        self._clear_n = CLEAR * (config.tension_max_n - config.tension_min_n)

    def gain(self) -> FloatArray:
        """K (n, 2n + n d) of w_0 = -K [x~; torques in flight]: the law where no limit is reached."""
        gain: FloatArray = np.asarray(np.linalg.solve(self.hessian, self.L), dtype=np.float64)
        return gain[: self._n]

    def state(self, found: Estimate) -> FloatArray:
        """x_0 (2n + n d,)."""
        return np.concatenate((found.state, found.in_flight_nm.ravel()))

    def limits(
        self, found: Estimate, tension_setpoint_n: FloatArray, applied_nm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """lower and upper (rows,) for an estimate, set-points (n,) and the torque sent last (n,).

        The next call writes over them.
        """
        config, lower, upper = self._config, self._lower, self._upper
        shift = found.errors.torque_nm - found.disturbance_nm  # u = w + shift
        lower[0], upper[0] = -config.torque_nm - shift, config.torque_nm - shift
        first = shift + found.bump_nm  # what was taken over is added to the first torque
        lower[0, 0], upper[0, 0] = -config.torque_nm - first, config.torque_nm - first
        begin_nm = applied_nm - first
        lower[1, 0], upper[1, 0] = begin_nm - self._reach_nm, begin_nm + self._reach_nm
        if self.limited and (setpoints := tension_setpoint_n.tobytes()) != self._setpoints:
            # A set-point beyond what is planned for is held all the same, and a slack web is tensioned.
            lower[2] = np.minimum(config.tension_min_n - tension_setpoint_n, -self._clear_n)
            upper[2] = np.maximum(config.tension_max_n - tension_setpoint_n, self._clear_n)
            self._setpoints = setpoints
        return self._limits

    def vectors(
        self, found: Estimate, tension_setpoint_n: FloatArray, applied_nm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """q, lower and upper of the programme by itself, lower <= A z <= upper: for who knows nothing of x_0."""
        x = self.state(found)
        lower, upper = self.limits(found, tension_setpoint_n, applied_nm)
        return self.linear(x), lower - self.C.dot(x), upper - self.C.dot(x)

    def linear(self, x: FloatArray) -> FloatArray:
        """q (variables,)."""
        q = np.zeros(self.variables)
        q[: self.torque_variables] = self.L.dot(x)
        return q

    def torques(self, solution: FloatArray, found: Estimate) -> FloatArray:
        """The plan (N_p, n) in Nm of a solution."""
        blocks = solution[: self.torque_variables].reshape(-1, self._n)
        return blocks[self._blocks] + (found.errors.torque_nm - found.disturbance_nm)


def _trajectories(F: FloatArray, G: FloatArray, blocks: list[int]) -> tuple[FloatArray, FloatArray]:
    """What the state and the blocks' torques do to the states at the ends of periods 1 to N_p."""
    size, n = G.shape
    free: list[FloatArray] = []
    forced: list[FloatArray] = []
    of_state, of_torques = np.eye(size), np.zeros((size, n * len(blocks)))
    for block, periods in enumerate(blocks):
        for _ in range(periods):
            of_state, of_torques = F @ of_state, F @ of_torques
            of_torques[:, n * block : n * (block + 1)] += G
            free.append(of_state)
            forced.append(of_torques)
    return np.array(free), np.array(forced)


def _block_diagonal(first: FloatArray, second: FloatArray) -> FloatArray:
    a, b = len(first), len(second)
    whole = np.zeros((a + b, a + b))
    whole[:a, :a], whole[a:, a:] = first, second
    return whole

"""The quadratic programme of the model predictive controller, condensed: torques of blocks are its variables.

With x = [x~; torques in flight] and w = u~ + d, x_{k+1} = F x_k + G w_k. Over the horizon the states are
X = Phi x_0 + Gamma z, z the torques w of each block and one slack per span, so that

    minimise  1/2 z' P z + q' z   subject to   lower <= A z <= upper

where P and A stay as they are and q, lower, upper follow from the estimate. Rows: torque of each block; its change from
the block before, as far as the rate goes from one block's middle to the next; and, where tension limits are looked at,
the tensions at the end of each block, to which a span's slack is added.
"""

import numpy as np
from scipy.sparse import csc_matrix, triu

from gateway.control.observer import Estimate
from gateway.control.sampled import Sampled
from gateway.core.controller_laws import MpcConfig
from gateway.core.signals import FloatArray

#: Of the band that is planned for: how far from any set-point no row begins, so that none is active at rest for noise.
CLEAR = 0.025


class MpcProblem:
    """P, A and the products that give the rest. All in Nm and N."""

    def __init__(self, config: MpcConfig) -> None:
        self._config = config
        n, blocks = config.n, config.blocks
        self._n = n
        self._limited = config.weight_tension_limit > 0.0
        model = config.predictor
        F, G = Sampled(np.array(model.transition), [np.array(matrix) for matrix in model.inputs]).augmented()
        free, forced = _trajectories(F, G, blocks)  # (N_p, s, s) and (N_p, s, n blocks)
        weight = np.zeros((config.horizon, F.shape[0], F.shape[0]))
        weight[:, : 2 * n, : 2 * n] = np.diag(config.weight_state)
        weight[-1] = config.weight_terminal  # the state at the end is in it with all that comes after
        torque = np.kron(np.diag(np.array(blocks, dtype=np.float64)), np.diag(config.weight_torque))
        weighted = np.einsum("ksz,kst->kzt", forced, weight)
        hessian = 2.0 * (np.einsum("kzt,kty->zy", weighted, forced) + torque)
        self._linear: FloatArray = 2.0 * np.einsum("kzt,kts->zs", weighted, free)
        ends = np.cumsum(blocks) - 1
        self._tension_free = free[ends][:, :n].reshape(-1, F.shape[0])
        tension = forced[ends][:, :n].reshape(-1, n * len(blocks))

        self.torque_variables = n * len(blocks)
        self.variables = self.torque_variables + (n if self._limited else 0)
        change = np.eye(self.torque_variables) - np.eye(self.torque_variables, k=-n)
        self.torque_rows = 2 * self.torque_variables  #: the first ones of A; the others are of tensions
        matrix = np.vstack((np.eye(self.torque_variables), change))
        # The symmetric part: rounding makes halves differ, and the solver reads one of them.
        hessian = 0.5 * (hessian + hessian.T)
        self.hessian: FloatArray = hessian  #: of the torques alone, (n blocks, n blocks)
        if self._limited:
            hessian = _block_diagonal(hessian, 2.0 * config.weight_tension_limit * np.eye(n))
            none = np.zeros((self.torque_rows, n))
            matrix = np.block([[matrix, none], [tension, np.tile(np.eye(n), (len(blocks), 1))]])
        self.P = csc_matrix(triu(hessian))
        self.A = csc_matrix(matrix)
        self.rows = matrix.shape[0]
        # From the middle of a block to that of the next; the first torque follows the one sent last by a period.
        apart = np.concatenate(([1.0], 0.5 * (np.array(blocks[1:]) + np.array(blocks[:-1]))))
        self._reach_nm: FloatArray = config.torque_rate_nm_per_s * config.period_s * np.repeat(apart, n)
        self._blocks = np.repeat(np.arange(len(blocks)), blocks)
        self._lower = np.full(self.rows, -np.inf)
        self._upper = np.full(self.rows, np.inf)

    def gain(self) -> FloatArray:
        """K (n, 2n + n d) of w_0 = -K [x~; torques in flight]: the law where no limit is reached."""
        gain: FloatArray = np.asarray(np.linalg.solve(self.hessian, self._linear), dtype=np.float64)
        return gain[: self._n]

    def vectors(
        self, found: Estimate, tension_setpoint_n: FloatArray, applied_nm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """q, lower and upper for an estimate, set-points (n,) and the torque sent last (n,).

        The next call writes over them.
        """
        config, n, m = self._config, self._n, self.torque_variables
        x = np.concatenate((found.state, found.in_flight_nm.ravel()))
        q = np.zeros(self.variables)
        q[:m] = self._linear.dot(x)
        lower, upper = self._lower, self._upper
        shift = found.errors.torque_nm - found.disturbance_nm  # u = w + shift
        blocks = len(config.blocks)
        lower[:m] = np.tile(-config.torque_nm - shift, blocks)
        upper[:m] = np.tile(config.torque_nm - shift, blocks)
        lower[m : 2 * m], upper[m : 2 * m] = -self._reach_nm, self._reach_nm
        lower[m : m + n] += applied_nm - shift
        upper[m : m + n] += applied_nm - shift
        for bound in (lower, upper):  # what was taken over is added to the first torque
            bound[:n] -= found.bump_nm
            bound[m : m + n] -= found.bump_nm
        if self._limited:
            tension = np.tile(tension_setpoint_n, blocks) + self._tension_free.dot(x)
            # A set-point beyond what is planned for is held all the same, and a slack web is tensioned.
            clear_n = CLEAR * (config.tension_max_n - config.tension_min_n)
            least = np.minimum(config.tension_min_n, tension_setpoint_n - clear_n)
            most = np.maximum(config.tension_max_n, tension_setpoint_n + clear_n)
            lower[2 * m :] = np.tile(least, blocks) - tension
            upper[2 * m :] = np.tile(most, blocks) - tension
        return q, lower, upper

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

"""What each control law needs, frozen: the kinds of phi.

Matrices act on deviations from the reference. With n spans: tension errors (n,), speed errors (n,), torques (n,).
x~ = [T - T_ref; v - v_ref], u~ = u - u_ref, where u_ref drives the line along the reference (feed-forward).
"""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from gateway.core.line import NonNegative, Positive, Strict
from gateway.core.signals import FloatArray

CONVEX = 1e-9  #: of the greatest eigenvalue: how far below 0 the smallest may come by rounding


def _between_rows(row: list[float]) -> list[float]:
    """The row: between two of them, which are checked in one call else, other threads have their turn."""
    return row


Matrix = list[Annotated[list[float], AfterValidator(_between_rows)]]
Vector = list[float]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Solver = Literal["daqp", "osqp"]


class Feedforward(Strict):
    """The parameters from which reference speeds and torques are computed; part of phi."""

    stiffness_n: Positive
    length_m: list[Positive]
    radius_m: list[Positive]
    inertia_kg_m2: list[Positive]
    friction_nms_per_rad: list[NonNegative]
    tension_before_n: NonNegative = 0.0
    tension_after_n: NonNegative = 0.0


class Law(Strict):
    """What every law needs."""

    period_s: Positive
    latency_s: NonNegative  #: from a sample to the torque that it causes
    draw_spans: list[int] = []  #: indices (from 0) of spans without a load cell: their rollers keep a speed ratio
    feedforward: Feedforward

    @property
    def n(self) -> int:
        return len(self.feedforward.radius_m)

    @model_validator(mode="after")
    def _check_spans(self) -> Self:
        feedforward = self.feedforward
        for name in ("length_m", "inertia_kg_m2", "friction_nms_per_rad"):
            if len(values := getattr(feedforward, name)) != self.n:
                raise ValueError(f"{len(values)} values of {name} for {self.n} radii")
        if sorted(set(self.draw_spans)) != self.draw_spans or not all(0 <= i < self.n for i in self.draw_spans):
            raise ValueError(f"draw_spans is {self.draw_spans}; allowed: indices from 0 to {self.n - 1}, ascending")
        return self

    def _require(self, name: str, matrix: Matrix, shape: tuple[int, int]) -> None:
        if _shape(matrix) != shape:
            raise ValueError(f"{name} is {_shape(matrix)}, for {self.n} spans it must be {shape}")

    def _require_blocks(self, name: str, matrix: Matrix) -> int:
        """The number of n x n blocks side by side."""
        rows, columns = _shape(matrix)
        if rows != self.n or columns % self.n:
            raise ValueError(
                f"{name} is {(rows, columns)}, it must have {self.n} rows and a multiple of {self.n} columns"
            )
        return columns // self.n


class PidConfig(Law):
    """The paper's PID with gain matrices on y = [T; v] (eq. pid), filtered derivative, anti-windup.

    u = u_ref + K_p e + K_i integral(e) + K_d de/dt
    """

    kind: Literal["pid"] = "pid"
    gain_proportional: Matrix  #: (n, 2n)
    gain_integral: Matrix  #: (n, n), on the controlled quantity of each span
    gain_derivative: Matrix  #: (n, n), on the tensions
    derivative_filter_s: Positive
    antiwindup: Share = 1.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        n = self.n
        self._require("gain_proportional", self.gain_proportional, (n, 2 * n))
        self._require("gain_integral", self.gain_integral, (n, n))
        self._require("gain_derivative", self.gain_derivative, (n, n))
        return self


class LqrConfig(Law):
    """State feedback (eq. lqr) with the torques in flight (dead time) as states, and no integral action.

    u = u_ref - K_x x~ - K_u [u~_{k-1}; ..; u~_{k-d}]
    """

    kind: Literal["lqr"] = "lqr"
    gain_state: Matrix  #: (n, 2n), Nm/N and Nm/(m/s)
    gain_input: Matrix  #: (n, n d), newest torque first

    @model_validator(mode="after")
    def _check(self) -> Self:
        self._require("gain_state", self.gain_state, (self.n, 2 * self.n))
        self._require_blocks("gain_input", self.gain_input)
        return self


class LqiConfig(Law):
    """State feedback with integral action and the torques in flight as states.

    u = u_ref - K_x x~ - K_u [u~_{k-1}; ..; u~_{k-d}] - K_i q, q the integral of the controlled errors
    """

    kind: Literal["lqi"] = "lqi"
    gain_state: Matrix  #: (n, 2n), Nm/N and Nm/(m/s)
    gain_input: Matrix  #: (n, n d), newest torque first
    gain_integral: Matrix  #: (n, n), Nm/(N s); Nm/m for a draw span
    antiwindup: Share = 1.0  #: share of the excess taken back each period

    @model_validator(mode="after")
    def _check(self) -> Self:
        self._require("gain_state", self.gain_state, (self.n, 2 * self.n))
        self._require("gain_integral", self.gain_integral, (self.n, self.n))
        if np.linalg.matrix_rank(np.array(self.gain_integral)) < self.n:
            raise ValueError("gain_integral is singular: some combination of errors would never be integrated away")
        self._require_blocks("gain_input", self.gain_input)
        return self


class Predictor(Strict):
    """The sampled model of deviations, with torque disturbances d that keep their value, and its observer.

    x~_{k+1} = F x~_k + sum_j G_j (u~_{k-j} + d) and the measurement's correction of x~ and d.
    """

    transition: Matrix  #: F, (2n, 2n)
    inputs: list[Matrix]  #: G_0 .. G_d, (2n, n) each: what the torque computed j periods ago does in the coming period
    gain_state: Matrix  #: (2n, 2n), from what was measured less what was predicted; 0 for what is not measured
    gain_disturbance: Matrix  #: (n, 2n), Nm/N and Nm/(m/s)

    def shapes(self) -> dict[str, tuple[Matrix, tuple[int, int]]]:
        """Matrices by name, with the shape that each must have."""
        n = len(self.gain_disturbance)
        found = {
            "transition": (self.transition, (2 * n, 2 * n)),
            "gain_state": (self.gain_state, (2 * n, 2 * n)),
            "gain_disturbance": (self.gain_disturbance, (n, 2 * n)),
        }
        return found | {f"inputs[{j}]": (matrix, (2 * n, n)) for j, matrix in enumerate(self.inputs)}


class LqgConfig(Law):
    """State feedback on a Kalman observer that estimates torque disturbances, and takes them back.

    u = u_ref - d - K_x x~ - K_u [u~_{k-1} + d; ..; u~_{k-d} + d], with x~ and d as the observer has them
    """

    kind: Literal["lqg"] = "lqg"
    predictor: Predictor
    gain_state: Matrix  #: (n, 2n)
    gain_input: Matrix  #: (n, n d), newest torque first

    @model_validator(mode="after")
    def _check(self) -> Self:
        self._require("gain_state", self.gain_state, (self.n, 2 * self.n))
        depth = self._require_blocks("gain_input", self.gain_input)
        _check_predictor(self.n, self.predictor, depth)
        return self


class MpcConfig(Law):
    """Model predictive control (eq. mpc) on the observer's estimate.

    Minimises sum_{i=1..N_p-1} x~_i' Q x~_i + sum_{i=0..N_p-1} u~_i' R u~_i + x_N' P x_N over torques that keep their
    value within each block, subject to torque and torque rate, and, as far as it can, to tension.
    """

    kind: Literal["mpc"] = "mpc"
    predictor: Predictor
    weight_state: Vector  #: diagonal of Q, (2n,)
    weight_torque: Vector  #: diagonal of R, (n,)
    weight_terminal: Matrix  #: P, (2n + n d, 2n + n d), on [x~; u~_{k-1}; ..; u~_{k-d}]
    blocks: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1)]  #: periods; their sum is N_p
    torque_nm: Positive
    torque_rate_nm_per_s: Positive
    tension_min_n: NonNegative
    tension_max_n: Positive
    weight_tension_limit: NonNegative  #: per squared N beyond the limits; 0: they are not looked at
    fallback_state: Matrix  #: (n, 2n), the gains of `LqgConfig`, for when no solution comes
    fallback_input: Matrix  #: (n, n d)
    most_iterations: Annotated[int, Field(ge=1, le=100_000)] = 1000
    time_limit_s: Positive  #: a solution later than this is not applied
    #: Not written where it is the usual one: configurations from before there was a choice keep their hash.
    solver: Annotated[Solver, Field(exclude_if=lambda value: value == "daqp")] = "daqp"

    @property
    def horizon(self) -> int:
        return sum(self.blocks)

    @model_validator(mode="after")
    def _check(self) -> Self:
        n = self.n
        depth = self._require_blocks("fallback_input", self.fallback_input)
        self._require("fallback_state", self.fallback_state, (n, 2 * n))
        size = 2 * n + n * depth
        self._require("weight_terminal", self.weight_terminal, (size, size))
        _check_convex(np.array(self.weight_terminal))
        _check_predictor(n, self.predictor, depth)
        for name, vector, length in (
            ("weight_state", self.weight_state, 2 * n),
            ("weight_torque", self.weight_torque, n),
        ):
            if len(vector) != length:
                raise ValueError(f"{name} has {len(vector)} entries, for {n} spans it must have {length}")
        if min(self.weight_state) < 0.0 or min(self.weight_torque) <= 0.0:
            raise ValueError("weight_state must not be negative, and weight_torque must be positive")
        if self.tension_min_n >= self.tension_max_n:
            raise ValueError(f"tension_min_n {self.tension_min_n:g} is not below tension_max_n {self.tension_max_n:g}")
        return self


def _check_convex(weight_terminal: FloatArray) -> None:
    """A cost that falls without end in some direction has no least: the solver would find out at the first sample."""
    symmetric = 0.5 * (weight_terminal + weight_terminal.T)
    eigenvalues: FloatArray = np.asarray(np.linalg.eigvalsh(symmetric), dtype=np.float64)
    least, greatest = float(eigenvalues[0]), float(np.abs(eigenvalues).max())
    if least < -CONVEX * greatest:
        raise ValueError(
            f"weight_terminal is not positive semidefinite: its smallest eigenvalue is {least:.4g}, allowed: from 0 up "
            f"(rounding: {-CONVEX * greatest:.1g})"
        )


def _check_predictor(n: int, predictor: Predictor, depth: int) -> None:
    if len(predictor.gain_disturbance) != n:
        raise ValueError(f"predictor.gain_disturbance has {len(predictor.gain_disturbance)} rows for {n} spans")
    if len(predictor.inputs) != depth + 1:
        raise ValueError(
            f"predictor.inputs has {len(predictor.inputs)} matrices, for {depth} torques in flight {depth + 1}"
        )
    for name, (matrix, shape) in predictor.shapes().items():
        if _shape(matrix) != shape:
            raise ValueError(f"predictor.{name} is {_shape(matrix)}, for {n} spans it must be {shape}")


def _shape(matrix: Matrix) -> tuple[int, int]:
    widths = {len(row) for row in matrix}
    if len(widths) > 1:
        raise ValueError("rows of unequal length")
    return len(matrix), widths.pop() if widths else 0

"""Controller configurations phi: what a control law needs, frozen, as data that can be stored, hashed and compared.

Matrices act on deviations from the reference. With n spans: tension errors (n,), speed errors (n,).
"""

import hashlib
import json
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator
from pydantic_core import ErrorDetails

from gateway.core.line import NonNegative, Positive, Strict

Matrix = list[list[float]]
Vector = list[float]


class Feedforward(Strict):
    """The parameters from which reference speeds and equilibrium torques are computed; part of phi."""

    stiffness_n: Positive
    radius_m: list[Positive]
    friction_nms_per_rad: list[NonNegative]
    tension_before_n: NonNegative = 0.0
    tension_after_n: NonNegative = 0.0


def _shape(matrix: Matrix) -> tuple[int, int]:
    widths = {len(row) for row in matrix}
    if len(widths) != 1:
        raise ValueError("rows of unequal length")
    return len(matrix), widths.pop()


class _Law(Strict):
    period_s: Positive
    draw_spans: list[int] = []  #: indices (from 0) of spans without a load cell: their rollers keep a speed ratio
    feedforward: Feedforward

    @property
    def n(self) -> int:
        return len(self.feedforward.radius_m)

    @model_validator(mode="after")
    def _check_spans(self) -> Self:
        feedforward = self.feedforward
        if len(feedforward.friction_nms_per_rad) != self.n:
            raise ValueError(f"{len(feedforward.friction_nms_per_rad)} friction values for {self.n} radii")
        if sorted(set(self.draw_spans)) != self.draw_spans or not all(0 <= i < self.n for i in self.draw_spans):
            raise ValueError(f"draw_spans is {self.draw_spans}; allowed: indices from 0 to {self.n - 1}, ascending")
        return self

    def _require(self, name: str, matrix: Matrix, shape: tuple[int, int]) -> None:
        if _shape(matrix) != shape:
            raise ValueError(f"{name} is {_shape(matrix)}, for {self.n} spans it must be {shape}")


class LqiConfig(_Law):
    """State feedback with integral action and the torques in flight (dead time) as states.

    u = u_eq - K_x [T - T_ref; v - v_ref] - K_u [u_{k-1} - u_eq; ..; u_{k-d} - u_eq] - K_i q
    """

    kind: Literal["lqi"] = "lqi"
    gain_state: Matrix  #: (n, 2n), Nm/N and Nm/(m/s)
    gain_input: Matrix  #: (n, n d), newest torque first
    gain_integral: Matrix  #: (n, n), Nm/(N s); Nm/m for a draw span
    antiwindup: Annotated[float, Field(ge=0.0, le=1.0)] = 1.0  #: share of the excess taken back each period

    @model_validator(mode="after")
    def _check(self) -> Self:
        n = self.n
        self._require("gain_state", self.gain_state, (n, 2 * n))
        self._require("gain_integral", self.gain_integral, (n, n))
        if np.linalg.matrix_rank(np.array(self.gain_integral)) < n:
            raise ValueError("gain_integral is singular: some combination of errors would never be integrated away")
        rows, columns = _shape(self.gain_input)
        if rows != n or columns % n:
            raise ValueError(f"gain_input is {(rows, columns)}, it must have {n} rows and a multiple of {n} columns")
        return self


class PidConfig(_Law):
    """The paper's PID with gain matrices on y = [T; v] (eq. pid), filtered derivative, anti-windup.

    u = u_eq + K_p e + K_i integral(e) + K_d de/dt
    """

    kind: Literal["pid"] = "pid"
    gain_proportional: Matrix  #: (n, 2n)
    gain_integral: Matrix  #: (n, n), on the controlled quantity of each span
    gain_derivative: Matrix  #: (n, n), on the tensions
    derivative_filter_s: Positive
    antiwindup: Annotated[float, Field(ge=0.0, le=1.0)] = 1.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        n = self.n
        self._require("gain_proportional", self.gain_proportional, (n, 2 * n))
        self._require("gain_integral", self.gain_integral, (n, n))
        self._require("gain_derivative", self.gain_derivative, (n, n))
        return self


ControllerConfig = Annotated[LqiConfig | PidConfig, Field(discriminator="kind")]
_adapter: TypeAdapter[LqiConfig | PidConfig] = TypeAdapter(ControllerConfig)


class ControllerRefused(Exception):
    """A configuration that must not be used; the text names every reason."""


def canonical(config: LqiConfig | PidConfig) -> bytes:
    """The one byte representation of a configuration, the same whoever writes it."""
    return json.dumps(config.model_dump(mode="json"), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def config_hash(config: LqiConfig | PidConfig) -> str:
    """SHA-256 of the canonical bytes, in hexadecimal."""
    return hashlib.sha256(canonical(config)).hexdigest()


def parse_controller(payload: bytes) -> LqiConfig | PidConfig:
    """The configuration in `payload` (JSON). Raises ControllerRefused with every reason."""
    try:
        return _adapter.validate_json(payload)
    except ValidationError as error:
        raise ControllerRefused("; ".join(map(_reason, error.errors()))) from error


def _reason(error: ErrorDetails) -> str:
    place = ".".join(map(str, error["loc"]))  # empty for text that is no JSON at all
    return f"{place}: {error['msg']}" if place else error["msg"]

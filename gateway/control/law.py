"""What every control law looks like to the cycle: engage, ask, commit.

The configuration is frozen; the state is a value that goes in and comes out. `commit` is told the torque that was
really applied, after limits and envelope, so that integrators never run away from the actuators.
"""

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from gateway.core.controller import Feedforward
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel, speed_ratios, web_torque


@dataclass(slots=True)
class Measured:
    """The line now: tensions (n,) in N, roller speeds (n,) and the unwinder's speed in m/s."""

    tension_n: FloatArray
    speed_m_per_s: FloatArray
    unwind_speed_m_per_s: float


@dataclass(slots=True)
class Decision:
    """What a law asks for, and the errors that it has asked it on."""

    torque_nm: FloatArray  #: (n,)
    tension_error_n: FloatArray  #: (n,), T - T_ref; 0 where there is no load cell
    controlled_error: FloatArray  #: (n,), what is integrated: tension error in N, speed error in m/s for a draw span


State = TypeVar("State")


class Law(Protocol[State]):
    """A control law of `n` spans, ready to run."""

    n: int

    def engage(self, measured: Measured, tension_setpoint_n: FloatArray, applied_nm: FloatArray) -> State:
        """The state from which the first `ask` returns `applied_nm` (n,): bumpless, whatever ran before."""
        ...

    def ask(self, state: State, measured: Measured, tension_setpoint_n: FloatArray) -> Decision:
        """The torque that the law wants now, before any limit."""
        ...

    def commit(self, state: State, decision: Decision, applied_nm: FloatArray) -> State:
        """The state for the next period, given the torque (n,) that was really applied."""
        ...


class Deviation:
    """Equilibrium and errors around it, shared by all laws: the feed-forward part of phi."""

    def __init__(self, feedforward: Feedforward, draw_spans: list[int]) -> None:
        n = len(feedforward.radius_m)
        ones = np.ones(n)
        # Lengths and inertias play no part at the equilibrium.
        self._model = WebModel(
            stiffness_n=feedforward.stiffness_n,
            length_m=ones,
            radius_m=np.array(feedforward.radius_m),
            inertia_kg_m2=ones,
            friction_nms_per_rad=np.array(feedforward.friction_nms_per_rad),
            tension_before_n=feedforward.tension_before_n,
            tension_after_n=feedforward.tension_after_n,
        )
        self._draw = np.array(draw_spans, dtype=np.intp)
        self._setpoints = b""  #: that the next three belong to: set-points move rarely, the unwinder always
        self._speed_ratios: FloatArray = ones
        self._friction_nm_s_per_m: FloatArray = ones
        self._web_torque_nm: FloatArray = ones

    def errors(
        self, measured: Measured, setpoint_n: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Tension error, speed error, controlled error and equilibrium torque, (n,) each."""
        reference, torque = self._equilibrium(setpoint_n, measured.unwind_speed_m_per_s)
        tension_error = measured.tension_n - setpoint_n
        speed_error = measured.speed_m_per_s - reference
        controlled = tension_error
        if self._draw.size:
            tension_error[self._draw] = 0.0
            controlled = tension_error.copy()
            controlled[self._draw] = speed_error[self._draw]
        return tension_error, speed_error, controlled, torque

    def _equilibrium(self, setpoint_n: FloatArray, unwind_speed_m_per_s: float) -> tuple[FloatArray, FloatArray]:
        """Reference speeds and torques, (n,) each: `reference_speeds` and `equilibrium_torque` of the model."""
        model, setpoints = self._model, setpoint_n.tobytes()
        if setpoints != self._setpoints:
            self._speed_ratios = speed_ratios(model, setpoint_n)
            self._friction_nm_s_per_m = model.friction_nms_per_rad * self._speed_ratios / model.radius_m
            self._web_torque_nm = web_torque(model, setpoint_n)
            self._setpoints = setpoints
        reference = unwind_speed_m_per_s * self._speed_ratios
        return reference, unwind_speed_m_per_s * self._friction_nm_s_per_m - self._web_torque_nm

"""What a law remembers, in the order of its `LinearForm`: as it is, and as it would be if it took over now."""

from typing import Any

import numpy as np

from gateway.control.linear_form import LinearForm
from gateway.control.lqi import LqiState
from gateway.control.lqr import LqrState
from gateway.control.observer import ObserverState
from gateway.control.pid import PidState
from gateway.control.scheduled import ScheduledState
from gateway.core.controller_laws import LqiConfig, LqrConfig, MpcConfig, PidConfig
from gateway.core.controller_schedule import LinearConfig
from gateway.core.signals import FloatArray


def memory(state: Any) -> FloatArray:
    """z (s,) of the form, from the state of a running law."""
    match state:
        case LqiState():
            parts = (state.integral_nm, state.in_flight_nm)
        case LqrState():
            parts = (state.in_flight_nm, state.bump_nm)
        case PidState():
            parts = (state.integral_nm, state.tension_error_n, state.error_rate_n_per_s)
        case ObserverState():
            parts = (state.predicted, state.disturbance_nm, state.in_flight_nm, state.bump_nm)
        case ScheduledState():
            return memory(state.inner)
        case _:  # of the model predictive law: its observer's
            return memory(state.observer)
    return np.concatenate([part.ravel() for part in parts])


def engagement(config: LinearConfig | MpcConfig, form: LinearForm) -> FloatArray:
    """Z (s, 6n) with z = Z [x; x_ref; u_ref; u_applied], the memory of a law that engages at x = [T; v] (2n,).

    An observer takes a tension near its set-point to be there; here it is where it is.
    """
    n, states = form.n, form.states
    x, x_ref, u_ref, applied = np.split(np.eye(6 * n), [2 * n, 4 * n, 5 * n])
    error = x - x_ref
    error[config.draw_spans] = 0.0
    depth = _depth(config, states)
    in_flight = np.tile(applied, (depth, 1))
    none = np.zeros_like(applied)
    match config:
        case PidConfig():
            before, behind = [none], [error[:n], none]
        case LqiConfig():
            before, behind = [none], [in_flight]
        case LqrConfig():
            before, behind = [in_flight, none], []
        case _:
            seen = x.copy()
            seen[config.draw_spans] = x_ref[config.draw_spans]
            before, behind = [seen, u_ref - applied, in_flight, none], []
    found = np.vstack([*before, *behind])
    asked = form.torque @ np.vstack((found, x - x_ref, x_ref, u_ref))
    # The last block before `behind` takes over what the law would have jumped by.
    end = sum(len(block) for block in before)
    found[end - n : end] = applied - asked
    return found


def _depth(config: LinearConfig | MpcConfig, states: int) -> int:
    """Torques in flight that are remembered."""
    match config:
        case PidConfig():
            return 0
        case LqiConfig() | LqrConfig():
            return states // config.n - 1
        case _:
            return states // config.n - 4

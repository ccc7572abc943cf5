"""Every linear law as matrices, for margins and for the simulation of many loops at once.

With e = y - x_ref = [T - T_ref; v - v_ref] and z the law's own state:

    u      = C z + D e + N x_ref + M u_ref
    z_next = A z + B e + L x_ref + K u_ref + E u_applied

Torques in flight and predictions are kept as they are, not as deviations: a reference that steps does not move them. It
holds for references that stand between their steps. (`Law` is what runs; a test holds the two together.)
"""

from dataclasses import dataclass

import numpy as np

from gateway.control.takeover import fade
from gateway.core.controller_laws import LqgConfig, LqiConfig, LqrConfig, MpcConfig, PidConfig, Predictor
from gateway.core.controller_schedule import LinearConfig
from gateway.core.signals import FloatArray


@dataclass(frozen=True)
class LinearForm:
    """Rows: `torque` gives u (n,), `state` and `applied` z_next (s,). Columns: [z; e; x_ref; u_ref], then u_applied."""

    n: int
    torque: FloatArray  #: (n, s + 5n)
    state: FloatArray  #: (s, s + 5n)
    applied: FloatArray  #: (s, n)

    @property
    def states(self) -> int:
        return self.state.shape[0]

    def part(self, rows: FloatArray, name: str) -> FloatArray:
        """The columns of `rows` (`torque` or `state`) that belong to "z", "e", "x_ref" or "u_ref"."""
        s, n = self.states, self.n
        begin = {"z": 0, "e": s, "x_ref": s + 2 * n, "u_ref": s + 4 * n, "end": s + 5 * n}
        names = list(begin)
        return rows[:, begin[name] : begin[names[names.index(name) + 1]]]


def without_constants(form: LinearForm) -> LinearForm:
    """The form without states that never change, such as a disturbance that no measurement corrects.

    They are modes at 1 which say nothing of stability.
    """
    states, width = form.state.shape
    constant = (form.state == np.eye(states, width)).all(axis=1) & ~form.applied.any(axis=1)
    kept = np.flatnonzero(~constant)
    columns = [*kept.tolist(), *range(states, width)]
    return LinearForm(form.n, form.torque[:, columns], form.state[kept][:, columns], form.applied[kept])


class _Signals:
    """Rows that pick a signal out of [z; e; x_ref; u_ref]."""

    def __init__(self, n: int, states: int) -> None:
        self.width = states + 5 * n
        eye = np.eye(self.width)
        self.z = eye[:states]
        self.e = eye[states : states + 2 * n]
        self.x_ref = eye[states + 2 * n : states + 4 * n]
        self.u_ref = eye[states + 4 * n :]


def linear_form(config: LinearConfig | MpcConfig) -> LinearForm:
    """The form of a law; of MPC, that of its feedback where no limit is reached. A schedule has one per speed."""
    match config:
        case PidConfig():
            return _pid(config)
        case LqrConfig():
            return _lqr(config)
        case LqiConfig():
            return _lqi(config)
        case LqgConfig():
            return _lqg(config, config.predictor, np.array(config.gain_state), np.array(config.gain_input))
        case MpcConfig():
            from gateway.control.mpc_problem import MpcProblem  # scipy, for those who use it

            gain = MpcProblem(config).gain()
            return _lqg(config, config.predictor, gain[:, : 2 * config.n], gain[:, 2 * config.n :])


def _pid(config: PidConfig) -> LinearForm:
    """z = [integral part in Nm; tension error before; its rate]"""
    n = config.n
    signals = _Signals(n, 3 * n)
    integral, before, rate = np.split(signals.z, 3)
    error, controlled = _errors(signals, config.draw_spans)
    decay = config.derivative_filter_s / (config.derivative_filter_s + config.period_s)
    rate_now = decay * rate + (error[:n] - before) / (config.derivative_filter_s + config.period_s)
    torque = signals.u_ref + integral - np.array(config.gain_proportional) @ error
    torque = torque - np.array(config.gain_derivative) @ rate_now
    integral_next = (
        integral - config.period_s * np.array(config.gain_integral) @ controlled - config.antiwindup * torque
    )
    applied = np.vstack((config.antiwindup * np.eye(n), np.zeros((2 * n, n))))
    return LinearForm(n, torque, np.vstack((integral_next, error[:n], rate_now)), applied)


def _lqr(config: LqrConfig) -> LinearForm:
    """z = [torques in flight, newest first; what was taken over]"""
    n, gain_input = config.n, np.array(config.gain_input).reshape(config.n, -1)
    depth = gain_input.shape[1] // n
    signals = _Signals(n, n * depth + n)
    sent, bump = signals.z[: n * depth], signals.z[n * depth :]
    error, _ = _errors(signals, config.draw_spans)
    in_flight = sent - np.tile(signals.u_ref, (depth, 1))
    torque = signals.u_ref - np.array(config.gain_state) @ error - gain_input @ in_flight + bump
    state = np.vstack((_shifted(sent, n), fade(config.period_s) * bump))
    return LinearForm(n, torque, state, np.vstack((_newest(n, depth), np.zeros((n, n)))))


def _lqi(config: LqiConfig) -> LinearForm:
    """z = [integral part in Nm; torques in flight, newest first]"""
    n, gain_input = config.n, np.array(config.gain_input).reshape(config.n, -1)
    depth = gain_input.shape[1] // n
    signals = _Signals(n, n + n * depth)
    integral, sent = signals.z[:n], signals.z[n:]
    error, controlled = _errors(signals, config.draw_spans)
    in_flight = sent - np.tile(signals.u_ref, (depth, 1))
    torque = signals.u_ref - np.array(config.gain_state) @ error - gain_input @ in_flight + integral
    integral_next = (
        integral - config.period_s * np.array(config.gain_integral) @ controlled - config.antiwindup * torque
    )
    applied = np.vstack((config.antiwindup * np.eye(n), _newest(n, depth)))
    return LinearForm(n, torque, np.vstack((integral_next, _shifted(sent, n))), applied)


def _lqg(config: LqgConfig | MpcConfig, model: Predictor, gain: FloatArray, gain_input: FloatArray) -> LinearForm:
    """z = [predicted state; disturbance; torques in flight, newest first; what was taken over]"""
    n, depth = config.n, len(model.inputs) - 1
    signals = _Signals(n, 4 * n + n * depth)
    predicted, disturbance_before, sent, bump = np.split(signals.z, [2 * n, 3 * n, 3 * n + n * depth])
    innovation = signals.e + signals.x_ref - predicted
    innovation[config.draw_spans] = 0.0
    state = predicted + np.array(model.gain_state) @ innovation - signals.x_ref
    disturbance = disturbance_before + np.array(model.gain_disturbance) @ innovation
    in_flight = sent + np.tile(disturbance - signals.u_ref, (depth, 1))
    torque = signals.u_ref - disturbance - gain @ state - gain_input.reshape(n, -1) @ in_flight + bump
    first, *rest = (np.array(matrix) for matrix in model.inputs)
    predicted_next = signals.x_ref + np.array(model.transition) @ state + first @ (disturbance - signals.u_ref)
    for age, matrix in enumerate(rest):
        predicted_next = predicted_next + matrix @ in_flight[n * age : n * (age + 1)]
    applied = np.vstack((first, np.zeros((n, n)), _newest(n, depth), np.zeros((n, n))))
    state_next = np.vstack((predicted_next, disturbance, _shifted(sent, n), fade(config.period_s) * bump))
    return LinearForm(n, torque, state_next, applied)


def _errors(signals: _Signals, draw_spans: list[int]) -> tuple[FloatArray, FloatArray]:
    """Rows of the errors (2n) that the law sees, and of those that it integrates (n)."""
    n = len(signals.e) // 2
    error = signals.e.copy()
    error[draw_spans] = 0.0
    controlled = error[:n].copy()
    controlled[draw_spans] = error[[n + i for i in draw_spans]]
    return error, controlled


def _shifted(sent: FloatArray, n: int) -> FloatArray:
    """Rows of the torques in flight a period later; the newest comes from what is applied."""
    return np.vstack((np.zeros((min(n, len(sent)), sent.shape[1])), sent[:-n]))


def _newest(n: int, depth: int) -> FloatArray:
    return np.eye(n * depth, n)

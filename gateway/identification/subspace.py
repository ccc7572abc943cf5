"""The line as a linear model found without knowing its equations, and its parameters read from that model.

MOESP with past data and set-points as instruments (`moesp`). Tensions and speeds are measured, so that the order is 2n,
C is invertible, and y itself is the state: A and B in that basis are the sampled equations of `web_model.linearise`,
whose matrix logarithm is continuous. f/J, R/J, EA/L and 1/L are entries of it. R^2/J, too weak there, shows in the mean
balance of torques, which linearising around the mean has taken out of the data.

From 5 s of experiment on six spans it reads f/J and R/J to 0.2 % and EA/L to 0.4 % where rollers share them, 0.4 and
1.1 % where they do not; a third of the latter is bias, since there are nearly as many instruments as samples. Intervals
are up to twice as wide as need be. That is two to five times worse than regressions on the known equations get from the
same data. What the method is good for is the order, by the singular values, and poles that owe nothing to equations.
"""

from dataclasses import dataclass
from math import floor

import numpy as np
from scipy.linalg import logm

from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.signals import BoolArray, FloatArray
from gateway.core.theta import Noise
from gateway.core.web_model import nominal_model
from gateway.identification.combinations import ROLLER, Evidence, fit
from gateway.identification.estimate import Estimate, Structure
from gateway.identification.moesp import Hankel, StateSpace, Stretch, hankel, moesp

METHOD = "subspace"
BLOCK_ROWS = 4
ASSUMED = Noise()
_PARTS = 10  #: of the jackknife
_MOVES = 2.0  #: times its own noise, from which on the unwinder's speed is an input


@dataclass(frozen=True)
class Identified:
    """The model of a recording. The state of A and B is [T_1 .. T_n, v_1 .. v_n], in deviations from its mean."""

    model: StateSpace  #: sampled, of scaled deviations; inputs [m_1 .. m_n], and v_0 where it moves
    A: FloatArray  #: (2n, 2n), continuous, SI
    B: FloatArray  #: (2n, n) or (2n, n+1)


@dataclass(frozen=True)
class _Data:
    """A recording, ready: rows are periods, columns T and v, in SI."""

    columns: Hankel
    before: FloatArray  #: (r, 2n), samples
    after: FloatArray  #: (r, 2n), a period later
    inputs: FloatArray  #: (r, m), what acts between them
    unwind_m_per_s: FloatArray  #: (r,)
    stretches: int
    output_scale: FloatArray  #: (2n,)
    input_scale: FloatArray  #: (m,)


def identified_by_subspace(line: Line, recording: Recording, block_rows: int = BLOCK_ROWS) -> Identified:
    """The linear model around the recording's mean.

    Raises ValueError for a recording of another line or period, with a span without load cell, without set-points that
    move, or too short.
    """
    data = _data(line, recording, block_rows)
    return _identified(data, *_kept(data, None), line.control.period_s)


def estimated_by_subspace(
    line: Line, recording: Recording, noise: Noise = ASSUMED, *, per_roller: bool = False, block_rows: int = BLOCK_ROWS
) -> Estimate:
    """The line's parameters. Raises ValueError as `identified_by_subspace` does.

    Covariance and first-order bias of the model's entries are those of a jackknife that leaves out a tenth at a time;
    the covariance is taken to be the same for all rollers, and for all spans.
    """
    data = _data(line, recording, block_rows)
    period_s = line.control.period_s
    whole = _identified(data, *_kept(data, None), period_s)
    parts = [_identified(data, *_kept(data, part), period_s) for part in range(_PARTS)]
    rollers = _jackknifed(np.array([_roller_entries(found, line.n) for found in (whole, *parts)]))
    spans = _jackknifed(np.array([_span_entries(found, line.n) for found in (whole, *parts)]))
    balance = _Balance(line, data, noise)
    evidence = Evidence(*balance.of_rollers(*rollers), *balance.of_spans(*spans))
    structure = Structure(per_roller=per_roller)
    found = fit(line, structure, evidence)
    return Estimate(METHOD, structure, found.theta, None, found.intervals, recording.samples)


def _data(line: Line, recording: Recording, block_rows: int) -> _Data:
    n, period_s, source = line.n, line.control.period_s, recording.source
    if (recording.n, recording.period_s) != (n, period_s):
        raise ValueError(
            f"{source}: has {recording.n} spans at a period of {recording.period_s:g} s; "
            f"the line has {n} at {period_s:g} s"
        )
    without = np.flatnonzero(np.isnan(recording.tension_n).all(axis=0))
    if without.size:
        raise ValueError(f"{source}: span {without[0] + 1} has no load cell; subspace needs every tension")
    late = line.control.latency_s / period_s
    lost = floor(late) + (late > floor(late))
    parts = [part for part in recording.stretches(2) if part.samples > lost + 2 * block_rows]
    if not parts:
        raise ValueError(f"{source}: no stretch of known samples under control is {lost + 2 * block_rows + 1} long")
    unwind = np.concatenate([part.unwind_speed_m_per_s[lost:] for part in parts])
    moves = bool(np.std(unwind) > _MOVES * np.std(np.diff(unwind)) / np.sqrt(2.0))
    stretches = [_stretch(part, late, lost, moves) for part in parts]
    scaled, output_scale, input_scale = _scaled(stretches)
    if not scaled[0].references.size:
        raise ValueError(f"{source}: no set-point moves; in a closed loop nothing else tells cause from effect")
    return _Data(
        columns=hankel(scaled, block_rows),
        before=np.vstack([x.outputs[:-1] for x in stretches]),
        after=np.vstack([x.outputs[1:] for x in stretches]),
        inputs=np.vstack([x.inputs[:-1] for x in stretches]),
        unwind_m_per_s=np.concatenate([part.unwind_speed_m_per_s[lost:-1] for part in parts]),
        stretches=len(stretches),
        output_scale=output_scale,
        input_scale=input_scale,
    )


def _stretch(part: Recording, late: float, lost: int, moves: bool) -> Stretch:
    """Torques as they act, from their sample to the next; the unwinder is part of the outside."""
    share, whole = late - floor(late), floor(late)
    torque, k = part.torque_nm, np.arange(lost, part.samples)
    acting = torque[k - whole] if share == 0.0 else (1.0 - share) * torque[k - whole] + share * torque[k - whole - 1]
    outside = part.unwind_speed_m_per_s[lost:, None][:, : int(moves)]
    return Stretch(
        np.hstack((part.tension_n[lost:], part.speed_m_per_s[lost:])),
        np.hstack((acting, outside)),
        np.hstack((part.tension_setpoint_n[lost:], outside)),
    )


def _scaled(stretches: list[Stretch]) -> tuple[list[Stretch], FloatArray, FloatArray]:
    """Deviations from the mean of all, over their spread, (p,) and (m,). References that do not move are left out."""
    outputs, inputs, references = (
        np.vstack([getattr(x, name) for x in stretches]) for name in ("outputs", "inputs", "references")
    )
    asked = references.std(axis=0) > 0.0

    def scaled(values: FloatArray, of_all: FloatArray) -> FloatArray:
        return (values - of_all.mean(axis=0)) / of_all.std(axis=0)

    found = [
        Stretch(
            scaled(x.outputs, outputs), scaled(x.inputs, inputs), scaled(x.references[:, asked], references[:, asked])
        )
        for x in stretches
    ]
    return found, outputs.std(axis=0), inputs.std(axis=0)


def _kept(data: _Data, part: int | None) -> tuple[BoolArray, BoolArray]:
    """Instants and periods without one of the parts; None: all."""
    masks: list[BoolArray] = []
    for count in (data.columns.inputs.shape[1], len(data.before)):
        mask = np.ones(count, dtype=np.bool_)
        if part is not None:
            mask[part * count // _PARTS : (part + 1) * count // _PARTS] = False
        masks.append(mask)
    return masks[0], masks[1]


def _identified(data: _Data, instants: BoolArray, periods: BoolArray, period_s: float) -> Identified:
    """B comes from the periods, given A: what acts answers no sample that its error depends on."""
    states = len(data.output_scale)
    model = moesp(data.columns.only(instants), states, states)
    basis = data.output_scale[:, None] * model.C
    A = basis @ model.A @ np.linalg.inv(basis)
    error = (data.after - data.before @ A.T)[periods]
    regressors = np.column_stack((data.inputs, np.ones(len(data.inputs))))[periods]
    B = np.linalg.lstsq(regressors, error, rcond=None)[0][:-1].T
    m = B.shape[1]
    sampled = np.block([[A, B], [np.zeros((m, states)), np.eye(m)]])
    continuous = logm(sampled) / period_s
    if np.abs(np.imag(continuous)).max() > 1e-6 * np.abs(continuous).max():
        raise ValueError("the model found has poles that no line has: the data are too few or too noisy")
    continuous = np.real(continuous)
    return Identified(model, continuous[:states, :states], continuous[:states, states:])


def _roller_entries(found: Identified, n: int) -> FloatArray:
    """(n, 3): f/J, R/J, R^2/J."""
    A, B, own = found.A, found.B, np.arange(n)
    return np.stack((-A[n + own, n + own], B[n + own, own], -A[n + own, own]), axis=1)


def _span_entries(found: Identified, n: int) -> FloatArray:
    """(n, 4): of dT_i/dt by v_i, by T_i, by v_{i-1} and by T_{i-1}; NaN where there is none."""
    A, own = found.A, np.arange(n)
    up = own[1:] - 1
    entries = np.full((n, 4), np.nan)
    entries[:, 0], entries[:, 1] = A[own, n + own], A[own, own]
    entries[1:, 2], entries[1:, 3] = A[own[1:], n + up], A[own[1:], up]
    return entries


def _jackknifed(entries: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Entries (n, e) without their first-order bias, and their covariance (e, e), of the whole and its parts."""
    whole, parts = entries[0], entries[1:]
    mean = parts.mean(axis=0)
    off = parts - mean
    full = np.isfinite(whole).all(axis=1)
    rows = off[:, full] if full.any() else np.nan_to_num(off)
    covariance = (_PARTS - 1) / _PARTS * np.einsum("gie,gif->ef", rows, rows) / rows.shape[1]
    return _PARTS * whole - (_PARTS - 1) * mean, covariance


class _Balance:
    """Mean balance of torque and of web, beside the entries of the model."""

    def __init__(self, line: Line, data: _Data, noise: Noise) -> None:
        n = line.n
        model = nominal_model(line)
        state, self._change = 0.5 * (data.before + data.after), (data.after - data.before) / line.control.period_s
        ones = np.ones((len(state), 1))
        self._tension = np.hstack((model.tension_before_n * ones, state[:, :n], model.tension_after_n * ones))
        self._speed = np.hstack((data.unwind_m_per_s[:, None], state[:, n:]))
        self._torque = data.inputs[:, :n]
        self._stretches, self._time_s, self._noise = data.stretches, len(state) * line.control.period_s, noise
        self._n = n

    def of_rollers(self, entries: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normal equations (n, 4, 4) and (n, 4) of f/J, R/J, R^2/J; the fourth is not seen."""
        n = self._n
        terms = np.stack((-self._speed[:, 1:], self._torque, np.diff(self._tension[:, 1:], axis=1)), axis=2)
        change = self._change[:, n:]
        variance = _variance(change - np.einsum("kij,ij->ki", terms[:, :, :2], entries[:, :2]))
        rows = np.zeros((n, 4, ROLLER))
        rows[:, :3, :3] = np.eye(3)
        rows[:, 3, :3] = terms.mean(axis=0)
        values = np.column_stack((entries, change.mean(axis=0)))
        return _normal(rows, values, covariance, variance)

    def of_spans(self, entries: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normal equations (n, 2, 2) and (n, 2) of EA/L and 1/L."""
        n, tension, speed = self._n, self._tension.mean(axis=0), self._speed.mean(axis=0)
        flow = self._tension[:, :-1] * self._speed
        taken = flow[:, :-1] - self._tension[:, 1:-1] * self._speed[:, 1:]
        stretch, change = np.diff(self._speed, axis=1), self._change[:, :n]
        # Of tensions at the ends, and of the speeds of two rollers all along.
        ends = 2.0 * self._stretches * (self._noise.tension_n / self._time_s) ** 2
        variance = ends + 2.0 * (float(entries[:, 0].mean()) * self._noise.speed_m_per_s) ** 2 / len(self._change)
        one, none = np.ones(n), np.zeros(n)
        rows = np.stack(
            [
                np.stack((one, -tension[1:-1]), axis=1), np.stack((none, -speed[1:]), axis=1),
                np.stack((-one, tension[:-2]), axis=1), np.stack((none, speed[:-1]), axis=1),
                np.stack((stretch.mean(axis=0), taken.mean(axis=0)), axis=1),
            ],
            axis=1,
        )  # fmt: skip
        return _normal(rows, np.column_stack((entries, change.mean(axis=0))), covariance, variance)


def _variance(residuals: FloatArray) -> float:
    """Of the mean of residuals (k, n) over all k, from how the means of tenths vary."""
    means = np.array([part.mean(axis=0) for part in np.array_split(residuals, _PARTS)])
    return float(means.var(axis=0, ddof=1).mean()) / _PARTS


def _normal(
    rows: FloatArray, values: FloatArray, covariance: FloatArray, variance: float
) -> tuple[FloatArray, FloatArray]:
    """Of `values` (n, e+1) = `rows` (n, e+1, c) times combinations; the last, a balance, has its own variance."""
    n, _, columns = rows.shape
    information, moment = np.zeros((n, columns, columns)), np.zeros((n, columns))
    for i in range(n):
        there = np.isfinite(values[i, :-1])
        weight = np.zeros((there.sum() + 1, there.sum() + 1))
        weight[:-1, :-1] = np.linalg.inv(covariance[np.ix_(there, there)])
        weight[-1, -1] = 1.0 / variance
        keep = np.append(there, True)
        weighted = rows[i, keep].T @ weight
        information[i], moment[i] = weighted @ rows[i, keep], weighted @ values[i, keep]
    return information, moment

"""Subspace identification of a linear model from its inputs and outputs, by QR: MOESP with instruments."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gateway.core.signals import BoolArray, FloatArray


@dataclass(frozen=True)
class Stretch:
    """Samples in a row."""

    outputs: FloatArray  #: (k, p)
    inputs: FloatArray  #: (k, m), which act from their sample to the next
    references: FloatArray  #: (k, q), what moves the loop from outside: set-points. (k, 0): there is no loop


@dataclass(frozen=True)
class StateSpace:
    """x_{k+1} = A x_k + B u_k, y_k = C x_k + D u_k, in a basis without meaning."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    singular_values: FloatArray  #: descending; the order is where they fall


@dataclass(frozen=True)
class Hankel:
    """Columns of data, of one instant each: what of them the identification needs."""

    inputs: FloatArray  #: (s m, N), of the s samples from the instant on
    outputs: FloatArray  #: (s p, N)
    instruments: FloatArray  #: (r, N)
    block_rows: int  #: s

    def only(self, keep: BoolArray) -> "Hankel":
        """Some of the instants, by a mask (N,)."""
        return Hankel(self.inputs[:, keep], self.outputs[:, keep], self.instruments[:, keep], self.block_rows)


def hankel(stretches: Sequence[Stretch], block_rows: int) -> Hankel:
    """Past and future of `block_rows` samples each, around every instant that has both.

    Raises ValueError when there are fewer instants than instruments: a longer recording or fewer block rows help.
    """
    s = block_rows
    parts = [_columns(stretch, s) for stretch in stretches if len(stretch.inputs) >= 2 * s]
    if not parts:
        raise ValueError(f"no stretch of data is {2 * s} samples long, as {s} block rows need it")
    found = Hankel(*(np.hstack(rows) for rows in zip(*parts, strict=True)), block_rows=s)
    rows, instants = found.instruments.shape
    if instants < 1.5 * rows:
        raise ValueError(f"{instants} instants are too few for {s} block rows, which need {round(1.5 * rows)}")
    return found


def _columns(stretch: Stretch, s: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    inputs, outputs = _stacked(stretch.inputs, 2 * s), _stacked(stretch.outputs, 2 * s)
    m, p = s * stretch.inputs.shape[1], s * stretch.outputs.shape[1]
    outside = _stacked(stretch.references, 2 * s) if stretch.references.size else inputs[m:]
    return inputs[m:], outputs[p:], np.vstack((outside, inputs[:m], outputs[:p]))


def _stacked(values: FloatArray, rows: int) -> FloatArray:
    """(rows * m, k - rows + 1)"""
    count = len(values) - rows + 1
    return np.vstack([values[row : row + count].T for row in range(rows)])


def moesp(data: Hankel, order: int, outputs: int) -> StateSpace:
    """The model of an order (at most (s - 1) p) for p `outputs`.

    Future outputs are Gamma x + H u, plus noise that is correlated with none of the instruments. Projected on these,
    the noise is gone; what is orthogonal to the projected inputs has Gamma's range. Without references the instruments
    are past inputs and outputs and the inputs themselves: PO-MOESP (Verhaegen 1994, Automatica 30). In a closed loop
    the inputs answer the noise, so that they may not be among their own instruments: references take their place
    (Chou and Verhaegen 1997, Automatica 33, for errors in variables and closed loops).
    """
    basis, _ = np.linalg.qr(data.instruments.T)
    rows = len(data.inputs)
    lower: FloatArray = np.linalg.qr((np.vstack((data.inputs, data.outputs)) @ basis).T)[1].T
    ranges, values, _ = np.linalg.svd(lower[rows:, rows:])
    gamma, beside = ranges[:, :order], ranges[:, order:]
    C = gamma[:outputs]
    A = np.linalg.lstsq(gamma[:-outputs], gamma[outputs:], rcond=None)[0]
    H: FloatArray = np.linalg.solve(lower[:rows, :rows].T, lower[rows:, :rows].T).T.astype(np.float64)
    B, D = _inputs(gamma, beside, beside.T @ H, outputs, data.block_rows)
    return StateSpace(A, B, C, D, values)


def _inputs(
    gamma: FloatArray, beside: FloatArray, response: FloatArray, outputs: int, s: int
) -> tuple[FloatArray, FloatArray]:
    """B and D, of which beside' H is a linear function: block column j is beside'[j:] [D; Gamma[: s - j - 1] B]."""
    m, p = response.shape[1] // s, outputs
    equations: list[FloatArray] = []
    for j in range(s):
        of_b = beside[(j + 1) * p :].T @ gamma[: (s - j - 1) * p]
        equations.append(np.hstack((beside[j * p : (j + 1) * p].T, of_b)))
    wanted = np.vstack([response[:, j * m : (j + 1) * m] for j in range(s)])
    found: FloatArray = np.linalg.lstsq(np.vstack(equations), wanted, rcond=None)[0].astype(np.float64)
    return found[p:], found[:p]

"""Least squares of rows whose errors are a moving average of the first order, with a prior on one coefficient."""

from math import inf, isnan

import numpy as np
from scipy.signal import lfilter

from gateway.core.signals import FloatArray

COLOURS = (0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.75, 0.85, 0.9, 0.94, 0.97, 0.98, 0.99, 0.995)
VAGUE_S = 0.1  #: standard deviation of the prior of a span's leads: what nothing is known of stays near 0


def least_known(cost: float) -> float:
    """The cost, to be minimised: infinite where it is no number."""
    return inf if isnan(cost) else float(cost)


class Solved:
    """Least squares of coloured rows with a prior on one coefficient `weak` = (column, mean, standard deviation)."""

    def __init__(
        self, y: list[FloatArray], table: list[FloatArray], weak: tuple[int, float, float], colour: float | None
    ) -> None:
        self.y, self.table, self.weak = y, table, weak
        colours = COLOURS if colour is None else (colour,)
        # What is no number is never the least: of tuples it would be, where it comes first.
        self.cost, self.colour = min((least_known(self._at(c)[2]), c) for c in colours)
        self.solution, self.rows, _ = self._at(self.colour)
        self.p = table[0].shape[1]
        self.coefficients = self.solution[: self.p]
        self.innovation = self.rows[1] - self.rows[0] @ self.solution
        count = sum(map(len, y))
        self.variance = max(float(np.sum(self.innovation[:count] ** 2)) / max(count - len(self.solution), 1), 1e-300)
        self.covariance = self._inverse(self.rows[0])[: self.p, : self.p]

    def residuals(self) -> list[FloatArray]:
        return [a - b @ self.coefficients for a, b in zip(self.y, self.table, strict=True)]

    def along(self, slopes: list[FloatArray]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gradient and information of what moves the first column by `slopes`, coefficients unknown; and the
        coefficients' covariance while this is unknown."""
        A = self.rows[0]
        extra = coloured([self.coefficients[0] * s for s in slopes], self.colour)
        extra = np.vstack((extra, np.zeros((len(A) - len(extra), extra.shape[1]))))
        Q, _ = np.linalg.qr(A)
        apart = extra - Q @ (Q.T @ extra)
        information = apart.T @ apart / self.variance
        width = np.sqrt(self.variance) / VAGUE_S
        wide = np.block([[A, extra], [np.zeros((extra.shape[1], A.shape[1])), width * np.eye(extra.shape[1])]])
        return apart.T @ self.innovation / self.variance, information, self._inverse(wide)[: self.p, : self.p]

    def _at(self, colour: float) -> tuple[FloatArray, tuple[FloatArray, FloatArray], float]:
        A = coloured(self.table, colour)
        first = np.zeros((len(A), len(self.y)))  # the error before each stretch's first row
        begin = 0
        for j, part in enumerate(self.y):
            first[begin : begin + len(part), j] = colour ** np.arange(len(part))
            begin += len(part)
        A = np.hstack((A, first)) if colour > 0.0 else A
        b = coloured([part[:, None] for part in self.y], colour)[:, 0]
        free = np.linalg.lstsq(A, b, rcond=None)[0]
        sigma = float(np.sqrt(np.mean((b - A @ free) ** 2))) + 1e-150
        column, mean, deviation = self.weak
        prior = np.zeros(A.shape[1])
        prior[column] = sigma / deviation
        A, b = np.vstack((A, prior)), np.append(b, mean * prior[column])
        solution: FloatArray = np.asarray(np.linalg.lstsq(A, b, rcond=None)[0], dtype=np.float64)
        return solution, (A, b), float(np.sum((b - A @ solution) ** 2))

    def _inverse(self, A: FloatArray) -> FloatArray:
        scale = np.sqrt(np.sum(A**2, axis=0)) + 1e-150  # columns differ by orders of magnitude
        return np.linalg.pinv((A / scale).T @ (A / scale), rcond=1e-13) * self.variance / np.outer(scale, scale)


def coloured(parts: list[FloatArray], colour: float) -> FloatArray:
    """Rows of all stretches, each divided by 1 - c q^-1, one below the other."""
    return np.vstack([lfilter([1.0], [1.0, -colour], part, axis=0) for part in parts])

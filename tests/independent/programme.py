"""The exact solution of a strictly convex quadratic programme, with the proof that it is: the conditions of Karush,
Kuhn and Tucker, which only one point meets.
"""

import numpy as np

from gateway.core.signals import FloatArray

NEAR = 1e-6  #: Nm and N: a row this near its limit is taken to be active, and none is farther beyond


class NotProven(Exception):
    """What was given is too far from the solution to say which rows are active."""


def exact(
    P: FloatArray, q: FloatArray, A: FloatArray, lower: FloatArray, upper: FloatArray, near: FloatArray
) -> FloatArray:
    """z (v,) that minimises 1/2 z' P z + q' z with lower <= A z <= upper; `near` says which rows are active, no more.

    Raises NotProven where they are not.
    """
    rows = A @ near
    below, above = rows - lower < NEAR, upper - rows < NEAR
    active = np.flatnonzero(below | above)
    C, limits = A[active], np.where(below, lower, upper)[active]
    system = np.block([[P, C.T], [C, np.zeros((len(active), len(active)))]])
    asked = np.concatenate((-q, limits))
    found = np.linalg.solve(system, asked)
    found += np.linalg.solve(system, asked - system @ found)
    z, pushes = found[: len(q)], found[len(q) :]
    rows = A @ z
    beyond = float(np.maximum(lower - rows, rows - upper).max())
    wrong = np.where(below[active], pushes, -pushes)  # a limit pushes to the inside
    if beyond > NEAR or (len(active) and float(wrong.max()) > 1e-9):
        raise NotProven(f"{beyond:.1e} beyond a limit; {len(active)} active rows, of which one pulls")
    return z

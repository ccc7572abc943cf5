"""A fallback in closed loop with the accepted model near one speed, as products from what is known now. Pure.

With s = [x~; u~ in flight; z] as safety/recoverability.py has it,

    u = K s + c,    s_next = A s + B u + d

where s at the next sample, c and d follow from q = [x; in flight; u; x_eq; u_eq; x_ref; u_ref] of now, and z where the
fallback runs already, by one matrix; and so do tensions, speeds and torques at every look over the horizon.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.control.engagement import engagement
from gateway.control.linear_form import LinearForm, linear_form
from gateway.control.sampled import Sampled
from gateway.core.controller_laws import MpcConfig
from gateway.core.controller_schedule import LinearConfig
from gateway.core.deployment import RecoveryNode
from gateway.core.signals import FloatArray


@dataclass(frozen=True)
class Way:
    """From q (with z behind it where the fallback runs already): where everything goes."""

    begin: FloatArray  #: (2 s + n, q), [s; d; c]
    states: FloatArray  #: (2n k, q), tensions, then speeds, of each at every look
    torques: FloatArray  #: (n k, q), asked for, likewise


@dataclass(frozen=True)
class ClosedLoop:
    """The fallback in closed loop with the model near one speed."""

    B: FloatArray  #: (s, n)
    K: FloatArray  #: (n, s)
    period: FloatArray  #: (s + n, s + n), [A B; K A, K B]: from [s; u] to the next s and what it asks for, less c and d
    onward: Way  #: from [s; B c + d]: tensions and speeds away from equilibrium, torques less c
    taking_over: Way
    running: Way


def closed_loop(node: RecoveryNode, law: LinearConfig | MpcConfig, looks: NDArray[np.int64]) -> ClosedLoop:
    """Near the node's speed. `looks` (k,): periods after the next sample at which it is looked."""
    form = linear_form(law)
    F, G = Sampled(np.array(node.transition), [np.array(matrix) for matrix in node.inputs]).augmented()
    physical, n = G.shape
    size = physical + form.states
    A, B, K = np.zeros((size, size)), np.vstack((G, form.applied)), np.zeros((n, size))
    A[:physical, :physical] = F
    A[physical:, : 2 * n] = form.part(form.state, "e")
    A[physical:, physical:] = form.part(form.state, "z")
    K[:, : 2 * n] = form.part(form.torque, "e")
    K[:, physical:] = form.part(form.torque, "z")
    taking_over, running = (_beginning(law, form, F, G, remembers) for remembers in (False, True))
    eye, none = np.eye(size, 2 * size), np.zeros((n, 2 * size))
    closed = A + B @ K
    onward = _way(closed, K, (eye, np.eye(size, 2 * size, size), none, none[:1]), eye[:0], looks)
    return ClosedLoop(
        B, K, np.block([[A, B], [K @ A, K @ B]]), onward,
        *(_way(closed, K, (s, B @ c + d, c, x_eq), np.vstack((s, d, c)), looks)
          for s, d, c, x_eq in (taking_over, running)),
    )  # fmt: skip


def _beginning(
    law: LinearConfig | MpcConfig, form: LinearForm, F: FloatArray, G: FloatArray, remembers: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """[s; d; c] and x_eq as rows on q."""
    (physical, n), kept = G.shape, form.states if remembers else 0
    depth = physical // n - 2
    lengths = [2 * n, depth * n, n, 2 * n, n, 2 * n, n, kept]
    x, sent, u, x_eq, u_eq, x_ref, u_ref, z = np.split(np.eye(sum(lengths)), np.cumsum(lengths)[:-1])
    away = np.vstack((x - x_eq, sent - np.tile(u_eq, (depth, 1))))
    away = F @ away + G @ (u - u_eq)
    if not remembers:
        z = engagement(law, form) @ np.vstack((away[: 2 * n] + x_eq, x_ref, u_ref, u))
    given = np.vstack((x_eq - x_ref, x_ref, u_ref))  # what of the law's inputs does not change from now on
    c, into_z = (rows[:, form.states :] @ given for rows in (form.torque, form.state))
    return np.vstack((away, z)), np.vstack((-G @ u_eq, into_z)), c, x_eq


def _way(
    closed: FloatArray,
    K: FloatArray,
    beginning: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    begin: FloatArray,
    looks: NDArray[np.int64],
) -> Way:
    """What s_next = closed s + driven, u = K s + c come to at each look. `beginning`: s, driven, c and x_eq."""
    s, driven, c, x_eq = beginning
    physical, wanted = 2 * len(K), set(looks.tolist())
    states: list[FloatArray] = []
    torques: list[FloatArray] = []
    for k in range(int(looks[-1]) + 1):
        if k in wanted:
            states.append(s[:physical] + x_eq)
            torques.append(K @ s + c)
        s = closed @ s + driven
    width = s.shape[1]
    return Way(begin, np.stack(states, axis=1).reshape(-1, width), np.stack(torques, axis=1).reshape(-1, width))

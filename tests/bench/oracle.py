"""The oracle: the least RMSE that any controller could reach, by direct transcription.

It knows the plant exactly and there is no noise; limits, sampling and latency are those of the loop, and it learns of
the change at the sample at which it happens. Sequential quadratic programming over the torques of every period: the
nonlinear equations are integrated by RK4 at 1 ms, their derivatives with them, and each quadratic programme is solved
by an interior-point method. The RMSE is that of the torques found, on the simulated line's own integrator.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import clarabel
import numpy as np
import piqp
from numpy.typing import NDArray
from scipy.sparse import block_diag, coo_matrix, csc_matrix, eye, hstack, triu, vstack

from gateway.core.scenario import Scenario
from sim_plant.physics import STEP_S, WebParameters, equilibrium, integrate

FloatArray = NDArray[np.float64]
LOOKED_AT_S, LOOKED_AT_PERIODS = 5.0, 1500  #: from the change on, the shorter; behind it the line is at rest
ITERATIONS = 12
CLOSE = 1e-6  #: a relative change of the squared error below this ends the iterations


@dataclass(frozen=True)
class Terms:
    """What the oracle keeps to."""

    period_s: float
    latency_s: float
    torque_nm: float
    torque_rate_nm_per_s: float
    tension_n: tuple[float, float] = (2.0, 60.0)

    @property
    def steps(self) -> int:
        return round(self.period_s / STEP_S)

    @property
    def delay(self) -> int:
        """Periods from a sample to its torque; a whole number here."""
        return round(self.latency_s / self.period_s)


@dataclass(frozen=True)
class Oracle:
    rmse_n: float  #: over the whole case
    torque_nm: FloatArray  #: (k, n), from the change on
    tension_n: FloatArray  #: (m, n), every millisecond from the change on
    iterations: int
    change: float  #: of the squared error in the last iteration, relative


Solver = Callable[[csc_matrix, FloatArray, csc_matrix, FloatArray, csc_matrix, FloatArray, FloatArray], FloatArray]


def oracle(case: Scenario, plant: WebParameters, terms: Terms, solve: Solver | None = None) -> Oracle:
    """The oracle of `case` on `plant`. `solve` solves the quadratic programmes (default: by piqp)."""
    solve = solve or by_piqp
    n = plant.n
    before_n, after_n = np.array(case.tension_n), np.array(case.tension_end_n)
    speed, rest = equilibrium(plant, before_n, case.speed_m_per_s)
    unwind = case.speed_end_m_per_s
    _, wanted = equilibrium(plant, after_n, unwind)
    start = np.concatenate((before_n, speed))
    periods = min(round(LOOKED_AT_S / terms.period_s), LOOKED_AT_PERIODS)
    free = periods - terms.delay  # the torques before are those from before the change
    torque = np.vstack((np.tile(rest, (terms.delay, 1)), _ramp(rest, wanted, free, terms)))
    tension, before, change, iterations = np.empty((0, n)), np.inf, np.inf, 0
    while change > CLOSE and iterations < ITERATIONS:
        programme = _programme(plant, start, torque, after_n, unwind, rest, terms)
        torque[terms.delay :] += solve(*programme)[: free * n].reshape(free, n)
        tension = simulated(plant, start, torque, unwind, terms)
        error = float(np.sum((tension - after_n) ** 2))
        change, before, iterations = abs(before - error) / error, error, iterations + 1
    total = before + float(np.sum((before_n - after_n) ** 2))  # and the change's own sample
    samples = round(case.duration_s / STEP_S) + 1
    assert case.change_at_s + LOOKED_AT_S < case.duration_s
    return Oracle(float(np.sqrt(total / samples)), torque, tension, iterations, change)


def simulated(
    plant: WebParameters, start: FloatArray, torque_nm: FloatArray, unwind: float, terms: Terms
) -> FloatArray:
    """Tensions (m, n) every millisecond under torques (k, n), one a period, on the simulated line's integrator."""
    n, state, rows = plant.n, start.copy(), []
    inputs, none = np.zeros((3, n + 1)), np.zeros((terms.steps, n))
    for torque in torque_nm:
        inputs[:2] = np.append(torque, unwind)
        trace = np.empty((terms.steps, 3 * n + 1))
        integrate(plant.coefficients(), plant.boundary_n(), state, inputs, none, trace)
        rows.append(trace[:, :n].copy())
    return np.vstack(rows)


def _ramp(begin: FloatArray, end: FloatArray, periods: int, terms: Terms) -> FloatArray:
    """A first guess that keeps the rate: straight to the torques of the new equilibrium."""
    most = terms.torque_rate_nm_per_s * terms.period_s * np.arange(1, periods + 1)[:, None]
    return begin + np.clip(end - begin, -most, most)


def _programme(
    plant: WebParameters, start: FloatArray, torque: FloatArray, wanted: FloatArray, unwind: float, rest: FloatArray,
    terms: Terms,
) -> tuple[csc_matrix, FloatArray, csc_matrix, FloatArray, csc_matrix, FloatArray, FloatArray]:  # fmt: skip
    """P, q, A, b, G, lower, upper of: min 1/2 z'Pz + q'z, A z = b, lower <= G z <= upper.

    z = [changes of the free torques; changes of the state at the end of each period].
    """
    n, periods = plant.n, len(torque)
    width, free = 2 * n, periods - terms.delay
    costs: list[FloatArray] = []
    gradients = np.zeros(free * n + periods * width)
    rows: list[Any] = []
    cross: list[tuple[int, int, FloatArray]] = []  # blocks of P: row, column, values
    state = start.copy()
    ends = np.empty((periods, width))
    at_state = [free * n + width * k for k in range(periods)]  # of the state at the end of period k
    for k in range(periods):
        u = k - terms.delay
        S, R = np.eye(width), np.zeros((width, n))
        Q = np.zeros((width + n, width + n))
        g = np.zeros(width + n)
        for _ in range(terms.steps):
            state, F, G = rk4_with_derivative(plant, state, torque[k], unwind)
            S, R = F @ S, F @ R + G
            seen = np.hstack((S[:n], R[:n]))
            Q += 2.0 * seen.T @ seen
            g += 2.0 * seen.T @ (state[:n] - wanted)
        ends[k] = state
        costs.append(Q)
        places = []
        if k:
            places.append((at_state[k - 1], slice(0, width)))
        if u >= 0:
            places.append((u * n, slice(width, width + n)))
        for place, part in places:
            gradients[place : place + g[part].size] += g[part]
            for other, part2 in places:
                cross.append((place, other, Q[part, part2]))
        blocks = [(at_state[k], -np.eye(width))]
        if k:
            blocks.append((at_state[k - 1], S))
        if u >= 0:
            blocks.append((u * n, R))
        rows.append(blocks)
    size = free * n + periods * width
    P = _assembled([(r, c, m) for r, c, m in cross], (size, size))
    A = _assembled([(k * width, c, m) for k, blocks in enumerate(rows) for c, m in blocks], (periods * width, size))
    # Torque, its change from period to period, and the tensions at the end of each period.
    before = np.vstack((rest if terms.delay == 0 else torque[terms.delay - 1], torque[terms.delay :]))
    change = eye(free * n) - eye(free * n, k=-n)
    pick = block_diag([np.eye(n, width)] * periods)
    limits = vstack(
        (
            hstack((eye(free * n), csc_matrix((free * n, periods * width)))),
            hstack((change, csc_matrix((free * n, periods * width)))),
            hstack((csc_matrix((periods * n, free * n)), pick)),
        ),
        format="csc",
    )
    reach = terms.torque_rate_nm_per_s * terms.period_s
    given, steps = torque[terms.delay :].ravel(), np.diff(before, axis=0).ravel()
    # Before its own torques act the oracle cannot hold a tension within anything.
    least = np.where(np.arange(periods) < terms.delay, -1e3, terms.tension_n[0])[:, None] - ends[:, :n]
    most = np.where(np.arange(periods) < terms.delay, 1e3, terms.tension_n[1])[:, None] - ends[:, :n]
    lower = np.concatenate((-terms.torque_nm - given, -reach - steps, least.ravel()))
    upper = np.concatenate((terms.torque_nm - given, reach - steps, most.ravel()))
    regular = 1e-9 * eye(size)
    return csc_matrix(P + regular), gradients, A, np.zeros(periods * width), csc_matrix(limits), lower, upper


def rk4_with_derivative(
    plant: WebParameters, state: FloatArray, torque_nm: FloatArray, unwind: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The state (2n,) a millisecond later, and its derivatives to the state (2n, 2n) and to the torque (2n, n)."""
    n, h = plant.n, STEP_S
    B = np.vstack((np.zeros((n, n)), np.diag(plant.radius_m / plant.inertia_kg_m2)))
    one = np.eye(2 * n)
    k1, A1 = _rate(plant, state, torque_nm, unwind)
    k2, A2 = _rate(plant, state + 0.5 * h * k1, torque_nm, unwind)
    k3, A3 = _rate(plant, state + 0.5 * h * k2, torque_nm, unwind)
    k4, A4 = _rate(plant, state + h * k3, torque_nm, unwind)
    S1, R1 = A1, B
    S2, R2 = A2 @ (one + 0.5 * h * S1), A2 @ (0.5 * h * R1) + B
    S3, R3 = A3 @ (one + 0.5 * h * S2), A3 @ (0.5 * h * R2) + B
    S4, R4 = A4 @ (one + h * S3), A4 @ (h * R3) + B
    following = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return following, one + h / 6.0 * (S1 + 2.0 * S2 + 2.0 * S3 + S4), h / 6.0 * (R1 + 2.0 * R2 + 2.0 * R3 + R4)


def _rate(
    plant: WebParameters, state: FloatArray, torque_nm: FloatArray, unwind: float
) -> tuple[FloatArray, FloatArray]:
    """d[T; v]/dt and its derivative to the state."""
    n = plant.n
    T = np.concatenate(([plant.tension_before_n], state[:n], [plant.tension_after_n]))
    v = np.concatenate(([unwind], state[n:]))
    EA, L, R, J, f = (
        plant.stiffness_n, plant.length_m, plant.radius_m, plant.inertia_kg_m2, plant.friction_nms_per_rad,
    )  # fmt: skip
    rate = np.concatenate(
        (
            (EA * np.diff(v) + T[:n] * v[:n] - T[1 : n + 1] * v[1:]) / L,
            (R**2 * (T[2:] - T[1 : n + 1]) - f * v[1:] + R * torque_nm) / J,
        )
    )
    A = np.zeros((2 * n, 2 * n))
    i = np.arange(n)
    A[i, i] = -v[1:] / L
    A[i[1:], i[:-1]] = v[1:n] / L[1:]
    A[i, n + i] = (EA - T[1 : n + 1]) / L
    A[i[1:], n + i[:-1]] = (T[1:n] - (EA * np.ones(n))[1:]) / L[1:]
    A[n + i, i] = -(R**2) / J
    A[n + i[:-1], i[1:]] = (R**2 / J)[:-1]
    A[n + i, n + i] = -f / J
    return rate, A


def _assembled(blocks: list[tuple[int, int, FloatArray]], shape: tuple[int, int]) -> csc_matrix:
    """A sparse matrix of dense blocks at (row, column); what overlaps adds up."""
    rows, columns, values = [], [], []
    for row, column, block in blocks:
        r, c = np.indices(block.shape)
        rows.append((r + row).ravel())
        columns.append((c + column).ravel())
        values.append(block.ravel())
    return coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape).tocsc()


def by_piqp(
    P: csc_matrix, q: FloatArray, A: csc_matrix, b: FloatArray, G: csc_matrix, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """A proximal interior-point method. Raises RuntimeError when it does not solve."""
    solver = piqp.SparseSolver()
    solver.settings.verbose = False
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-7
    solver.setup(P, q, A, b, G, lower, upper)
    status = solver.solve()
    if status != piqp.PIQP_SOLVED:
        raise RuntimeError(f"piqp: {status}")
    return np.array(solver.result.x)


def by_clarabel(
    P: csc_matrix, q: FloatArray, A: csc_matrix, b: FloatArray, G: csc_matrix, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """A homogeneous interior-point method. Raises RuntimeError when it does not solve."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    rows = vstack((A, G, -G), format="csc")
    cones = [clarabel.ZeroConeT(len(b)), clarabel.NonnegativeConeT(2 * len(lower))]
    solution = clarabel.DefaultSolver(
        csc_matrix(triu(P)), q, rows, np.concatenate((b, upper, -lower)), cones, settings
    ).solve()
    if "Solved" not in str(solution.status):
        raise RuntimeError(f"clarabel: {solution.status}")
    return np.array(solution.x)

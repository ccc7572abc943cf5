"""The truth against the paper's equations, written here a second time and in another form."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from sim_plant.physics import STEP_S, WebParameters, derivative, equilibrium, integrate

Array = NDArray[np.float64]

TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])


def parameters(n: int, seed: int, disturbance: float = 0.0) -> WebParameters:
    """Every roller different, around the paper's S_real, with tension at both ends."""
    rng = np.random.default_rng(seed)

    def around(value: float) -> Array:
        return value * rng.uniform(0.7, 1.3, n)

    return WebParameters(
        stiffness_n=around(2200.0),
        length_m=around(1.2),
        radius_m=around(0.035),
        inertia_kg_m2=around(1.0),
        friction_nms_per_rad=around(15.0),
        disturbance_m_per_s2=np.full(n, disturbance),
        tension_before_n=rng.uniform(0.0, 30.0),
        tension_after_n=rng.uniform(0.0, 30.0),
    )


def right_hand_side(p: WebParameters, u: Array, v0: float):
    """dx/dt with x = [T, v], in matrix form: differences of padded vectors, as the paper's two equations say."""

    def f(_t: float, x: Array) -> Array:
        T = np.concatenate(([p.tension_before_n], x[: p.n], [p.tension_after_n]))
        v = np.concatenate(([v0], x[p.n :]))
        A_E_over_L, one_over_L = p.stiffness_n / p.length_m, 1.0 / p.length_m
        dT = A_E_over_L * np.diff(v) - one_over_L * np.diff(T[:-1] * v)
        dv = (p.radius_m**2 * np.diff(T[1:]) - p.friction_nms_per_rad * v[1:] + p.radius_m * u) / p.inertia_kg_m2
        return np.concatenate((dT, dv))

    return f


def linearisation(p: WebParameters, T: Array, v: Array, v0: float) -> Array:
    """df/dx by hand, in blocks of diagonals."""
    n = p.n
    v_up = np.concatenate(([v0], v[:-1]))
    T_up = np.concatenate(([p.tension_before_n], T[:-1]))
    gain = p.radius_m**2 / p.inertia_kg_m2
    TT = np.diag(-v / p.length_m) + np.diag((v_up / p.length_m)[1:], -1)
    Tv = np.diag((p.stiffness_n - T) / p.length_m) - np.diag(((p.stiffness_n - T_up) / p.length_m)[1:], -1)
    vT = np.diag(-gain) + np.diag(gain[:-1], 1)
    vv = np.diag(-p.friction_nms_per_rad / p.inertia_kg_m2)
    return np.block([[TT, Tv], [vT, vv]]) if n > 1 else np.array([[TT[0, 0], Tv[0, 0]], [vT[0, 0], vv[0, 0]]])


def run(p: WebParameters, state: Array, u: Array, v0: float, steps: int, noise: Array | None = None) -> Array:
    inputs = np.zeros((3, p.n + 1))
    inputs[:2] = np.append(u, v0)
    trace = np.empty((steps, 3 * p.n + 1))
    xi = np.zeros((steps, p.n)) if noise is None else noise
    integrate(p.coefficients(), p.boundary_n(), state.copy(), inputs, xi, trace)
    return trace


@settings(max_examples=200)
@given(
    n=st.integers(1, 60),
    seed=st.integers(0, 2**32 - 1),
    tensions=st.lists(st.floats(2.0, 60.0), min_size=60, max_size=60),
    v0=st.floats(0.0, 2.0),
)
def test_nothing_moves_at_equilibrium(n: int, seed: int, tensions: list[float], v0: float) -> None:
    p, T = parameters(n, seed), np.array(tensions[:n])
    v, u = equilibrium(p, T, v0)
    dT, dv = derivative(p, T, v, u, v0)
    assert max(np.abs(dT).max(), np.abs(dv).max()) < 1e-9
    assert np.abs(right_hand_side(p, u, v0)(0.0, np.concatenate((T, v)))).max() < 1e-9


def eigenvalue_error(n: int, v0: float) -> float:
    """Largest difference between the eigenvalues of the derivative and those by hand, over the smallest of these."""
    p = parameters(n, seed=n)
    T = np.resize(TENSION_N, n)
    v, u = equilibrium(p, T, v0)
    x = np.concatenate((T, v))
    J = np.empty((2 * n, 2 * n))
    for j in range(2 * n):  # the right-hand side is quadratic: a central difference is exact but for rounding
        h = 1.0 if j < n else 0.01
        step = np.zeros(2 * n)
        step[j] = h
        plus, minus = x + step, x - step
        difference = [
            a - b
            for a, b in zip(
                derivative(p, plus[:n], plus[n:], u, v0), derivative(p, minus[:n], minus[n:], u, v0), strict=True
            )
        ]
        J[:, j] = np.concatenate(difference) / (2.0 * h)
    found = np.sort_complex(np.linalg.eigvals(J))
    expected = np.sort_complex(np.linalg.eigvals(linearisation(p, T, v, v0)))
    return float(np.abs(found - expected).max() / np.abs(expected).min())


@pytest.mark.parametrize(("n", "v0"), [(1, 0.1), (6, 0.01), (6, 0.1), (20, 0.5)])
def test_eigenvalues_are_those_of_a_linearisation_by_hand(n: int, v0: float) -> None:
    assert eigenvalue_error(n, v0) <= 1e-6


def solver_errors() -> tuple[float, float]:
    """Largest difference over 15 s between a run and an independent solver, in N and in m/s."""
    p = parameters(6, seed=3)
    v, u = equilibrium(p, TENSION_N, 0.01)
    x0 = np.concatenate((TENSION_N, v))
    u, v0 = u + np.array([1.0, -0.5, 0.3, 0.2, -0.1, 0.4]), 0.011  # off the equilibrium, so that something happens
    trace = run(p, x0, u, v0, 15_000)
    t = STEP_S * np.arange(1, 15_001)
    solution = solve_ivp(right_hand_side(p, u, v0), (0.0, t[-1]), x0, method="DOP853", t_eval=t, rtol=1e-11, atol=1e-12)
    assert np.abs(solution.y[:6, -1] - TENSION_N).max() > 1.0
    tension_n = np.abs(trace[:, :6] - solution.y[:6].T).max()
    return float(tension_n), float(np.abs(trace[:, 6:12] - solution.y[6:].T).max())


def test_a_run_equals_an_independent_solver_on_independent_equations() -> None:
    tension_n, speed_m_per_s = solver_errors()
    assert tension_n < 1e-4 and speed_m_per_s < 1e-7


def test_the_disturbance_accelerates_one_roller_for_one_step() -> None:
    p = parameters(3, seed=1, disturbance=0.05)
    T = TENSION_N[:3]
    v, u = equilibrium(p, T, 0.1)
    noise = np.zeros((1, 3))
    noise[0, 1] = 2.0
    after = run(p, np.concatenate((T, v)), u, 0.1, 1, noise)[0, 3:6]
    # b xi over 1 ms; friction takes f/J * 0.5 ms of it away again, and the web much less
    assert after[1] - v[1] == pytest.approx(0.05 * 2.0 * STEP_S, rel=0.02)
    assert np.abs(after[[0, 2]] - v[[0, 2]]).max() < 1e-6


def test_inputs_move_to_their_target_at_their_rate() -> None:
    p = parameters(1, seed=1)
    inputs = np.array([[0.0, 0.1], [1.0, 0.0], [250.0, 10.0]])  # 0 to 1 Nm at 250 Nm/s, 0.1 to 0 m/s at 10 m/s2
    trace = np.empty((12, 4))
    integrate(p.coefficients(), p.boundary_n(), np.zeros(2), inputs, np.zeros((12, 1)), trace)
    assert trace[:5, 2] == pytest.approx([0.25, 0.5, 0.75, 1.0, 1.0])
    assert trace[:, 3] == pytest.approx([0.09, 0.08, 0.07, 0.06, 0.05, 0.04, 0.03, 0.02, 0.01, 0.0, 0.0, 0.0])

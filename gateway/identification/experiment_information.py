"""What a recording can tell of the parameters, before it is made: Fisher information of the Kalman predictor.

With x the sensitivity of the predicted state to the logarithms of the parameters (2n, p),

    x_{k+1} = F (I - K C) x_k + dPhi/dtheta(state_k, torque_k),    psi_k = C x_k,    I = sum_k psi_k' S^-1 psi_k

Phi is the line's step over a period (nonlinear, by RK4, its derivative by central differences), F its linearisation
where the line stands, K and S gain and innovation covariance of the stationary Kalman filter there. States and torques
are those of the closed loop without noise. That the innovations' covariance depends on the parameters too, and that
noise moves the line by itself, is left out: both tell a little more. Parameters have one factor for all rollers or
spans, and a predictor that begins at the true state.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from gateway.control.design.sampling import sampled
from gateway.control.rollout import Course, Plants, Setup, plants_of, simulate, start
from gateway.core.controller import Controller
from gateway.core.line import Line
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise
from gateway.core.unnamed_terms import widest
from gateway.core.web_model import WebModel, linearise, reference_speeds

#: The factors that are estimated; the last is the Coulomb friction c of all bearings, in Nm and not as a logarithm.
PARAMETERS = ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad", "coulomb_nm")
#: What intervals are told of: powers of the first five.
COMBINATIONS: dict[str, tuple[int, ...]] = {
    "stiffness_per_length": (1, -1, 0, 0, 0),
    "radius_per_inertia": (0, 0, 1, -1, 0),
    "friction_per_inertia": (0, 0, 0, -1, 1),
    "stiffness_n": (1, 0, 0, 0, 0),
    "length_m": (0, 1, 0, 0, 0),
    "radius_m": (0, 0, 1, 0, 0),
    "inertia_kg_m2": (0, 0, 0, 1, 0),
    "friction_nms_per_rad": (0, 0, 0, 0, 1),
}
COULOMB_SHARE = 0.05  #: of the drives' torque: standard deviation of the Coulomb friction before anything is known
FACTOR = 1e-4  #: by which parameters are moved to differentiate; the Coulomb friction by so many Nm
_95 = 1.959964


@dataclass(frozen=True)
class Run:
    """A closed loop without noise, on b plants: at the samples, and what acted in each step of a period from then."""

    plants: Plants
    state: FloatArray  #: (b, k, 2n)
    acting_nm: FloatArray  #: (b, k, substeps, n)
    unwind_speed_m_per_s: FloatArray  #: (k,)


def prior_precision(line: Line, *, coulomb: bool) -> FloatArray:
    """Of the parameters (p, p): log-normal with standard deviation log(1 + tolerance) / sqrt(3), as if uniform."""
    tolerances = [
        line.web.stiffness_n.tolerance,
        widest([span.length_m for span in line.spans]),
        widest([roller.radius_m for roller in line.rollers]),
        widest([roller.inertia_kg_m2 for roller in line.rollers]),
        widest([roller.friction_nms_per_rad for roller in line.rollers]),
    ]
    deviations = np.log1p(tolerances) / np.sqrt(3.0)
    if coulomb:
        deviations = np.append(deviations, COULOMB_SHARE * line.limits.torque_nm)
    return np.diag(deviations**-2.0)


def half_widths(information: FloatArray) -> dict[str, float]:
    """Of the 95 % intervals, as fractions, by name. `information` (p, p) with the prior's."""
    covariance = np.linalg.inv(information)[:5, :5]
    found: dict[str, float] = {}
    for name, powers in COMBINATIONS.items():
        row = np.array(powers, dtype=np.float64)
        found[name] = _95 * float(np.sqrt(row @ covariance @ row))
    return found


def closed_loop(config: Controller, models: list[WebModel], course: Course, setup: Setup) -> Run:
    """The loop of `config` without noise, rounding and limits, from each plant's own equilibrium."""
    ideal = Setup(setup.period_s, setup.latency_s, setup.substeps)
    plants = plants_of(models)
    torque = simulate(config, plants, course, ideal, record=True).torque_nm
    begin, held = start(plants, course)
    # The torque that acts in step j of period k was computed `age` periods before.
    ages = [max(-(-(ideal.delay_steps - j) // ideal.substeps), 0) for j in range(ideal.substeps)]
    padded = np.concatenate((np.repeat(held[:, None], max(ages), axis=1), torque), axis=1)
    first = max(ages)
    acting = np.stack([padded[:, first - age : first - age + course.periods] for age in ages], axis=2)
    states = np.empty((plants.count, course.periods, 2 * plants.n))
    state = begin
    for k, unwind in enumerate(course.unwind_speed_m_per_s.tolist()):
        states[:, k] = state
        state = period_ahead(plants, state, acting[:, k], np.full(plants.count, unwind), ideal.step_s)
    return Run(plants, states, acting, course.unwind_speed_m_per_s)


def standing(
    models: list[WebModel], tension_n: FloatArray, unwind_speed_m_per_s: float, periods: int, setup: Setup
) -> Run:
    """The same of a line where nothing moves."""
    plants = plants_of(models)
    course = Course(np.tile(tension_n, (periods, 1)), np.full(periods, unwind_speed_m_per_s))
    begin, held = start(plants, course)
    state = np.repeat(begin[:, None], periods, axis=1)
    acting = np.repeat(np.repeat(held[:, None], periods, axis=1)[:, :, None], setup.substeps, axis=2)
    return Run(plants, state, acting, course.unwind_speed_m_per_s)


def sensitivities(
    run: Run, index: int, noise: Noise, setup: Setup, draw: tuple[int, ...], *, coulomb: bool
) -> FloatArray:
    """S^-1/2 psi (k, m, p) of one plant, whose squares sum up to the information; m measured quantities."""
    state, acting = run.state[index], run.acting_nm[index]
    unwind = run.unwind_speed_m_per_s
    n = run.plants.n
    measured = [*(i for i in range(n) if i not in draw), *range(n, 2 * n)]
    model = run.plants.model(index)
    F, gain, root = stationary_filter(model, state[0, :n], float(np.median(unwind)), noise, setup.period_s, measured)
    driven = np.stack(
        [
            (
                period_ahead(
                    _moved(run.plants, index, j, FACTOR), state, _pulled(acting, j, FACTOR), unwind, setup.step_s
                )
                - period_ahead(
                    _moved(run.plants, index, j, -FACTOR), state, _pulled(acting, j, -FACTOR), unwind, setup.step_s
                )
            )
            / (2.0 * FACTOR)
            for j in range(len(PARAMETERS) if coulomb else len(PARAMETERS) - 1)
        ],
        axis=2,
    )  # (k, 2n, p)
    closed = F @ (np.eye(2 * n) - gain @ np.eye(2 * n)[measured])
    found = np.empty((len(state), len(measured), driven.shape[2]))
    x = np.zeros((2 * n, driven.shape[2]))
    for k, forced in enumerate(driven):
        found[k] = root @ x[measured]
        x = closed @ x + forced
    return found


def _moved(plants: Plants, index: int, parameter: int, by: float) -> Plants:
    """Plant `index` alone, with the logarithm of a parameter moved."""
    names = ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")
    arrays = {name: getattr(plants, name)[index : index + 1] for name in (*names, "boundary_n")}
    if parameter < len(names):
        arrays[names[parameter]] = arrays[names[parameter]] * np.exp(by)
    return Plants(**arrays)


def _pulled(acting_nm: FloatArray, parameter: int, by: float) -> FloatArray:
    """Torques less what Coulomb friction of rollers that turn forward takes."""
    return acting_nm - by if PARAMETERS[parameter] == "coulomb_nm" else acting_nm


def stationary_filter(
    model: WebModel, tension_n: FloatArray, unwind_m_per_s: float, noise: Noise, period_s: float, measured: list[int]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Kalman filter around tensions (n,): F (2n, 2n), the gain K (2n, m) on the innovation, and S^-1/2 (m, m)."""
    n = model.n
    A, B = linearise(model, tension_n, reference_speeds(model, tension_n, unwind_m_per_s), unwind_m_per_s)
    F, _ = sampled(A, B, period_s)
    # Van Loan 1978: what white noise on the accelerations adds up to over a period.
    block = np.zeros((4 * n, 4 * n))
    block[: 2 * n, : 2 * n] = -A
    block[n : 2 * n, 3 * n :] = noise.acceleration_m_per_s1_5**2 * np.eye(n)
    block[2 * n :, 2 * n :] = A.T
    moved = F @ np.asarray(expm(block * period_s))[: 2 * n, 2 * n :]
    C = np.eye(2 * n)[measured]
    seen = np.diag([noise.tension_n**2 if i < n else noise.speed_m_per_s**2 for i in measured])
    P = np.asarray(solve_discrete_are(F.T, C.T, 0.5 * (moved + moved.T), seen))
    S = C @ P @ C.T + seen
    gain: FloatArray = np.asarray(np.linalg.solve(S, C @ P).T, dtype=np.float64)
    root: FloatArray = np.asarray(np.linalg.inv(np.linalg.cholesky(S)), dtype=np.float64)
    return F, gain, root


def period_ahead(
    plants: Plants, state: FloatArray, acting_nm: FloatArray, unwind_m_per_s: FloatArray, step_s: float
) -> FloatArray:
    """States (m, 2n) a period later, with torques (m, substeps, n); plants are m, or one for all."""
    for j in range(acting_nm.shape[1]):
        torque = acting_nm[:, j]
        k1 = _rate(plants, state, torque, unwind_m_per_s)
        k2 = _rate(plants, state + 0.5 * step_s * k1, torque, unwind_m_per_s)
        k3 = _rate(plants, state + 0.5 * step_s * k2, torque, unwind_m_per_s)
        k4 = _rate(plants, state + step_s * k3, torque, unwind_m_per_s)
        state = state + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return state


def _rate(plants: Plants, state: FloatArray, torque_nm: FloatArray, unwind: FloatArray) -> FloatArray:
    """`rollout.rate` for many states (m, 2n) at once."""
    n, m = plants.n, len(state)
    tension = np.empty((m, n + 2))
    tension[:, 0], tension[:, 1:-1], tension[:, -1] = plants.boundary_n[:, 0], state[:, :n], plants.boundary_n[:, 1]
    speed = np.concatenate((unwind[:, None], state[:, n:]), axis=1)
    carried = tension[:, :n] * speed[:, :n] - tension[:, 1 : n + 1] * speed[:, 1:]
    stretched = (plants.stiffness_n * np.diff(speed, axis=1) + carried) / plants.length_m
    pulled = plants.radius_m**2 * (tension[:, 2:] - tension[:, 1 : n + 1])
    turned = pulled - plants.friction_nms_per_rad * speed[:, 1:] + plants.radius_m * torque_nm
    return np.concatenate((stretched, turned / plants.inertia_kg_m2), axis=1)

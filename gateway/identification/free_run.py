"""What a theta predicts of a recording, run freely from measured states on under the torques that were sent."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, exp, floor

import numpy as np

from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Theta

_STEP_S = 0.005  #: of the integration, at most
_SETTLED = 5.0  #: time constants of a torque's lag, after which its beginning is forgotten


@dataclass(frozen=True)
class Windows:
    """w pieces of recordings, k periods long each, with the torques of p periods before."""

    tension_n: FloatArray  #: (w, k+1, n); NaN of a span without load cell
    tension_setpoint_n: FloatArray  #: (w, n), at the beginning
    speed_m_per_s: FloatArray  #: (w, k+1, n)
    torque_nm: FloatArray  #: (w, p+k, n), sent
    unwind_speed_m_per_s: FloatArray  #: (w, k)
    period_s: float

    @property
    def count(self) -> int:
        return len(self.speed_m_per_s)

    @property
    def periods(self) -> int:
        return self.unwind_speed_m_per_s.shape[1]

    @property
    def n(self) -> int:
        return self.speed_m_per_s.shape[2]


def periods_before(theta: Theta, period_s: float) -> int:
    """For how many periods before a state torques still matter."""
    return ceil((theta.latency_s + _SETTLED * theta.torque_lag_s) / period_s - 1e-9) + 1


def windows_of(recordings: Sequence[Recording], periods: int, before: int, every: int) -> Windows:
    """Windows of so many periods that begin `every` so many, wherever all is known and under control.

    Raises ValueError where there is none, or where recordings are of different lines or periods.
    """
    kinds = sorted({(recording.n, recording.period_s) for recording in recordings})
    if len(kinds) > 1:
        raise ValueError(f"recordings differ: {', '.join(f'{n} spans at {period_s:g} s' for n, period_s in kinds)}")
    parts = [part for recording in recordings for part in recording.stretches(before + periods + 1)]
    if not parts:
        names = ", ".join(recording.source for recording in recordings) or "no recording"
        raise ValueError(f"{names}: nothing is known and under control for {before + periods + 1} periods in a row")
    found: list[tuple[FloatArray, ...]] = []
    for part in parts:
        begins = np.arange(before, part.samples - periods, every)[:, None]
        now, sent = begins + np.arange(periods + 1), begins + np.arange(-before, periods)
        found.append(
            (
                part.tension_n[now], part.tension_setpoint_n[begins[:, 0]], part.speed_m_per_s[now],
                part.torque_nm[sent], part.unwind_speed_m_per_s[now[:, :-1]],
            )
        )  # fmt: skip
    return Windows(*(np.concatenate(rows) for rows in zip(*found, strict=True)), period_s=kinds[0][1])


def run_freely(theta: Theta, windows: Windows) -> tuple[FloatArray, FloatArray]:
    """Tensions in N and speeds in m/s (w, k, n each) at the samples after the first, from the first as measured.

    The unwinder keeps its measured speed from a sample to the next.
    """
    first = windows.tension_n[:, 0]
    tension = np.where(np.isnan(first), windows.tension_setpoint_n, first)
    state = np.concatenate((tension, windows.speed_m_per_s[:, 0]), axis=1)
    substeps = ceil(windows.period_s / _STEP_S - 1e-9)
    step_s = windows.period_s / substeps
    torque = _acting(theta, windows, substeps)
    found = np.empty((windows.count, windows.periods, 2 * theta.n))
    for k in range(windows.periods):
        unwind = windows.unwind_speed_m_per_s[:, k, None]
        for part in range(substeps):
            state = _rk4(theta, state, torque[:, k * substeps + part], unwind, step_s)
        found[:, k] = state
    return found[:, :, : theta.n], found[:, :, theta.n :]


def _acting(theta: Theta, windows: Windows, substeps: int) -> FloatArray:
    """Mean torque (w, k * substeps, n) that acts in each step: what was sent, after latency and lag."""
    step_s = windows.period_s / substeps
    late = theta.latency_s / step_s
    whole, share = floor(late + 1e-9), max(late - floor(late + 1e-9), 0.0)
    sent = np.repeat(windows.torque_nm, substeps, axis=1)
    arrived = (1.0 - share) * sent[:, 1:] + share * sent[:, :-1] if share > 0.0 else sent[:, 1:]
    begin = (sent.shape[1] - windows.periods * substeps) - 1  # of the window, in `arrived`
    if theta.torque_lag_s == 0.0:
        return arrived[:, begin - whole : arrived.shape[1] - whole]
    ratio = step_s / theta.torque_lag_s
    left = exp(-ratio)
    mean = (1.0 - left) / ratio  # of what is left over a step
    given = arrived[:, 0]
    acting: list[FloatArray] = []
    for k in range(arrived.shape[1] - whole):
        target = arrived[:, k]
        acting.append(target + mean * (given - target))
        given = target + left * (given - target)
    return np.stack(acting[begin - whole :], axis=1)


def _rk4(theta: Theta, state: FloatArray, torque: FloatArray, unwind: FloatArray, step_s: float) -> FloatArray:
    a = _rate(theta, state, torque, unwind)
    b = _rate(theta, state + 0.5 * step_s * a, torque, unwind)
    c = _rate(theta, state + 0.5 * step_s * b, torque, unwind)
    d = _rate(theta, state + step_s * c, torque, unwind)
    return state + step_s / 6.0 * (a + 2.0 * b + 2.0 * c + d)


def _rate(theta: Theta, state: FloatArray, torque: FloatArray, unwind: FloatArray) -> FloatArray:
    """d[T; v]/dt (w, 2n): eqs. web_tension_dynamics and roller_velocity_dynamics, with Coulomb friction."""
    web, n = theta.web, theta.n
    ends = np.ones((len(state), 1))
    tension = np.hstack((web.tension_before_n * ends, state[:, :n], web.tension_after_n * ends))
    speed = np.hstack((unwind, state[:, n:]))
    flow = tension[:, :n] * speed[:, :n] - tension[:, 1:-1] * speed[:, 1:]
    stretched = (web.stiffness_n * np.diff(speed, axis=1) + flow) / web.length_m
    pulled = web.radius_m**2 * np.diff(tension[:, 1:], axis=1) - web.friction_nms_per_rad * speed[:, 1:]
    turned = pulled + web.radius_m * (torque - theta.coulomb_nm * np.sign(speed[:, 1:]))
    return np.hstack((stretched, turned / web.inertia_kg_m2))

"""What a design is made for, and what refuses it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import inf

import numpy as np

from gateway.core.controller_laws import Feedforward
from gateway.core.line import Line
from gateway.core.signals import BoolArray, FloatArray
from gateway.core.theta import Noise, Theta, expected_noise
from gateway.core.web_model import WebModel, equilibrium_torque, linearise, nominal_model, reference_speeds

#: Slower, a draw span's tension decays (with L / v) too slowly for any design to tell it from never.
LEAST_DRAW_SPEED_M_PER_S = 1e-6


class DesignRefused(Exception):
    """No controller can be offered; the text says why."""


@dataclass(frozen=True)
class DesignLimits:
    """What the design keeps to. Per drive and span."""

    torque_nm: float = inf
    torque_rate_nm_per_s: float = inf
    tension_min_n: float = 0.0
    tension_max_n: float = inf
    speed_max_m_per_s: float = 0.0  #: up to which the equilibrium must be within the torque; 0: not asked


@dataclass(frozen=True)
class DesignTask:
    """Tensions (n,) in N and a speed in m/s fix the operating point."""

    model: WebModel
    period_s: float
    latency_s: float
    tension_n: FloatArray
    unwind_speed_m_per_s: float
    draw_spans: tuple[int, ...] = ()
    noise: Noise = field(default_factory=Noise)
    limits: DesignLimits = field(default_factory=DesignLimits)
    encoder_noise_m_per_s: float = 0.0  #: 1 sigma of a roller's speed as it is measured; 0: none is known

    @property
    def n(self) -> int:
        return self.model.n

    @property
    def tension_spans(self) -> list[int]:
        """Spans (from 0) whose tension is measured and controlled."""
        return [i for i in range(self.n) if i not in self.draw_spans]


def task_of(line: Line) -> DesignTask:
    """The design task of a line: its nominal model at the first recipe's tensions and half the greatest speed."""
    limits = line.limits
    return DesignTask(
        model=nominal_model(line),
        period_s=line.control.period_s,
        latency_s=line.control.latency_s,
        tension_n=np.array(line.recipes[0].tension_n),
        unwind_speed_m_per_s=0.5 * limits.speed_max_m_per_s,
        draw_spans=tuple(i for i, span in enumerate(line.spans) if span.control == "draw"),
        limits=DesignLimits(
            limits.torque_nm, limits.torque_rate_nm_per_s, limits.tension_min_n, limits.tension_max_n,
            limits.speed_max_m_per_s,
        ),
        encoder_noise_m_per_s=expected_noise(line).speed_m_per_s,
    )  # fmt: skip


def task_on(line: Line, theta: Theta, noise: Noise | None = None) -> DesignTask:
    """`task_of`, on what is believed of the line now in place of its file's values. `noise` None: as `task_of` has it.

    What a linear design knows of the rest of theta:

    - The torque's lag is taken as so much more dead time, beside the latency. At the frequencies of a loop that stands
      the two together, a lag turns the phase by atan(w t) where dead time turns it by w t: the design is on the safe
      side.
    - Coulomb friction has no place in it. While a roller turns it is a constant torque, which integral action (LQI,
      PID) and the disturbance observer (LQG, MPC) find; an LQR keeps an offset of it. The feed-forward knows viscous
      friction only, as `Feedforward` has it: at a reversal or a start the torque comes from the feedback.
    """
    return replace(
        task_of(line),
        model=theta.web,
        latency_s=theta.latency_s + theta.torque_lag_s,
        noise=noise or Noise(),
        encoder_noise_m_per_s=(noise or expected_noise(line)).speed_m_per_s,
    )


def linear(task: DesignTask) -> tuple[FloatArray, FloatArray]:
    """A (2n, 2n) and B (2n, n) at the operating point."""
    speed = reference_speeds(task.model, task.tension_n, task.unwind_speed_m_per_s)
    return linearise(task.model, task.tension_n, speed, task.unwind_speed_m_per_s)


def feedforward_of(model: WebModel) -> Feedforward:
    """The feed-forward part of phi for a model."""
    return Feedforward(
        stiffness_n=model.stiffness_n,
        length_m=model.length_m.tolist(),
        radius_m=model.radius_m.tolist(),
        inertia_kg_m2=model.inertia_kg_m2.tolist(),
        friction_nms_per_rad=model.friction_nms_per_rad.tolist(),
        tension_before_n=model.tension_before_n,
        tension_after_n=model.tension_after_n,
    )


def check_task(task: DesignTask) -> None:
    """Raises DesignRefused with every reason for which no law can do it."""
    found = _bad_numbers(task) or [*_torque_reasons(task), *_control_reasons(task)]
    if found:
        raise DesignRefused("; ".join(found))


def _bad_numbers(task: DesignTask) -> list[str]:
    model, limits, noise = task.model, task.limits, task.noise
    positive = {
        "stiffness_n": model.stiffness_n,
        "length_m": model.length_m,
        "radius_m": model.radius_m,
        "inertia_kg_m2": model.inertia_kg_m2,
        "period_s": task.period_s,
        "noise.tension_n": noise.tension_n,
        "noise.speed_m_per_s": noise.speed_m_per_s,
        "noise.acceleration_m_per_s1_5": noise.acceleration_m_per_s1_5,
    }
    not_negative = {
        "friction_nms_per_rad": model.friction_nms_per_rad,
        "latency_s": task.latency_s,
        "tension_n": task.tension_n,
        "unwind_speed_m_per_s": task.unwind_speed_m_per_s,
        "limits.tension_min_n": limits.tension_min_n,
        "encoder_noise_m_per_s": task.encoder_noise_m_per_s,
        "limits.speed_max_m_per_s": limits.speed_max_m_per_s,
    }
    may_be_none = {
        "limits.torque_nm": limits.torque_nm,
        "limits.torque_rate_nm_per_s": limits.torque_rate_nm_per_s,
        "limits.tension_max_n": limits.tension_max_n,
    }
    found = [
        *_outside(positive, lambda v: (v > 0.0) & np.isfinite(v), "above 0, finite"),
        *_outside(not_negative, lambda v: (v >= 0.0) & np.isfinite(v), "0 and above, finite"),
        *_outside(may_be_none, lambda v: v > 0.0, "above 0"),
    ]
    return found or _bad_together(task)


def _outside(
    values: Mapping[str, FloatArray | float], allowed: Callable[[FloatArray], BoolArray], said: str
) -> list[str]:
    arrays = {name: np.atleast_1d(np.asarray(value, dtype=np.float64)) for name, value in values.items()}
    return [f"{name} is {_listed(v)}; allowed: {said}" for name, v in arrays.items() if not allowed(v).all()]


def _bad_together(task: DesignTask) -> list[str]:
    """Numbers that are good each by itself."""
    model, limits, n = task.model, task.limits, task.n
    found: list[str] = []
    if len(task.tension_n) != n:
        found.append(f"{len(task.tension_n)} tensions for {n} spans")
    elif (task.tension_n >= model.stiffness_n).any():
        found.append(f"tension_n is {_listed(task.tension_n)}: the web of {model.stiffness_n:g} N would tear")
    if not limits.tension_min_n < limits.tension_max_n:
        found.append(
            f"limits.tension_min_n is {limits.tension_min_n:g}; allowed: below limits.tension_max_n, "
            f"{limits.tension_max_n:g}"
        )
    draw = task.draw_spans
    if any(type(i) is not int for i in draw) or [*draw] != sorted({*draw} & {*range(n)}):
        found.append(f"draw_spans is {list(draw)}; allowed: whole numbers from 0 to {n - 1}, ascending, each once")
    elif draw and task.unwind_speed_m_per_s < LEAST_DRAW_SPEED_M_PER_S:
        found.append(
            f"unwind_speed_m_per_s is {task.unwind_speed_m_per_s:g} and span {draw[0] + 1} is draw-controlled: its "
            f"tension follows from a ratio of speeds, and of a web that stands no law brings it back; allowed: "
            f"{LEAST_DRAW_SPEED_M_PER_S:g} m/s and above: design for a speed at which the line runs, that law holds it "
            f"at standstill too"
        )
    return found


def _torque_reasons(task: DesignTask) -> list[str]:
    """Where the torque does not even hold the line at its greatest speed."""
    speed = max(task.limits.speed_max_m_per_s, task.unwind_speed_m_per_s)
    speeds = reference_speeds(task.model, task.tension_n, speed)
    torque = equilibrium_torque(task.model, task.tension_n, speeds)
    return [
        f"roller {i + 1} needs {torque[i]:.1f} Nm to keep {speed:g} m/s, the limit is {task.limits.torque_nm:g} Nm: "
        f"a greater torque limit, or a lower speed"
        for i in np.flatnonzero(~(np.abs(torque) < task.limits.torque_nm))  # what is no number holds nothing
    ]


def _control_reasons(task: DesignTask) -> list[str]:
    # A web without stiffness, or a roller that its drive cannot turn, shows as a loss of rank.
    A, B = linear(task)
    scale = np.abs(np.linalg.eigvals(A)).max()
    blocks: list[FloatArray] = []
    block = B
    for _ in range(A.shape[0]):
        blocks.append(block / max(np.abs(block).max(), 1e-300))
        block = A @ block / scale
        if np.linalg.matrix_rank(np.hstack(blocks)) == A.shape[0]:
            return []
    rank = int(np.linalg.matrix_rank(np.hstack(blocks)))
    return [f"not controllable: the drives reach {rank} of {A.shape[0]} states"]


def _listed(values: FloatArray) -> str:
    return ", ".join(f"{value:g}" for value in np.unique(values))

"""The loop, simulated on the corners of what is believed of the line, under stress: does it keep the web?

Nonlinear, with saturation, rate limit, noise and latency, and with torque lag, late commands, Coulomb friction and
rollers out of round, which the plain equations do not have.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from gateway.control.judged_courses import corner_courses
from gateway.control.mpc_linear import unconstrained
from gateway.control.rollout import Course, Rollouts, simulate, simulate_slowly
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.line import Line
from gateway.core.theta import Noise, Theta
from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import at_least, at_most, told
from safety.simulated import holdable, judged_of, plants_under_stress, setup_of, stressed

RULE = "corners"
WHOLE_MPC = 2  #: corners on which a predictive controller runs whole: where its linear law does worst
WHOLE_LASTING_S, WHOLE_TAIL_S = 1.2, 0.8  #: of its changes, and their tail


@dataclass
class Worst:
    """Over corners and courses, with the name of the course."""

    lowest_n: tuple[float, str] = (inf, "")
    highest_n: tuple[float, str] = (-inf, "")
    swing_n: tuple[float, str] = (-inf, "")
    error_n: tuple[float, str] = (-inf, "")
    chatter_nm: tuple[float, str] = (-inf, "")

    def take(self, found: Rollouts, name: str) -> None:
        """A course's rollouts. What is no number is the worst there is."""
        self.lowest_n = min(self.lowest_n, (-_greatest(-found.tension_min_n), name))
        self.highest_n = max(self.highest_n, (_greatest(found.tension_max_n), name))
        self.swing_n = max(self.swing_n, (_greatest(found.tail_swing_n), name))
        self.error_n = max(self.error_n, (_greatest(found.tail_error_n), name))
        self.chatter_nm = max(self.chatter_nm, (_greatest(found.chatter_nm), name))


def check(case: Case) -> list[RuleFinding]:
    """Tension's band, its oscillation and error once it should stand, and the torque's chatter: the worst of all."""
    judged, config = judged_of(case), case.controller
    worst, left_out = Worst(), dict[str, int]()
    for name, course in corner_courses(judged).items():
        kept = _holdable(case, course)
        left_out[name] = len(case.corners) - len(kept)
        if not kept:
            return [_nobody_holds(case, name)]
        law = unconstrained(config) if isinstance(config, MpcConfig) else config
        found = rollouts(case.line, law, kept, course, case.noise, case.seed)
        worst.take(found, name)
        if isinstance(config, MpcConfig) and course.unwind_speed_m_per_s.max() == judged.fast_m_per_s:
            _run_whole(case, config, kept, found, name, worst)
    return [*_limits(case, worst), _of_corners(case, left_out), *_of_mpc(config)]


def rollouts(
    line: Line, config: Controller, thetas: Sequence[Theta], course: Course, noise: Noise, seed: int
) -> Rollouts:
    """On stressed plants."""
    setup = setup_of(line, noise, seed, line.gate.stress_late_share)
    return simulate(config, plants_under_stress(thetas, line.gate, seed), course, setup)


def _holdable(case: Case, course: Course) -> list[Theta]:
    plants = [stressed(theta, case.line.gate) for theta in case.corners]
    return holdable(plants, course, case.line.limits.torque_nm)


def _run_whole(case: Case, config: MpcConfig, thetas: list[Theta], linear: Rollouts, name: str, worst: Worst) -> None:
    """The predictive controller itself, where its linear law does worst, in shorter courses."""
    if name not in ("steps, fast", "speed change"):
        return
    course = corner_courses(judged_of(case), WHOLE_LASTING_S, WHOLE_TAIL_S)[name]
    badness = linear.tail_swing_n.max(axis=1) + linear.chatter_nm.max(axis=1) + linear.beyond_n.max(axis=1)
    most = 1 if name == "speed change" else WHOLE_MPC
    order: list[int] = np.argsort(np.nan_to_num(badness, nan=inf))[::-1][:most].tolist()
    setup = setup_of(case.line, case.noise, case.seed, case.line.gate.stress_late_share)
    plants = plants_under_stress([thetas[i] for i in order], case.line.gate, case.seed)
    worst.take(simulate_slowly(config, plants, course, setup), f"{name}, solved at each sample")


def _limits(case: Case, worst: Worst) -> list[RuleFinding]:
    limits, gate = case.line.limits, case.line.gate
    (low, low_at), (high, high_at) = worst.lowest_n, worst.highest_n
    (swing, swing_at), (error, error_at), (chatter, chatter_at) = worst.swing_n, worst.error_n, worst.chatter_nm
    return [
        at_least(
            "corners: lowest tension", low, limits.tension_min_n, "N",
            f"tension falls to {_n(low)} ({low_at}); allowed: down to {limits.tension_min_n:g} N",
        ),
        at_most(
            "corners: highest tension", high, limits.tension_max_n, "N",
            f"tension rises to {_n(high)} ({high_at}); allowed: up to {limits.tension_max_n:g} N",
        ),
        at_most(
            "corners: oscillation", swing, gate.tail_oscillation_max_n, "N",
            f"tension swings by {_n(swing)} where it should stand ({swing_at}); allowed: gate.tail_oscillation_max_n, "
            f"{gate.tail_oscillation_max_n:g} N",
        ),
        at_most(
            "corners: error", error, gate.tail_error_max_n, "N",
            f"tension stands {_n(error)} from its set-point ({error_at}); allowed: gate.tail_error_max_n, "
            f"{gate.tail_error_max_n:g} N",
        ),
        at_most(
            "corners: chatter", chatter, gate.chatter_max_nm, "Nm",
            f"torque moves by {_n(chatter, 'Nm')} rms from period to period ({chatter_at}); allowed: "
            f"gate.chatter_max_nm, {gate.chatter_max_nm:g} Nm",
        ),
    ]  # fmt: skip


def _of_corners(case: Case, left_out: dict[str, int]) -> RuleFinding:
    what = f"{len(case.corners)} plants that the line may be, {len(left_out)} courses each, up to "
    what += f"{case.speed_max_m_per_s:g} m/s and steps of {case.tension_step_n:g} N"
    most = max(left_out.values())
    if most:
        names = ", ".join(f"{count} of {name}" for name, count in left_out.items() if count)
        what += f"; left out, because no controller holds them with {case.line.limits.torque_nm:g} Nm: {names}"
    return told(RULE, True, what)


def _of_mpc(config: Controller) -> list[RuleFinding]:
    if not isinstance(config, MpcConfig):
        return []
    text = (
        f"simulated is the law that it is where no limit is reached; the programme itself only on {WHOLE_MPC} corners "
        "and for shorter: how it plans at its limits on the other corners has not been seen"
    )
    return [told("corners: what is lost", True, text)]


def _nobody_holds(case: Case, name: str) -> RuleFinding:
    return told(
        RULE, False,
        f"none of {len(case.corners)} plants that the line may be is held with {case.line.limits.torque_nm:g} Nm "
        f"({name}, up to {case.speed_max_m_per_s:g} m/s): a lower speed, or larger drives",
    )  # fmt: skip


def _greatest(values: object) -> float:
    """Of an array; infinite where one is no number."""
    greatest = float(np.max(np.asarray(values, dtype=np.float64)))
    return inf if np.isnan(greatest) else greatest


def _n(value: float, unit: str = "N") -> str:
    return f"{value:.2f} {unit}" if np.isfinite(value) else "no end"

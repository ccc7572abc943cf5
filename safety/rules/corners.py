"""The loop, simulated on the corners of what is believed of the line, under stress: does it keep the web?

Nonlinear, with saturation, rate limit, noise and latency, and with torque lag, late commands, Coulomb friction and
rollers out of round, which the plain equations do not have.
"""

from dataclasses import dataclass, replace
from math import inf

import numpy as np

from gateway.control.judged_courses import CornerCourse
from gateway.control.mpc_linear import unconstrained
from gateway.control.rollout import Rollouts, simulate
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.line_limits import chatter_limit_nm, tension_bands_n, torque_limits_nm
from gateway.core.signals import FloatArray
from gateway.core.verdict import RuleFinding
from safety import programme
from safety.case import Case
from safety.corner_runs import corners_held, courses_of, in_largest_steps
from safety.findings import at_least, at_most, told
from safety.simulated import holdable, plants_out_of_round, setup_of, stressed

RULE = "corners"
LATE, FINE = 2, 0.1  #: plants that are later than the line is, and the part of a period in steps of which they are so


@dataclass
class Worst:
    """Over corners and courses, with the name of the course."""

    low_n: FloatArray  #: (n,), what tensions may fall to, and rise to
    high_n: FloatArray
    lowest_n: tuple[float, str, int] = (inf, "", 0)  #: above its limit, and of which span (from 0)
    highest_n: tuple[float, str, int] = (inf, "", 0)  #: below its limit
    swing_n: tuple[float, str] = (-inf, "")
    error_n: tuple[float, str] = (-inf, "")
    chatter_nm: tuple[float, str] = (-inf, "")

    def take(self, found: Rollouts, name: str, spans: list[int]) -> None:
        """A course's rollouts; the tensions of `spans` should stand. What is no number is the worst there is."""
        self.lowest_n = min(self.lowest_n, _least_room(found.tension_min_n - self.low_n, name))
        self.highest_n = min(self.highest_n, _least_room(self.high_n - found.tension_max_n, name))
        self.swing_n = max(self.swing_n, (_greatest(found.tail_swing_n[:, spans]), name))
        self.error_n = max(self.error_n, (_greatest(found.tail_error_n[:, spans]), name))
        self.chatter_nm = max(self.chatter_nm, (_greatest(found.chatter_nm), name))


def check(case: Case) -> list[RuleFinding]:
    """Tension's band, its oscillation and error once it should stand, and the torque's chatter: the worst of all."""
    if nobody := [name for name, some in corners_held(case).items() if not some]:
        return [_nobody_holds(case, nobody[0])]
    config = case.controller
    worst = _of_mpc(case, config) if isinstance(config, MpcConfig) else _of_law(case, config)
    return [*_limits(case, worst), _of_corners(case), *_lost(case)]


def _of_law(case: Case, config: Controller) -> Worst:
    worst, courses = Worst(*tension_bands_n(case.line)), courses_of(case)
    for name, found in in_largest_steps(case).items():
        worst.take(found, name, case.tension_spans)
        for late in _late(case, config, courses[name]):
            worst.take(late, f"{name}, late", case.tension_spans)
    return worst


def _late(case: Case, config: Controller, one: CornerCourse) -> list[Rollouts]:
    """On what is believed of the line, stressed, and as late as the delay margin promises to stand.

    A linear loop that is stable then may still swing so far that it leaves the band. The delay is in place of the lag
    that corners are stressed by: both are the reserve for what is not known of the delay. Nothing where no torque
    holds it.
    """
    gate, believed = case.line.gate, case.believed
    late = replace(
        stressed(believed, gate),
        latency_s=case.latency_s + gate.delay_margin_min_s,
        torque_lag_s=believed.torque_lag_s,
    )
    if not one.late or not holdable([late], one.course, torque_limits_nm(case.line)):
        return []
    setup = setup_of(case.line, case.stress_noise, case.seed, gate.stress_late_share, FINE * case.line.control.period_s)
    return [simulate(config, plants_out_of_round([late] * LATE, gate, case.seed), one.course, setup)]


def _of_mpc(case: Case, config: MpcConfig) -> Worst:
    """Small moves on all corners by the law that it is where no limit is reached; large ones by itself, on some."""
    worst, courses = Worst(*tension_bands_n(case.line)), programme.small_courses(case)
    for name, found in programme.in_small(case).items():
        worst.take(found, f"{name}, small", case.tension_spans)
        for late in _late(case, unconstrained(config), courses[name]):
            worst.take(late, f"{name}, small, late", case.tension_spans)
    if not programme.fails_in_small(case):
        for name, found in programme.by_itself(case).items():
            worst.take(found, name, case.tension_spans)
    return worst


def _limits(case: Case, worst: Worst) -> list[RuleFinding]:
    gate = case.line.gate
    (low_room, low_at, low_span), (high_room, high_at, high_span) = worst.lowest_n, worst.highest_n
    least, most = float(worst.low_n[low_span]), float(worst.high_n[high_span])
    low, high = least + low_room, most - high_room
    (swing, swing_at), (error, error_at), (chatter, chatter_at) = worst.swing_n, worst.error_n, worst.chatter_nm
    return [
        at_least(
            "corners: lowest tension", low, least, "N",
            f"tension falls to {_n(low)} ({low_at}); allowed: down to {least:g} N",
        ),
        at_most(
            "corners: highest tension", high, most, "N",
            f"tension rises to {_n(high)} ({high_at}); allowed: up to {most:g} N",
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
            "corners: chatter", chatter, chatter_limit_nm(case.line), "Nm",
            f"torque moves by {_n(chatter, 'Nm')} rms from period to period ({chatter_at}); allowed: "
            f"gate.chatter_max_nm, {chatter_limit_nm(case.line):g} Nm",
        ),
    ]  # fmt: skip


def _of_corners(case: Case) -> RuleFinding:
    courses, kept = courses_of(case), corners_held(case)
    left_out = {name: max(len(courses[name].of(case.corners)) - len(some), 0) for name, some in kept.items()}
    shared = sum(one.shared for one in courses.values())
    what = f"{len(case.corners)} plants that the line may be, and {LATE} late, {len(courses) - shared} courses each, "
    what += f"{shared} shared out, up to {case.speed_max_m_per_s:g} m/s and steps of {case.tension_step_n:g} N"
    most = max(left_out.values())
    if most:
        names = ", ".join(f"{count} of {name}" for name, count in left_out.items() if count)
        what += f"; left out, because no controller holds them with {case.line.limits.torque_nm:g} Nm: {names}"
    return told(RULE, True, what)


def _lost(case: Case) -> list[RuleFinding]:
    if not isinstance(case.controller, MpcConfig):
        return []
    if programme.fails_in_small(case):
        return [told("corners: what is lost", True, "it is refused for its small moves: no large ones were looked at")]
    text = (
        f"the programme itself was simulated on {programme.WHOLE} corners, and for shorter; on the others only small "
        "moves, by the law that it is where no limit is reached: how it plans at its limits there has not been seen"
    )
    return [told("corners: what is lost", True, text)]


def _nobody_holds(case: Case, name: str) -> RuleFinding:
    return told(
        RULE, False,
        f"none of {len(case.corners)} plants that the line may be is held with {case.line.limits.torque_nm:g} Nm "
        f"({name}, up to {case.speed_max_m_per_s:g} m/s): a lower speed, or larger drives",
    )  # fmt: skip


def _least_room(room_n: FloatArray, name: str) -> tuple[float, str, int]:
    """Of (b, n): how far a tension keeps from its limit, where, and of which span. What is no number is the least."""
    found = np.where(np.isnan(room_n), -inf, room_n).min(axis=0)
    span = int(found.argmin())
    return float(found[span]), name, span


def _greatest(values: object) -> float:
    """Of an array; infinite where one is no number."""
    greatest = float(np.max(np.asarray(values, dtype=np.float64)))
    return inf if np.isnan(greatest) else greatest


def _n(value: float, unit: str = "N") -> str:
    return f"{value:.2f} {unit}" if np.isfinite(value) else "no end"

"""Configurations on an accepted model, the one that promises most first, then calmer ones. Pure.

A design is worth proposing where it does no worse on the model than the configuration in service, as far as that was
judged for, in any figure by which the gate compares the two (docs/gate.md, improvement): tracking error, overshoot and
settling time in the gate's courses. The tracking error in all that it is proposed for decides. What holds on the
model's corners is the gate's own to find: where it refuses one, the next of the ladder is a calmer one.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from math import inf, isnan

import numpy as np

from gateway.commissioning.candidates import NEAR, Law, NotOffered, configuration, fastest_m_per_s
from gateway.commissioning.simulated_loop import QUIET, loop_of
from gateway.control.judged_courses import Judged, improvement_courses
from gateway.control.rollout import Course, plants_of_thetas, simulate
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.deployment import Region
from gateway.core.line import Line
from gateway.core.line_model import LineModel, noise_of, theta_of
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise

#: None quicker than the design's own weights: those track better on the model, and their rollers run so far ahead that
#: the loop lets only small steps happen.
LAWS = (
    *(
        Law("lqi", (("torque_per_nm2", torque), ("integral_per_n2s2", integral)))
        for torque in (1.0, 2.0, 4.0)
        for integral in (1.0, 0.3)
    ),
    *(
        Law("lqg", (("torque_per_nm2", torque), ("disturbance_nm_per_sqrt_s", disturbance)))
        for torque in (1.0, 2.0)
        for disturbance in (1.0, 2.0)
    ),
    Law("pid"),
)
#: Predictive control, and calmer ones. The observer of disturbances is a slow one: a quicker one tracks no better, and
#: on random plants it cost 2 ms of the delay that the loop stands, with which it swings under the gate's late stress.
PREDICTIVE = tuple(
    Law("mpc", (("torque_per_nm2", torque), ("disturbance_nm_per_sqrt_s", 0.25))) for torque in (1.0, 2.0, 4.0)
)
#: Calmer still, with which predictive control overshoots a step at the torque limit by less; the others hardly differ
#: in that.
CALM_PREDICTIVE = tuple(
    Law("mpc", (("torque_per_nm2", torque), ("disturbance_nm_per_sqrt_s", 0.25))) for torque in (8.0, 16.0)
)
LINEAR_RUNGS = 4  #: of all others that are worth it: the best, and more at even distances down to the calmest
RUNGS = len(PREDICTIVE) + LINEAR_RUNGS
LASTING_S, BRIEF_S = 2.5, 1.0  #: of each change; with predictive control
OF_TOLERANCE = 0.9  #: that is used of what the gate lets a figure be worse: it meets another noise


@dataclass(frozen=True)
class Figures:
    """Of one course on the model."""

    rmse_n: float
    overshoot_pct: float
    settling_s: float


@dataclass(frozen=True)
class Offer:
    """A design worth proposing, and what it does on the model, by course."""

    law: Law
    controller: Controller
    speed_m_per_s: float  #: up to which it is designed
    figures: Mapping[str, Figures]
    before: Mapping[str, Figures]  #: the same of what is in service

    @property
    def share(self) -> float:
        """Its tracking error over that in service, mean of the courses."""
        return float(np.mean(list(self.shares.values())))

    @property
    def shares(self) -> dict[str, float]:
        """The same by course."""
        errors = {name: (self.figures[name].rmse_n, of.rmse_n) for name, of in self.before.items()}
        return {name: 0.0 if one < before == inf else ratio(one, before) for name, (one, before) in errors.items()}


@dataclass(frozen=True)
class Beside:
    """What is in service, and for what it was judged."""

    controller: Controller
    region: Region


def redesigns(
    line: Line, model: LineModel, in_service: Controller, tension_n: Sequence[float], region: Region,
    wanted_m_per_s: float = inf, last: bool = False,
) -> list[Offer]:  # fmt: skip
    """At most `RUNGS`, for steps as the line's file permits and speeds up to those of the model's data.

    Or up to a higher one of `region`, for which the configuration in service was judged. Predictive control is offered
    once it is the highest that the drives hold, or `wanted_m_per_s`: on the way there it would only take the gate's
    time.

    `last`: nothing comes after them, so they may use all that the gate tolerates, and `CALM_PREDICTIVE` comes on top.
    """
    shown_m_per_s = region.speed_max_m_per_s or 0.0
    speed = min(max(model.region.speed_to_m_per_s, shown_m_per_s), line.limits.speed_max_m_per_s)
    limits = line.limits
    judged = Judged(
        line, np.array(tension_n), speed, limits.tension_step_max_n, min(limits.speed_step_max_m_per_s, speed)
    )
    of_tolerance, predictive_laws = (1.0, (*PREDICTIVE, *CALM_PREDICTIVE)) if last else (OF_TOLERANCE, PREDICTIVE)
    designed = _designed(line, model, speed, LAWS)
    beside = Beside(in_service, region)
    found = _worth(designed, beside, line, model, judged, BRIEF_S if _slow(in_service) else LASTING_S, of_tolerance)
    places = sorted({round(k * (len(found) - 1) / (LINEAR_RUNGS - 1)) for k in range(LINEAR_RUNGS)}) if found else []
    linear = [found[place] for place in places]
    if speed < NEAR * min(wanted_m_per_s, fastest_m_per_s(line, model)):
        return linear
    predictive = _designed(line, model, speed, predictive_laws)
    best = [(one.law, one.controller) for one in linear[:1]]
    found = _worth([*predictive, *best], beside, line, model, judged, BRIEF_S, of_tolerance)
    return [*takewhile(lambda each: (each.law, each.controller) not in best, found), *linear]


def _designed(line: Line, model: LineModel, speed_m_per_s: float, laws: Sequence[Law]) -> list[tuple[Law, Controller]]:
    """Those of `laws` of which there is a design."""
    found: list[tuple[Law, Controller]] = []
    for law in laws:
        with suppress(NotOffered):
            found.append((law, configuration(line, model, speed_m_per_s, law)))
    return found


def _worth(
    designed: Sequence[tuple[Law, Controller]], beside: Beside, line: Line, model: LineModel, judged: Judged,
    lasting_s: float, of_tolerance: float,
) -> list[Offer]:  # fmt: skip
    """Those that do no worse than what is in service, the one with the least tracking error first."""
    known = judged.within(beside.region)
    before, before_known = (predicted(beside.controller, line, model, of, lasting_s) for of in (judged, known))
    found: list[tuple[float, Offer]] = []
    for law, config in designed:
        figures = predicted(config, line, model, judged, lasting_s)
        figures_known = figures if known is judged else predicted(config, line, model, known, lasting_s)
        if before_known and all(
            no_worse(line, figures_known[name], before_known[name], of_tolerance) for name in before_known
        ):
            whole = sum(ratio(figures[name].rmse_n, before[name].rmse_n) for name in before)
            if isnan(whole):  # beyond what it is compared in: nothing can be sorted by it
                continue
            found.append((whole, Offer(law, config, judged.speed_max_m_per_s, figures, before)))
    return [offer for _, offer in sorted(found, key=lambda each: each[0])]


def _slow(config: Controller) -> bool:
    """To simulate."""
    return isinstance(config, MpcConfig)


def predicted(
    config: Controller, line: Line, model: LineModel, judged: Judged, lasting_s: float = LASTING_S
) -> dict[str, Figures]:
    """On the model's mean, by course: tracking error under its noise, overshoot and settling without.

    In brief courses no noise is looked at: they are for a law that takes its time, beside others in the same courses.
    """
    plants = plants_of_thetas([theta_of(model)])
    noisy, quiet = loop_of(line, noise_of(model) or Noise()), loop_of(line, QUIET)
    spans = [i for i, span in enumerate(line.spans) if span.control == "tension"]
    found: dict[str, Figures] = {}
    for name, course in improvement_courses(judged, lasting_s).items():
        still = simulate(config, plants, course, quiet)
        noised = still if lasting_s == BRIEF_S else simulate(config, plants, course, noisy)
        error = noised.squared_error_n2[0, spans]
        found[name] = Figures(
            rmse_n=float(np.sqrt(error.sum())),
            overshoot_pct=float((100.0 * still.beyond_n[0, spans] / _scale(course)[spans]).max()),
            settling_s=float(quiet.period_s * still.settled[0, spans].max()),
        )
    return found


def ratio(rmse_n: float, before_n: float) -> float:
    """How large a tracking error is; by itself where what it is held against is none, or has no end."""
    return rmse_n / before_n if 0.0 < before_n < inf else rmse_n


def no_worse(line: Line, one: Figures, before: Figures, of_tolerance: float = OF_TOLERANCE) -> bool:
    """As the gate compares them, with a part of its tolerances. What is no number is worse."""
    gate = line.gate
    rows = (
        (one.rmse_n, before.rmse_n, gate.tolerance_n, 0.0),
        (one.overshoot_pct, before.overshoot_pct, gate.tolerance_overshoot_pct, gate.fine_overshoot_pct),
        (one.settling_s, before.settling_s, gate.tolerance_settling_s, 0.0),
    )
    return all(
        value == reference
        or value <= max(reference + of_tolerance * max(gate.tolerance_share * reference, floor), of_tolerance * fine)
        for value, reference, floor, fine in rows
    )


def _scale(course: Course) -> FloatArray:
    """What an overshoot is a share of (n,): the step; the set-point where it does not step."""
    settled: FloatArray = course.settled_at_n
    step: FloatArray = np.abs(settled[0] - course.tension_n[0])
    return np.where(step > 0.0, step, settled[0])

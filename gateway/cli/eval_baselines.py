"""Searches without any reasoning, in the place of whoever chooses a redesign: what they find is proposed as theirs.

They turn the knobs that the chain's redesigns have, within the bounds of its question, and look at what the rules look
at: the courses of the gate's improvement on the accepted model, beside what is in service. What counts is the tracking
error in all that is proposed; in what the configuration in service was judged for nothing may be worse. Courses last
as long as those in which the rules compare predictive control with the rest, wherever that is offered or in service.
They may look as often as the rules do. The truth they do not know. What they find goes before the gate like
anything else: the best first, then, where that is refused, the next. Everything but a redesign they leave to the rules.
"""

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import exp, inf, log

import numpy as np
from scipy.optimize import minimize

from gateway.cli.commission_questions import option_id
from gateway.cli.commission_side import GateSide, region_kept
from gateway.cli.eval_result import Policy
from gateway.commissioning.candidates import NotOffered, configuration
from gateway.commissioning.decisions import RULES, Decided
from gateway.commissioning.redesign import (
    BRIEF_S,
    LASTING_S,
    LAWS,
    PREDICTIVE,
    Offer,
    no_worse,
    predicted,
    ratio,
    redesigns,
)
from gateway.control.judged_courses import Judged
from gateway.core.controller_laws import MpcConfig
from gateway.core.deployment import Region
from gateway.core.line import Line
from gateway.core.line_model import LineModel, model_hash
from gateway.core.questions import Choice, Question, usual_choice
from gateway.core.signals import FloatArray

EVALUATIONS = len(LAWS) + len(PREDICTIVE) + 1  #: designs that the rules simulate for one redesign at the greatest speed
WORSE = 10.0  #: what is worse than in service in any figure comes behind everything that is not
RUNS_AWAY = 1e6

Factors = dict[str, float]


@dataclass(frozen=True)
class Found:
    """A turned option, and its mean tracking error over that of what is in service, with what speaks against it."""

    option: str
    factors: Factors
    cost: float


class Searching:
    """`Decider` over `side`, whose methods run in `loop`; `decide` is called from another thread."""

    def __init__(
        self, policy: Policy, line: Line, side: GateSide, loop: asyncio.AbstractEventLoop, wanted_m_per_s: float,
        seed: int,
    ) -> None:  # fmt: skip
        self._policy: Policy = policy
        self._line = line
        self._side = side
        self._loop = loop
        self._wanted_m_per_s = wanted_m_per_s
        self._generator = np.random.default_rng([seed, 5])
        self._found: tuple[str, list[Found]] = "", []  #: on which model; the best first

    def decide(self, question: Question) -> Decided:
        if question.decision != "adapt.change" or not question.knobs:
            return Decided(usual_choice(question), RULES)
        on, left = self._found
        model, offers, judged, region = self._known()
        if on != model_hash(model):
            left = self._searched(question, model, offers, judged, region)
        offered = {one.id for one in question.options}
        left = [one for one in left if one.option in offered]
        self._found = model_hash(model), left[1:]
        if not left:
            return Decided(usual_choice(question), RULES)
        best = left[0]
        said = f"{best.cost:.3f} of the tracking error in service, after {EVALUATIONS} evaluations"
        return Decided(Choice(option=best.option, factors=best.factors, reason=said), self._policy)

    def _known(self) -> tuple[LineModel, dict[str, Offer], Judged, Region]:
        now = asyncio.run_coroutine_threadsafe(self._side.now(), self._loop).result()
        shown = asyncio.run_coroutine_threadsafe(self._side.proposals(), self._loop).result()
        assert now.model is not None  # a redesign follows a model
        region = region_kept(shown) or Region()
        made = redesigns(self._line, now.model, now.in_service, now.tension_n, region, self._wanted_m_per_s)
        self._in_service = now.in_service
        limits, speed = self._line.limits, max((one.speed_m_per_s for one in made), default=self._wanted_m_per_s)
        judged = Judged(
            self._line, np.array(now.tension_n), speed, limits.tension_step_max_n,
            min(limits.speed_step_max_m_per_s, speed),
        )  # fmt: skip
        return now.model, {option_id(rung): one for rung, one in enumerate(made)}, judged, region

    def _searched(
        self, question: Question, model: LineModel, offers: Mapping[str, Offer], judged: Judged, region: Region
    ) -> list[Found]:
        line, known = self._line, judged.within(region)
        slow = any(isinstance(one, MpcConfig) for one in (self._in_service, *(of.controller for of in offers.values())))
        lasting_s = BRIEF_S if slow else LASTING_S
        before, before_known = (predicted(self._in_service, line, model, of, lasting_s) for of in (judged, known))

        def cost(option: str, factors: Factors) -> float:
            try:
                config = configuration(line, model, offers[option].speed_m_per_s, offers[option].law.turned(factors))
            except NotOffered:
                return RUNS_AWAY
            figures = predicted(config, line, model, judged, lasting_s)
            figures_known = figures if known is judged else predicted(config, line, model, known, lasting_s)
            share = float(np.mean([ratio(figures[name].rmse_n, before[name].rmse_n) for name in before]))
            worse = not all(no_worse(line, figures_known[name], before_known[name]) for name in before_known)
            return min(share + WORSE * worse, RUNS_AWAY) if share < inf else RUNS_AWAY

        bounds = {
            option: {knob.name: (knob.least, knob.most) for knob in question.knobs if option in (knob.of or [option])}
            for option in (one.id for one in question.options)
            if option in offers
        }
        if not bounds:
            return []
        found = (self._nelder_mead if self._policy == "nelder-mead" else self._at_random)(question, bounds, cost)
        each = {(one.option, *one.factors.values()): one for one in found if one.cost < WORSE}  # none is tried twice
        return sorted(each.values(), key=lambda one: one.cost)

    def _nelder_mead(
        self, question: Question, bounds: Mapping[str, Mapping[str, tuple[float, float]]],
        cost: Callable[[str, Factors], float],
    ) -> list[Found]:  # fmt: skip
        """From the option that the rules take, as it is."""
        option = question.usual if question.usual in bounds else next(iter(bounds))
        knobs, found = bounds[option], list[Found]()

        def looked_at(logs: FloatArray) -> float:
            factors = {
                name: min(max(exp(value), least), most)
                for (name, (least, most)), value in zip(knobs.items(), logs.tolist(), strict=True)
            }
            if len(found) < EVALUATIONS:  # a step may ask for one more than it was given
                found.append(Found(option, factors, cost(option, factors)))
            return found[-1].cost

        ends = [(log(least), log(most)) for least, most in knobs.values()]
        minimize(looked_at, np.zeros(len(knobs)), method="Nelder-Mead", bounds=ends,
                 options={"maxfev": EVALUATIONS, "initial_simplex": _simplex(len(knobs))})  # fmt: skip
        return found

    def _at_random(
        self, question: Question, bounds: Mapping[str, Mapping[str, tuple[float, float]]],
        cost: Callable[[str, Factors], float],
    ) -> list[Found]:  # fmt: skip
        """Options and the logarithms of factors evenly."""
        found: list[Found] = []
        for _ in range(EVALUATIONS):
            option = list(bounds)[int(self._generator.integers(len(bounds)))]
            factors = {
                name: exp(self._generator.uniform(log(least), log(most)))
                for name, (least, most) in bounds[option].items()
            }
            found.append(Found(option, factors, cost(option, factors)))
        return found


def _simplex(n: int) -> FloatArray:
    """About the origin: a factor of 2 along each knob."""
    return np.vstack([np.zeros(n), log(2.0) * np.eye(n)])

"""Which rules each kind of proposal must pass, and what is reported beside them."""

from collections.abc import Callable
from dataclasses import dataclass

from gateway.core.proposal import Kind
from gateway.core.verdict import RuleFinding, ScenarioFigures
from safety.case import Case
from safety.performance import figures_of
from safety.rules import (
    alignment,
    authority,
    cool_down,
    corners,
    decay,
    delay_margin,
    experiment,
    fits_line,
    freshness,
    improvement,
    line_state,
    model_data,
    model_fits,
    model_likelihood,
    model_residuals,
    paper,
    promises,
    roller_speed,
    validity,
)

#: See `Rule.luck`: on corners, of rollers' speeds there, and on the mean, where noise alone is drawn.
CORNERS_LUCK, SPEED_LUCK, MEAN_LUCK = 0.15, 0.05, 0.01


@dataclass(frozen=True)
class Rule:
    name: str
    check: Callable[[Case], list[RuleFinding]]
    with_model_only: bool = False  #: not asked of a first configuration, for which no model is accepted yet
    luck: float = 0.0  #: of value or limit, the greater: so far another draw may move a margin; 0: it draws nothing
    luck_when_first: bool = True  #: False: of a first configuration it is drawn once, and the region goes by that


RULES: dict[Kind, tuple[Rule, ...]] = {
    "gains": (
        Rule(authority.RULE, authority.check),
        Rule(freshness.RULE, freshness.check),
        Rule(cool_down.RULE, cool_down.check),
        Rule(line_state.RULE, line_state.check_gains),
        Rule(fits_line.RULE, fits_line.check),
        Rule(validity.RULE, validity.check, with_model_only=True),
        Rule(alignment.RULE, alignment.check, with_model_only=True),
        Rule(decay.RULE, decay.check, luck=CORNERS_LUCK),
        Rule(delay_margin.RULE, delay_margin.check),
        Rule(corners.RULE, corners.check, luck=CORNERS_LUCK),
        Rule(roller_speed.RULE, roller_speed.check, luck=SPEED_LUCK, luck_when_first=False),
        Rule(improvement.RULE, improvement.check, with_model_only=True, luck=MEAN_LUCK),
        Rule(promises.RULE, promises.check, with_model_only=True),
    ),
    "experiment": (
        Rule(authority.RULE, authority.check),
        Rule(freshness.RULE, freshness.check),
        Rule(line_state.RULE, line_state.check_experiment),
        Rule(experiment.LIMITS_RULE, experiment.check_limits),
        Rule(experiment.ABORT_RULE, experiment.check_abort),
        Rule(experiment.RULE, experiment.check_corners, luck=CORNERS_LUCK),
    ),
    "model": (
        Rule(authority.RULE, authority.check),
        Rule(freshness.RULE, freshness.check),
        Rule(line_state.RULE, line_state.check_model),
        Rule(model_fits.RULE, model_fits.check),
        Rule(model_data.RULE, model_data.check),
        Rule(model_residuals.RULE, model_residuals.check),
        Rule(model_residuals.ALIGNMENT_RULE, model_residuals.check_alignment),
        Rule(model_likelihood.SURENESS, model_likelihood.check_sureness),
        Rule(model_likelihood.NOISE, model_likelihood.check_noise),
        Rule(model_likelihood.OTHERS, model_likelihood.check_others),
    ),
}

REPORTED: dict[Kind, tuple[Rule, ...]] = {
    "gains": (Rule(paper.RULE, paper.check, with_model_only=True),),
    "experiment": (),
    "model": (),
}

FIGURES: dict[Kind, Callable[[Case], list[ScenarioFigures]]] = {"gains": figures_of}

"""Which rules each kind of proposal must pass, and what is reported beside them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from gateway.core.verdict import RuleFinding, ScenarioFigures
from safety.case import Case
from safety.rules import authority, cool_down, fits_line, freshness, line_state

Kind = Literal["gains", "experiment", "model"]


@dataclass(frozen=True)
class Rule:
    name: str
    check: Callable[[Case], list[RuleFinding]]


RULES: dict[Kind, tuple[Rule, ...]] = {
    "gains": (
        Rule(authority.RULE, authority.check),
        Rule(freshness.RULE, freshness.check),
        Rule(cool_down.RULE, cool_down.check),
        Rule(line_state.RULE, line_state.check_gains),
        Rule(fits_line.RULE, fits_line.check),
    ),
    "experiment": (
        Rule(authority.RULE, authority.check),
        Rule(freshness.RULE, freshness.check),
        Rule(line_state.RULE, line_state.check_experiment),
    ),
    "model": (
        Rule(authority.RULE, authority.check),
        Rule(freshness.RULE, freshness.check),
        Rule(line_state.RULE, line_state.check_model),
    ),
}

REPORTED: dict[Kind, tuple[Rule, ...]] = {"gains": (), "experiment": (), "model": ()}

FIGURES: dict[Kind, Callable[[Case], list[ScenarioFigures]]] = {}

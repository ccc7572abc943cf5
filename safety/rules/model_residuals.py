"""The proposed model's own predictions of the data: held to what the accepted model's must be."""

from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.rules import alignment, validity

RULE, ALIGNMENT_RULE = "model: residuals", "model: alignment"


def check(case: Case) -> list[RuleFinding]:
    """Normalised innovation squared at each speed of the data."""
    return validity.of_model(case, case.model, RULE)


def check_alignment(case: Case) -> list[RuleFinding]:
    """By how much a channel tells late, by this model."""
    return alignment.of_model(case, case.model, ALIGNMENT_RULE)

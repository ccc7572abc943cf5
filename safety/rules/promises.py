"""What a proposal promises must come true in the simulation, within tolerance."""

from collections.abc import Iterator

from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import at_most, told
from safety.performance import performances
from safety.rules.improvement import NAMES, UNITS, allowed, in_words, value_of

RULE = "promises"


def check(case: Case) -> list[RuleFinding]:
    """Each promised figure against the simulated one, with gate.tolerance_*."""
    if not case.proposal.predicted:
        return [told(RULE, True, "nothing is promised")]
    return list(_checked(case)) or [told(RULE, True, "nothing is promised")]


def _checked(case: Case) -> Iterator[RuleFinding]:
    proposed = performances(case)["proposed"]
    for promise in case.proposal.predicted:
        if promise.scenario not in proposed:
            yield told(
                RULE, False,
                f"{promise.scenario} is no course of the gate, so that its promise cannot be checked; allowed: "
                f"{', '.join(proposed)}",
            )  # fmt: skip
            continue
        for metric, unit in UNITS.items():
            promised: float | None = getattr(promise, metric)
            if promised is not None:
                value, limit = value_of(proposed[promise.scenario], metric), allowed(case.line.gate, metric, promised)
                text = (
                    f"{NAMES[metric]} in {promise.scenario} comes out as {in_words(value, metric)}, promised are "
                    f"{in_words(promised, metric)}; allowed: up to {in_words(limit, metric)}"
                )
                yield at_most(f"{RULE}: {NAMES[metric]}", value, limit, unit, text)

"""Findings of rules, in words and numbers."""

from math import inf, isfinite

from gateway.core.line_problem import printable
from gateway.core.verdict import RuleFinding

LONGEST = 2000  #: letters, as the verdict's format has them


def told(rule: str, passed: bool, text: str) -> RuleFinding:
    """A finding without a number."""
    return RuleFinding(rule=rule, passed=passed, text=_short(text))


def at_least(rule: str, value: float, limit: float, unit: str, text: str) -> RuleFinding:
    """Passed where `value` is at `limit` or above; never by one that is no number, or without end: none was seen."""
    return _of_number(rule, limit <= value < inf, value, limit, value - limit, unit, text)


def at_most(rule: str, value: float, limit: float, unit: str, text: str) -> RuleFinding:
    """Passed where `value` is at `limit` or below; never by one that is no number, or without end: none was seen."""
    return _of_number(rule, -inf < value <= limit, value, limit, limit - value, unit, text)


def share_of(found: RuleFinding, tension_step_n: float) -> float | None:
    """Its margin as a share of value or limit, the greater; of a tension at least of the step: zero is no measure.

    None of what has no number.
    """
    if found.margin is None or found.value is None or found.limit is None:
        return None
    scale = max(abs(found.value), abs(found.limit), tension_step_n if found.rule.endswith(" tension") else 0.0)
    return found.margin / scale if scale > 0.0 else 0.0


def _of_number(rule: str, passed: bool, value: float, limit: float, margin: float, unit: str, text: str) -> RuleFinding:
    return RuleFinding(
        rule=rule, passed=bool(passed), text=_short(text), value=_finite(value), limit=_finite(limit),
        margin=_finite(margin), unit=unit,
    )  # fmt: skip


def _finite(value: float) -> float | None:
    return float(value) if isfinite(value) else None


def _short(text: str) -> str:
    """What a format takes: nothing unprintable, and no more letters than it allows."""
    clean = printable(text)
    return clean if len(clean) <= LONGEST else clean[: LONGEST - 4] + " ..."

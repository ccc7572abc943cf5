"""Whether the line would be no worse off on the accepted model: against what is in service, and against a fixed
baseline, so that many small steps do not walk away.
"""

from math import inf, isnan

from gateway.core.deployment import Region
from gateway.core.line import Gate
from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import at_most
from safety.performance import Figures, Performance, beside_baseline, beside_in_service
from safety.simulated import compared_of

RULE = "improvement"
UNITS = {"rmse_n": "N", "overshoot_pct": "%", "settling_s": "s"}
NAMES = {"rmse_n": "tracking error", "overshoot_pct": "overshoot", "settling_s": "settling time"}


def check(case: Case) -> list[RuleFinding]:
    """Of each metric the course in which it does worst, against each reference, with gate.tolerance_*.

    Against each only as far as that was judged for: where it never runs, it is no measure.
    """
    gate, context = case.line.gate, case.context
    in_service, baseline = beside_in_service(case), beside_baseline(case)
    known = _as_far_as(case, context.region)
    findings = [_worst(gate, metric, "in service", *in_service, known) for metric in UNITS]
    if baseline is not None:
        known = _as_far_as(case, context.baseline_region)
        findings += [_worst(gate, metric, "baseline", *baseline, known) for metric in UNITS]
    return findings


def allowed(gate: Gate, metric: str, reference: float) -> float:
    """How large a metric may be beside that of a reference, with its tolerance."""
    floor = {
        "rmse_n": gate.tolerance_n,
        "overshoot_pct": gate.tolerance_overshoot_pct,
        "settling_s": gate.tolerance_settling_s,
    }
    return reference + max(gate.tolerance_share * reference, floor[metric])


def no_worse(gate: Gate, metric: str, reference: float) -> float:
    """How large a metric may be for a change to be no worse than a reference."""
    most = allowed(gate, metric, reference)
    return max(most, gate.fine_overshoot_pct) if metric == "overshoot_pct" else most


def value_of(figures: Figures, metric: str) -> float:
    """By the name of a metric."""
    return {
        "rmse_n": figures.rmse_n, "overshoot_pct": figures.overshoot_pct, "settling_s": figures.settling_s,
    }[metric]  # fmt: skip


def in_words(value: float, metric: str) -> str:
    """With its unit; a settling time without end in words."""
    if value == float("inf"):
        return "never" if metric == "settling_s" else "without end"
    return f"{value:.3g} {UNITS[metric]}"


def _as_far_as(case: Case, region: Region) -> str:
    """How far what was judged for `region` is a measure; empty: in everything that the change is proposed for."""
    known = compared_of(case, region)
    if known is None:
        return ""
    return f", compared up to {known.speed_max_m_per_s:.3g} m/s and steps of {known.tension_step_n:.3g} N"


def _worst(
    gate: Gate, metric: str, whose: str, reference: Performance, proposed: Performance, how_far: str
) -> RuleFinding:
    pairs = [(name, value_of(proposed[name], metric), value_of(reference[name], metric)) for name in proposed]
    name, value, before = max(pairs, key=lambda pair: _excess(pair[1], no_worse(gate, metric, pair[2])))
    limit = no_worse(gate, metric, before)
    text = (
        f"{NAMES[metric]} in {name}: {in_words(value, metric)}, {whose} {in_words(before, metric)}; allowed: up to "
        f"{in_words(limit, metric)}{how_far}"
    )
    return at_most(f"{RULE}: {NAMES[metric]}, {whose}", value, limit, UNITS[metric], text)


def _excess(value: float, limit: float) -> float:
    """By how much it is too large; where both have no end, not at all. What is no number is the worst there is."""
    excess = 0.0 if value == limit else value - limit
    return inf if isnan(excess) else excess

"""One change has had its time before the next one comes."""

from gateway.core.verdict import RuleFinding
from safety.case import Case
from safety.findings import at_least, told

RULE = "cool-down"


def check(case: Case) -> list[RuleFinding]:
    """Seconds since the last change, against gate.cool_down_s."""
    since_s, least_s = case.context.state.since_change_s, case.line.gate.cool_down_s
    if since_s is None:
        return [told(RULE, True, "the line has not been changed yet")]
    text = f"the last change was {since_s:g} s ago; allowed: gate.cool_down_s, {least_s:g} s, and more"
    return [at_least(RULE, since_s, least_s, "s", text)]

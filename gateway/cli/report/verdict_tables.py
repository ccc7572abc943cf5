"""A verdict in a report: tables, in whose place the page's script puts the operator page's bars."""

from html import escape

from gateway.cli.report.markup import number, table
from gateway.core.verdict import RuleFinding, ScenarioFigures, Verdict

MEASURES = (("rmse_n", "RMSE, N"), ("overshoot_pct", "Overshoot, %"), ("settling_s", "Settling, s"),
            ("effort_n2m2s", "Effort, N²m²s"))  # fmt: skip
LOST = {"settling_s": "does not settle"}


def verdict_tables(index: int, verdict: Verdict) -> str:
    """Figures in sight, the rules folded away unless one of them failed; `index`: of the verdict in the page's data."""
    count = len(verdict.findings)
    rules = (
        f"All {count} rules with their margins" if verdict.accepted else f"All {count} rules, with what failed first"
    )
    parts = [_fold(rules, _place(index, "findings", _rules(verdict.findings)), "" if verdict.accepted else " open")]
    if verdict.figures:
        told = '<p class="muted">Before and after, as the gate has simulated them on the model of the time.</p>'
        parts.insert(0, told + _place(index, "figures", _figures(verdict.figures)))
    if verdict.reported:
        parts.append(_fold("Reported beside them, without a say", _place(index, "reported", _rules(verdict.reported))))
    return "".join(parts)


def _place(index: int, part: str, content: str) -> str:
    return f'<div data-verdict="{index}" data-part="{part}">{content}</div>'


def _fold(title: str, content: str, state: str = "") -> str:
    return f"<details{state}><summary>{title}</summary>{content}</details>"


def _rules(findings: list[RuleFinding]) -> str:
    rows = [
        [escape(one.rule), "passed" if one.passed else '<span class="alarm-text">▲ not passed</span>',
         *(_value(value, one.unit) for value in (one.value, one.limit, one.margin)), escape(one.text)]
        for one in sorted(findings, key=lambda one: one.passed)
    ]  # fmt: skip
    return table("", ["Rule", "Verdict", "Value", "Limit", "Margin", "Found"], rows, {2, 3, 4})


def _figures(figures: list[ScenarioFigures]) -> str:
    heads = ["Scenario", "Configuration", *(head for _, head in MEASURES)]
    rows = [
        [escape(one.scenario), one.configuration, *(_measure(one, name) for name, _ in MEASURES)] for one in figures
    ]
    return table("", heads, rows, {2, 3, 4, 5})


def _measure(one: ScenarioFigures, name: str) -> str:
    value: float | None = getattr(one, name)
    return LOST.get(name, "ran away") if value is None else number(value)


def _value(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{number(value)}{f'&nbsp;{escape(unit)}' if unit else ''}"

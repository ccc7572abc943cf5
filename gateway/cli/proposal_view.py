"""Proposals on the terminal: what a person needs to decide, in 80 columns."""

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from gateway.core.decisions import ProposalList, ProposalShown
from gateway.core.line_problem import printable, quoted
from gateway.core.verdict import RuleFinding, Verdict

SHORT = 12  #: letters of a hash
COLOURS = {"waiting": "bold yellow", "refused": "red", "rolled-back": "red", "not-deployed": "red", "kept": "green"}


def print_list(found: ProposalList, console: Console) -> None:
    if not found.proposals:
        console.print("no proposal yet: `r2rgate propose FILE --reason TEXT` makes one")
    else:
        table = Table(box=SIMPLE_HEAD, pad_edge=False)
        for head in ("proposal", "kind", "author", "stage", "why"):
            table.add_column(head, overflow="fold")
        for one in found.proposals:
            stage = Text(one.stage, COLOURS.get(one.stage, ""))
            table.add_row(one.proposal[:SHORT], one.kind, printable(one.author), stage, printable(one.why)[:120])
        console.print(table)
    service = "unknown" if found.in_service is None else found.in_service[:SHORT]
    good = "unknown" if found.last_known_good is None else found.last_known_good[:SHORT]
    console.print(f"in service: {service} (epoch {found.epoch}), last known good: {good}", markup=False)
    judged_by = "what the line's file says" if found.model is None else f"model {found.model[:SHORT]}"
    console.print(f"judged by {judged_by}", markup=False)


def print_shown(found: ProposalShown, console: Console) -> None:
    proposal = found.proposal
    console.print(Text(f"Proposal {found.proposal_hash[:SHORT]}: {proposal.kind}", "bold"))
    console.print(f"stage     {found.stage}{f': {printable(found.why)}' if found.why else ''}", markup=False)
    console.print(f"author    {printable(proposal.author)}, {proposal.created}", markup=False)
    console.print(f"good until {proposal.expires}", markup=False)
    console.print("what changes, as this gateway sees it:")
    for text in found.difference:
        console.print(f"  - {printable(text)}", markup=False)
    console.print("reason, in the author's words:")
    console.print(f"  {quoted(proposal.reason)}", markup=False)
    if found.verdict is not None:
        _print_verdict(found.verdict, console)


def _print_verdict(verdict: Verdict, console: Console) -> None:
    console.print()
    word = ("accepted by the gate", "bold green") if verdict.accepted else ("refused by the gate", "bold red")
    console.print(Text(*word))
    console.print(_rules(verdict.findings))
    if verdict.figures:
        console.print(_figures(verdict))
    if verdict.region is not None:
        region = verdict.region
        parts = {
            "speed to": (region.speed_max_m_per_s, "m/s"),
            "steps of tension to": (region.tension_step_max_n, "N"),
            "of speed to": (region.speed_step_max_m_per_s, "m/s"),
        }
        said = ", ".join(f"{what} {value:g} {unit}" for what, (value, unit) in parts.items() if value is not None)
        console.print(f"judged for: {said or 'the limits of the line'}", markup=False)


def _rules(findings: list[RuleFinding]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("")
    table.add_column("rule", overflow="fold")
    table.add_column("value", justify="right")
    table.add_column("limit", justify="right")
    table.add_column("found", overflow="fold")
    for one in findings:
        mark = Text("ok", "green") if one.passed else Text("NO", "bold red")
        table.add_row(mark, one.rule, _number(one.value, one.unit), _number(one.limit, one.unit), printable(one.text))
    return table


def _figures(verdict: Verdict) -> Table:
    table = Table("scenario", "", "RMSE N", "overshoot %", "settling s", box=SIMPLE_HEAD, pad_edge=False)
    for one in verdict.figures:
        table.add_row(
            one.scenario, one.configuration, _number(one.rmse_n), _number(one.overshoot_pct), _number(one.settling_s)
        )
    return table


def _number(value: float | None, unit: str = "") -> str:
    return "-" if value is None else f"{value:.4g}{f' {unit}' if unit else ''}"

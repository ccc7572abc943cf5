"""The table of checks, for a person at a terminal or a pipe of 80 columns. Pure.

What is OK of one subject takes one row; whatever is not takes a row of its own, with what is wanted and what to do.
"""

from collections.abc import Iterator, Sequence
from itertools import groupby

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gateway.cli.doctor_check import VERDICTS, Check, Verdict, counted
from gateway.core.line_problem import printable

STYLE = {"OK": "green", "warning": "bold yellow", "FAIL": "bold red", "skipped": "dim"}
_SUBJECT_WIDTH = 16


def table(title: str, checks: Sequence[Check]) -> RenderableType:
    """All checks under their groups, and the count of the verdicts."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(no_wrap=True, width=max(map(len, VERDICTS)))
    grid.add_column(width=_SUBJECT_WIDTH, overflow="fold")
    grid.add_column(overflow="fold")
    for group, of_group in groupby(checks, key=lambda check: check.group):
        grid.add_row("", Text(f"\n{group}", "bold"), "")
        for _, of_subject in groupby(of_group, key=lambda check: check.subject):
            for verdict, subject, text in _rows(list(of_subject)):
                grid.add_row(Text(verdict, STYLE[verdict]), printable(subject), text)
    counts = counted(checks)
    summary = ", ".join(_counted(counts[verdict], verdict) for verdict in VERDICTS if counts[verdict])
    return Group(Text(title, "bold"), grid, Text(), Text(summary, "bold"))


def _rows(checks: Sequence[Check]) -> Iterator[tuple[str, str, RenderableType]]:
    """Verdict, subject and text of the rows of one subject."""
    fine = [check for check in checks if check.verdict == "OK"]
    if fine:
        text = Text("; ".join(_measured(check) for check in fine))
        if len(checks) == 1 and fine[0].wanted not in ("", fine[0].measured):
            text.append(f" (wanted: {printable(fine[0].wanted)})", "dim")
        yield "OK", fine[0].subject, text
    for check in checks:
        if check.verdict != "OK":
            text = Text(_measured(check))
            if check.wanted:
                text.append(f"\nwanted: {printable(check.wanted)}", "dim")
            if check.todo:
                text.append(f"\n-> {printable(check.todo)}")
            yield check.verdict, check.subject, text


def _counted(count: int, verdict: Verdict) -> str:
    return f"{count} {verdict}{'s' if verdict == 'warning' and count > 1 else ''}"


def _measured(check: Check) -> str:
    return f"{check.name}: {printable(check.measured)}" if check.name else printable(check.measured)

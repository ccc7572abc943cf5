"""A run as one self-contained, interactive HTML page: `render_report(Report(...))` returns its text.

`render_page(Page(...))` does the same for anything else that is told in tables and charts.
"""

from gateway.cli.report.data import Case, Comparison, EventCount, Machine, Report, RunEvent, Timing
from gateway.cli.report.page import Chart, Fold, Page, Section, Series, Story, Table
from gateway.cli.report.page_render import render_page
from gateway.cli.report.render import render_report

__all__ = [
    "Case",
    "Chart",
    "Comparison",
    "EventCount",
    "Fold",
    "Machine",
    "Page",
    "Report",
    "RunEvent",
    "Section",
    "Series",
    "Story",
    "Table",
    "Timing",
    "render_page",
    "render_report",
]

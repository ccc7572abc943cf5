"""A run as one self-contained, interactive HTML page: `render_report(Report(...))` returns its text."""

from gateway.cli.report.data import Case, Comparison, EventCount, Machine, Report, RunEvent, Timing
from gateway.cli.report.render import render_report

__all__ = ["Case", "Comparison", "EventCount", "Machine", "Report", "RunEvent", "Timing", "render_report"]

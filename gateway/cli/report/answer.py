"""The first thing a reader sees: was it safe, were the goals met, was it in time."""

import math
from html import escape

import numpy as np

from gateway.cli.report.data import Case, Report
from gateway.cli.report.markup import count, fixed, grouped, number, percentile, plural, table


def answer_section(report: Report) -> str:
    """Sentence, key figures, a row per case, and every kind of unsafe event that was watched for, seen or not."""
    unsafe, missed = _unsafe(report), _missed(report)
    rows = [
        [
            f'<a href="#case-{i}">{escape(case.title)}</a>',
            fixed(case.rmse_n, 4),
            _goal(case),
            _worst_span(case),
            count(case.unsafe_events, "alarm-text"),
            count(case.missed_cycles, "attention-text"),
        ]
        for i, case in enumerate(report.cases)
    ]
    foot = ["Whole run", "", "", "", count(unsafe, "alarm-text"), count(missed, "attention-text")]
    cases = table(
        "RMSE: root of the time mean of the squared 2-norm of the tension error over all spans. "
        "The whole run includes start and stop.",
        ["Case", "RMSE, N", "Goal", "Worst span", "Unsafe events", "Missed cycles"],
        rows,
        numeric={1, 4, 5},
        foot=foot,
        style="cases",
    )
    kinds = table(
        "Unsafe events at the drives, over the whole run: everything that was watched for.",
        ["Kind", "Seen"],
        [[escape(event.kind), count(event.count, "alarm-text")] for event in report.unsafe_events],
        numeric={1},
        style="narrow",
    )
    return f"""<section id="answer" aria-label="The answer">
<p class="answer">{_sentences(report)}</p>
<dl class="figures">{"".join(_figures(report))}</dl>
{cases}
{kinds}
</section>"""


def _unsafe(report: Report) -> int:
    return sum(event.count for event in report.unsafe_events)


def _missed(report: Report) -> int:
    return report.timing.missed if report.timing is not None else sum(case.missed_cycles for case in report.cases)


def _sentences(report: Report) -> str:
    unsafe, missed = _unsafe(report), _missed(report)
    safety = f"{plural(unsafe, 'unsafe event')} at the drives." if unsafe else "No unsafe event at the drives."
    failed = [escape(case.title) for case in report.cases if case.goal is not None and not _goal_met(case)]
    if failed:
        goals = f"Goal missed: {', '.join(failed)}."
    else:
        goals = "Every goal met." if any(case.goal for case in report.cases) else "No goals were set."
    if report.timing is None:
        timing = "Made in stepped time, so it says nothing about cycle timing."
    else:
        cycles = plural(len(report.timing.time_s), "cycle")
        timing = f"{plural(missed, 'cycle')} missed, {cycles} run." if missed else f"{cycles} run, none missed."
    return f"{safety} {goals} {timing}"


def _figures(report: Report) -> list[str]:
    unsafe, missed = _unsafe(report), _missed(report)
    watched = f"{plural(len(report.unsafe_events), 'kind')} watched for"
    figures = [_figure("Unsafe events at the drives", grouped(unsafe), watched, "alarm" if unsafe else "")]
    judged = [case for case in report.cases if case.goal is not None]
    if judged:
        met = sum(map(_goal_met, judged))
        state = "" if met == len(judged) else "attention"
        figures.append(_figure("Goals met", f"{met} of {len(judged)}", "total RMSE of a case", state))
    if (timing := report.timing) is not None:
        cycles = f"{plural(len(timing.time_s), 'cycle')} run"
        figures.append(_figure("Missed cycles", grouped(missed), cycles, "attention" if missed else ""))
        late = f"{fixed(percentile(timing.lateness_us, 99.0), 0)} µs"
        figures.append(_figure("Lateness, p99", late, f"period {number(timing.period_us / 1000.0)} ms", ""))
    return figures


def _figure(name: str, value: str, remark: str, state: str) -> str:
    mark = "▲ " if state else ""
    return (
        f'<div class="{state}"><dt>{name}</dt><dd class="value">{mark}{value}</dd><dd class="muted">{remark}</dd></div>'
    )


def _goal_met(case: Case) -> bool:
    return case.goal is not None and case.rmse_n <= case.goal.rmse_n


def _goal(case: Case) -> str:
    if case.goal is None:
        return "none set"
    goal = f"at most {fixed(case.goal.rmse_n, 4)}&nbsp;N ({escape(case.goal.label)})"
    return f"✓ met: {goal}" if _goal_met(case) else f'<span class="attention-text">✗ missed:</span> {goal}'


def _worst_span(case: Case) -> str:
    if np.isnan(case.rmse_per_span_n).all():
        return number(math.nan)
    worst = int(np.nanargmax(case.rmse_per_span_n))
    return f"{escape(case.span_labels[worst])}: {fixed(case.rmse_per_span_n[worst], 4)}&nbsp;N"

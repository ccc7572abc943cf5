"""One self-contained HTML page from a `Report`: the answer first, then the evidence, then how it was made."""

from html import escape

from gateway.cli.report import shell
from gateway.cli.report.answer import answer_section
from gateway.cli.report.data import Report
from gateway.cli.report.embed import page_data
from gateway.cli.report.evidence import case_section, timing_section
from gateway.cli.report.markup import fixed, plural, table, versions_text


def render_report(report: Report) -> str:
    """The page's text. It holds script, style and data, asks nothing of any network, and works from a file."""
    sections = [answer_section(report)]
    sections += [case_section(i, case) for i, case in enumerate(report.cases)]
    if report.timing is not None:
        sections.append(timing_section(report.timing))
    sections += [_events_section(report), _method_section(report)]
    return shell.html_page(
        report.title, _header(report), "\n".join(sections), page_data(report), shell.asset("report.js")
    )


def _header(report: Report) -> str:
    links = [(f"case-{i}", case.title) for i, case in enumerate(report.cases)]
    links += [("timing", "Cycle timing")] if report.timing is not None else []
    links += [("events", "Events"), ("method", "How this was made")]
    return shell.header(f"Line {report.line}, plant {report.plant}", report.when, report.title, links)


def _events_section(report: Report) -> str:
    body = table(
        "In the order they were reported; time since the start of the run.",
        ["Time, s", "Kind", "What happened"],
        [[fixed(event.time_s, 3), escape(event.kind), escape(event.text)] for event in report.events],
        numeric={0},
        style="events",
    )
    return f"""<section id="events" aria-labelledby="events-title"><h2 id="events-title">Events</h2>
{body if report.events else "<p>None were reported.</p>"}</section>"""


def _method_section(report: Report) -> str:
    machine = report.machine
    facts = shell.facts(
        (
            ("Command", f"<code>{escape(report.command)}</code>"),
            ("Date", shell.date(report.when)),
            ("Machine", f"{plural(machine.cpu_count, 'processor')}, {escape(machine.kernel)}"),
            ("Real time", " ".join(escape(sentence) for sentence in machine.realtime)),
            ("Versions", versions_text(report.versions)),
        )
    )
    return f"""<section id="method" aria-labelledby="method-title"><h2 id="method-title">How this was made</h2>
{facts}
<h3>Who measured</h3>{shell.bullets(case.source for case in report.cases)}
{shell.notes_list(report.notes)}
{shell.THIS_PAGE}
</section>"""

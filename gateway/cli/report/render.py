"""One self-contained HTML page from a `Report`: the answer first, then the evidence, then how it was made."""

import base64
import hashlib
from datetime import datetime
from html import escape
from importlib.resources import files
from string import Template

from gateway.cli.report.answer import answer_section
from gateway.cli.report.data import Report
from gateway.cli.report.embed import page_data
from gateway.cli.report.evidence import case_section, timing_section
from gateway.cli.report.markup import fixed, plural, table


def render_report(report: Report) -> str:
    """The page's text. It holds script, style and data, asks nothing of any network, and works from a file.

    Its content security policy forbids every request, and every script but the two of its own.
    """
    licence = f"/*\n{_asset('uplot.LICENSE.txt')}\n*/\n"
    scripts = {"uplot": licence + _asset("uplot.iife.min.js"), "script": _asset("report.js")}
    hashes = " ".join(f"'sha256-{_sha256(script)}'" for script in scripts.values())
    sections = [answer_section(report)]
    sections += [case_section(i, case) for i, case in enumerate(report.cases)]
    if report.timing is not None:
        sections.append(timing_section(report.timing))
    sections += [_events_section(report), _method_section(report)]
    return Template(_asset("page.html")).substitute(
        scripts,
        policy=f"default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}",
        title=escape(report.title),
        style=_asset("uplot.min.css") + _asset("report.css"),
        header=_header(report),
        main="\n".join(sections),
        data=page_data(report),
    )


def _header(report: Report) -> str:
    links = [(f"case-{i}", case.title) for i, case in enumerate(report.cases)]
    links += [("timing", "Cycle timing")] if report.timing is not None else []
    links += [("events", "Events"), ("method", "How this was made")]
    items = "".join(f'<li><a href="#{anchor}">{escape(title)}</a></li>' for anchor, title in links)
    return f"""<header>
<p class="origin">Line {escape(report.line)}, plant {escape(report.plant)}, {_when(report)}</p>
<h1>{escape(report.title)}</h1>
</header>
<noscript><p>The charts need JavaScript. All tables and figures are complete without it.</p></noscript>
<nav aria-label="Contents"><ul>{items}</ul></nav>"""


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
    versions = ", ".join(f"{escape(name)} {escape(version)}" for name, version in report.versions.items())
    realtime = " ".join(escape(sentence) for sentence in machine.realtime)
    sources = _list(dict.fromkeys(case.source for case in report.cases))
    notes = f"<h3>Notes</h3>{_list(dict.fromkeys(report.notes))}" if report.notes else ""
    return f"""<section id="method" aria-labelledby="method-title"><h2 id="method-title">How this was made</h2>
<dl class="facts">
<dt>Command</dt><dd><code>{escape(report.command)}</code></dd>
<dt>Date</dt><dd>{_when(report)}</dd>
<dt>Machine</dt><dd>{plural(machine.cpu_count, "processor")}, {escape(machine.kernel)}</dd>
<dt>Real time</dt><dd>{realtime}</dd>
<dt>Versions</dt><dd>{versions}</dd>
</dl>
<h3>Who measured</h3>{sources}
{notes}
<h3>This page</h3>
<p>It draws from the numbers it carries, every sample with seven digits, and loads nothing from anywhere.
Charts by uPlot, MIT licence; the licence's text stands in the source of this page.</p>
</section>"""


def _list(texts: dict[str, None]) -> str:
    return f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in texts)}</ul>"


def _when(report: Report) -> str:
    shown = datetime.fromisoformat(report.when).strftime("%Y-%m-%d %H:%M:%S %Z").rstrip()
    return f'<time datetime="{escape(report.when)}">{shown}</time>'


def _asset(name: str) -> str:
    return (files("gateway.cli.report") / "assets" / name).read_text(encoding="utf-8")


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()

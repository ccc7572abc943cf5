"""What every page has: one self-contained HTML file that asks nothing of any network."""

import base64
import hashlib
from collections.abc import Iterable
from datetime import datetime
from html import escape
from importlib.resources import files
from string import Template

STYLES = ("uplot.min.css", "colours.css", "components.css")
THIS_PAGE = """<h3>This page</h3>
<p>It draws from the numbers it carries, every sample with seven digits, and loads nothing from anywhere.
Charts by uPlot, MIT licence; the licence's text stands in the source of this page.</p>"""


def html_page(title: str, header: str, main: str, data: str, *scripts: str) -> str:
    """The page's text; `header`, `main` and `data` are HTML and JSON already, `scripts` what draws, in this order.

    It holds script, style and data, and works from a file. Its content security policy forbids every request, and every
    script but the two of its own.
    """
    licence = f"/*\n{static('uplot.LICENSE.txt')}\n*/\n"
    own = {"uplot": licence + static("uplot.iife.min.js"), "script": "".join((asset("charts.js"), *scripts))}
    hashes = " ".join(f"'sha256-{_sha256(text)}'" for text in own.values())
    return Template(asset("page.html")).substitute(
        own,
        policy=f"default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}",
        title=escape(title),
        style="".join(map(static, STYLES)) + asset("report.css"),
        header=header,
        main=main,
        data=data,
    )


def header(origin: str, when: str, title: str, links: Iterable[tuple[str, str]]) -> str:
    """Origin, date and title, and links (anchor, text) to the sections."""
    items = "".join(f'<li><a href="#{anchor}">{escape(text)}</a></li>' for anchor, text in links)
    return f"""<header>
<p class="origin">{escape(origin)}, {date(when)}</p>
<h1>{escape(title)}</h1>
</header>
<noscript><p>The charts need JavaScript. All tables and figures are complete without it.</p></noscript>
<nav aria-label="Contents"><ul>{items}</ul></nav>"""


def date(when: str) -> str:
    shown = datetime.fromisoformat(when).strftime("%Y-%m-%d %H:%M:%S %Z").rstrip()
    return f'<time datetime="{escape(when)}">{shown}</time>'


def facts(rows: Iterable[tuple[str, str]]) -> str:
    """Names and what belongs to them, which is HTML already."""
    return f'<dl class="facts">\n{"".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in rows)}</dl>'


def bullets(texts: Iterable[str]) -> str:
    """Each text once."""
    return f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in dict.fromkeys(texts))}</ul>"


def notes_list(texts: Iterable[str]) -> str:
    """Notes under their heading; nothing where there are none."""
    return f"<h3>Notes</h3>{bullets(found)}" if (found := tuple(texts)) else ""


def asset(name: str) -> str:
    """A file of the reports' own."""
    return (files("gateway.cli.report") / "assets" / name).read_text(encoding="utf-8")


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def static(name: str) -> str:
    """A file of the operator's page, which reports share."""
    return (files("gateway.operator.page") / "static" / name).read_text(encoding="utf-8")

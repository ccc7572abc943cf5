"""One self-contained HTML page from a `Page`: the answer first, then its sections, then how it was made."""

from html import escape
from typing import Any

import numpy as np

from gateway.cli.report import shell
from gateway.cli.report.components import component_words, components
from gateway.cli.report.data import FloatArray
from gateway.cli.report.embed import packed, script_json
from gateway.cli.report.markup import chart_place, plural, range_words, swatch, table, versions_text, zoom_bar
from gateway.cli.report.page import Chart, Page, Section, Story, Table
from gateway.cli.report.verdict_tables import verdict_tables
from gateway.core.verdict import Verdict
from gateway.operator.page.told import verdict_told

HINT = """<p class="muted hint">Point at a chart to read its values above it. Drag across it to look closer,
double-click to see all of it again. In a chart that has the focus, arrow keys move the cursor, + and − zoom, 0 shows
all of it. The coloured buttons hide and show a line.</p>"""

NARROW = 4  #: columns, up to which a table is not stretched to the page's width


def render_page(page: Page) -> str:
    """The page's text. It holds script, style and data, asks nothing of any network, and works from a file."""
    links = [(f"section-{i}", section.title) for i, section in enumerate(page.sections)]
    header = shell.header(page.origin, page.when, page.title, [*links, ("method", "How this was made")])
    answer = "".join(f'<p class="answer">{escape(sentence)}</p>' for sentence in page.answer)
    main = [f'<section id="answer" aria-label="The answer">{answer}</section>']
    judged: list[Verdict] = []
    main += [_section(i, section, judged) for i, section in enumerate(page.sections)]
    data: dict[str, Any] = {"sections": [_data(section) for section in page.sections]}
    scripts = [shell.asset("sections.js")]
    if judged:
        data |= {"verdicts": [verdict_told(one) for one in judged], "words": component_words()}
        scripts += [components(), shell.asset("verdicts.js")]
    return shell.html_page(page.title, header, "\n".join([*main, _method(page)]), script_json(data), *scripts)


def _section(index: int, section: Section, judged: list[Verdict]) -> str:
    """`judged` takes up the verdicts that the section tells."""
    parts = [f"<p>{escape(paragraph)}</p>" for paragraph in section.paragraphs]
    parts += [_table(one) for one in section.tables]
    parts += [_story(one, judged) for one in section.stories]
    if section.charts:
        parts += [HINT, f'<div class="readout">{zoom_bar("Whole range")}</div>']
        parts.append(f'<div class="charts">{"".join(_chart(i, chart) for i, chart in enumerate(section.charts))}</div>')
    title = f'<h2 id="section-{index}-title">{escape(section.title)}</h2>'
    content = "\n".join((title, *parts))
    return f'<section id="section-{index}" data-section aria-labelledby="section-{index}-title">\n{content}\n</section>'


def _story(one: Story, judged: list[Verdict]) -> str:
    parts = [f"<h3>{escape(one.title)}</h3>", *(f"<p>{escape(text)}</p>" for text in one.paragraphs)]
    if one.facts:
        parts.append(shell.facts((escape(name), "".join(map(_line, texts))) for name, texts in one.facts))
    parts += [_table(each) for each in one.tables]
    if one.lead:
        parts.append(f"<p>{escape(one.lead)}</p>")
    if one.quote:
        parts.append(f"<blockquote>{escape(one.quote)}</blockquote>")
    parts += [f"<p>{escape(text)}</p>" for text in one.after]
    if one.verdict is not None:
        parts.append(verdict_tables(len(judged), one.verdict))
        judged.append(one.verdict)
    parts += [
        f"<details><summary>{escape(fold.title)}</summary><pre>{escape(fold.text)}</pre></details>"
        for fold in one.folds
    ]
    return f'<article class="story">{"".join(parts)}</article>'


def _line(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def _table(one: Table) -> str:
    def cells(row: tuple[str, ...]) -> list[str]:
        return [escape(cell) for cell in row]

    body = table(
        escape(one.caption),
        cells(one.heads),
        [cells(row) for row in one.rows],
        set(one.numeric),
        None if one.foot is None else cells(one.foot),
        "narrow" if len(one.heads) <= NARROW else "",
    )
    return body + (f'<p class="muted">{escape(one.note)}</p>' if one.note else "")


def _chart(index: int, chart: Chart) -> str:
    """Title, the lines as buttons with the value at the cursor, and the place that the script draws in."""
    buttons = "".join(
        f'<button type="button" aria-pressed="true" data-toggle>{swatch(colour, " dashed" if one.dashed else "")}'
        f'{escape(one.name)} <span class="now"></span></button>'
        for colour, one in zip(chart.colours, chart.series, strict=True)
    )
    title = ", ".join(filter(None, (chart.title, chart.unit, "log scale" if chart.log_y else "")))
    ranges = range_words(np.concatenate([one.values for one in chart.series]), chart.unit)
    words = f"{chart.title} over {chart.x_label}: {plural(len(chart.series), 'line')}, {ranges}"
    place = chart_place(f"chart-{index}", words, f' data-x="{escape(chart.x_label)}"')
    return (
        f'<figure><figcaption><h3>{escape(title)}</h3></figcaption><div class="legend">{buttons}</div>{place}</figure>'
    )


def _data(section: Section) -> dict[str, Any]:
    """Numbers of a section's charts. Those with the same x are one group, which shares cursor and zoom."""
    groups: list[FloatArray] = []
    charts: list[dict[str, Any]] = []
    for chart in section.charts:
        group = next((i for i, x in enumerate(groups) if np.array_equal(x, chart.x)), len(groups))
        if group == len(groups):
            groups.append(chart.x)
        charts.append(
            {
                "group": group,
                "values": packed(np.array([one.values for one in chart.series])),
                "colours": chart.colours,
                "dashed": [one.dashed for one in chart.series],
                "log": chart.log_y,
                "points": chart.points,
            }
        )
    return {"groups": [packed(x, "<f8") for x in groups], "charts": charts}


def _method(page: Page) -> str:
    head = (("Head of the audit", f"<code>{escape(page.audit_head)}</code>"),) if page.audit_head else ()
    facts = shell.facts(
        (
            ("Command", f"<code>{escape(page.command)}</code>"),
            ("Date", shell.date(page.when)),
            ("Machine", escape(page.machine)),
            ("Versions", versions_text(page.versions)),
            *head,
        )
    )
    return f"""<section id="method" aria-labelledby="method-title"><h2 id="method-title">How this was made</h2>
{facts}
{shell.notes_list(page.notes)}
{shell.THIS_PAGE}
</section>"""

"""The evidence: each case with its tables and charts, and the timing of the cycles.

Charts are empty places here, which the page's script fills; each says in words what it shows.
"""

from html import escape

import numpy as np

from gateway.cli.report.data import Case, Timing
from gateway.cli.report.embed import cycles_per_point
from gateway.cli.report.markup import (
    chart_place,
    count,
    fixed,
    flagged,
    grouped,
    largest,
    move,
    number,
    percentile,
    range_words,
    swatch,
    table,
    zoom_bar,
)

PERCENTILES = (("p50", 50.0), ("p99", 99.0), ("p99.9", 99.9), ("Largest", 100.0))
QUANTITIES = (
    ("tension_n", "Tension, N"),
    ("setpoint_n", "Set-point, N"),
    ("torque_nm", "Torque, Nm"),
    ("speed_m_per_s", "Speed, m/s"),
)


def case_section(index: int, case: Case) -> str:
    """One case: what was done, what came of it in numbers, and what it looked like."""
    tension = f"Tension of the spans: {range_words(case.tension_n, 'N')}."
    torque = f"Torque of the rollers: {range_words(case.torque_nm, 'Nm')}."
    speed = (
        f"Web speed at the rollers: {range_words(case.speed_m_per_s, 'm/s')}; "
        f"at the unwinder, v0: {range_words(case.unwind_speed_m_per_s, 'm/s')}."
    )
    band = f"{number(case.tension_min_n)} to {number(case.tension_max_n)} N"
    multiples = "".join(_span_chart(case, i) for i in range(len(case.tension_n)))
    return f"""<section class="case" id="case-{index}" data-case aria-labelledby="case-{index}-title">
<h2 id="case-{index}-title">{escape(case.title)}</h2>
<p>{escape(case.description)}</p>
<dl class="facts"><dt>Control law</dt><dd>{escape(case.law)}</dd>
<dt>Measured by</dt><dd>{escape(case.source)}</dd></dl>
{_comparison_table(case)}
{_span_table(case)}
{_readout(case)}
<figure><figcaption><h3>Tension, N</h3>
<p>{tension} Set-points are dashed in the colour of their span. The tension must stay within {band}.</p></figcaption>
{chart_place("tension", tension)}</figure>
<figure><figcaption><h3>Tension of each span, N</h3>
<p>The same, larger: every chart has a scale of its own.</p></figcaption>
<div class="multiples">{multiples}</div></figure>
<figure><figcaption><h3>Torque, Nm</h3>
<p>{torque} Limits at ±{number(case.torque_limit_nm)} Nm, dashed red where they lie in view.</p></figcaption>
{chart_place("torque", torque)}</figure>
<figure><figcaption><h3>Speed, m/s</h3>
<p>{speed} The unwinder is the dotted line.</p></figcaption>
{chart_place("speed", speed)}</figure>
</section>"""


def timing_section(timing: Timing) -> str:
    """Lateness and cycle time: percentiles of every cycle, their course, and a histogram."""
    width = cycles_per_point(timing)
    thinning = (
        f"A point stands for {width} cycles: the shade reaches from the smallest to the largest of them, "
        "the line is their median."
        if width > 1
        else "A point is one cycle."
    )
    lateness = f"Lateness over time: {range_words(timing.lateness_us, 'µs')}"
    cycle = f"Cycle time over time: {range_words(timing.cycle_us, 'µs')}"
    readout = "".join(
        f'<tr><th scope="row">{name}, µs</th>'
        + "".join(f'<td data-value="{key}" data-row="{row}"></td>' for row in range(3))
        + "</tr>"
        for key, name in (("lateness", "Lateness"), ("cycle", "Cycle time"))
    )
    return f"""<section id="timing" data-timing aria-labelledby="timing-title">
<h2 id="timing-title">Cycle timing</h2>
<p>{grouped(len(timing.time_s))} cycles with a period of {number(timing.period_us / 1000.0)} ms.
Missed cycles: {count(timing.missed, "attention-text")}.</p>
{_percentile_table(timing)}
<div class="readout">{zoom_bar()}<div class="scroll"><table><thead><tr><td></td>
<th scope="col">smallest</th><th scope="col">median</th><th scope="col">largest</th></tr></thead>
<tbody>{readout}</tbody></table></div></div>
<figure><figcaption><h3>Lateness, µs, log scale</h3><p>{thinning}</p></figcaption>
{chart_place("lateness", lateness)}</figure>
<figure><figcaption><h3>Cycle time, µs, log scale</h3><p>{thinning}</p></figcaption>
{chart_place("cycle", cycle)}</figure>
<figure><figcaption><h3>How often: number of cycles by time, log scales</h3>
<p>{swatch(0)}lateness {swatch(1)}cycle time.
<span data-bin>Every cycle is counted. Point at a bar for its numbers.</span></p></figcaption>
{chart_place("histogram", "Histogram of lateness and cycle time; the table of percentiles tells the same")}</figure>
</section>"""


def _comparison_table(case: Case) -> str:
    others = [(f"Goal: {case.goal.label}", case.goal.rmse_n)] if case.goal is not None else []
    others += [(other.label, other.rmse_n) for other in case.comparisons]
    rows = [["This run", fixed(case.rmse_n, 4), ""]]
    rows += [
        [escape(label), fixed(rmse_n, 4), fixed(case.rmse_n / rmse_n, 3) if rmse_n > 0.0 else ""]
        for label, rmse_n in others
    ]
    heads = ["", "RMSE, N", "This run relative to it"]
    return table("Total RMSE, and what it is held against.", heads, rows, numeric={1, 2}, style="narrow")


def _span_table(case: Case) -> str:
    rows = []
    for i, label in enumerate(case.span_labels):
        tension_n, setpoint_n = case.tension_n[i], case.setpoint_n[i]
        lowest_n, highest_n = -largest(-tension_n), largest(tension_n)
        torque_nm = largest(np.abs(case.torque_nm[i]))
        rows.append(
            [
                swatch(i) + escape(label),
                move(float(setpoint_n[0]), float(setpoint_n[-1])),
                fixed(case.rmse_per_span_n[i], 4),
                fixed(largest(np.abs(tension_n - setpoint_n)), 2),
                flagged(lowest_n, lowest_n < case.tension_min_n),
                flagged(highest_n, highest_n > case.tension_max_n),
                fixed(torque_nm, 2),
                f"{fixed(100.0 * torque_nm / case.torque_limit_nm, 0)} %",
            ]
        )
    heads = ["Span", "Set-point, N", "RMSE, N", "Largest error, N", "Lowest tension, N", "Highest tension, N"]
    heads += ["Largest torque, Nm", "Torque, of its limit"]
    return table("Each span, and the roller at its end.", heads, rows, numeric=set(range(1, len(heads))))


def _percentile_table(timing: Timing) -> str:
    series = (
        ("Lateness: wake-up after the due time", timing.lateness_us),
        ("Cycle time: wake-up to the last write", timing.cycle_us),
    )
    rows = [
        [
            swatch(i) + name,
            *(fixed(percentile(values, percent), 0) for _, percent in PERCENTILES),
            f"{fixed(100.0 * largest(values) / timing.period_us, 1)} %",
        ]
        for i, (name, values) in enumerate(series)
    ]
    heads = ["", *(f"{name}, µs" for name, _ in PERCENTILES), "Largest, of the period"]
    return table("Percentiles of every cycle.", heads, rows, numeric=set(range(1, len(heads))))


def _span_chart(case: Case, i: int) -> str:
    label, rmse = case.span_labels[i], fixed(case.rmse_per_span_n[i], 4)
    words = f"{label}: {range_words(case.tension_n[i], 'N')}, RMSE {rmse} N"
    head = f'{swatch(i)}{escape(label)} <span class="muted">RMSE {rmse} N</span>'
    return f"<div><h4>{head}</h4>{chart_place(f'span-{i}', words)}</div>"


def _readout(case: Case) -> str:
    """The values at the cursor; its heads are the buttons that hide and show a span, and the legend."""
    heads = "".join(
        f'<th scope="col"><button type="button" aria-pressed="true" data-toggle="{i}" title="{escape(label)}">'
        f"{swatch(i)}Span {i + 1}</button></th>"
        for i, label in enumerate(case.span_labels)
    )
    rows = "".join(
        f'<tr><th scope="row">{name}</th>'
        + "".join(f'<td data-value="{key}" data-span="{i}"></td>' for i in range(len(case.tension_n)))
        + "</tr>"
        for key, name in QUANTITIES
    )
    return f"""<p class="muted hint">Point at a chart to read its values here. Drag across it to look closer,
double-click to see the whole case again. In a chart that has the focus, arrow keys move the cursor, + and − zoom,
0 shows the whole case. The coloured buttons hide and show a span.</p>
<div class="readout">{zoom_bar(more='<button type="button" data-all>All spans</button>')}
<div class="scroll" tabindex="0" role="region" aria-label="Values at the cursor">
<table><thead><tr><td></td>{heads}</tr></thead><tbody>{rows}</tbody></table></div></div>"""

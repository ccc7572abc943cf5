"""A page of sections as its reader gets it: parsed as a browser would, its data decoded without what packed it."""

import base64
import dataclasses
import hashlib
import re

import numpy as np
import pytest

from gateway.cli.report import Chart, Fold, Page, Section, Series, Story, Table, render_page
from tests.unit.test_report import HOSTILE, decoded
from tests.unit.test_report import Page as Parsed

TIME_S = np.linspace(0.0, 15.0, 301)


def make_series(name="Span 1", dashed=False, values=None):
    values = 28.0 + np.random.default_rng(len(name)).normal(0.0, 0.1, 301) if values is None else values
    return Series(name, values, dashed)


def make_chart(**changes):
    series = (make_series("Span 1"), make_series("Span 2"), make_series("Set-point 1", True), make_series("Goal", True))
    return dataclasses.replace(Chart("Tension, LQI on S_sim", "N", TIME_S, series), **changes)


def make_growth(**changes):
    spans = np.array([6.0, 20.0, 60.0])
    series = (Series("p50", np.array([0.12, 1.3, 14.0])), Series("goal", np.array([0.2, np.nan, np.nan]), True))
    return dataclasses.replace(Chart("Step", "ms", spans, series, "Spans", log_y=True, points=True), **changes)


def make_table(**changes):
    rows = (("LQI", "2.0090", "1.095"), ("MPC", "2.2330", "1.217"))
    table = Table(
        "20 seeds", ("Law", "RMSE, N", "To the oracle"), rows, frozenset({1, 2}), ("All", "", "x"), "As asked"
    )
    return dataclasses.replace(table, **changes)


def make_story(**changes):
    story = Story(
        "Which one?", ("Asked at noon.",), (make_table(),), "Chosen by the rules:", "the calmest\nof all", ("Kept.",),
        (Fold("Word by word", "first\n  second"),),
    )  # fmt: skip
    return dataclasses.replace(story, **changes)


def make_page(**changes):
    sections = (
        Section("Tier A", ("10 ms period.",), (make_table(),), (make_chart(), make_chart(title="Torque", unit="Nm"))),
        Section("Growth", charts=(make_growth(),), stories=(make_story(),)),
        Section("What is left open", ("Nothing.",)),
    )
    page = Page(
        title="Control",
        origin="S_real, 6 spans",
        when="2026-11-20T09:41:07+00:00",
        command="make bench-control",
        versions={"numpy": "2.3.4"},
        machine="2 cpus",
        answer=("No unsafe event.", "Goals met: 20 of 26."),
        sections=sections,
        notes=("Seeds 0 to 19.",),
    )
    return dataclasses.replace(page, **changes)


def test_it_is_well_formed_and_asks_nothing_of_any_network():
    html = render_page(make_page())
    page = Parsed(html)
    assert page.open == []
    assert not {"link", "img", "iframe", "object", "base", "form"} & {tag for tag, _ in page.elements}
    assert [script for script in page.all("script") if "src" in script] == []
    identities = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(identities) == len(set(identities))
    assert {a["href"] for a in page.all("a")} <= {f"#{name}" for name in identities}
    assert re.findall(r"(?:https?:|wss?:|url\(|@import|fetch\(|XMLHttpRequest)[^\s*]*", html) == [
        "https://github.com/leeoniya/uPlot"  # the head of the library's own text, a comment
    ]


def test_its_policy_lets_its_own_scripts_run_and_no_other():
    page = Parsed(render_page(make_page()))
    policy = next(m["content"] for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'") and policy.count("sha256-") == len(page.scripts[1:]) == 2
    for script in page.scripts[1:]:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy


def test_everything_said_stands_in_the_text():
    words = Parsed(render_page(make_page())).words.replace("\xa0", " ")
    assert "No unsafe event. Goals met: 20 of 26. Tier A" in words
    assert "20 seeds Law RMSE, N To the oracle LQI 2.0090 1.095 MPC 2.2330 1.217 All x As asked" in words
    for said in ("make bench-control", "numpy 2.3.4", "2 cpus", "Seeds 0 to 19.", "2026-11-20 09:41:07 UTC"):
        assert said in words
    assert "Step, ms, log scale" in words
    assert "Tension, LQI on S_sim, N" in words
    assert "S_real, 6 spans" in words


def test_a_story_is_told_in_its_order_and_its_details_are_folded():
    html = render_page(make_page(sections=(Section("Asked", stories=(make_story(), Story("Nothing came of it"))),)))
    page = Parsed(html)
    places = [
        page.words.index(said)
        for said in (
            "Which one?",
            "Asked at noon.",
            "20 seeds",
            "Chosen by the rules:",
            "the calmest",
            "Kept.",
            "Word by",
        )
    ]
    assert places == sorted(places)
    (details,) = page.all("details")
    assert "open" not in details and "<pre>first\n  second</pre>" in html
    assert len(page.all("article")) == 2 and len(page.all("blockquote")) == 1


def test_text_from_outside_is_text():
    table = Table(HOSTILE, (HOSTILE, "x"), ((HOSTILE, HOSTILE),), foot=(HOSTILE, HOSTILE), note=HOSTILE)
    story = Story(HOSTILE, (HOSTILE,), (), HOSTILE, HOSTILE, (HOSTILE,), (Fold(HOSTILE, HOSTILE),))
    series = tuple(make_series(HOSTILE, one.dashed) for one in make_chart().series)
    chart = make_chart(title=HOSTILE, unit=HOSTILE, series=series, x_label=HOSTILE)
    page = make_page(
        title=HOSTILE,
        origin=HOSTILE,
        command=HOSTILE,
        versions={HOSTILE: HOSTILE},
        machine=HOSTILE,
        answer=(HOSTILE,),
        sections=(Section(HOSTILE, (HOSTILE,), (table,), (chart,), (story,)),),
        notes=(HOSTILE,),
    )
    calm = Story("x", ("x",), (), "x", "x", ("x",), (Fold("x", "x"),))
    tame = make_page(sections=(Section("x", ("x",), (table,), (make_chart(),), (calm,)),))
    found, plain = Parsed(render_page(page)), Parsed(render_page(tame))
    assert found.open == []
    assert found.scripts[1:] == plain.scripts[1:]
    assert {tag for tag, _ in found.elements} == {tag for tag, _ in plain.elements}
    assert found.words.count(" ".join(HOSTILE.split())) >= 20
    chart_place = next(d for d in found.all("div") if "data-chart" in d)
    assert chart_place["data-x"] == HOSTILE


def test_data_decodes_to_what_was_given():
    values = make_series().values.copy()
    values[10:20] = np.nan
    charts = (make_chart(series=(make_series(values=values), make_series("Span 2"))), make_growth(), make_chart())
    (entry,) = Parsed(render_page(make_page(sections=(Section("One", charts=charts),)))).data["sections"]
    assert [chart["group"] for chart in entry["charts"]] == [0, 1, 0]  # the same time: one cursor, one zoom
    np.testing.assert_array_equal(decoded(entry["groups"][0]), TIME_S)
    np.testing.assert_array_equal(decoded(entry["groups"][1]), [6.0, 20.0, 60.0])
    for chart, got in zip(charts, entry["charts"], strict=True):
        given = np.array([one.values for one in chart.series])
        np.testing.assert_allclose(decoded(got["values"]), given, rtol=2.0**-24)
        assert (got["log"], got["points"]) == (chart.log_y, chart.points)
    assert np.isnan(decoded(entry["charts"][0]["values"])[0, 10:20]).all()


def test_every_line_has_a_button_and_every_chart_words():
    page = make_page()
    parsed = Parsed(render_page(page))
    charts = [chart for section in page.sections for chart in section.charts]
    places = [d for d in parsed.all("div") if "data-chart" in d]
    assert len(places) == len(charts) and all(place["aria-label"] for place in places)
    assert sum("data-toggle" in b for b in parsed.all("button")) == sum(len(chart.series) for chart in charts)
    assert len([s for s in parsed.all("section") if "data-section" in s]) == len(page.sections)


def test_a_setpoint_has_the_colour_of_its_span():
    spans, setpoints = [make_series(f"Span {i}") for i in range(8)], [make_series(f"{i}", True) for i in range(8)]
    assert make_chart(series=(*spans, *setpoints)).colours == (*range(8), *range(8))
    assert make_chart(series=(spans[0], setpoints[0], spans[1], setpoints[1])).colours == (0, 0, 1, 1)
    assert make_chart(series=(*spans[:3], setpoints[0])).colours == (0, 1, 2, 3)


@pytest.mark.parametrize(
    ("make", "changes", "complaint"),
    [
        (make_table, {"rows": (("LQI", "1"),)}, "row 0 has 2 cells for 3 heads"),
        (make_table, {"foot": ("All",)}, "row 2 has 1 cells for 3 heads"),
        (make_table, {"numeric": frozenset({1, 3})}, r"numeric columns are \[1, 3\]; allowed: 0 to 2"),
        (make_chart, {"x": TIME_S[::-1]}, "x must have two finite samples or more, and increase"),
        (make_chart, {"x": TIME_S[:1]}, "x must have two finite samples or more"),
        (make_chart, {"x": np.where(TIME_S > 14.9, np.inf, TIME_S)}, "x must have two finite samples"),
        (make_chart, {"x": TIME_S[:300]}, r"'Span 1' has shape \(301,\); \(300,\) is needed"),
        (make_chart, {"series": ()}, "no series"),
        (make_chart, {"series": (make_series(values=np.full(301, np.inf)),)}, "holds a value beyond 3e\\+38"),
        (make_chart, {"series": (make_series(values=np.full(301, -1e39)),)}, "holds a value beyond 3e\\+38"),
        (make_chart, {"series": (make_series(values=np.zeros(301)),), "log_y": True}, "a value of 0 or below"),
        (make_page, {"when": "yesterday"}, "isoformat"),
        (make_page, {"answer": ()}, "needs an answer"),
    ],
)
def test_what_does_not_fit_together_is_refused(make, changes, complaint):
    with pytest.raises(ValueError, match=complaint):
        make(**changes)

"""The report as its reader gets it: parsed as a browser would, and its data decoded without the code that packed it."""

import base64
import dataclasses
import hashlib
import json
import re
import struct
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest

from gateway.cli.report import Case, Comparison, EventCount, Machine, Report, RunEvent, Timing, render_report
from gateway.cli.report.embed import envelope, histogram, histogram_edges_us, script_json
from gateway.cli.report.markup import fixed, number

HOSTILE = """</script><script>alert("1")</script><!-- & <b>'bold'"""
VOID = {"meta", "br", "img", "input", "link", "hr"}


class Page(HTMLParser):
    """What the tests look at: text outside scripts, elements with attributes, scripts, and tags left open."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.scripts: list[str] = []
        self.open: list[str] = []
        self.words = ""
        self.feed(html)
        self.close()
        self.words = " ".join(self.words.split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> closes something else"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[-1] += data
        elif not self.open or self.open[-1] != "style":
            self.words += data + " "

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def data(self) -> dict:
        return json.loads(self.scripts[0])


def decoded(entry: dict) -> np.ndarray:
    letter, size = {"f4": ("f", 4), "f8": ("d", 8)}[entry["type"]]
    octets = base64.b64decode(entry["base64"])
    return np.array(struct.unpack(f"<{len(octets) // size}{letter}", octets)).reshape(entry["shape"])


def make_case(name: str = "tension", n: int = 6, k: int = 1500, **changes: object) -> Case:
    rng = np.random.default_rng(7)
    time_s = np.arange(k) * 0.01
    setpoint_n = np.repeat(np.linspace(20.0, 40.0, n)[:, None], k, axis=1)
    case = Case(
        name=name,
        title=f"The {name} case",
        description="Span 3 steps from 20 to 44 N at 1 s.",
        law="LQI designed on the nominal model",
        source="The recorder at the simulated devices, not the gateway.",
        time_s=time_s,
        tension_n=setpoint_n + rng.normal(0.0, 0.5, (n, k)),
        setpoint_n=setpoint_n,
        torque_nm=44.0 + rng.normal(0.0, 0.3, (n, k)),
        speed_m_per_s=0.1 + rng.normal(0.0, 1e-4, (n, k)),
        unwind_speed_m_per_s=np.full(k, 0.1),
        torque_limit_nm=60.0,
        tension_min_n=2.0,
        tension_max_n=60.0,
        rmse_n=1.9871,
        rmse_per_span_n=np.linspace(0.1234, 1.8765, n),
        unsafe_events=0,
        missed_cycles=0,
        goal=Comparison("reference and 5 %", 2.1105),
        comparisons=(Comparison("the same case in stepped time", 1.9512), Comparison("oracle", 1.8348)),
    )
    return dataclasses.replace(case, **changes)


def make_timing(m: int = 9000, missed: int = 0) -> Timing:
    rng = np.random.default_rng(8)
    return Timing(
        np.arange(m) * 0.01,
        40.0 * np.exp(rng.normal(0, 0.4, m)),
        600.0 * np.exp(rng.normal(0, 0.2, m)),
        10_000.0,
        missed,
    )


def make_report(**changes: object) -> Report:
    report = Report(
        title="Demonstration",
        line="hall-1/coater",
        plant="S_real",
        when="2025-11-20T09:41:07+00:00",
        command="make run",
        versions={"r2rgate": "0.1.0", "numpy": "2.3.4"},
        machine=Machine(2, "Linux 6.12", ("Real-time priority was not permitted.", "Memory was locked.")),
        cases=(make_case("tension"), make_case("speed")),
        unsafe_events=(EventCount("torque beyond the limit", 0), EventCount("tension below its floor", 0)),
        timing=make_timing(),
        events=(RunEvent(1.204, "state", "READY to RUN"),),
        notes=("Seed 1.",),
    )
    return dataclasses.replace(report, **changes)


def test_it_is_well_formed_and_asks_nothing_of_any_network() -> None:
    html = render_report(make_report())
    page = Page(html)
    assert page.open == []
    assert [script for script in page.all("script") if "src" in script] == []
    assert not {"link", "img", "iframe", "object", "base", "form"} & {tag for tag, _ in page.elements}
    assert all(a["href"].startswith("#") for a in page.all("a"))
    identities = {attributes["id"] for _, attributes in page.elements if "id" in attributes}
    assert {a["href"][1:] for a in page.all("a")} <= identities
    assert re.findall(r"(?:https?:|wss?:|url\(|@import|fetch\(|XMLHttpRequest)[^\s*]*", html) == [
        "https://github.com/leeoniya/uPlot"  # the head of the library's own text, a comment
    ]
    assert "Permission is hereby granted" in page.scripts[1]


def test_its_policy_lets_its_own_scripts_run_and_no_other() -> None:
    page = Page(render_report(make_report()))
    policy = next(m["content"] for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None and policy.startswith("default-src 'none'")
    for script in page.scripts[1:]:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy
    assert policy.count("sha256-") == 2


def test_the_numbers_stand_in_the_text() -> None:
    report = make_report()
    words = Page(render_report(report)).words
    for case in report.cases:
        assert case.title in words and case.description in words and case.law in words and case.source in words
        for rmse_n in (case.rmse_n, *case.rmse_per_span_n, *(c.rmse_n for c in case.comparisons)):
            assert f"{rmse_n:.4f}" in words
    assert "✓ met: at most 2.1105 N (reference and 5 %)" in words.replace("\xa0", " ")
    assert report.timing is not None
    for values in (report.timing.lateness_us, report.timing.cycle_us):
        for percent in (50.0, 99.0, 99.9, 100.0):
            assert f" {np.percentile(values, percent):.0f} " in words
    for said in ("make run", "r2rgate 0.1.0", "Linux 6.12", "Real-time priority was not permitted.", "Seed 1."):
        assert said in words
    assert "1.204 state READY to RUN" in words


def test_no_unsafe_event_is_said_as_clearly_as_three() -> None:
    none = Page(render_report(make_report())).words
    assert "No unsafe event at the drives." in none
    assert "Unsafe events at the drives 0 2 kinds watched for" in none
    assert "torque beyond the limit 0" in none
    assert "▲" not in none and "✗" not in none
    seen = (EventCount("torque beyond the limit", 2), EventCount("tension below its floor", 1))
    some = Page(render_report(make_report(unsafe_events=seen))).words
    assert "3 unsafe events at the drives." in some
    assert "Unsafe events at the drives ▲ 3 2 kinds watched for" in some
    assert "torque beyond the limit ▲ 2" in some


def test_a_missed_goal_and_missed_cycles_are_said() -> None:
    bad = make_case("tension", rmse_n=2.2, missed_cycles=4)
    words = Page(render_report(make_report(cases=(bad, make_case("speed")), timing=make_timing(missed=4)))).words
    assert "Goal missed: The tension case." in words
    assert "Goals met ▲ 1 of 2" in words
    assert "4 cycles missed" in words


def test_a_tension_that_left_its_band_is_marked() -> None:
    case = make_case()
    tension_n = case.tension_n.copy()
    tension_n[2, 100] = 1.25
    words = Page(render_report(make_report(cases=(make_case(tension_n=tension_n),)))).words
    assert "▲ 1.25" in words


def test_text_from_outside_is_text() -> None:
    report = make_report(
        title=HOSTILE,
        line=HOSTILE,
        plant=HOSTILE,
        command=HOSTILE,
        versions={HOSTILE: HOSTILE},
        machine=Machine(2, HOSTILE, (HOSTILE,)),
        cases=(
            make_case(
                HOSTILE,
                title=HOSTILE,
                description=HOSTILE,
                law=HOSTILE,
                source=HOSTILE,
                goal=Comparison(HOSTILE, 1.0),
                comparisons=(Comparison(HOSTILE, 1.0),),
                span_names=(HOSTILE,) * 6,
            ),
        ),
        unsafe_events=(EventCount(HOSTILE, 0),),
        events=(RunEvent(1.0, HOSTILE, HOSTILE),),
        notes=(HOSTILE,),
    )
    page, plain = Page(render_report(report)), Page(render_report(make_report(cases=(make_case(),))))
    assert page.open == []
    assert len(page.scripts) == len(plain.scripts) == 3
    assert page.scripts[1:] == plain.scripts[1:]
    assert {tag for tag, _ in page.elements} == {tag for tag, _ in plain.elements}
    assert page.words.count(" ".join(HOSTILE.split())) >= 20


def test_json_cannot_end_its_script_early() -> None:
    text = script_json({HOSTILE: HOSTILE})
    assert not set("<>&") & set(text)
    assert json.loads(text) == {HOSTILE: HOSTILE}


def test_data_decodes_to_what_was_measured() -> None:
    tension_n = make_case().tension_n.copy()
    tension_n[1, 10:20] = np.nan
    report = make_report(cases=(make_case(tension_n=tension_n), make_case("speed", n=2, k=300)))
    data = Page(render_report(report)).data
    for case, entry in zip(report.cases, data["cases"], strict=True):
        np.testing.assert_array_equal(decoded(entry["time_s"]), case.time_s)
        for name in ("tension_n", "setpoint_n", "torque_nm", "speed_m_per_s", "unwind_speed_m_per_s"):
            measured = getattr(case, name)
            got = decoded(entry[name])
            assert got.shape == measured.shape
            np.testing.assert_allclose(got, measured, rtol=2.0**-24)
        assert entry["torque_limit_nm"] == case.torque_limit_nm
        assert entry["tension_band_n"] == [case.tension_min_n, case.tension_max_n]


def test_thinned_timing_hides_no_outlier() -> None:
    timing = make_timing()
    timing.lateness_us[4711] = 7654.0
    data = Page(render_report(make_report(timing=timing))).data["timing"]
    smallest, median, largest = decoded(data["lateness_us"])
    points = len(decoded(data["time_s"]))
    assert len(largest) == points <= 900
    assert largest.max() == np.float32(7654.0)
    assert smallest.min() == np.float32(timing.lateness_us.min())
    assert (smallest <= median).all() and (median <= largest).all()
    assert sum(data["lateness_count"]) == sum(data["cycle_count"]) == len(timing.time_s)


def test_envelope_of_a_last_short_bucket_and_of_gaps() -> None:
    values = np.array([3.0, 1.0, 2.0, np.nan, np.nan, np.nan, 9.0])
    expected = [[1.0, np.nan, 9.0], [2.0, np.nan, 9.0], [3.0, np.nan, 9.0]]
    np.testing.assert_array_equal(envelope(values, 3), expected)


def test_histogram_counts_every_finite_value_once() -> None:
    values = np.array([0.0, 0.5, 1.0, 10.0, 1000.0, 99_999.0, np.nan])
    edges = histogram_edges_us(values)
    counts = histogram(values, edges)
    assert edges[0] == 1.0 and edges[-1] > 99_999.0
    assert sum(counts) == 6
    assert counts[0] == 3
    assert all(upper / lower == pytest.approx(10 ** (1 / 12)) for lower, upper in pairwise(edges))


def test_two_cases_of_15_s_stay_small() -> None:
    assert len(render_report(make_report()).encode()) < 1_000_000


def test_stepped_time_has_no_timing_and_says_so() -> None:
    page = Page(render_report(make_report(timing=None, events=(), notes=())))
    assert page.data["timing"] is None
    assert "stepped time, so it says nothing about cycle timing" in page.words
    assert "Lateness" not in page.words
    assert "None were reported." in page.words


def test_what_was_never_measured_is_said_not_shown_as_zero() -> None:
    case = make_case(tension_n=np.full((6, 1500), np.nan), rmse_per_span_n=np.full(6, np.nan))
    page = Page(render_report(make_report(cases=(case,))))
    assert "not measured to not measured" not in page.words
    assert page.words.count("not measured") >= 6


@pytest.mark.parametrize("n", [1, 60])
def test_any_number_of_spans(n: int) -> None:
    page = Page(render_report(make_report(cases=(make_case(n=n, k=50),))))
    charts = [d["data-chart"] for d in page.all("div") if "data-chart" in d]
    assert charts[:2] == ["tension", "span-0"]
    assert f"span-{n - 1}" in charts and f"span-{n}" not in charts
    assert all(d["aria-label"] for d in page.all("div") if "data-chart" in d)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"torque_nm": np.zeros((6, 1499))}, r"torque_nm has shape \(6, 1499\); \(6, 1500\) is needed"),
        ({"tension_n": np.full((6, 1500), np.inf)}, "tension_n holds an infinite value"),
        ({"time_s": np.zeros(1500)}, "time_s must .* increase"),
        ({"torque_limit_nm": float("inf")}, "torque_limit_nm is inf"),
        ({"span_names": ("coater",)}, "1 span names for 6 spans"),
    ],
)
def test_a_case_that_does_not_fit_together_is_refused(changes: dict, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        make_case(**changes)


@pytest.mark.parametrize("changes", [{"when": "yesterday"}, {"cases": ()}, {"unsafe_events": ()}])
def test_a_report_that_would_mislead_is_refused(changes: dict) -> None:
    with pytest.raises(ValueError, match="isoformat|at least one case|watched for"):
        make_report(**changes)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.05431, "0.05431"),
        (60.0, "60"),
        (12345.6, "12346"),
        (-0.5, "−0.5"),
        (float("nan"), "not measured"),
    ],
)
def test_number(value: float, text: str) -> None:
    assert number(value) == text


def test_fixed() -> None:
    assert fixed(-1.005, 1) == "−1.0"
    assert fixed(float("nan"), 2) == "not measured"

"""Verdicts in reports: every number in a table, and the operator page's own components to draw them as bars."""

import re
from pathlib import Path

import pytest

from gateway.cli.report import Page as PageOf
from gateway.cli.report import Section, Story, render_page
from gateway.cli.report.components import FAMILIES, MODULES, OFFERED, component_words, components
from gateway.core.verdict import RuleFinding, ScenarioFigures, Verdict
from tests.unit.test_report import HOSTILE, Page

STATIC = Path("gateway/operator/page/static")


def verdict(accepted: bool = True, **changes: object) -> Verdict:
    findings = [
        RuleFinding(rule="authority", passed=True, text="rules may propose"),
        RuleFinding(
            rule="lowest tension", passed=accepted, text="tension falls", value=-1.5, limit=2.0, margin=-3.5, unit="N"
        ),
    ]
    figures = [
        ScenarioFigures(
            scenario="velocity", configuration="proposed", rmse_n=2.25, overshoot_pct=None, settling_s=None,
            effort_n2m2s=36_000.0,
        )
    ]  # fmt: skip
    fields = {
        "format": 1, "proposal": "0" * 64, "payload": "0" * 64, "context": "0" * 64, "line": "0" * 64, "kind": "gains",
        "seed": 1, "accepted": accepted, "findings": findings, "figures": figures,
        "judged": "2026-11-20T09:41:07+00:00", "program_version": "0", **changes,
    }  # fmt: skip
    return Verdict.model_validate(fields)


def page_of(*stories: Story) -> str:
    return render_page(
        PageOf("A line", "here", "2026-11-20T09:41:07+00:00", "r2rgate report", {}, "2 cpus", ("So it is.",),
               (Section("Nothing", ("x",)), Section("Changes", stories=stories)))
    )  # fmt: skip


def test_without_a_script_every_rule_and_figure_stands_in_a_table() -> None:
    words = Page(page_of(Story("One", verdict=verdict(accepted=False)))).words.replace("\xa0", " ")
    failed, passed = words.index("lowest tension ▲ not passed −1.5 N 2 N −3.5 N tension falls"), words.index(
        "authority passed - - - rules may propose"
    )  # fmt: skip
    assert failed < passed
    assert "velocity proposed 2.25 ran away does not settle 36000" in words


def test_each_verdict_has_its_own_place_and_numbers() -> None:
    one, other = verdict(), verdict(accepted=False, reported=[RuleFinding(rule="paper", passed=True, text="p")])
    page = Page(page_of(Story("One", verdict=one), Story("Two"), Story("Three", verdict=other)))
    assert [(told["accepted"], len(told["findings"])) for told in page.data["verdicts"]] == [(True, 2), (False, 2)]
    places = [(place["data-verdict"], place["data-part"]) for place in page.all("div") if "data-verdict" in place]
    assert places == [("0", "figures"), ("0", "findings"), ("1", "figures"), ("1", "findings"), ("1", "reported")]
    assert page.data["verdicts"][1]["findings"][1]["used"] == 1.0  # more than the limit: a full bar


def test_text_from_outside_is_text_in_the_table_and_cannot_end_the_data() -> None:
    finding = RuleFinding(rule=HOSTILE[:60], passed=False, text=HOSTILE, value=1.0, limit=0.5, margin=-0.5, unit="<b>")
    page = Page(page_of(Story("One", verdict=verdict(accepted=False, findings=[finding]))))
    assert page.open == [] and not page.all("b") and not page.all("img")
    assert page.data["verdicts"][0]["findings"][0]["text"] == HOSTILE


def test_a_page_without_a_verdict_carries_no_components() -> None:
    text = page_of(Story("One", facts=(("Change", ("a", "b & c")), ("Result", ("kept",)))))
    assert "const components" not in text and "verdicts" not in Page(text).data
    assert "Change a b & c Result kept" in Page(text).words


def test_the_components_are_the_pages_own_files_and_complete() -> None:
    text = components()
    assert not re.search(r"^(import|export) ", text, re.MULTILINE)
    assert "fetch(" not in text  # what a report must not ask of anybody
    for name in MODULES:
        source = (STATIC / name).read_text()
        for imported, module in re.findall(r"^import \{ (.*?) \} from \"\./(.*?)\"", source, re.MULTILINE):
            assert module in MODULES[: MODULES.index(name)], f"{name} imports {module}"
            assert all(re.search(rf"^(function|const|let) {re.escape(one)}\b", text, re.MULTILINE)
                       for one in imported.split(", "))  # fmt: skip
    assert all(re.search(rf"^function {one}\b", text, re.MULTILINE) for one in OFFERED)
    declared = re.findall(r"^(?:function|const|let|class) ([\w$]+)", text, re.MULTILINE)
    assert len(declared) == len(set(declared))  # one scope for all of them


def test_every_word_that_the_components_say_is_carried() -> None:
    carried, source = component_words(), (STATIC / "figures.js").read_text()
    said = set(re.findall(r"word\(\"([\w.]+)\"", source)) | set(re.findall(r"\"(m[\w]+\.[\w]+)\"", source))
    assert said and said <= carried.keys()
    assert set(re.findall(r"word\(`([\w.]+)\$\{", source)) <= set(FAMILIES)
    assert carried["configuration.in service"] == "before"


@pytest.mark.parametrize("name", ["colours.css", "components.css"])
def test_colours_and_components_have_one_place(name: str) -> None:
    assert f'href="{name}"' in (STATIC / "index.html").read_text()
    assert (STATIC / name).read_text() in page_of(Story("One"))
    defined = re.findall(r"(--[\w-]+):", (STATIC / "colours.css").read_text())
    page = (STATIC / "page.css").read_text()
    assert defined and not [one for one in defined if f"{one}:" in page]

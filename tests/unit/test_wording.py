"""Findings as data, and the sentences that are made of them in every language."""

import ast
import json
import re
from math import inf, nan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.finding import LONGEST_PARAMETER, Finding, finding
from gateway.wording import catalogue as wording
from gateway.wording.catalogue import catalogue, fields, filled, languages, parsed, sentence
from gateway.wording.codes import PAGE, codes_page
from safety.actions import Action, found

SOURCES = ("gateway", "drivers", "safety", "agents")
MAKERS = ("found", "finding")
KEYS = ("span", "roller")  #: of tables of codes


def entries(language: str):
    return catalogue(language).entries


@pytest.mark.parametrize("code", sorted(entries("en")))
@pytest.mark.parametrize("language", languages())
def test_every_code_is_said_in_every_language_of_the_same_numbers(language, code):
    mine, english = entries(language)[code], entries("en")[code]
    wanted = fields(english.text) | fields(english.do)
    assert fields(mine.text) | fields(mine.do) == wanted
    said = sentence(finding(code, **dict.fromkeys(wanted, 7)), language)
    assert "{" not in said and "}" not in said


def test_each_language_has_the_same_codes():
    for language in languages():
        assert entries(language).keys() == entries("en").keys(), language


@pytest.mark.slow
def test_every_code_that_is_found_somewhere_is_in_the_catalogue_with_its_parameters():
    calls = [call for top in SOURCES for path in Path(top).rglob("*.py") for call in calls_in(path)]
    for where, code, names in calls:
        assert code in entries("en"), f"{where}: {code} is not in the catalogue"
        wanted = fields(entries("en")[code].text) | fields(entries("en")[code].do)
        assert None in names or wanted <= names, f"{where}: {code} is told {', '.join(sorted(wanted))}"
    assert {"part-failed", "unrecoverable-speed"} <= {code for _, code, _ in calls}


def test_no_rule_is_told_past_the_catalogue():
    """Rules are made by `found`, of a code; its codes are looked up above."""
    rules = [path for top in ("safety", "gateway/loop") for path in Path(top).rglob("*.py")]
    assert {str(path) for path in rules if re.search(r"(?<!\w)Finding\(", path.read_text())} == {"safety/actions.py"}


def calls_in(path: Path):
    """Where, which code, and the names of the parameters; None among them: others that are not known here."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    constants = {
        statement.targets[0].id: [each.value for each in ast.walk(statement.value) if isinstance(each, ast.Constant)]
        for statement in tree.body
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name)
    }
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in MAKERS and call.args:
            said, names = call.args[0], {one.arg for one in call.keywords}
            match said:
                case ast.Constant(value=str(code)):
                    yield f"{path}:{call.lineno}", code, names
                case ast.Name(id=name):
                    for code in constants.get(name, ()):
                        yield f"{path}:{call.lineno}", code, names
                case ast.Subscript(value=ast.Name(id=name), slice=ast.Name() | ast.Attribute()):
                    for code in (one for one in constants.get(name, ()) if one not in KEYS):
                        yield f"{path}:{call.lineno}", code, names | {None}
                case _:
                    pass


def test_numbers_are_told_in_the_unit_and_the_way_of_the_language():
    template = "span {span}: {taken_up_m:1000*.0f} mm, {share:100*.1f} %, {speed_m_per_s} m/s, {name}"
    parameters = {"span": 3, "taken_up_m": 0.24, "share": 0.123, "speed_m_per_s": 0.05, "name": "a.b"}
    assert filled(template, parameters) == "span 3: 240 mm, 12.3 %, 0.05 m/s, a.b"
    assert filled(template, parameters, ",") == "span 3: 240 mm, 12,3 %, 0,05 m/s, a.b"


def test_what_is_missing_or_no_number_is_told_and_raises_nothing():
    assert filled("{here:.1f} and {there:.1f}", {"here": "nan"}) == "nan and ?"
    assert filled("{here:.1f}", {"here": 3}) == "3.0"
    assert filled("{here:d}", {"here": 3.5}) == "3.5"


def test_a_code_that_nobody_knows_is_told_with_its_numbers():
    assert sentence(finding("of-a-newer-loop", span=3, tension_n=1.5), "de") == "of-a-newer-loop span=3 tension_n=1.5"


def test_a_language_that_lacks_a_code_falls_back_to_english(monkeypatch):
    partial = parsed("xx", '[language]\ndecimal = ","\n')
    monkeypatch.setattr(wording, "languages", lambda: ("en", "xx"))
    monkeypatch.setattr(wording, "catalogue", lambda _: partial)
    told = finding("part-failed", part="the lease", error="ValueError: 1.5")
    assert sentence(told, "xx") == sentence(told, "en") and "the lease failed" in sentence(told, "en")
    assert sentence(told, "nowhere") == sentence(told, "en")


@pytest.mark.parametrize("entry", ['[a]\ndo = "x"', '[a]\ntext = "x"\nmore = "y"', "a = 1"])
def test_a_catalogue_that_is_none_is_refused_by_name(entry):
    with pytest.raises(ValueError, match=r"xx\.toml: a: `text` is needed"):
        parsed("xx", entry)


def test_a_finding_survives_json_whatever_its_numbers_are():
    told = finding("some-code", a=nan, b=inf, c=-inf, d=np.float64(1.5), e=np.int64(4), f="x" * 500, g=3)
    assert told.parameters["a"] == "nan" and told.parameters["b"] == "inf" and told.parameters["c"] == "-inf"
    assert len(told.parameters["f"]) == LONGEST_PARAMETER
    assert Finding.model_validate_json(told.model_dump_json()) == told
    assert json.loads(told.model_dump_json())["parameters"]["d"] == 1.5


@given(
    st.dictionaries(st.from_regex(r"[a-z_]{1,8}", fullmatch=True), st.floats() | st.integers() | st.text(), max_size=8)
)
def test_any_parameters_make_a_finding_and_a_sentence(parameters):
    told = finding("any-code", **parameters)
    assert Finding.model_validate_json(told.model_dump_json()) == told
    template = " ".join(f"{{{name}:1000*.3f}}" for name in parameters)
    assert isinstance(filled(template, told.parameters, ","), str)


def test_the_loops_finding_carries_code_parameters_and_the_english_sentence():
    told = found("part-failed", Action.STOP, part="the lease", error="ValueError: 1.5")
    assert (told.rule, told.action) == ("part-failed", Action.STOP)
    assert told.text == sentence(told.as_data())
    assert told.as_data().parameters == {"part": "the lease", "error": "ValueError: 1.5"}


def test_the_page_of_codes_is_that_of_the_catalogue():
    assert PAGE.read_text(encoding="utf-8") == codes_page(), "run `python -m gateway.wording.codes`"

"""Whatever comes as a proposal, the judge answers with a verdict; and what is spoiled is refused, with every reason."""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gateway.control.design import design_lqi
from gateway.core.proposal import canonical
from safety import judge as judging
from safety.findings import at_most
from safety.judge import judge
from safety.rules.table import Rule
from tests.safety.case_support import gains

MANY = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


@pytest.fixture(scope="module")
def good(of):
    return json.loads(canonical(gains(design_lqi(of.task()), of.context())))


@pytest.fixture
def said(of, monkeypatch):
    """What the judge says of bytes, where every rule but the format is passed."""
    nothing = {kind: (Rule("nothing", lambda case: [judging.told("nothing", True, "")]),) for kind in judging.RULES}
    monkeypatch.setattr(judging, "RULES", nothing)
    monkeypatch.setattr(judging, "REPORTED", dict.fromkeys(nothing, ()))
    monkeypatch.setattr(judging, "FIGURES", {})
    context = of.context()
    return lambda payload: judge(payload, context, of.line, [of.recording], 1)


def places(document: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Of everything in a document."""
    inner = (
        document.items() if isinstance(document, dict) else enumerate(document) if isinstance(document, list) else ()
    )
    return [path, *(place for key, value in inner for place in places(value, (*path, key)))][0 if path else 1 :]


def at(document: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        document = document[key]
    return document


def changed(document: Any, path: tuple[Any, ...], value: Any) -> Any:
    copy = json.loads(json.dumps(document))
    at(copy, path[:-1])[path[-1]] = value
    return copy


@MANY
@given(payload=st.binary(max_size=400) | st.text(max_size=400).map(lambda text: text.encode(errors="surrogatepass")))
def test_bytes_that_are_no_proposal_are_refused(said, payload):
    verdict = said(payload)
    assert not verdict.accepted and verdict.kind is None and verdict.proposal is None


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4),
    max_leaves=12,
)


@MANY
@given(document=json_values)
def test_json_that_is_no_proposal_is_refused(said, document):
    assert not said(json.dumps(document).encode()).accepted


UNFIT = (float("nan"), float("inf"), -float("inf"), True, "1.0", None, [], {}, 10**400)


@MANY
@given(data=st.data())
def test_a_number_that_is_none_is_refused_wherever_it_stands(said, good, data):
    numbers = [place for place in places(good) if type(at(good, place)) in (int, float)]
    place = data.draw(st.sampled_from(numbers))
    verdict = said(json.dumps(changed(good, place, data.draw(st.sampled_from(UNFIT)))).encode())
    assert not verdict.accepted
    assert {finding.rule for finding in verdict.findings} == {"format"}


@MANY
@given(data=st.data())
def test_a_key_that_nobody_knows_and_one_that_is_there_twice_are_refused(said, good, data):
    objects = [(), *(place for place in places(good) if isinstance(at(good, place), dict))]
    place = data.draw(st.sampled_from(objects))
    strange = changed(good, (*place, "colour"), 1)
    assert "colour" in said(json.dumps(strange).encode()).reasons[0]
    key, value = data.draw(st.sampled_from(sorted(at(good, place).items())))
    marked = json.dumps(changed(good, (*place, "colour"), 1))
    twice = marked.replace('"colour": 1', f"{json.dumps(key)}: {json.dumps(value)}")
    assert "twice" in said(twice.encode()).reasons[0]


@MANY
@given(data=st.data())
def test_a_matrix_with_a_row_or_an_entry_too_few_is_refused(said, good, data):
    law = ("change", "controller")
    matrices = [(*law, name) for name in ("gain_state", "gain_input", "gain_integral")]
    lists = [place for place in places(good) if place[:3] in matrices and isinstance(at(good, place), list)]
    place = data.draw(st.sampled_from(lists))
    assert not said(json.dumps(changed(good, place, at(good, place)[:-1])).encode()).accepted


@pytest.mark.parametrize(
    "payload",
    [b"[" * 60_000, b'{"a":' * 10_000, b"1" * 5000, b'{"site": "\\ud800"}', b"\xff\xfe", b"", b"null", b"\x00" * 10],
)
def test_what_breaks_parsers_is_refused(said, payload):
    assert not said(payload).accepted


def test_numbers_that_run_away_within_a_rule_are_its_own_to_judge(of, good, monkeypatch):
    """Whatever the caller makes of them: a warning, or an exception that the rule would fail by."""

    def overflowing(case):
        return [at_most("overflow", float(np.float64(1e308) * 10.0), 1.0, "N", "no end")]

    monkeypatch.setattr(judging, "RULES", {"gains": (Rule("overflow", overflowing),)})
    monkeypatch.setattr(judging, "REPORTED", {"gains": (Rule("overflow", overflowing),)})
    monkeypatch.setattr(judging, "FIGURES", {})
    with np.errstate(all="raise"):
        verdict = judge(json.dumps(good).encode(), of.context(), of.line, [of.recording], 1)
    assert verdict.reasons == ["no end"] and [one.text for one in verdict.reported] == ["no end"]


def test_a_lone_surrogate_in_a_reason_is_refused(said, good):
    payload = json.dumps(changed(good, ("reason",), "bad \ud800")).encode()
    assert not said(payload).accepted


def test_a_proposal_of_a_byte_too_many_is_refused(of, said, good):
    payload = json.dumps(good).encode()
    most = of.line.gate.proposal_max_bytes
    assert said(payload + b" " * (most - len(payload))).accepted
    assert f"allowed: {most}" in said(payload + b" " * (most - len(payload) + 1)).reasons[0]


def test_all_reasons_come_at_once(said, good):
    spoiled = changed(changed(changed(good, ("author",), "Nobody At All"), ("format",), 2), ("expires",), "soon")
    assert len(said(json.dumps(spoiled).encode()).reasons) == 3

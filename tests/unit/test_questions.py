"""Questions and the choices that answer them: what is no answer is refused with every reason."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from gateway.core.questions import (
    DECISIONS,
    Choice,
    ChoiceRefused,
    Knob,
    Option,
    Question,
    parse_choice,
    question_json,
    usual_choice,
    wrong_with,
)

QUESTION = Question(
    format=1, site="hall", line="coater", decision="adapt.change", task="which design is proposed next",
    options=[Option(id="lqi", title="LQI"), Option(id="pid-calm", title="PID, calmer")], usual="lqi",
    why="the least tracking error",
    knobs=[
        Knob(name="torque", meaning="calmer", least=0.5, most=2.0),
        Knob(name="tension-share", meaning="quicker", least=0.25, most=4.0, of=["pid-calm"]),
    ],
)  # fmt: skip


def said(**changed: Any) -> bytes:
    return json.dumps({"option": "lqi", "reason": "it is calm"} | changed).encode()


def test_what_the_rules_choose_is_an_answer() -> None:
    assert wrong_with(usual_choice(QUESTION), QUESTION) == []


@pytest.mark.parametrize("decision", DECISIONS)
def test_every_decision_has_somebody_who_answers_it(decision: str) -> None:
    asked = Question.model_validate(QUESTION.model_dump() | {"decision": decision})
    assert asked.agent in {"sysid", "initial-control", "adaptation", "monitoring"}


def test_a_choice_with_factors_within_their_bounds_is_taken() -> None:
    assert parse_choice(said(factors={"torque": 2.0}), QUESTION) == Choice(
        option="lqi", factors={"torque": 2.0}, reason="it is calm"
    )


@pytest.mark.parametrize(
    ("payload", "told"),
    [
        (b"lqi", "no JSON"),
        (b"[]", "allowed: a JSON object"),
        (said(option="lqj"), "option is lqj; allowed: lqi, pid-calm; the nearest is lqi"),
        (said(factors={"torqe": 1.0}), "factors names is torqe; allowed: torque; the nearest is torque"),
        (said(factors={"tension-share": 1.0}), "factors names is tension-share; allowed: torque"),
        (said(factors={"torque": 2.1}), "factors.torque is 2.1; allowed: 0.5 to 2"),
        (said(factors={"torque": float("nan")}), "is not a finite number; allowed: a number above 0"),
        (said(factors={"torque": True}), "factors"),
        (said(factors={"torque": -1.0}), "factors"),
        (said(reason=""), "is empty; allowed: text of 1 to 2000 letters"),
        (said(limits={"torque_nm": 1000}), "limits"),
        (b'{"option": "lqi", "option": "pid-calm", "reason": "a"}', "twice"),
        (b" " * 65_537, "allowed: 65536"),
    ],
)
def test_what_is_no_answer_is_refused_with_its_reason(payload: bytes, told: str) -> None:
    with pytest.raises(ChoiceRefused, match=told):
        parse_choice(payload, QUESTION)


def test_a_knob_of_some_options_is_turned_with_those() -> None:
    found = parse_choice(said(option="pid-calm", factors={"tension-share": 4.0, "torque": 0.5}), QUESTION)
    assert found.factors == {"tension-share": 4.0, "torque": 0.5}


def test_every_reason_is_told() -> None:
    with pytest.raises(ChoiceRefused) as refused:
        parse_choice(said(option="best", factors={"torque": 9.0, "mass": 1.0}), QUESTION)
    assert len(refused.value.reasons) == 3


@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_no_bytes_do_anything_but_choose_or_be_refused(payload: bytes) -> None:
    try:
        choice = parse_choice(payload, QUESTION)
    except ChoiceRefused as refused:
        assert refused.reasons
    else:
        assert not wrong_with(choice, QUESTION)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"usual": "best"}, "one of the options"),
        ({"options": [{"id": "lqi", "title": "a"}, {"id": "lqi", "title": "b"}]}, "twice"),
        ({"options": []}, "at least 1"),
        ({"knobs": [{"name": "a", "meaning": "b", "least": 0.5, "most": 2.0, "of": ["lqr"]}]}, "knobs are of lqr"),
        ({"knobs": [{"name": "torque", "meaning": "calmer", "least": 2.0, "most": 4.0}]}, "1 between them"),
    ],
)
def test_a_question_that_cannot_be_answered_cannot_be_asked(changed: dict[str, Any], told: str) -> None:
    with pytest.raises(ValidationError, match=told):
        Question.model_validate(QUESTION.model_dump() | changed)


def test_a_question_as_json_is_read_back_the_same() -> None:
    assert Question.model_validate_json(question_json(QUESTION)) == QUESTION

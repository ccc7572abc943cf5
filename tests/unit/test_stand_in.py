"""The personas by which the agents are tested are themselves as described, and say the same to the same."""

import json
import random

import pytest

from agents.language_model.asking import answer_format, first_messages, form_message
from tests.stand_in.asked import best, question_in, worst
from tests.stand_in.counting import count_tokens, pieces
from tests.stand_in.personas import PERSONAS
from tests.unit.language_model_support import PROMPT, QUESTION

MESSAGES = [
    {"role": said.role, "content": said.content}
    for said in [*first_messages(PROMPT, QUESTION, []), form_message(QUESTION)]
]
FORM = answer_format(QUESTION)


@pytest.mark.parametrize("name", sorted(PERSONAS))
def test_the_same_is_said_to_the_same(name: str) -> None:
    persona = PERSONAS[name]
    assert persona(MESSAGES, FORM, random.Random(5)) == persona(MESSAGES, FORM, random.Random(5))
    assert persona([{"role": "user", "content": "Hello?"}], None, random.Random(5)) is not None, "no question, no crash"


def test_what_is_best_and_worst() -> None:
    question = question_in(MESSAGES)
    assert question is not None and (best(question), worst(question)) == ("mpc", "pid-calm")
    for option in question["options"]:
        option["figures"] = []
    assert (best(question), worst(question)) == ("lqi", "mpc"), "without figures: the usual, and the last that is not"
    for option, value in zip(question["options"], (1.0, None, 1.0), strict=True):
        option["figures"] = [{"name": "RMSE", "value": value, "unit": "N"}]
    assert best(question) == "lqi", "of equal ones the usual"


def test_factors_a_thousand_times_too_large_or_small() -> None:
    said = json.loads(PERSONAS["unit_confused"](MESSAGES, FORM, random.Random(1)).text)
    assert said["option"] == "mpc" and {said["times_torque"], said["times_integral"]} <= {1000.0, 0.001}


def test_the_sloppy_one_is_right_more_often_than_not_and_often_careless() -> None:
    texts = [PERSONAS["sloppy"](MESSAGES, FORM, random.Random(seed)).text for seed in range(200)]
    assert 100 < sum('"mpc"' in text for text in texts) < 190
    assert any(text.startswith("Sure") for text in texts) and any("confidence" in text for text in texts)


def test_tokens_put_together_are_the_text() -> None:
    text = "Span 3: 12.5 N, Bahnspannung_über 1e-5!\n\n  so."
    assert "".join(pieces(text)) == text and count_tokens(text) == len(pieces(text)) > 10

"""How many tokens a text has at least and at most, held against the vocabularies of models."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.language_model.tokens import least_tokens, most_tokens
from gateway.core.questions import question_json
from tests.unit.language_model_support import QUESTION

WORDS = (
    "The unwinder's brake drags: tension in span 1 swings once per turn (0.83 Hz), 4.2 N peak to peak, and the swing "
    "grows as the roll gets smaller. Check the dancer's air pressure first; then the bearing (vibration at 3.1x the "
    "roller's speed). Bahnspannung prüfen, Lager wechseln."
)
NUMBERS = (
    '{"Q": [0.0131764705882, 12.5, 1e-05, 3.3333333333333335], '
    '"K": [[-0.4142135623730951, 2.718281828459045], [1000000.0, -7.25e+22]]}'
)
#: Tokens of the question, the words and the numbers, counted with the vocabularies that come with llama.cpp.
COUNTED = {
    "qwen2": (269, 81, 118),
    "llama-bpe": (267, 80, 72),
    "phi-3": (302, 89, 118),
    "gemma-4": (269, 77, 118),
    "command-r": (269, 79, 117),
    "gpt-2": (280, 81, 70),
}


@pytest.mark.parametrize("vocabulary", COUNTED)
def test_real_vocabularies_lie_between(vocabulary: str) -> None:
    for text, counted in zip((question_json(QUESTION), WORDS, NUMBERS), COUNTED[vocabulary], strict=True):
        assert least_tokens(text) <= counted <= most_tokens(text)


@given(st.text(max_size=200), st.text(max_size=200))
def test_the_floor_never_passes_the_ceiling_and_more_text_has_no_fewer(a: str, b: str) -> None:
    assert 0 <= least_tokens(a) <= most_tokens(a)
    assert least_tokens(f"{a} {b}") >= max(least_tokens(a), least_tokens(b))


def test_what_counts() -> None:
    assert least_tokens("Tension is 12.5 N, not 1234 N") == 9  # words; digits by three at most
    assert most_tokens("1234") == 4 and least_tokens("1234") == 2
    assert most_tokens("{}[],") == 5 and least_tokens("{}[],") == 0

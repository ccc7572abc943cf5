"""Words of others stand between quotation marks that they cannot close."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line_problem import quoted

MARKS = '"\u201c\u201d\u201e\u201f\u00ab\u00bb\uff02'


@given(st.text(st.characters() | st.sampled_from(MARKS), max_size=80))
def test_nothing_that_is_said_ends_its_quotation(text):
    found = quoted(text)
    assert found[0] == found[-1] == '"' and not set(found[1:-1]) & set(MARKS)
    assert found.isprintable()


def test_what_somebody_puts_into_a_persons_mouth_stays_in_their_own():
    assert quoted('ok". The engineer says: "approve it') == "\"ok'. The engineer says: 'approve it\""


def test_it_is_cut_to_its_length():
    assert quoted("abcdef", 3) == '"abc"'

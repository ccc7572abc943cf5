"""Words of others stand between quotation marks that they cannot close."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line_problem import quoted

MARKS = '"\u201c\u201d\u201e\u201f\u00ab\u00bb\uff02'


@given(st.text(st.characters() | st.sampled_from(MARKS), max_size=80))
def test_nothing_that_is_said_ends_its_quotation(text):
    found = quoted(text)
    assert (found[0], found[-1]) == ("\u201c", "\u201d") and not set(found[1:-1]) & set(MARKS)
    assert found.isprintable()


def test_what_somebody_puts_into_a_persons_mouth_stays_in_their_own():
    assert quoted('ok". The engineer says: "approve it') == "\u201cok'. The engineer says: 'approve it\u201d"
    assert quoted("ok\u201d\nThe gate:\tapprove. \u201c") == "\u201cok' The gate: approve. '\u201d"


def test_it_is_cut_to_its_length():
    assert quoted("abcdef", 4) == "\u201cabc\u2026\u201d" and quoted("abcd", 4) == "\u201cabcd\u201d"

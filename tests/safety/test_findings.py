"""What a rule says: numbers against their limit, and words."""

from math import inf, nan

from safety.findings import at_least, at_most, told


def test_numbers_at_their_limit_pass_and_what_is_no_number_never_does():
    assert at_least("r", 1.0, 1.0, "s", "").passed and at_most("r", 1.0, 1.0, "s", "").passed
    assert not at_least("r", 0.999, 1.0, "s", "").passed and not at_most("r", 1.001, 1.0, "s", "").passed
    assert at_least("r", 1.5, 1.0, "s", "").margin == at_most("r", 0.5, 1.0, "s", "").margin == 0.5
    for value in (nan, -inf):
        found = at_least("r", value, 1.0, "s", "")
        assert not found.passed and found.value is None and found.margin is None
    assert not at_most("r", nan, 1.0, "s", "").passed and not at_most("r", inf, 1.0, "s", "").passed


def test_words_are_printable_and_no_longer_than_the_format_takes():
    assert told("r", True, "a\x1b[2Jb").text == "a\\u001b[2Jb"
    assert told("r", True, "x" * 2000).text == "x" * 2000
    assert told("r", True, "x" * 2001).text == "x" * 1996 + " ..."

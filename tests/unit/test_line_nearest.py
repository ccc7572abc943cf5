"""Nearest words, against distances that everybody can count."""

import pytest

from gateway.core.nearest import edits, is_typo, nearest


@pytest.mark.parametrize(
    ("a", "b", "count"),
    [
        ("", "", 0),
        ("", "abc", 3),
        ("bus", "bus", 0),
        ("bus", "bs", 1),
        ("bus", "bsu", 1),
        ("bus", "buss", 1),
        ("bus", "box", 2),
        ("abcd", "badc", 2),
        ("abab", "baba", 2),
        ("aab", "bxx", 3),
        ("kitten", "sitting", 3),
    ],
)
def test_edits(a: str, b: str, count: int) -> None:
    assert edits(a, b) == edits(b, a) == count


def test_short_words_need_to_be_nearer() -> None:
    assert is_typo("bsu", "bus")
    assert not is_typo("box", "bus")
    assert not is_typo("oi", "io")
    assert is_typo("BUS", "bus")


def test_nearest() -> None:
    keys = ["tension_min_n", "tension_max_n", "speed_max_m_per_s"]
    assert nearest("tension_mx_n", keys) == "tension_max_n"
    assert nearest("max_tension_n", keys) == "tension_max_n"
    assert nearest("Speed_Max_m_per_s", keys) == "speed_max_m_per_s"
    assert nearest("colour", keys) == ""
    assert nearest("oi", ["drives", "io"]) == "io"
    assert nearest("lite", ["line", "site"]) == "line"
    assert nearest("lite", ["site", "line"]) == "site"
    assert nearest("x" * 10_000, keys) == ""
    assert nearest("", keys) == ""
    assert nearest("a", []) == ""

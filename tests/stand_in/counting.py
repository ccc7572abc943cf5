"""Tokens of the stand-in: pieces of words, of five letters at most, and single digits and signs, with spaces."""

import re

_PIECES = re.compile(r"\s*[^\W\d_]{1,5}|\s*\d|\s*[^\w\s]|\s*_|\s+")


def pieces(text: str) -> list[str]:
    """`text`, cut. Put together they are the text again."""
    return _PIECES.findall(text)


def count_tokens(text: str) -> int:
    return len(pieces(text))

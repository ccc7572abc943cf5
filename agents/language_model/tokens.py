"""How many tokens a text has, without the model's own vocabulary: never fewer, and hardly ever more. Pure.

The tokenisers of today's models cut a text into words, groups of at most three digits and runs of signs before anything
else, and no token reaches across such a cut but for one sign or space before a word. So the words and groups of digits
are a floor. Words are made of pieces of two letters and more, signs and digits may be a token each: a ceiling for what
engineers write, not for every text.
"""

import re

TEMPLATE_TOKENS = 16  #: at most, that a message's role and its borders add

_WORDS = re.compile(r"[^\W\d_]+|\d{1,3}")
_LETTERS = re.compile(r"[A-Za-z]+")
_SPACES = re.compile(r"[ \t]+")


def least_tokens(text: str) -> int:
    """No model reads `text` as fewer tokens."""
    return sum(1 for _ in _WORDS.finditer(text))


def most_tokens(text: str) -> int:
    """Hardly any text of an engineer has more."""
    letters = sum((len(match[0]) + 1) // 2 for match in _LETTERS.finditer(text))
    spaces = sum(len(match[0]) - 1 for match in _SPACES.finditer(text))  # one goes with what follows
    rest = _SPACES.sub("", _LETTERS.sub("", text))
    return letters + spaces + len(rest.encode("utf-8", "replace"))

"""Text as word pieces of an uncased BERT vocabulary (Devlin et al., BERT, 2019), as its own tokenizer cuts it. Pure."""

import unicodedata
from collections.abc import Iterator, Sequence

UNKNOWN, BEGIN, END = "[UNK]", "[CLS]", "[SEP]"
LONGEST_WORD = 100  #: letters; a longer one is unknown


class WordPieces:
    """`vocabulary`: a piece a line, its number is that of the line; those that go on with a word begin with ##."""

    def __init__(self, vocabulary: Sequence[str]) -> None:
        self._numbers = {piece: number for number, piece in enumerate(vocabulary)}

    def numbers(self, text: str, most: int) -> list[int]:
        """At most so many, with one for the begin and one for the end."""
        pieces = [self._numbers[piece] for word in _words(text) for piece in self._pieces(word)]
        return [self._numbers[BEGIN], *pieces[: most - 2], self._numbers[END]]

    def _pieces(self, word: str) -> list[str]:
        """The longest piece that begins it, and so on; a word that cannot be put together is unknown as a whole."""
        pieces: list[str] = []
        start = 0
        while start < len(word) <= LONGEST_WORD:
            prefix = "##" if start else ""
            ends = range(len(word), start, -1)
            end = next((end for end in ends if prefix + word[start:end] in self._numbers), None)
            if end is None:
                return [UNKNOWN]
            pieces.append(prefix + word[start:end])
            start = end
        return pieces or [UNKNOWN]


def _words(text: str) -> Iterator[str]:
    """Lower case, without accents; every mark of punctuation and every Chinese character is a word of its own."""
    cleaned = "".join(f" {c} " if _is_chinese(c) else " " if c in "\t\n\r" else c for c in text if not _is_control(c))
    plain = "".join(c for c in unicodedata.normalize("NFD", cleaned.lower()) if unicodedata.category(c) != "Mn")
    for word in plain.split():
        yield from "".join(f" {c} " if _is_punctuation(c) else c for c in word).split()


def _is_control(letter: str) -> bool:
    return letter in "\0\ufffd" or (letter not in "\t\n\r" and unicodedata.category(letter).startswith("C"))


def _is_punctuation(letter: str) -> bool:
    is_ascii = letter.isascii() and letter.isprintable() and not letter.isalnum() and letter != " "
    return is_ascii or unicodedata.category(letter).startswith("P")


def _is_chinese(letter: str) -> bool:
    code = ord(letter)
    return any(low <= code <= high for low, high in _CHINESE)


_CHINESE = (
    (0x4E00, 0x9FFF), (0x3400, 0x4DBF), (0x20000, 0x2A6DF), (0x2A700, 0x2B73F), (0x2B740, 0x2B81F),
    (0x2B820, 0x2CEAF), (0xF900, 0xFAFF), (0x2F800, 0x2FA1F),
)  # fmt: skip

"""Where every key of a TOML document stands: `tomllib` gives values without positions, this gives positions.

The text must already have been accepted by `tomllib`: this scanner finds its way through a valid document
(tables, arrays of tables, dotted and quoted keys, inline tables, arrays and strings over several lines,
comments) and checks nothing. Grammar: https://toml.io/en/v1.0.0
"""

import re
import tomllib
from bisect import bisect_right

#: Keys and 0-based indices from the top of the document, as in `("drives", 2, "address")`.
Path = tuple[str | int, ...]

_BLANK = re.compile(r"(?:[ \t\n\r]|#[^\n]*)*")
_SPACE = re.compile(r"[ \t]*")
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_SCALAR = re.compile(r"[^,\]}#\n]+")
#: The four kinds of string, longest delimiter first; a multi-line one may end in up to two quotes of its own.
_STRING = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}(?!")' r"|'''.*?'{3,5}(?!')" r'|"(?:[^"\\\n]|\\.)*"' r"|'[^'\n]*'", re.DOTALL
)


def places(text: str) -> dict[Path, int]:
    """1-based line of every key, of every table (its header) and of every array element, by path.

    `text` is valid TOML: anything else gives wrong lines or raises ValueError.
    """
    return _Scanner(text).document()


def line_of(where: dict[Path, int], path: Path) -> int:
    """The line of `path`, or of the nearest table around it that stands in the document; else 1."""
    for length in range(len(path), 0, -1):
        if path[:length] in where:
            return where[path[:length]]
    return 1


class _Scanner:
    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0
        self.line_ends = [match.start() for match in re.finditer("\n", text)]
        self.where: dict[Path, int] = {}
        self.tables_in: dict[Path, int] = {}  #: how many [[tables]] an array of tables has so far

    def document(self) -> dict[Path, int]:
        table: Path = ()
        self.skip(_BLANK)
        while self.at < len(self.text):
            if self.text[self.at] == "[":
                table = self.header()
            else:
                self.pair(table)
            self.skip(_BLANK)
        return self.where

    def line(self) -> int:
        return bisect_right(self.line_ends, self.at - 1) + 1

    def skip(self, pattern: re.Pattern[str]) -> None:
        match = pattern.match(self.text, self.at)
        self.at = match.end() if match else self.at

    def take(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self.text, self.at)
        if match is None:
            raise ValueError(f"line {self.line()}: not valid TOML")
        self.at = match.end()
        return match.group()

    def header(self) -> Path:
        """`[a.b]` or `[[a.b]]`; returns the path of the table that it opens."""
        line = self.line()
        double = self.text.startswith("[[", self.at)
        self.at += 2 if double else 1
        *parents, last = self.key()
        self.at += 2 if double else 1
        path: Path = ()
        for part in parents:
            path = self.newest((*path, part))
            self.where.setdefault(path, line)
        path = (*path, last)
        if not double:
            self.where[path] = line
            return path
        index = self.tables_in.get(path, 0)
        self.tables_in[path] = index + 1
        self.where.setdefault(path, line)
        self.where[(*path, index)] = line
        return (*path, index)

    def newest(self, path: Path) -> Path:
        """In a header, the name of an array of tables means the newest table of it."""
        return (*path, self.tables_in[path] - 1) if path in self.tables_in else path

    def key(self) -> list[str]:
        """A key with its dots; leaves the scanner behind it and the spaces around it."""
        parts: list[str] = []
        while True:
            self.skip(_SPACE)
            if self.text[self.at] in "\"'":
                parts.append(tomllib.loads(f"key = {self.take(_STRING)}")["key"])
            else:
                parts.append(self.take(_BARE_KEY))
            self.skip(_SPACE)
            if not self.text.startswith(".", self.at):
                return parts
            self.at += 1

    def pair(self, table: Path) -> None:
        line = self.line()
        path = table
        for part in self.key():
            path = (*path, part)
            self.where.setdefault(path, line)
        self.at += 1  # the equals sign
        self.skip(_SPACE)
        self.value(path)

    def value(self, path: Path) -> None:
        first = self.text[self.at]
        if first in "\"'":
            self.take(_STRING)
        elif first == "[":
            self.array(path)
        elif first == "{":
            self.inline_table(path)
        else:
            self.take(_SCALAR)

    def array(self, path: Path) -> None:
        self.at += 1
        self.skip(_BLANK)
        index = 0
        while self.text[self.at] != "]":
            self.where[(*path, index)] = self.line()
            self.value((*path, index))
            index += 1
            self.skip(_BLANK)
            if self.text[self.at] == ",":
                self.at += 1
                self.skip(_BLANK)
        self.at += 1

    def inline_table(self, path: Path) -> None:
        self.at += 1
        self.skip(_BLANK)
        while self.text[self.at] != "}":
            self.pair(path)
            self.skip(_BLANK)
            if self.text[self.at] == ",":
                self.at += 1
                self.skip(_BLANK)
        self.at += 1

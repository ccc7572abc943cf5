"""JSON read row by row, so that no single call holds the interpreter for longer than one row takes. Pure.

`json.loads` is one such call: of 2 MB of numbers it keeps a thread with a deadline waiting for some periods, whoever
calls it. What is long in a message are rows of numbers. Each is read by itself here, and then what is around them.
"""

import json
import re
import secrets
from collections.abc import Callable
from typing import Any

Pairs = list[tuple[str, Any]]

#: A text, which is left as it is, or a row of numbers. What is shorter costs less than its place would.
_TEXT_OR_ROW = re.compile(r'"[^"\\]*+(?:\\.[^"\\]*+)*+"|\[[-+0-9.eE, \t\r\n]{16,}+\]', re.DOTALL)


class TooLongAPiece(Exception):
    """A row, or all that is in none, is longer than what may be read at once: `size_bytes`, or more."""

    def __init__(self, size_bytes: int) -> None:
        super().__init__(f"{size_bytes} bytes in one piece")
        self.size_bytes = size_bytes


def load_rows(text: str, most: int, object_of: Callable[[Pairs], Any]) -> Any:
    """The document in `text`, of which no piece may be longer than `most` letters; `object_of` makes each object.

    Raises ValueError where it is no JSON, RecursionError, and TooLongAPiece.
    """
    if len(text) <= most:
        return json.loads(text, object_pairs_hook=object_of)
    rows: list[Any] = []
    name = secrets.token_hex(8)  # of the places at which they stand: nobody can have written one

    def with_rows(pairs: Pairs) -> Any:
        return rows[pairs[0][1]] if len(pairs) == 1 and pairs[0][0] == name else object_of(pairs)

    around: list[str] = []
    begun = at = size = 0
    while (found := _TEXT_OR_ROW.search(text, at, at + 2 * most)) is not None:
        at = found.end()
        if text[found.start()] == '"':
            continue
        around += text[begun : found.start()], f'{{"{name}":{len(rows)}}}'
        size += found.start() - begun
        if (longest := max(size, at - found.start())) > most:
            raise TooLongAPiece(longest)
        rows.append(json.loads(found.group()))
        begun = at
    if (size := size + len(text) - begun) > most:
        raise TooLongAPiece(size)
    return json.loads("".join((*around, text[begun:])), object_pairs_hook=with_rows)

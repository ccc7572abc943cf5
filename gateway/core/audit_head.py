"""The audit's head as people carry it elsewhere: NUMBER:HASH of its last record, which stands for all before it."""

import re
from datetime import UTC, datetime
from itertools import pairwise
from typing import NamedTuple

_DIGITS = r"([1-9][0-9]{0,17}):([0-9a-f]{64})"
_HEAD = re.compile(_DIGITS)
#: Alone on a line; behind what the log says, a field of JSON, or what `audit verify` says; on the page of a report.
_PRINTED = re.compile(
    r"(?:^[ \t]*|audit head: |\"audit_head\": ?\"|last record: |Head of the audit(?:\s|<[^<>]*>)*)"
    + _DIGITS
    + r"(?![0-9a-zA-Z])(?=[ \t]*\r?$|\"|<|\s)",
    re.MULTILINE,
)
#: A line of the file of heads that was kept elsewhere: when, the head, of which line.
_KEPT = re.compile(r"^(\d{4}-\d\d-\d\d)T\d\d:\d\d:\d\dZ " + _DIGITS + r" .*$", re.MULTILINE)
NEWEST_KEPT = 1000  #: lines that stay as they are where a file is thinned out, and as many of days before


class AuditHead(NamedTuple):
    sequence: int
    hash: str  #: SHA-256, 64 hexadecimal digits

    def __str__(self) -> str:
        return f"{self.sequence}:{self.hash}"


def parse_head(text: str) -> AuditHead:
    """The head that `text` is, as it was printed. Raises ValueError: short forms prove less than they seem to."""
    match = _HEAD.fullmatch(text.strip())
    if match is None:
        raise ValueError(
            "allowed is NUMBER:HASH as it was printed, with all 64 digits of the hash (0-9, a-f), or a file that has it"
        )
    return AuditHead(int(match[1]), match[2])


def last_head_in(text: str) -> AuditHead:
    """The last head that a log, `status --json`, a report or a note of it has. Raises ValueError: there is none."""
    printed = list(_PRINTED.finditer(text))
    if not printed:
        raise ValueError(
            "there is no head in it; allowed is a file with a line NUMBER:HASH, or what the log (`audit head: ...`), "
            "`status --json` or a report has of it, with all 64 digits"
        )
    return AuditHead(int(printed[-1][1]), printed[-1][2])


def heads_in(text: str) -> list[AuditHead]:
    """Every head of a file that has kept them one after the other; of any other the last. Raises ValueError."""
    return [_kept(match) for match in _KEPT.finditer(text)] or [last_head_in(text)]


def kept_line(head: AuditHead, line: str, wall_s: float) -> str:
    """As `heads_in` reads it."""
    return f"{datetime.fromtimestamp(wall_s, UTC):%Y-%m-%dT%H:%M:%SZ} {head} {' '.join(line.split())}\n"


def last_kept(text: str) -> AuditHead | None:
    found = list(_KEPT.finditer(text))
    return _kept(found[-1]) if found else None


def thinned(text: str) -> str:
    """The newest lines, and before them the last of each day."""
    found = list(_KEPT.finditer(text))
    older = [one for one, after in pairwise(found[: -NEWEST_KEPT + 1]) if one[1] != after[1]]
    return "".join(f"{one[0]}\n" for one in [*older[-NEWEST_KEPT:], *found[-NEWEST_KEPT:]])


def _kept(match: re.Match[str]) -> AuditHead:
    return AuditHead(int(match[2]), match[3])

"""The audit's head as people carry it elsewhere: NUMBER:HASH of its last record, which stands for all before it."""

import re
from typing import NamedTuple

_HEAD = re.compile(r"([1-9][0-9]{0,17}):([0-9a-f]{64})")


class AuditHead(NamedTuple):
    sequence: int
    hash: str  #: SHA-256, 64 hexadecimal digits

    def __str__(self) -> str:
        return f"{self.sequence}:{self.hash}"


def parse_head(text: str) -> AuditHead:
    """The head that `text` is, as it was printed. Raises ValueError: short forms prove less than they seem to."""
    match = _HEAD.fullmatch(text.strip())
    if match is None:
        raise ValueError("allowed is NUMBER:HASH as it was printed, with all 64 digits of the hash (0-9, a-f)")
    return AuditHead(int(match[1]), match[2])

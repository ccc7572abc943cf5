"""Who makes room where more connect than there is room for: those who crowd, never whoever comes now. Pure.

So a process that opens connections without end pushes out its own, and a `stop` that comes in the middle of it finds a
place. Of many processes with one connection each the one that was quiet for longest goes: it dials again where it
lives.
"""

from collections import Counter
from collections.abc import Collection
from typing import Protocol, TypeVar


class Guest(Protocol):
    """A connection, as far as it matters here."""

    heard_s: float  #: monotonic; when something came over it last

    @property
    def in_flight(self) -> int:
        """Requests that are being answered."""
        ...

    @property
    def pid(self) -> int: ...


G = TypeVar("G", bound=Guest)


def who_makes_room(guests: Collection[G]) -> G:
    """Of the process with the most of them the one that was quiet for longest, rather one that waits for no answer."""
    crowds = Counter(guest.pid for guest in guests)
    return min(guests, key=lambda guest: (-crowds[guest.pid], guest.in_flight > 0, guest.heard_s))

"""Where those who connect come from, and who makes room where more come than there is room for. Pure.

Both ways in, OPC UA and the page, go by it: whoever crowds takes places from themselves, never from whoever comes now.
"""

from collections import Counter
from collections.abc import Sequence
from ipaddress import IPv4Address, IPv6Network, ip_address
from math import floor
from typing import Protocol

SHARE = 0.75  #: of what there is, that one place may have where others want it


class Guest(Protocol):
    """Whatever takes one of a bounded number of places."""

    @property
    def place(self) -> str: ...

    def is_proven(self) -> bool:
        """Somebody has shown there that they may come in."""
        ...

    def end(self) -> None:
        """At once: it counts no more."""
        ...


def place_of(address: str) -> str:
    """By which connections are counted: of IPv6 the /64, in which one machine has as many addresses as it likes."""
    try:
        found = ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(found, IPv4Address):
        return str(found)
    return str(found.ipv4_mapped or IPv6Network((found, 64), strict=False))


def share_of(most: int) -> int:
    """How many of `most` one place may have."""
    return max(1, floor(SHARE * most))


def make_room(place: str, guests: Sequence[Guest], most: int) -> bool:
    """Whether there is room for one more from there. Where it is full, a guest is ended for it; False: none can be.

    `guests`: as they came. It goes by who has more than their share, else by who has proved nothing: of the place that
    has most of these the oldest, and rather one that has proved nothing. Those who have are not ended for their own.
    """
    if len(guests) < most:
        return True
    held = Counter([place, *(one.place for one in guests)])
    crowd = [one for one in guests if held[one.place] > share_of(most)]
    if not crowd:
        crowd = [one for one in guests if not one.is_proven()] or list(guests)
        held = Counter([place, *(one.place for one in crowd)])
    largest = max(held[one.place] for one in crowd)
    theirs = [one for one in crowd if held[one.place] == largest]
    unproven = [one for one in theirs if not one.is_proven()]
    if not unproven and held[place] == largest:
        return False
    (unproven or theirs)[0].end()
    return True

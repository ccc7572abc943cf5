"""Who makes room where more connect than there is room for."""

from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.operator.places import make_room, place_of, share_of

MOST = 8


@dataclass(eq=False)
class Guest:
    place: str
    proven: bool = False
    there: list["Guest"] = field(default_factory=list["Guest"])

    def is_proven(self) -> bool:
        return self.proven

    def end(self) -> None:
        self.there.remove(self)


def come(there: list[Guest], place: str, proven: bool = False) -> Guest | None:
    """None: there was no room."""
    if not make_room(place, there, MOST):
        return None
    there.append(Guest(place, proven, there))
    return there[-1]


def full(*places: tuple[str, bool, int]) -> list[Guest]:
    there: list[Guest] = []
    there += [Guest(place, proven, there) for place, proven, count in places for _ in range(count)]
    return there


@given(st.lists(st.tuples(st.sampled_from("abcd"), st.booleans()), max_size=60), st.booleans())
def test_there_are_never_more_and_whoever_comes_from_elsewhere_always_gets_in(comers, proven):
    there: list[Guest] = []
    for place, shows in comers:
        come(there, place, shows)
        assert len(there) <= MOST
    guest = come(there, "elsewhere", proven)
    assert guest is not None and guest in there


def test_who_floods_takes_places_from_themselves():
    there = full(("other", False, 1), ("flood", False, MOST - 1))
    other, first = there[0], there[1]
    for _ in range(3 * MOST):
        assert come(there, "flood") is not None
    assert other in there and first not in there


def test_a_session_from_where_the_flood_comes_stays():
    there = full(("flood", True, 1), ("flood", False, MOST - 1))
    proven = there[0]
    for _ in range(3 * MOST):
        come(there, "flood")
    assert proven in there


def test_from_many_places_strangers_go_and_no_session_does():
    there: list[Guest] = []
    mine = [come(there, "person", proven=True) for _ in range(3)]
    for k in range(5 * MOST):
        assert come(there, f"machine {k}") is not None
    assert all(one in there for one in mine)
    assert come(there, "person", proven=True) is not None


def test_whoever_has_proved_much_is_held_to_their_share_where_others_want_it():
    there = full(("crowd", True, MOST))
    assert come(there, "crowd", proven=True) is None
    others = [come(there, f"person {k}", proven=True) for k in range(MOST - share_of(MOST))]
    assert None not in others and len([one for one in there if one.place == "crowd"]) == share_of(MOST)


@pytest.mark.parametrize(("most", "share"), [(1, 1), (2, 1), (4, 3), (20, 15), (100, 75)])
def test_of_whatever_there_is_others_can_have_something(most: int, share: int):
    assert share_of(most) == share


@pytest.mark.parametrize(
    ("address", "place"),
    [
        ("192.0.2.7", "192.0.2.7"), ("::ffff:192.0.2.7", "192.0.2.7"), ("2001:db8:1:2:3::4", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"), ("", ""), ("no address", "no address"),
    ],
)  # fmt: skip
def test_a_machine_is_one_place_however_many_addresses_it_has(address: str, place: str):
    assert place_of(address) == place

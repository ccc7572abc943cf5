"""What a fault needs to know of the frames on a wire; `can_frames`, `mbap_frames` and `opcua_frames` know it."""

from collections.abc import Callable
from enum import Enum
from random import Random
from typing import Protocol, TypeVar

from sim_plant.faults.parse import Injection
from sim_plant.faults.table import FROM_DEVICE, TO_DEVICE

F = TypeVar("F")

Passed = list[tuple[float, F]]  #: what goes on in place of a frame: delay in s, frame


class Direction(Enum):
    TO_DEVICE = TO_DEVICE
    FROM_DEVICE = FROM_DEVICE


Way = tuple[Direction, int]  #: towards or from an address

#: What one fault makes of a frame on its way. The last argument asks once whether this frame is meant (direction,
#: probability, count), and counts it then.
Effect = Callable[[Way, F, Callable[[], bool]], Passed[F]]


class Freezer(Protocol[F]):
    """Remembers first answers. One is made for each fault."""

    def request(self, frame: F) -> None:
        """A frame towards the device has passed."""
        ...

    def answer(self, frame: F) -> F:
        """The first answer of this sort, framed as `frame` is."""
        ...


class FrameKind(Protocol[F]):
    """Pure functions on whole frames of one protocol. None means that nothing is left of the frame."""

    def corrupted(self, frame: F, dice: Random) -> F | None:
        """One bit of the content inverted."""
        ...

    def other_function(self, frame: F) -> F: ...

    def other_length(self, frame: F, by: int, fits: bool) -> F:
        """Bytes cut off the end (`by` negative) or zeros added, as far as the protocol has room for it.

        Where the frame has a length field, it tells the new length if it `fits`, else it lies: it is kept.
        """
        ...

    def freezer(self) -> Freezer[F]: ...

    def own_effect(self, injection: Injection) -> Effect[F] | None:
        """Of a fault that this protocol alone has; None when it has no such fault."""
        ...


def with_flipped_bit(data: bytes, first: int, dice: Random) -> bytes:
    """`data` with one bit of its bytes from `first` on inverted; there must be such a byte."""
    position = dice.randrange(first, len(data))
    return data[:position] + bytes((data[position] ^ 1 << dice.randrange(8),)) + data[position + 1 :]


def resized(data: bytes, by: int, shortest: int, longest: int) -> bytes:
    """`data` cut or filled with zeros by so many bytes, but to no length outside of the two."""
    size = max(shortest, min(longest, len(data) + by))
    return data[:size] + bytes(max(0, size - len(data)))

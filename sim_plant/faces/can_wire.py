"""The time of a CAN bus: one frame after the other, each for its bits, the lowest identifier first.

For buses that carry frames in no time (`udp_multicast`, `virtual`). No I/O and no clock: frames are handed in with
the time from which they wait, and taken out with the time at which their last bit was on the wire. It is as if every
frame that waits had a transmit buffer of its own; errors and retransmissions are not modelled.
"""

from collections.abc import Iterator
from heapq import heappop, heappush
from itertools import count
from math import inf

import can

from sim_plant.faces.can_bits import INTERMISSION_BITS, arbitration_key, frame_bits

MOST_WAITING = 4096  #: frames; a real sender would be refused long before


class CanWire:
    """A bus with this bitrate. Times are in s on any clock that does not run backwards.

    A frame that is handed in late, with a time that has been passed already, waits from then on all the same; what
    was on the wire by then stays.
    """

    def __init__(self, bitrate_bit_per_s: int) -> None:
        self.bit_s = 1.0 / bitrate_bit_per_s
        self.busy_s = 0.0  #: time for which the wire was taken, or will be by the frame on it
        self.overflows = 0  #: frames that were lost because MOST_WAITING waited
        self._free_s = -inf  #: from when the next frame may begin
        self._coming: list[tuple[float, int, can.Message]] = []  #: by the time from which they wait
        self._waiting: list[tuple[int, int, can.Message]] = []  #: by priority, then age
        self._on_wire: tuple[float, can.Message] | None = None  #: the end of the frame that has won
        self._numbers = count()

    def request(self, message: can.Message, at_s: float) -> None:
        """`message` wants the wire from `at_s` on."""
        if len(self._coming) + len(self._waiting) >= MOST_WAITING:
            self.overflows += 1
            return
        heappush(self._coming, (at_s, next(self._numbers), message))

    def next_s(self) -> float:
        """When something happens: the frame on the wire is through, or else the next one begins; inf is never."""
        return self._begin_s() if self._on_wire is None else self._on_wire[0]

    def through(self, now_s: float) -> Iterator[tuple[can.Message, float]]:
        """The frames that are through by `now_s`, each with its time; what is requested meanwhile takes part."""
        while True:
            if self._on_wire is None and not self._arbitrate(now_s):
                return
            assert self._on_wire is not None
            end_s, message = self._on_wire
            if end_s > now_s:
                return
            self._on_wire = None
            yield message, end_s

    def _begin_s(self) -> float:
        if self._waiting:  # they have lost an arbitration, and wait for its winner
            return self._free_s
        return max(self._free_s, self._coming[0][0]) if self._coming else inf

    def _admit(self, now_s: float) -> None:
        """Those that wait by `now_s` take part in the arbitration."""
        while self._coming and self._coming[0][0] <= now_s:
            _, number, message = heappop(self._coming)
            heappush(self._waiting, (arbitration_key(message), number, message))

    def _arbitrate(self, now_s: float) -> bool:
        """Put the frame on the wire that wins when it is free, if that has come by `now_s`."""
        begin_s = self._begin_s()
        if begin_s > now_s:
            return False
        self._admit(begin_s)
        _, _, message = heappop(self._waiting)
        end_s = begin_s + self.bit_s * frame_bits(message)
        self._free_s = end_s + self.bit_s * INTERMISSION_BITS
        self.busy_s += self._free_s - begin_s
        self._on_wire = (end_s, message)
        return True

"""How much of an event loop's time those who write to it may have, so that its own work is not late.

Time goes by windows. In each, so many datagrams are taken of all processes together, and so many connections. While
others wait, a process has no more than its equal share of them; who has to wait has its turn in the order of waiting.
Of what is long so many bytes are taken in a window, too, beside which what is short goes on. So neither many
connections of one process, nor a crowd of processes, nor the longest messages keep a `stop` from being taken, or a
period from being computed in time. Whoever waits is not read; its own sends fail when its buffer is full.
"""

import asyncio
from collections import Counter
from collections.abc import Callable

from gateway.mailbox.codec import MAX_DATAGRAM

WINDOW_S = 0.025  #: as short as that: nobody waits for longer until the next one begins
MAX_PER_WINDOW = 100  #: datagrams
SHORT = 8192  #: bytes, of a command with its proof: what counts as one datagram and no more
LONG_PER_WINDOW = MAX_DATAGRAM  #: bytes of all that are longer: one of the longest, which takes 0.2 ms
MAX_ACCEPTED = 10  #: connections; the others wait in the kernel, in the order in which they came


class Turns:
    """Of one mailbox, in the thread of its event loop."""

    def __init__(self, most: int = MAX_PER_WINDOW) -> None:
        """`most`: datagrams that are taken in a window, of all processes together."""
        self._loop = asyncio.get_running_loop()
        self._most = most
        self._end_s = 0.0  #: of the window that runs
        self._taken: Counter[int] = Counter()  #: datagrams in this window, by process
        self._all = 0
        self._long_bytes = 0
        self._accepted = 0
        self._connections: Counter[int] = Counter()  #: that are open, by process
        self._waiting: list[tuple[int, int, Callable[[], None]]] = []  #: process, length of what it has sent, what then
        self._timer: asyncio.TimerHandle | None = None

    def come(self, pid: int) -> None:
        """A connection of this process has been opened."""
        self._connections[pid] += 1

    def go(self, pid: int) -> None:
        """One of its connections has been closed."""
        self._connections[pid] -= 1
        if self._connections[pid] <= 0:
            del self._connections[pid]

    def is_on(self, pid: int, length: int) -> bool:
        """Whether a datagram of this process, so many bytes long, may be taken now."""
        self._roll()
        too_long = length > SHORT and self._long_bytes + length > LONG_PER_WINDOW
        if self._all >= self._most or (too_long and self._long_bytes):
            return False
        return not self._waiting or self._taken[pid] < max(1, self._most // max(1, len(self._connections)))

    def took(self, pid: int, length: int) -> None:
        """A datagram of this process has been taken."""
        self._taken[pid] += 1
        self._all += 1
        self._long_bytes += length if length > SHORT else 0

    def wait(self, pid: int, length: int, then: Callable[[], None]) -> None:
        """`then` is called when this process has turns again for so many bytes, and those before it have had theirs."""
        self._waiting.append((pid, length, then))
        if self._timer is None:
            self._timer = self._loop.call_at(self._end_s, self._go_on)

    def accept(self) -> float | None:
        """A connection has been taken. The time (of the event loop) before which no other one may; None: at once."""
        self._roll()
        self._accepted += 1
        return self._end_s if self._accepted >= MAX_ACCEPTED else None

    def close(self) -> None:
        """Nobody has a turn any more. Idempotent."""
        self._waiting.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _roll(self) -> None:
        now_s = self._loop.time()
        if now_s >= self._end_s:
            self._end_s = now_s + WINDOW_S
            self._taken.clear()
            self._all = self._long_bytes = self._accepted = 0

    def _go_on(self) -> None:
        self._timer = None
        self._roll()
        for one in self._waiting.copy():  # who waits for its process's share keeps its place
            pid, length, then = one
            if self._waiting and self.is_on(pid, length):
                self._waiting.remove(one)
                then()
        if self._waiting and self._timer is None:
            self._timer = self._loop.call_at(self._end_s, self._go_on)

"""From a stream of bytes to whole frames, and back to a stream with late ones among them. Pure."""

import heapq
from collections.abc import Callable
from math import inf
from typing import Generic

from sim_plant.faults.frames import F


class Framer:
    """Cuts a stream into frames, in whatever segments it comes. Frames and rest joined are the stream.

    `size_of` tells from the first `header` bytes how long the frame is, or 0 when this is no frame. From there on no
    frame can be found any more: `framed` is False, and all that comes is `rest`.
    """

    def __init__(self, header: int, size_of: Callable[[bytes], int]) -> None:
        self.framed = True
        self._header = header
        self._size_of = size_of
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Every frame that is whole now."""
        self._buffer += data
        frames: list[bytes] = []
        start = 0
        while self.framed and len(self._buffer) - start >= self._header:
            size = self._size_of(bytes(self._buffer[start : start + self._header]))
            if size < self._header:
                self.framed = False
            elif start + size > len(self._buffer):
                break
            else:
                frames.append(bytes(self._buffer[start : start + size]))
                start += size
        del self._buffer[:start]
        return frames

    def rest(self) -> bytes:
        """What has come and is no whole frame; it is taken."""
        rest = bytes(self._buffer)
        self._buffer.clear()
        return rest


class DelayLine(Generic[F]):
    """Frames that wait for their time. Those of equal time keep their order."""

    def __init__(self) -> None:
        self._waiting: list[tuple[float, int, F]] = []
        self._put = 0

    @property
    def due_s(self) -> float:
        """When the next one goes; inf when none waits."""
        return self._waiting[0][0] if self._waiting else inf

    def put(self, due_s: float, frame: F) -> None:
        self._put += 1
        heapq.heappush(self._waiting, (due_s, self._put, frame))

    def take(self, now_s: float) -> list[F]:
        """Those whose time has come, in the order in which they go."""
        taken: list[F] = []
        while self._waiting and self._waiting[0][0] <= now_s:
            taken.append(heapq.heappop(self._waiting)[2])
        return taken

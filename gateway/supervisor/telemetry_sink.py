"""What arrives from the loop: checks each frame, counts what is missing, and knows the newest and the last seconds."""

from collections import deque
from collections.abc import Callable
from math import isfinite
from typing import NamedTuple

import numpy as np

from gateway.core.finding import Finding, finding
from gateway.core.telemetry import VERSION, Frame, frame_dtype, unpack

WINDOW_S = 10.0
MOST_CYCLES = 20_000  #: also where times are such that none grows old
_RESTARTED = 2**31  # a sequence number that goes back (modulo 2^32) is one of a new loop


class Cycle(NamedTuple):
    time_s: float
    cycle_s: float
    lateness_s: float
    missed: int  #: periods skipped since the loop's start


class TelemetrySink:
    """`keep` gets every well-formed frame. Nothing that arrives raises."""

    def __init__(
        self, spans: int, keep: Callable[[bytes], None], clock: Callable[[], float] | None = None, early_s: float = 0.0
    ) -> None:
        """Frames that are due more than `early_s` after `clock` are refused; without a clock none is."""
        self.frames = 0
        self.dropped = 0  #: gaps in the sequence
        self.malformed = 0
        self.refused = 0  #: that are of the past or the future
        self.why_refused: Finding | None = None  #: the newest of them
        self.restarts = 0  #: a loop that began to count anew
        self.other_version: int | None = None  #: of telemetry, that came last and cannot be read
        self.cycles: deque[Cycle] = deque(maxlen=MOST_CYCLES)  #: of the loop that runs, over WINDOW_S
        self._spans = spans
        self._dtype = frame_dtype(spans)
        self._keep = keep
        self._clock = clock
        self._early_s = early_s
        self._newest = b""
        self._sequence = 0
        self._begins = False

    def take(self, payload: bytes) -> None:
        version = int.from_bytes(payload[:2], "little")
        if version != VERSION or len(payload) != self._dtype.itemsize:
            self.malformed += 1
            self.other_version = version if version != VERSION else None
            return
        row = np.frombuffer(payload, self._dtype)[0]
        time_s = float(row["time_s"])
        if row["n"] != self._spans or not isfinite(time_s):
            self.malformed += 1
            return
        if (reason := self._out_of_time(time_s)) is not None:
            self.refused += 1
            self.why_refused = reason
            return
        self._count(int(row["sequence"]))
        self._newest, self.other_version = payload, None
        self.cycles.append(Cycle(time_s, float(row["cycle_s"]), float(row["lateness_s"]), int(row["missed"])))
        while self.cycles[0].time_s < time_s - WINDOW_S:
            self.cycles.popleft()
        self._keep(payload)

    def newest(self) -> Frame | None:
        """The last frame that came, whatever its age."""
        return unpack(self._newest) if self._newest else None

    def age_s(self, now_s: float) -> float | None:
        """How long ago the cycle of the newest frame was due; None before the first."""
        return max(0.0, now_s - self.cycles[-1].time_s) if self.cycles else None

    def begin_anew(self) -> None:
        """Another loop speaks from now on: its times are held against the clock, and not against those before."""
        self._begins = True

    def _out_of_time(self, time_s: float) -> Finding | None:
        """Why a frame cannot be one of now; None: it can. Of a loop that runs each is later than the one before."""
        if self._clock is None:
            return None
        ahead_s = time_s - self._clock()
        if ahead_s > self._early_s:
            return finding("loop-frame-future", ahead_s=ahead_s)
        if self.cycles and not self._begins and time_s <= self.cycles[-1].time_s:
            return finding("loop-frame-past", behind_s=self.cycles[-1].time_s - time_s)
        self._begins = False
        return None

    def _count(self, sequence: int) -> None:
        if self.frames:
            step = (sequence - self._sequence) % 2**32
            if 0 < step < _RESTARTED:
                self.dropped += step - 1
            else:
                self.restarts += 1
                self.cycles.clear()
        self.frames += 1
        self._sequence = sequence

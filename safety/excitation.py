"""Which recordings say something of a model: those that are recent, and in which every measured tension moves.

Quiet data pass almost any model: its errors hide behind the noise, and an integrator makes up for what is wrong.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from math import isfinite

import numpy as np

from gateway.core.judge_context import JudgeContext
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise

LEAST_S = 2.0  #: of a part at one speed
LONGEST_S = 10.0  #: a longer one is several
MOST_S = 60.0  #: of excited data are looked at, the newest
MOVING = 2.0  #: standard deviation of a tension that moves, in units of what a load cell's noise would make of it
SAME_SPEED, SAME_M_PER_S = 0.05, 2e-3  #: speeds closer than this share, or this, are one
_LEVEL_S = 0.1  #: over which a speed is averaged


@dataclass(frozen=True)
class Excited:
    """A part of a recording at one speed, without a gap, in which every measured tension moves."""

    recording: Recording
    speed_m_per_s: float  #: of the unwinder, mean
    movement_n: float  #: standard deviation of the tension that moves least


def recent(context: JudgeContext, recordings: Sequence[Recording], most_s: float) -> list[Recording]:
    """Those that ended at most so long before the context's `now`, and not after it; the newest first."""
    now = datetime.fromisoformat(context.now)
    ages = [(now - datetime.fromisoformat(one.recorded)).total_seconds() for one in context.data]
    known = sorted(zip(ages, range(len(ages)), recordings, strict=True), key=lambda each: each[:2])
    return [recording for age_s, _, recording in known if 0.0 <= age_s <= most_s]


def excited_parts(recording: Recording, noise: Noise | None = None) -> list[Excited]:
    """Of one recording, the latest first. Where a speed, or a tension that moves, is no number: none."""
    least_n = MOVING * (noise or Noise()).tension_n
    found = [Excited(part, float(part.unwind_speed_m_per_s.mean()), _movement_n(part)) for part in _parts(recording)]
    return [part for part in reversed(found) if part.movement_n >= least_n and isfinite(part.speed_m_per_s)]


def newest(parts: Sequence[Excited], most_s: float = MOST_S) -> list[Excited]:
    """As many, from the first on, as last so long; of each speed at least one."""
    found: list[Excited] = []
    total_s, speeds = 0.0, list[float]()
    for part in parts:
        known = any(same_speed(part.speed_m_per_s, speed) for speed in speeds)
        if known and total_s >= most_s:
            continue
        found.append(part)
        speeds.append(part.speed_m_per_s)
        total_s += part.recording.samples * part.recording.period_s
    return found


def same_speed(one_m_per_s: float, other_m_per_s: float) -> bool:
    """Whether two speeds are one."""
    return abs(one_m_per_s - other_m_per_s) <= max(SAME_SPEED * abs(other_m_per_s), SAME_M_PER_S)


def _parts(recording: Recording) -> Iterator[Recording]:
    """Without a gap, at one speed, of `LEAST_S` to `LONGEST_S`."""
    least, longest = round(LEAST_S / recording.period_s), round(LONGEST_S / recording.period_s)
    for stretch in recording.stretches(least):
        for begin, end in _levels(stretch.unwind_speed_m_per_s, max(1, round(_LEVEL_S / recording.period_s))):
            count = max(1, round((end - begin) / longest))
            cuts = np.linspace(begin, end, count + 1).astype(np.int64).tolist()
            for first, last in zip(cuts[:-1], cuts[1:], strict=True):
                if last - first >= least:
                    yield stretch.part(first, last)


def _levels(speed_m_per_s: FloatArray, length: int) -> Iterator[tuple[int, int]]:
    """Samples from and to which a speed (k,) stays what it was over the first `length` of them."""
    begin = 0
    while begin < len(speed_m_per_s):
        level = float(speed_m_per_s[begin : begin + length].mean())
        near = max(SAME_SPEED * abs(level), SAME_M_PER_S)
        away = np.flatnonzero(np.abs(speed_m_per_s[begin:] - level) > near)
        end = begin + max(int(away[0]), 1) if len(away) else len(speed_m_per_s)
        yield begin, end
        begin = end


def _movement_n(part: Recording) -> float:
    """Of the tension that moves least; infinite where there is no load cell: then speeds are all there is."""
    cells = ~np.isnan(part.tension_n).all(axis=0)
    return float(part.tension_n[:, cells].std(axis=0).min()) if cells.any() else float("inf")

"""Which recordings say something of a model: those that are recent, and in which every measured tension moves.

Quiet data pass almost any model: its errors hide behind the noise, and an integrator makes up for what is wrong.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from math import isfinite

import numpy as np

from gateway.core.judge_context import JudgeContext
from gateway.core.line import Line
from gateway.core.line_scales import LineScales, line_scales
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise, expected_noise

LEAST, LONGEST = 100.0, 500.0  #: moments of a part at one speed; a longer one is several
MOST = 3000.0  #: moments of excited data that are looked at, the newest
MOVING = 2.0  #: standard deviation of a tension that moves, in units of what a load cell's noise would make of it
SAME_SPEED = 0.05  #: speeds closer than this share, or than a small speed of the line, are one
_LEVEL = 5.0  #: moments over which a speed is averaged


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


def excited_parts(recording: Recording, line: Line, noise: Noise | None = None) -> list[Excited]:
    """Of one recording, the latest first. Where a speed, or a tension that moves, is no number: none.

    `noise` is what is expected of a line of this size where nothing is given.
    """
    least_n = MOVING * (noise or expected_noise(line)).tension_n
    parts = _parts(recording, line_scales(line))
    found = [Excited(part, float(part.unwind_speed_m_per_s.mean()), _movement_n(part)) for part in parts]
    return [part for part in reversed(found) if part.movement_n >= least_n and isfinite(part.speed_m_per_s)]


def newest(parts: Sequence[Excited], line: Line, most: float = MOST) -> list[Excited]:
    """As many, from the first on, as last so many moments; of each speed at least one."""
    found: list[Excited] = []
    most_s = most * line_scales(line).moment_s
    total_s, speeds = 0.0, list[float]()
    for part in parts:
        known = any(same_speed(part.speed_m_per_s, speed, line) for speed in speeds)
        if known and total_s >= most_s:
            continue
        found.append(part)
        speeds.append(part.speed_m_per_s)
        total_s += part.recording.samples * part.recording.period_s
    return found


def least_seconds(line: Line) -> float:
    """How long a part at one speed lasts at least."""
    return LEAST * line_scales(line).moment_s


def same_speed(one_m_per_s: float, other_m_per_s: float, line: Line) -> bool:
    """Whether two speeds are one."""
    return abs(one_m_per_s - other_m_per_s) <= near_m_per_s(other_m_per_s, line)


def near_m_per_s(speed_m_per_s: float, line: Line) -> float:
    """How far another speed may lie from this one to be the same."""
    return max(SAME_SPEED * abs(speed_m_per_s), line_scales(line).speed_m_per_s)


def _parts(recording: Recording, scales: LineScales) -> Iterator[Recording]:
    """Without a gap, at one speed, of `LEAST` to `LONGEST` moments."""
    per_moment = scales.moment_s / recording.period_s
    least, longest, level = (max(1, round(moments * per_moment)) for moments in (LEAST, LONGEST, _LEVEL))
    for stretch in recording.stretches(least):
        for begin, end in _levels(stretch.unwind_speed_m_per_s, level, scales.speed_m_per_s):
            count = max(1, round((end - begin) / longest))
            cuts = np.linspace(begin, end, count + 1).astype(np.int64).tolist()
            for first, last in zip(cuts[:-1], cuts[1:], strict=True):
                if last - first >= least:
                    yield stretch.part(first, last)


def _levels(speed_m_per_s: FloatArray, length: int, small_m_per_s: float) -> Iterator[tuple[int, int]]:
    """Samples from and to which a speed (k,) stays what it was over the first `length` of them."""
    begin = 0
    while begin < len(speed_m_per_s):
        level = float(speed_m_per_s[begin : begin + length].mean())
        near = max(SAME_SPEED * abs(level), small_m_per_s)
        away = np.flatnonzero(np.abs(speed_m_per_s[begin:] - level) > near)
        end = begin + max(int(away[0]), 1) if len(away) else len(speed_m_per_s)
        yield begin, end
        begin = end


def _movement_n(part: Recording) -> float:
    """Of the tension that moves least; infinite where there is no load cell: then speeds are all there is."""
    cells = ~np.isnan(part.tension_n).all(axis=0)
    return float(part.tension_n[:, cells].std(axis=0).min()) if cells.any() else float("inf")

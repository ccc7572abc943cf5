"""Tensions of an interval, thinned out: of each bucket of time the least and the greatest, in the order they came in.

So nothing that stood out for a moment is lost, however long the interval. Read in parts: memory is that of one.
"""

from contextlib import closing
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from gateway.core.line_past import TensionsBetween, TensionsTold
from gateway.core.signals import FloatArray, Quality
from gateway.mailbox.port import MAX_PAYLOAD
from gateway.supervisor.history import History

MOST_FRAMES = 1_500_000  #: read for one answer: 4 h at 100 Hz, which takes 0.8 s
LEAST_PERIODS = 4  #: in a bucket: one frame that is missing is no gap
_HEAD_BYTES, _TIME_BYTES, _VALUE_BYTES, _QUALITY_BYTES = 500, 16, 12, 2  #: of an answer as JSON
_FIELDS = ("wall_s", "tension_n", "tension_setpoint_n", "unwind_speed_m_per_s", "tension_quality")


class NotTold(Exception):
    """Why the interval cannot be told, and what can."""


class _Buckets:
    """Least and greatest of each column, when in the interval each was, and how far it may be trusted."""

    def __init__(self, count: int, columns: int) -> None:
        self.least_quality = np.full((count, columns), Quality.MISSING, np.int8)
        self.greatest_quality = self.least_quality.copy()
        self.least = np.full((count, columns), np.inf)
        self.greatest = np.full((count, columns), -np.inf)
        self.least_at = np.zeros((count, columns))
        self.greatest_at = np.zeros((count, columns))
        self.filled = np.zeros(count, bool)

    def take(self, bucket: NDArray[np.intp], at_s: FloatArray, values: FloatArray, quality: NDArray[np.int8]) -> None:
        """Samples in order of time: shapes (k,), (k,), twice (k, columns). What is not finite is no value."""
        starts = np.flatnonzero(np.diff(bucket, prepend=-1))
        for first, end in zip(starts, [*starts[1:], len(bucket)], strict=True):
            part, trust, which = values[first:end], quality[first:end], bucket[first]
            self.filled[which] = True
            for sign, kept, kept_at, kept_quality in (
                (1.0, self.least, self.least_at, self.least_quality),
                (-1.0, self.greatest, self.greatest_at, self.greatest_quality),
            ):
                signed = np.where(np.isfinite(part), sign * part, np.inf)
                row = np.argmin(signed, axis=0)
                columns = np.arange(part.shape[1])
                found = signed[row, columns]
                better = found < sign * kept[which]
                kept[which] = np.where(better, sign * found, kept[which])
                kept_at[which] = np.where(better, at_s[first:end][row], kept_at[which])
                kept_quality[which] = np.where(better, trust[row, columns], kept_quality[which])


def thinned(history: History, asked: TensionsBetween, period_s: float) -> TensionsTold:
    """Raises NotTold and HistoryError."""
    from_s, length_s = asked.from_wall_s, asked.to_wall_s - asked.from_wall_s
    if length_s <= 0.0:
        raise NotTold(f"from {asked.from_wall_s:.3f} to {asked.to_wall_s:.3f} there is no time; from must be before to")
    if length_s > MOST_FRAMES * period_s:
        most_h = MOST_FRAMES * period_s / 3600.0
        raise NotTold(f"{length_s / 3600.0:.1f} h are too much for one answer; allowed: {most_h:.1f} h")
    with closing(history.walk_wall(asked.from_wall_s, asked.to_wall_s, _FIELDS)) as walk:
        spans = next(walk)["tension_n"].shape[1]
        rows = min(asked.points, (MAX_PAYLOAD - _HEAD_BYTES) // (_TIME_BYTES + _row_bytes(spans)))
        count = max(1, min(rows // 2, int(length_s / (LEAST_PERIODS * period_s))))
        buckets = _Buckets(count, 2 * spans + 1)
        for part in walk:
            at_s = part["wall_s"] - from_s
            bucket = np.minimum((at_s * (count / length_s)).astype(np.intp), count - 1)
            columns = (part["tension_n"], part["tension_setpoint_n"], part["unwind_speed_m_per_s"][:, None])
            quality = np.zeros((len(bucket), 2 * spans + 1), np.int8)
            quality[:, :spans] = part["tension_quality"]
            buckets.take(bucket, at_s, np.hstack(columns).astype(np.float64), quality)
    return _told(buckets, spans, from_s, length_s / count)


def _row_bytes(spans: int) -> int:
    return (2 * spans + 1) * _VALUE_BYTES + spans * _QUALITY_BYTES


def _told(buckets: _Buckets, spans: int, from_s: float, bucket_s: float) -> TensionsTold:
    """Two rows a bucket; one without values where a gap begins, so that nobody draws a line across it."""
    swapped = buckets.greatest_at < buckets.least_at
    first = np.where(swapped, buckets.greatest, buckets.least)
    second = np.where(swapped, buckets.least, buckets.greatest)
    first_quality = np.where(swapped, buckets.greatest_quality, buckets.least_quality)[:, :spans]
    second_quality = np.where(swapped, buckets.least_quality, buckets.greatest_quality)[:, :spans]
    wall_s, rows, quality = list[float](), list[list[float | None]](), list[list[int]]()
    nothing: list[float | None] = [None] * (2 * spans + 1)
    for k in np.flatnonzero(buckets.filled | (np.diff(buckets.filled, prepend=False) != 0)):
        if buckets.filled[k]:
            wall_s += [round(from_s + (k + quarter) * bucket_s, 3) for quarter in (0.25, 0.75)]
            rows += [_values(first[k]), _values(second[k])]
            quality += [first_quality[k].tolist(), second_quality[k].tolist()]
        else:
            wall_s.append(round(from_s + (k + 0.5) * bucket_s, 3))
            rows.append(nothing)
            quality.append([int(Quality.MISSING)] * spans)
    columns = [list(column) for column in zip(*rows, strict=True)] or [[] for _ in nothing]
    return TensionsTold(
        format=1, wall_s=wall_s, tension_n=columns[:spans], setpoint_n=columns[spans : 2 * spans],
        speed_m_per_s=columns[-1], quality=[list(column) for column in zip(*quality, strict=True)],
    )  # fmt: skip


def _values(row: FloatArray) -> list[float | None]:
    return [round(float(value), 4) if isfinite(value) else None for value in row]

"""What a change has shown on the line itself while it is under watch: swing, offset and chatter, where nothing moves.

The limits are those by which it was judged, or, where the line did worse before the change, what it did before and a
fifth more: what a reel out of round does is not held against a controller.

A look is for a change, against it, or neither: of what was not seen often enough nobody knows how it was.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import sqrt
from typing import Literal

import numpy as np

from gateway.core.line import Gate
from gateway.core.signals import BoolArray, FloatArray

WORSE = 1.2  #: than before the change, beyond which it is held against it
#: Of a load cell's samples. Where the others are just those at the peaks of a swing, it still shows 7/8 of its size.
LEAST_TENSION = 0.8
#: Of the changes of a torque from period to period. One late answer of any drive holds all torques and takes two of
#: them, so at 2 % late answers of 20 drives half of them are gone; what is left is not chosen by the chatter.
LEAST_TORQUE = 0.25

WORDS = (("tension", "is off by", "N"), ("tension", "swings by", "N"), ("torque", "chatters by", "Nm"))


@dataclass(frozen=True)
class Standing:
    """Of a while in which set-points and speed stand. Arrays (n,); figures are NaN where nothing was seen."""

    offset_n: FloatArray  #: mean of the tension less its set-point, either way
    swing_n: FloatArray  #: amplitude of a sine with the same root mean square
    chatter_nm: FloatArray  #: root mean square of the change of torque from period to period
    tension_seen: FloatArray  #: share of the periods with a good sample
    torque_seen: FloatArray  #: share of the changes from period to period that were seen


@dataclass(frozen=True)
class Unseen:
    """A figure of which too little was seen to say anything."""

    what: Literal["tension", "torque"]
    number: int  #: of the span, or of the drive's roller
    share: float
    least: float

    def __str__(self) -> str:
        needed = f"{self.least:.0%} are needed"
        if self.what == "tension":
            return f"the load cell of span {self.number} has told {self.share:.0%} of its samples, {needed}"
        return f"of torque {self.number} {self.share:.0%} of the changes were seen, {needed}"


@dataclass(frozen=True)
class Look:
    """What a while says of a change."""

    against: str  #: a figure that was seen and is beyond its limit; empty: none
    unseen: tuple[Unseen, ...]

    @property
    def good(self) -> bool:
        """Whether everything was seen, and nothing speaks against the change."""
        return not self.against and not self.unseen


def standing(tension_n: FloatArray, setpoint_n: FloatArray, torque_nm: FloatArray) -> Standing:
    """From periods (k, n) in a row, at least two. NaN: a tension was not measured, a torque not asked for anew."""
    error: FloatArray = tension_n - setpoint_n
    mean, seen = _mean(error)
    square, _ = _mean((error - mean) ** 2)
    change, changes_seen = _mean(np.diff(torque_nm, axis=0) ** 2)  # of two periods of which one is NaN: NaN
    return Standing(np.abs(mean), sqrt(2.0) * np.sqrt(square), np.sqrt(change), seen, changes_seen)


def look_at(now: Standing, before: Standing | None, gate: Gate, measured: BoolArray, noise_n: float = 0.0) -> Look:
    """Whether `now` speaks for a change, against it, or neither.

    `measured` (n,): spans whose tension a load cell controls; the others are not looked at. `before`: how the line
    stood before the change, as far as it was seen. `noise_n`: of a sample of a load cell.
    """
    tension_seen, torque_seen = measured & _tension_seen(now), _torque_seen(now)
    limits = np.array([[gate.tail_error_max_n], [gate.tail_oscillation_max_n + sqrt(2.0) * noise_n],
                       [gate.chatter_max_nm]])  # fmt: skip
    found, seen = _figures(now), np.vstack((tension_seen, tension_seen, torque_seen))
    allowed = np.broadcast_to(limits, found.shape)
    if before is not None:
        earlier = _figures(before)
        known = np.vstack((_tension_seen(before), _tension_seen(before), _torque_seen(before))) & np.isfinite(earlier)
        allowed = np.maximum(allowed, np.where(known, WORSE * earlier, allowed))
    beyond = seen & ~(found <= allowed)  # a figure that is no number, of what was seen, is beyond
    unseen = tuple(_unseen(now, measured & ~tension_seen, ~torque_seen))
    return Look(_worst(found, allowed, beyond), unseen)


def _figures(one: Standing) -> FloatArray:
    """(3, n), in the order of WORDS."""
    return np.vstack((one.offset_n, one.swing_n, one.chatter_nm))


def _tension_seen(one: Standing) -> BoolArray:
    return one.tension_seen >= LEAST_TENSION  # False for a share that is no number


def _torque_seen(one: Standing) -> BoolArray:
    return one.torque_seen >= LEAST_TORQUE


def _worst(found: FloatArray, allowed: FloatArray, beyond: BoolArray) -> str:
    """Of the first figure that is beyond its limit anywhere; empty: none is."""
    for (what, does, unit), value, limit, where in zip(WORDS, found, allowed, beyond, strict=True):
        if where.any():
            indices = np.flatnonzero(where)
            i = int(indices[np.argmax(value[indices] / limit[indices])])  # what is no number goes first
            return f"{what} {i + 1} {does} {value[i]:.2f} {unit}, allowed: {limit[i]:.2f} {unit}"
    return ""


def _mean(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of those in each column that are numbers, NaN where none is; and their share."""
    known = np.isfinite(values)
    count = np.count_nonzero(known, axis=0)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), count / len(values)


def _unseen(now: Standing, tensions: BoolArray, torques: BoolArray) -> Iterator[Unseen]:
    for i in np.flatnonzero(tensions):
        yield Unseen("tension", int(i) + 1, float(now.tension_seen[i]), LEAST_TENSION)
    for i in np.flatnonzero(torques):
        yield Unseen("torque", int(i) + 1, float(now.torque_seen[i]), LEAST_TORQUE)

"""What a change has shown on the line itself while it is under watch: swing, offset and chatter, where nothing moves.

The limits are those by which it was judged, or, where the line did worse before the change, what it did before and a
fifth more: what a reel out of round does is not held against a controller.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from gateway.core.line import Gate
from gateway.core.signals import FloatArray

WORSE = 1.2  #: than before the change, beyond which it is held against it


@dataclass(frozen=True)
class Standing:
    """Of a while in which set-points and speed stand. Arrays (n,); spans that are not measured are NaN."""

    offset_n: FloatArray  #: mean of the tension less its set-point, either way
    swing_n: FloatArray  #: amplitude of a sine with the same root mean square
    chatter_nm: FloatArray  #: root mean square of the change of torque from period to period


def standing(tension_n: FloatArray, setpoint_n: FloatArray, torque_nm: FloatArray) -> Standing:
    """From samples (k, n) in a row, at least two."""
    error: FloatArray = tension_n - setpoint_n
    return Standing(
        np.abs(error.mean(axis=0)),
        sqrt(2.0) * error.std(axis=0),
        np.sqrt(np.mean(np.diff(torque_nm, axis=0) ** 2, axis=0)),
    )


def against(now: Standing, before: Standing | None, gate: Gate, noise_n: float = 0.0) -> str:
    """Why a change should not be kept; empty: nothing speaks against it. `noise_n`: of a sample of a load cell."""
    limits = (
        ("tension", "is off by", "N", now.offset_n, before and before.offset_n, gate.tail_error_max_n),
        (
            "tension", "swings by", "N", now.swing_n, before and before.swing_n,
            gate.tail_oscillation_max_n + sqrt(2.0) * noise_n,
        ),
        ("torque", "chatters by", "Nm", now.chatter_nm, before and before.chatter_nm, gate.chatter_max_nm),
    )  # fmt: skip
    for what, does, unit, found, earlier, limit in limits:
        allowed = np.full(len(found), limit)
        if earlier is not None:
            allowed = np.fmax(allowed, WORSE * earlier)
        beyond = np.flatnonzero(found > allowed)
        if len(beyond):
            i = int(beyond[np.argmax(found[beyond] / allowed[beyond])])
            return f"{what} {i + 1} {does} {found[i]:.2f} {unit}, allowed: {allowed[i]:.2f} {unit}"
    return ""

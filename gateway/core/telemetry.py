"""One telemetry frame per cycle, as bytes of fixed layout: a header, then arrays over the spans (little-endian).

The loop packs it without allocating more than the frame itself; whoever reads it needs only this file.
"""

import struct
from dataclasses import dataclass

import numpy as np

from gateway.core.signals import FloatArray, IntArray

VERSION = 1
_HEADER = struct.Struct("<HHIdffIffBBH")
FLOAT_FIELDS = ("tension_n", "tension_setpoint_n", "speed_m_per_s", "torque_nm", "torque_actual_nm")
BYTE_FIELDS = ("tension_quality", "drive_state")


class MalformedFrame(Exception):
    """Bytes that are no telemetry frame of this version."""


@dataclass(slots=True)
class Frame:
    """What a cycle saw and did. Arrays have shape (n,)."""

    sequence: int  #: cycle number since the loop started
    time_s: float  #: monotonic time at which the cycle was due
    lateness_s: float  #: wake-up after the due time
    cycle_s: float  #: from the wake-up to the last write handed over
    missed: int  #: periods skipped since the start
    unwind_speed_m_per_s: float
    speed_setpoint_m_per_s: float
    state: int  #: LoopState
    saturated: bool  #: a torque or its rate is at its limit
    tension_n: FloatArray
    tension_setpoint_n: FloatArray
    speed_m_per_s: FloatArray
    torque_nm: FloatArray  #: applied: what was sent to the drives
    torque_actual_nm: FloatArray  #: what the drives report
    tension_quality: IntArray  #: Quality
    drive_state: IntArray  #: DriveState


def pack(frame: Frame) -> bytes:
    n = len(frame.tension_n)
    header = _HEADER.pack(
        VERSION,
        n,
        frame.sequence & 0xFFFFFFFF,
        frame.time_s,
        frame.lateness_s,
        frame.cycle_s,
        frame.missed & 0xFFFFFFFF,
        frame.unwind_speed_m_per_s,
        frame.speed_setpoint_m_per_s,
        frame.state,
        frame.saturated,
        0,
    )
    floats = np.concatenate([getattr(frame, name) for name in FLOAT_FIELDS]).astype("<f4").tobytes()
    return header + floats + frame.tension_quality.tobytes() + frame.drive_state.tobytes()


def unpack(payload: bytes) -> Frame:
    """The frame in `payload`. Raises MalformedFrame for a wrong version or length."""
    if len(payload) < _HEADER.size:
        raise MalformedFrame(f"{len(payload)} bytes are shorter than a header")
    version, n, sequence, time_s, lateness, cycle, missed, unwind, setpoint, state, saturated, _ = _HEADER.unpack_from(payload)
    if version != VERSION:
        raise MalformedFrame(f"version {version}, this program reads {VERSION}")
    expected = _HEADER.size + n * (4 * len(FLOAT_FIELDS) + len(BYTE_FIELDS))
    if len(payload) != expected:
        raise MalformedFrame(f"{len(payload)} bytes, a frame of {n} spans has {expected}")
    floats = np.frombuffer(payload, "<f4", n * len(FLOAT_FIELDS), _HEADER.size).astype(np.float64).reshape(-1, n)
    octets = np.frombuffer(payload, np.int8, n * len(BYTE_FIELDS), expected - n * len(BYTE_FIELDS)).reshape(-1, n)
    return Frame(
        sequence, time_s, lateness, cycle, missed, unwind, setpoint, state, bool(saturated), *floats, *octets
    )

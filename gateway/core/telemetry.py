"""One telemetry frame per cycle, as bytes of fixed layout: a header, then arrays over the spans (little-endian).

The loop packs it and forgets it; whoever reads it needs only this file.
"""

import struct
from dataclasses import dataclass

import numpy as np

from gateway.core.signals import FloatArray, IntArray

VERSION = 3
_HEADER = struct.Struct("<HHIdffIffBBBBBHB")
_FLOAT = np.dtype("<f4")
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
    phase: int  #: Phase
    by_person: bool  #: in STOP, because a person wanted it
    standstill: bool  #: no speed is asked for, and unwinder and rollers are known to stand still
    saturated: bool  #: a torque or its rate is at its limit
    held: int  #: periods in a row in which a signal was missing and the outputs were held
    doubts: int  #: a mask of Doubt: why proposals are blocked
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
        frame.phase,
        frame.by_person,
        frame.standstill,
        frame.saturated,
        min(frame.held, 0xFFFF),
        frame.doubts,
    )
    fields = [getattr(frame, name) for name in FLOAT_FIELDS]
    floats = np.concatenate(fields, dtype=_FLOAT, casting="same_kind").tobytes()
    return header + floats + frame.tension_quality.tobytes() + frame.drive_state.tobytes()


def unpack(payload: bytes) -> Frame:
    """The frame in `payload`. Raises MalformedFrame for a wrong version or length."""
    if len(payload) < _HEADER.size:
        raise MalformedFrame(f"{len(payload)} bytes are shorter than a header")
    version, n, *scalars = _HEADER.unpack_from(payload)
    sequence, time_s, lateness, cycle, missed, unwind, setpoint, state, phase, *flags = scalars
    by_person, standstill, saturated, held, doubts = flags
    if version != VERSION:
        raise MalformedFrame(f"version {version}, this program reads {VERSION}")
    expected = _HEADER.size + n * (4 * len(FLOAT_FIELDS) + len(BYTE_FIELDS))
    if len(payload) != expected:
        raise MalformedFrame(f"{len(payload)} bytes, a frame of {n} spans has {expected}")
    with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one
        floats = np.frombuffer(payload, "<f4", n * len(FLOAT_FIELDS), _HEADER.size).astype(np.float64).reshape(-1, n)
    octets: IntArray = np.frombuffer(payload, np.int8, n * len(BYTE_FIELDS), expected - n * len(BYTE_FIELDS))
    return Frame(
        sequence, time_s, lateness, cycle, missed, unwind, setpoint, state, phase, bool(by_person),
        bool(standstill), bool(saturated), held, doubts,
        floats[0], floats[1], floats[2], floats[3], floats[4], octets[:n], octets[n:],
    )  # fmt: skip


def frame_dtype(n: int) -> np.dtype[np.void]:
    """The same layout for numpy, so that many frames of `n` spans are read at once: `np.frombuffer(b"".join(...))`."""
    header = (
        ("version", "<u2"),
        ("n", "<u2"),
        ("sequence", "<u4"),
        ("time_s", "<f8"),
        ("lateness_s", "<f4"),
        ("cycle_s", "<f4"),
        ("missed", "<u4"),
        ("unwind_speed_m_per_s", "<f4"),
        ("speed_setpoint_m_per_s", "<f4"),
        ("state", "u1"),
        ("phase", "u1"),
        ("by_person", "u1"),
        ("standstill", "u1"),
        ("saturated", "u1"),
        ("held", "<u2"),
        ("doubts", "u1"),
    )
    floats = [(name, "<f4", (n,)) for name in FLOAT_FIELDS]
    octets = [(name, "i1", (n,)) for name in BYTE_FIELDS]
    return np.dtype([*header, *floats, *octets])

"""What was measured and sent on a line over some time: the data of identification, validity and diagnosis."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.core.signals import BoolArray, FloatArray, Quality
from gateway.core.states import LoopState, Phase

ARRAYS = (
    "time_s", "tension_n", "tension_setpoint_n", "speed_m_per_s", "torque_nm", "torque_actual_nm",
    "unwind_speed_m_per_s", "controlled",
)  # fmt: skip
GAP_PERIODS = 10  #: between recordings that are joined


@dataclass(frozen=True)
class Recording:
    """Samples k = 0 .. of n spans, and the torque sent with each. NaN: not known. Time ascends; there may be gaps."""

    time_s: FloatArray  #: (k,), at which the samples were taken
    tension_n: FloatArray  #: (k, n)
    tension_setpoint_n: FloatArray  #: (k, n)
    speed_m_per_s: FloatArray  #: (k, n), of the rollers
    torque_nm: FloatArray  #: (k, n), sent when the sample had been taken; it acts after the line's latency
    torque_actual_nm: FloatArray  #: (k, n), as the drives report it
    unwind_speed_m_per_s: FloatArray  #: (k,), measured
    controlled: BoolArray  #: (k,), whether the loop was in RUN or HOLD and held nothing
    period_s: float
    source: str  #: for messages: a file, an experiment

    @property
    def samples(self) -> int:
        return len(self.time_s)

    @property
    def n(self) -> int:
        return self.tension_n.shape[1]

    def digest(self) -> str:
        """SHA-256 of all numbers: which data a model was made from."""
        found = hashlib.sha256(np.float64(self.period_s).tobytes())
        for name in ARRAYS:
            array: NDArray[np.float64] = np.ascontiguousarray(getattr(self, name), dtype="<f8")
            found.update(f"{name}{array.shape}".encode())
            found.update(array.tobytes())
        return found.hexdigest()

    def part(self, begin: int, end: int) -> "Recording":
        """Samples begin <= k < end."""
        arrays = {name: getattr(self, name)[begin:end] for name in ARRAYS}
        return Recording(**arrays, period_s=self.period_s, source=self.source)

    def stretches(self, least: int) -> list["Recording"]:
        """Parts of at least `least` samples in a row, under control, without a gap, in which everything is known.

        A tension may be unknown throughout: that span has no load cell.
        """
        cells = ~np.isnan(self.tension_n).all(axis=0)
        known = [self.tension_n[:, cells], self.speed_m_per_s, self.torque_nm, self.unwind_speed_m_per_s[:, None]]
        good = self.controlled & np.isfinite(np.hstack(known)).all(axis=1)
        follows = np.diff(self.time_s) < 1.5 * self.period_s
        ends = np.flatnonzero(np.concatenate(([True], ~(good[1:] & good[:-1] & follows), [True])))
        return [
            self.part(begin, end)
            for begin, end in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)
            if good[begin] and end - begin >= least
        ]


def recording_of(frames: NDArray[np.void], period_s: float, source: str) -> Recording:
    """From telemetry frames (`frame_dtype`, (k,)), in order. What was not measured in its cycle is NaN."""

    def floats(name: str) -> FloatArray:
        return frames[name].astype(np.float64)

    measured = frames["tension_quality"] == Quality.GOOD
    held = frames["held"] > 0
    speed = floats("speed_m_per_s")
    speed[held] = np.nan  # a frame does not say which signal was missing
    return Recording(
        time_s=floats("time_s"),
        tension_n=np.where(measured, floats("tension_n"), np.nan),
        tension_setpoint_n=floats("tension_setpoint_n"),
        speed_m_per_s=speed,
        torque_nm=floats("torque_nm"),
        torque_actual_nm=floats("torque_actual_nm"),
        unwind_speed_m_per_s=floats("unwind_speed_m_per_s"),
        # While the wiring is proved the web hangs, and no law holds it.
        controlled=np.isin(frames["state"], (LoopState.RUN, LoopState.HOLD))
        & (frames["phase"] != Phase.PROVING)
        & ~held,
        period_s=period_s,
        source=source,
    )


def joined(recordings: Sequence[Recording]) -> Recording:
    """Recordings one after another, each after a gap. Raises ValueError where sizes or periods differ."""
    first = recordings[0]
    if any((one.n, one.period_s) != (first.n, first.period_s) for one in recordings):
        raise ValueError("the recordings differ in spans or period; those of one line are wanted")
    times: list[FloatArray] = []
    begin_s = 0.0
    for one in recordings:
        times.append(one.time_s - one.time_s[0] + begin_s)
        begin_s = float(times[-1][-1]) + GAP_PERIODS * first.period_s
    arrays = {name: np.concatenate([getattr(one, name) for one in recordings]) for name in ARRAYS[1:]}
    source = ", ".join(dict.fromkeys(one.source for one in recordings))
    return Recording(time_s=np.concatenate(times), **arrays, period_s=first.period_s, source=source)

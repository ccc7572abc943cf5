"""The last seconds of telemetry, as far as the line ran and its set-points stood.

Frames may be lost. Whether the line moves is decided by those that came; whether enough was seen of it is another
question, which `Standing` answers by its shares, down to none.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from gateway.core.signals import FloatArray, Quality
from gateway.core.states import LoopState
from gateway.core.telemetry import frame_dtype
from safety.probation import LEAST_TENSION, Standing, standing

SETTLE_S = 3.0  #: after the last move of a set-point
WINDOW_S = 2.0
_FAR = 1e9  #: periods: outside of every window
STANDING_S = SETTLE_S + WINDOW_S


class Recent:
    """`take` every frame; ask a few times a second."""

    def __init__(self, spans: int, period_s: float) -> None:
        self._dtype = frame_dtype(spans)
        self._period_s = period_s
        self._window = round(WINDOW_S / period_s)  #: periods
        self._periods = round(STANDING_S / period_s)
        self._frames: deque[bytes] = deque(maxlen=self._periods)
        self._first_s: float | None = None  #: when the first frame since the last `forget` was due
        self._ran = 0  #: frames

    @property
    def ran_s(self) -> float:
        """How long the line has run, all in all, since the last `forget`."""
        return self._ran * self._period_s

    @property
    def newest_s(self) -> float | None:
        """When the newest frame was due (monotonic); None: none has come since the last `forget`."""
        return float(np.frombuffer(self._frames[-1], self._dtype)["time_s"][0]) if self._frames else None

    def take(self, payload: bytes) -> None:
        """A well-formed frame."""
        self._frames.append(payload)
        frame = np.frombuffer(payload, self._dtype)[0]
        self._ran += frame["state"] == LoopState.RUN
        if self._first_s is None or frame["time_s"] < self._first_s:
            self._first_s = float(frame["time_s"])

    def forget(self) -> None:
        """What was before says nothing of what is now."""
        self._frames.clear()
        self._first_s = None
        self._ran = 0

    def stands(self) -> bool:
        """Whether set-points and speed have stood since some seconds, in RUN, as most of the frames have it."""
        frames = self._standing()
        return frames is not None and len(frames) >= LEAST_TENSION * self._periods

    def standing(self) -> Standing | None:
        """How the line stands, however much of it was seen; None: it moves, or has not stood for long enough.

        Periods of which no frame came, and tensions that are not GOOD, are not seen: a value that a device no longer
        tells stays in the frames, and so does a torque while the outputs are held.
        """
        frames = self._standing()
        if frames is None:
            return None
        row = self._window - 1 - self._periods_before_newest(frames)
        frames, row = frames[row >= 0], row[row >= 0]
        good = frames["tension_quality"] == Quality.GOOD
        asked_anew = (frames["held"] == 0)[:, np.newaxis]
        tension, setpoint, torque = (
            self._in_rows(row, np.where(usable, _floats(frames, name), np.nan))
            for name, usable in (("tension_n", good), ("tension_setpoint_n", True), ("torque_nm", asked_anew))
        )
        return standing(tension, setpoint, torque)

    def _standing(self) -> NDArray[np.void] | None:
        """The frames of the last seconds, where none of them moves."""
        if not self._frames or self._first_s is None:
            return None
        frames = np.frombuffer(b"".join(self._frames), self._dtype)
        with np.errstate(over="ignore", invalid="ignore"):  # a frame may tell any time that is a number
            passed = (frames["time_s"][-1] - self._first_s) / self._period_s + 1.0  # periods
        if not passed >= self._periods - 0.5:
            return None
        before = self._periods_before_newest(frames)
        frames = frames[(before >= 0) & (before < self._periods)]
        # What is no number is not 0: it moves.
        with np.errstate(over="ignore", invalid="ignore"):
            moved = np.ptp(frames["tension_setpoint_n"], axis=0).any() or np.ptp(frames["speed_setpoint_m_per_s"])
        ran = (frames["state"] == LoopState.RUN).all()
        return frames if ran and not moved else None

    def _periods_before_newest(self, frames: NDArray[np.void]) -> NDArray[np.int64]:
        """Of each frame (k,). Frames may be lost, and a loop may skip periods."""
        with np.errstate(over="ignore", invalid="ignore"):
            before = np.rint((frames["time_s"][-1] - frames["time_s"]) / self._period_s)
        return np.nan_to_num(np.clip(before, -_FAR, _FAR), nan=_FAR).astype(np.int64)

    def _in_rows(self, row: NDArray[np.int64], values: FloatArray) -> FloatArray:
        """One row for each period of the window: NaN where no frame came."""
        found: FloatArray = np.full((self._window, values.shape[1]), np.nan)
        found[row] = values
        return found


def _floats(frames: NDArray[np.void], name: str) -> FloatArray:
    with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one
        return frames[name].astype(np.float64)

"""The last seconds of telemetry, as far as the line ran and its set-points stood."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from gateway.core.signals import FloatArray, Quality
from gateway.core.states import LoopState
from gateway.core.telemetry import frame_dtype
from safety.probation import Standing, standing

SETTLE_S = 3.0  #: after the last move of a set-point
WINDOW_S = 2.0


class Recent:
    """`take` every frame; ask a few times a second."""

    def __init__(self, spans: int, period_s: float) -> None:
        self._dtype = frame_dtype(spans)
        self._period_s = period_s
        self._frames: deque[bytes] = deque(maxlen=round((SETTLE_S + WINDOW_S) / period_s))
        self._ran = 0  #: frames

    @property
    def ran_s(self) -> float:
        """How long the line has run, all in all, since the last `forget`."""
        return self._ran * self._period_s

    def take(self, payload: bytes) -> None:
        """A well-formed frame."""
        self._frames.append(payload)
        self._ran += np.frombuffer(payload, self._dtype)["state"][0] == LoopState.RUN

    def forget(self) -> None:
        """What was before says nothing of what is now."""
        self._frames.clear()
        self._ran = 0

    def stands(self) -> bool:
        """Whether set-points and speed have stood since some seconds, in RUN."""
        return self._standing() is not None

    def standing(self) -> Standing | None:
        """How the line stands; None: it moves, or has not stood for long enough."""
        frames = self._standing()
        if frames is None:
            return None
        last = frames[-round(WINDOW_S / self._period_s) :]
        measured: FloatArray = np.where(last["tension_quality"] == Quality.GOOD, last["tension_n"], np.nan)
        return standing(measured, _floats(last, "tension_setpoint_n"), _floats(last, "torque_nm"))

    def _standing(self) -> NDArray[np.void] | None:
        if len(self._frames) < (self._frames.maxlen or 0):
            return None
        frames = np.frombuffer(b"".join(self._frames), self._dtype)
        moved = np.ptp(frames["tension_setpoint_n"], axis=0).any() or np.ptp(frames["speed_setpoint_m_per_s"])
        ran = (frames["state"] == LoopState.RUN).all()
        return frames if ran and not moved else None


def _floats(frames: NDArray[np.void], name: str) -> FloatArray:
    return frames[name].astype(np.float64)

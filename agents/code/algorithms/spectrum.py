"""What swings in a channel, and whether a roller turns as fast.

The periodogram of the longest piece without a gap, windowed (Hann), its trend taken out. An ordinate of noise alone is
exponentially distributed about its floor, which is the median of its surroundings over ln 2: what stands out by more
than chance over all ordinates explains is a peak.
"""

from dataclasses import dataclass
from math import log, pi

import numpy as np
from scipy.signal import detrend, find_peaks

from agents.code.algorithms.figures import figure, sentences
from agents.code.calls import CallRefused, Channel, Spectrum
from agents.code.job import Job, Outcome
from gateway.core.line_model import theta_of
from gateway.core.questions import Figure
from gateway.core.recording import Recording
from gateway.core.signals import BoolArray, FloatArray
from gateway.core.theta import nominal_theta

LEAST_SAMPLES = 128
MOST_PEAKS = 6
RISK = 1e-3  #: that noise alone has any peak
FLOOR_HALF_WIDTH = 25  #: ordinates on either side that make the floor
SLOWEST = 3  #: ordinates at the slow end that are drift
HARMONICS = (1, 2, 3)  #: of a turn, at which a roller shows
_SIGNALS = {"tension": "tension_n", "speed": "speed_m_per_s", "torque": "torque_nm"}
_UNITS: dict[Channel, str] = {"tension": "N", "speed": "m/s", "torque": "Nm"}
_HANN_WIDTH = 2.0  #: ordinates, to which two lines are told apart


@dataclass(frozen=True)
class Peak:
    frequency_hz: float
    amplitude: float  #: of the sine that would make it, in the channel's unit
    over_floor: float  #: power, over that of the noise around it


def spectrum_of(call: Spectrum, job: Job) -> Outcome:
    recording, believed = job.recordings[0], job.models[0]
    if call.index > recording.n:
        raise CallRefused([f"index is {call.index}; allowed: 1 to {recording.n}"])
    theta = nominal_theta(job.line) if believed.model is None else theta_of(believed.model)
    signal: FloatArray = getattr(recording, _SIGNALS[call.channel])[:, call.index - 1]
    piece = _longest(recording, signal)
    speeds = np.nanmean(recording.speed_m_per_s[piece], axis=0)
    resolution_hz = 1.0 / ((piece.stop - piece.start) * recording.period_s)
    found = peaks(signal[piece], recording.period_s)
    turns_hz: FloatArray = np.abs(speeds) / (2.0 * pi * theta.web.radius_m)
    words = [
        f"{call.channel} {call.index} of {recording.source}, {(piece.stop - piece.start) * recording.period_s:.3g} s",
        f"two peaks nearer than {_HANN_WIDTH * resolution_hz:.3g} Hz are one; radii are of {believed.name}",
        f"rollers turn at {', '.join(f'{turn:.3g}' for turn in turns_hz)} Hz in the mean",
        _steadiness(recording, piece),
        *([] if found else ["nothing stands out of the noise"]),
        *(_told(number, peak, turns_hz, resolution_hz) for number, peak in enumerate(found, 1)),
    ]
    figures: list[Figure] = []
    for number, peak in enumerate(found, 1):
        figures += [
            figure(f"peak {number}: frequency", peak.frequency_hz, "Hz"),
            figure(f"peak {number}: amplitude", peak.amplitude, _UNITS[call.channel]),
            figure(f"peak {number}: power over the floor", peak.over_floor),
        ]
    return Outcome(figures=[*figures, figure("resolution", resolution_hz, "Hz")], words=sentences(words))


def peaks(signal: FloatArray, period_s: float) -> list[Peak]:
    """Of a signal (k,), the greatest first; none where noise explains all."""
    samples = len(signal)
    window = np.hanning(samples)
    transformed = np.fft.rfft(window * np.asarray(detrend(signal), dtype=np.float64))
    power: FloatArray = np.square(np.abs(transformed))
    floor = np.array([np.median(power[max(k - FLOOR_HALF_WIDTH, SLOWEST) : k + FLOOR_HALF_WIDTH + 1])
                      for k in range(len(power))]) / log(2.0)  # fmt: skip
    over: FloatArray = power / np.maximum(floor, 1e-18 * max(float(power.max()), 1e-300))
    over[:SLOWEST] = 0.0
    at, _ = find_peaks(over, height=log(len(over) / RISK))
    found = [
        Peak(
            (k + _beside(power, k)) / (samples * period_s), 2.0 * _height(power, k) / float(window.sum()),
            float(over[k]),
        )
        for k in at.tolist()
    ]  # fmt: skip
    return sorted(found, key=lambda peak: -peak.amplitude)[:MOST_PEAKS]


def _beside(power: FloatArray, k: int) -> float:
    """By how much of an ordinate the line stands beside k: of Hann's window, from the greater neighbour (Grandke)."""
    left, middle, right = np.sqrt(power[k - 1 : k + 2]).tolist() if 0 < k < len(power) - 1 else (0.0, 1.0, 0.0)
    ratio = max(left, right) / middle
    return float(np.sign(right - left)) * (2.0 * ratio - 1.0) / (1.0 + ratio) if ratio > 0.5 else 0.0


def _height(power: FloatArray, k: int) -> float:
    """The amplitude that a line beside k would have on an ordinate."""
    d = _beside(power, k)
    return float(np.sqrt(power[k])) * (1.0 - d * d) / float(np.sinc(d))


def _longest(recording: Recording, signal: FloatArray) -> slice:
    """The longest piece in which the signal is known, the web moves and no sample is missing. Raises CallRefused."""
    known: BoolArray = np.isfinite(signal) & np.isfinite(recording.speed_m_per_s).all(axis=1)
    follows = np.diff(recording.time_s) < 1.5 * recording.period_s
    ends = np.flatnonzero(np.concatenate(([True], ~(known[1:] & known[:-1] & follows), [True])))
    longest = int(np.argmax(np.diff(ends)))
    piece = slice(int(ends[longest]), int(ends[longest + 1]))
    if piece.stop - piece.start < LEAST_SAMPLES or not known[piece].all():
        raise CallRefused(
            [f"{recording.source} has no {LEAST_SAMPLES} samples of it in a row; allowed: another channel or recording"]
        )
    return piece


def _steadiness(recording: Recording, piece: slice) -> str:
    speed = recording.speed_m_per_s[piece].mean(axis=1)
    low, high = float(speed.min()), float(speed.max())
    steady = high - low < 0.1 * max(abs(high), 1e-9)
    said = "steady" if steady else "not steady: what turns with a roller is smeared"
    return f"rollers run at {low:.3g} to {high:.3g} m/s: {said}"


def _told(number: int, peak: Peak, turns_hz: FloatArray, resolution_hz: float) -> str:
    """Whose turn it is, as far as the resolution tells."""
    whose = [
        f"roller {roller} ({'once' if times == 1 else f'{times} times'} a turn)"
        for times in HARMONICS
        for roller, turn in enumerate(turns_hz.tolist(), 1)
        if turn > 0.0 and abs(peak.frequency_hz - times * turn) <= resolution_hz
    ]
    said = f"matches {', '.join(whose)}" if whose else "matches no roller's turning"
    return f"peak {number}, {peak.frequency_hz:.4g} Hz: {said}"

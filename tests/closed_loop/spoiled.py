"""Recordings as they should not be: what goes wrong between a sensor and a file."""

from dataclasses import replace

import numpy as np

from gateway.core.recording import ARRAYS, Recording


def times(recording: Recording, channel: str, factor: float, *columns: int) -> Recording:
    """With columns (from 0; none: all) of an array multiplied."""
    array = getattr(recording, channel).copy()
    array[(slice(None), list(columns)) if columns else ...] *= factor
    return replace(recording, **{channel: array})


def swapped(recording: Recording, channel: str, a: int, b: int) -> Recording:
    array = getattr(recording, channel).copy()
    array[:, [a, b]] = array[:, [b, a]]
    return replace(recording, **{channel: array})


def unwinder_swapped(recording: Recording, roller: int) -> Recording:
    speed = recording.speed_m_per_s.copy()
    speed[:, roller] = recording.unwind_speed_m_per_s
    return replace(recording, speed_m_per_s=speed, unwind_speed_m_per_s=recording.speed_m_per_s[:, roller].copy())


def frozen(recording: Recording, channel: str, column: int, begin: int, end: int | None = None) -> Recording:
    array = getattr(recording, channel).copy()
    array[begin:end, column] = array[begin, column]
    return replace(recording, **{channel: array})


def stuck_with_noise(recording: Recording, channel: str, column: int, noise: float, seed: int) -> Recording:
    """A sensor that shows its mean, whatever it measures, and the amplifier's noise."""
    array = getattr(recording, channel).copy()
    generator = np.random.default_rng(seed)
    array[:, column] = array[:, column].mean() + noise * generator.standard_normal(len(array))
    return replace(recording, **{channel: array})


def doubled(recording: Recording, k: int, count: int) -> Recording:
    """Samples k .. k + count - 1 are written twice."""
    order = np.sort(np.concatenate((np.arange(recording.samples), np.arange(k, k + count))))
    return replace(recording, **{name: getattr(recording, name)[order] for name in ARRAYS})


def repeated(recording: Recording, every: int) -> Recording:
    """Every so many samples shows the one before once more, as of a source that is slower than its file."""
    order = np.arange(recording.samples)
    order[every::every] -= 1
    arrays = {name: getattr(recording, name)[order] for name in ARRAYS if name != "time_s"}
    return replace(recording, **arrays)


def joined(first: Recording, second: Recording, begin: int) -> Recording:
    """`second` follows after the first `begin` samples, without a gap."""
    length = first.samples - begin
    arrays = {name: np.concatenate((getattr(first, name)[:begin], getattr(second, name)[:length])) for name in ARRAYS}
    return replace(first, **{**arrays, "time_s": first.time_s})


def shifted(recording: Recording, channel: str, column: int, periods: int) -> Recording:
    """A column later by whole periods, the ends of all cut off."""
    array = np.roll(getattr(recording, channel), periods, axis=0) if column < 0 else getattr(recording, channel).copy()
    if column >= 0:
        array[:, column] = np.roll(array[:, column], periods)
    margin = abs(periods)
    return replace(recording, **{channel: array}).part(margin, recording.samples - margin)

"""Time offsets between the channels of a recording, with intervals, from what the equations link; and their correction.

A channel with the offset d shows at t what was true at t - d. Each span's regression says by how much v_i and v_{i-1}
lead its tension, each roller's by how much the torque acts later than the line's latency says (`regressions`); least
squares put these together. Only differences can be known: offsets are relative to the roller speed in the middle of
those that are linked to each other. A torque that acts late, by latency or lag of the drive, has a negative offset.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.identification.regressions import EquationFit, equation_fits, moving

#: An offset whose standard deviation is above this is not known: half a period, where it may as well be a sample more.
UNKNOWN_PERIODS = 0.5
_VAGUE_S = 0.1


@dataclass(frozen=True)
class Alignment:
    """The interval is of 95 %; -inf to inf where the data say nothing."""

    channel: str  #: "tension_1_n", "speed_1_m_per_s", "torque_1_nm" (from 1) or "unwind_speed_m_per_s"
    offset_s: float
    low_s: float
    high_s: float
    reference: bool = False  #: the channel to which the others are relative

    @property
    def known(self) -> bool:
        return bool(np.isfinite(self.low_s))


def estimate_alignment(recording: Recording, line: Line, fits: Sequence[EquationFit] | None = None) -> list[Alignment]:
    """Of all channels that the recording has: v0, speeds, tensions, torques. Empty where no stretch is long enough."""
    fits = equation_fits(recording, line) if fits is None else fits
    if not fits:
        return []
    fits, there = [fit for fit in fits if moving(fit)], {fit.index for fit in fits if fit.kind == "span"}
    n = line.n
    names = channels(n)
    information = np.eye(len(names)) / _VAGUE_S**2
    gradient = np.zeros(len(names))
    for fit in fits:
        links = _links(fit, n)
        information += links.T @ fit.shift_information @ links
        gradient += links.T @ fit.shift_information @ fit.shift_s
    covariance: FloatArray = np.asarray(np.linalg.inv(information), dtype=np.float64)
    offset = covariance @ gradient
    found: list[Alignment] = []
    for group in _linked(fits, n, covariance, UNKNOWN_PERIODS * recording.period_s):
        found += _relative(group, n, names, offset, covariance)
    found = [_wider(a, 0.5 * recording.period_s) if a.channel == names[0] else a for a in found]
    absent = {names[1 + n + i] for i in range(n) if i not in there}
    return sorted((a for a in found if a.channel not in absent), key=lambda a: names.index(a.channel))


def channels(n: int) -> list[str]:
    """In the order of all arrays here: v_0 .. v_n, T_1 .. T_n, u_1 .. u_n."""
    numbers = range(1, n + 1)
    return [
        "unwind_speed_m_per_s",
        *(f"speed_{i}_m_per_s" for i in numbers),
        *(f"tension_{i}_n" for i in numbers),
        *(f"torque_{i}_nm" for i in numbers),
    ]


def aligned(recording: Recording, alignments: Sequence[Alignment], least_s: float = 0.0) -> Recording:
    """With the known channels moved by their offsets of more than `least_s`, in straight lines between samples.

    What it costs: by a fraction a of a period, white noise of a sensor falls to sqrt(1 - 2 a + 2 a^2) of itself (0.71
    at half a period) and is no longer white, and a signal of frequency f is damped by up to 1 - cos(pi f h); whole
    periods cost nothing but the samples at the ends of stretches. So noise and innovations of a channel that was
    moved are not to be believed to better than this. Torques belong to the model's latency and lag: leave them out,
    unless their time stamps are known to be wrong. Where a sample is missing on either side the result is NaN.
    """
    moved: dict[str, FloatArray] = {}
    for alignment in alignments:
        if not alignment.known or abs(alignment.offset_s) <= least_s or alignment.offset_s == 0.0:
            continue
        array, column = _place(alignment.channel)
        if array not in moved:
            moved[array] = np.array(getattr(recording, array), dtype=np.float64)
        target = moved[array] if column is None else moved[array][:, column]
        target[:] = _at(recording, target.copy(), alignment.offset_s)
    return replace(recording, **moved)


def _links(fit: EquationFit, n: int) -> FloatArray:
    """Rows (shifts, channels) that make a fit's shifts of the channels' offsets."""
    i = fit.index
    if fit.kind == "roller":
        links = np.zeros((1, 3 * n + 1))
        links[0, 1 + i], links[0, 1 + 2 * n + i] = 1.0, -1.0
        return links
    links = np.zeros((2, 3 * n + 1))
    links[0, 1 + i], links[1, i] = 1.0, 1.0
    links[:, 1 + n + i] = -1.0
    return links


def _linked(fits: Sequence[EquationFit], n: int, covariance: FloatArray, unknown_s: float) -> list[list[int]]:
    """Channels in groups within which offsets are known relative to each other, to better than `unknown_s`."""
    group = list(range(3 * n + 1))
    for fit in fits:
        for link in _links(fit, n):
            a, b = np.flatnonzero(link).tolist()
            spread = covariance[a, a] + covariance[b, b] - 2.0 * covariance[a, b]
            if spread < unknown_s**2:
                old, new = group[b], group[a]
                group = [new if g == old else g for g in group]
    return [[k for k in range(len(group)) if group[k] == g] for g in sorted(set(group))]


def _relative(
    group: list[int], n: int, names: list[str], offset: FloatArray, covariance: FloatArray
) -> list[Alignment]:
    speeds = [k for k in group if 1 <= k <= n]
    if not speeds:  # what is linked to no roller's speed says nothing
        return [Alignment(names[k], 0.0, -np.inf, np.inf) for k in group]
    reference = sorted(speeds, key=lambda k: float(offset[k]))[(len(speeds) - 1) // 2]
    found: list[Alignment] = []
    for k in group:
        value = float(offset[k] - offset[reference])
        variance = covariance[k, k] + covariance[reference, reference] - 2.0 * covariance[k, reference]
        half = 1.96 * float(np.sqrt(max(variance, 0.0)))
        found.append(Alignment(names[k], value, value - half, value + half, k == reference))
    return found


def _wider(alignment: Alignment, by_s: float) -> Alignment:
    """Whether it goes straight from sample to sample, or stays, nobody knows: half a period lies between the two."""
    return replace(alignment, low_s=alignment.low_s - by_s, high_s=alignment.high_s + by_s)


def _place(channel: str) -> tuple[str, int | None]:
    """Name of the array, and column."""
    if channel == "unwind_speed_m_per_s":
        return channel, None
    kind, number, unit = channel.split("_", 2)
    return f"{kind}_{unit}", int(number) - 1


def _at(recording: Recording, x: FloatArray, later_s: float) -> FloatArray:
    """x(t + later) at the recording's times t."""
    t = recording.time_s
    at = t + later_s
    j = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    length = t[j + 1] - t[j]
    part = (at - t[j]) / length
    part = np.where(np.abs(part - np.round(part)) < 1e-6, np.round(part), part)  # so that NaN beside it does not count
    before, after = np.where(part < 1.0, x[j], 0.0), np.where(part > 0.0, x[j + 1], 0.0)
    value = (1.0 - part) * before + part * after
    good = (part >= 0.0) & (part <= 1.0) & (length < 1.5 * recording.period_s)
    return np.where(good, value, np.nan)

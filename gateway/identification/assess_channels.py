"""Of each channel by itself: unknown, frozen, saturated, noisy, or at a level that only a wrong unit explains."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, pi

import numpy as np

from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.signals import BoolArray, FloatArray
from gateway.core.theta import Noise
from gateway.identification.findings import Finding, Severity

UNKNOWN_WARNED, UNKNOWN_REFUSED = 0.0, 0.1  #: share of samples without a value
SATURATED_WARNED, SATURATED_REFUSED = 0.3, 0.6  #: share of samples
NOISE_WARNED, NOISE_REFUSED = 5.0, 30.0  #: times what a load cell usually has
FROZEN_LEAST = 10  #: samples in a row
SLIP = 0.05  #: relative: what speeds of a web may differ by, beside the radii
AS_NEAR = 1.1  #: ratio between units of which either may be meant
STANDSTILL = 0.02  #: of the largest speed: below it, ratios of speeds say nothing

#: By how much a number is larger than it should be.
FORCE_UNITS = {
    "mN": 1e3,
    "kN": 1e-3,
    "daN": 0.1,
    "kgf": 1 / 9.80665,
    "gf": 1e3 / 9.80665,
    "lbf": 1 / 4.44822,
    "N multiplied by 9.81 (taken for kgf)": 9.80665,
    "N multiplied by 4.448 (taken for lbf)": 4.44822,
    "tenths of N": 10.0,
}
TORQUE_UNITS = {
    "mNm": 1e3,
    "kNm": 1e-3,
    "daNm": 0.1,
    "Ncm": 100.0,
    "kgf m": 1 / 9.80665,
    "lbf ft": 1 / 1.35582,
    "lbf in": 1 / 0.112985,
    "tenths of Nm": 10.0,
}
SPEED_UNITS = {
    "mm/s": 1e3,
    "cm/s": 100.0,
    "m/min": 60.0,
    "ft/s": 1 / 0.3048,
    "ft/min": 60 / 0.3048,
    "km/h": 3.6,
    "tenths of m/s": 10.0,
    "units of 10 m/s": 0.1,
    "km/s": 1e-3,
}


@dataclass(frozen=True)
class Unit:
    name: str
    factor: float  #: number read over the number in SI


def speed_units(line: Line, roller: int | None) -> list[Unit]:
    """Those of the web, and of the roller's shaft (None: the unwinder, whose radius the line does not know)."""
    units = [Unit(name, factor) for name, factor in SPEED_UNITS.items()]
    if roller is None:
        return units
    radius = line.rollers[roller].radius_m.value
    turns = 1.0 / (2.0 * pi * radius)
    return [
        *units,
        Unit("rad/s of the shaft", 1.0 / radius),
        Unit("rpm of the shaft", 60.0 * turns),
        Unit("turns/s", turns),
    ]


def torque_units(line: Line, roller: int) -> list[Unit]:
    rated = [drive.roller_torque_nm for drive in line.drives if drive.roller == roller + 1]
    shares = [
        Unit(f"{name} of the rated torque", k / r)
        for r in rated[:1]
        for name, k in (("per cent", 1e2), ("per mille", 1e3), ("parts", 1.0))
    ]
    return [*(Unit(name, factor) for name, factor in TORQUE_UNITS.items()), *shares]


def force_units() -> list[Unit]:
    return [Unit(name, factor) for name, factor in FORCE_UNITS.items()]


def assess_channels(recording: Recording, line: Line) -> list[Finding]:
    used = recording.controlled
    if not used.any():
        return []
    return [
        *_unknown(recording, line, used),
        *_frozen(recording, line, used),
        *_saturation(recording, line, used),
        *_noise(recording, used),
        *_speed_levels(recording, line, used),
        *_tension_levels(recording, used),
    ]


def series(recording: Recording) -> list[tuple[str, FloatArray]]:
    """Every measured or sent channel by its name; tensions of spans without a load cell left out."""
    found = [("unwind_speed_m_per_s", recording.unwind_speed_m_per_s)]
    for pattern, array in (
        ("tension_{}_n", recording.tension_n),
        ("speed_{}_m_per_s", recording.speed_m_per_s),
        ("torque_{}_nm", recording.torque_nm),
    ):
        found += [(pattern.format(i + 1), array[:, i]) for i in range(recording.n)]
    return [(name, x) for name, x in found if not (name.startswith("tension") and np.isnan(x).all())]


def likely_units(factor: float, units: Sequence[Unit], within: float) -> str:
    """The unit whose factor is nearest, and others as near, joined by "or"; "" if none is within a ratio."""
    if factor <= 0.0:
        return ""
    away = sorted((abs(log(factor / unit.factor)), unit.name) for unit in units)
    return " or ".join(name for off, name in away if off <= log(within) and off <= away[0][0] + log(AS_NEAR))


def _unknown(recording: Recording, line: Line, used: BoolArray) -> list[Finding]:
    found: list[Finding] = []
    for i, span in enumerate(line.spans):
        if span.control == "tension" and np.isnan(recording.tension_n[:, i]).all():
            what = "no tension was recorded, and the line's file says that the span has a load cell"
            mend = "record it, or describe the span as draw-controlled"
            found.append(Finding("unknown", Severity.REFUSAL, what, f"tension_{i + 1}_n", 1.0, UNKNOWN_REFUSED, mend))
    for name, x in series(recording):
        share = float(np.mean(~np.isfinite(x[used])))
        if share > UNKNOWN_WARNED:
            severity = Severity.REFUSAL if share > UNKNOWN_REFUSED else Severity.WARNING
            what = f"{share:.1%} of the samples under control have no value"
            found.append(
                Finding("unknown", severity, what, name, share, UNKNOWN_REFUSED, "mend the sensor or its wire")
            )
    return found


def _frozen(recording: Recording, line: Line, used: BoolArray) -> list[Finding]:
    """Values that repeat for longer than their resolution explains. v0 may well stand still, a limited torque too."""
    found: list[Finding] = []
    for name, x in series(recording):
        if name == "unwind_speed_m_per_s":
            continue
        free = used & (np.abs(x) < 0.999 * line.limits.torque_nm) if name.startswith("torque") else used
        same = (x[1:] == x[:-1]) & free[1:] & free[:-1]
        begin, length = longest_run(same)
        others = max(int(np.sum(free)) - 1 - length, 1)
        share = (float(np.sum(same)) - length) / others
        expected = log(len(x) + 1.0) / log(1.0 / min(max(share, 1e-3), 0.99))
        limit = max(FROZEN_LEAST, 3.0 * expected + 5.0)
        if length >= limit or (length * recording.period_s >= line.limits.stuck_s and not name.startswith("torque")):
            what = f"shows {x[begin]:.6g} for {length + 1} samples in a row ({length * recording.period_s:.3g} s)"
            where = f"{name}, sample {begin + 1} on"
            mend = "mend the sensor or its wire, or leave this time out"
            found.append(Finding("frozen", Severity.REFUSAL, what, where, float(length), limit, mend))
    return found


def longest_run(same: BoolArray) -> tuple[int, int]:
    """Begin and length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], same, [False])).astype(np.int8)))
    if not len(edges):
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    longest = int(np.argmax(lengths))
    return int(edges[2 * longest]), int(lengths[longest])


def _saturation(recording: Recording, line: Line, used: BoolArray) -> list[Finding]:
    """Of the torque sent and of its rate. It is known, so it spoils nothing; but what is at a limit moves nothing."""
    found: list[Finding] = []
    torque, limits = recording.torque_nm, line.limits
    rate_nm = limits.torque_rate_nm_per_s * recording.period_s
    for i in range(recording.n):
        beyond = float(np.mean(np.abs(torque[used, i]) > 1.01 * limits.torque_nm))
        if beyond > 0.0:
            what = f"{beyond:.1%} of the samples are beyond the line's limit of {limits.torque_nm:g} Nm"
            found.append(Finding("unit", Severity.REFUSAL, what, f"torque_{i + 1}_nm", beyond, 0.0, "give it in Nm"))
    moves = np.abs(np.diff(torque, axis=0, prepend=torque[:1])) >= 0.999 * rate_nm
    for kind, reached in (("torque", np.abs(torque) >= 0.999 * limits.torque_nm), ("torque rate", moves)):
        shares = np.mean(reached[used], axis=0)
        worst = int(np.argmax(shares))
        share = float(shares[worst])
        if share > SATURATED_WARNED and not found:
            severity = Severity.REFUSAL if share > SATURATED_REFUSED else Severity.WARNING
            limit = SATURATED_REFUSED if share > SATURATED_REFUSED else SATURATED_WARNED
            what = f"its {kind} is at the limit in {share:.0%} of the samples, more than any other's"
            text = "set-points moved by less, or more slowly"
            found.append(Finding("saturation", severity, what, f"torque_{worst + 1}_nm", share, limit, "", text))
    return found


def _noise(recording: Recording, used: BoolArray) -> list[Finding]:
    """Of load cells, from third differences, which leave nearly nothing of a tension's own movement."""
    found: list[Finding] = []
    usual = Noise().tension_n
    for i in range(recording.n):
        third = np.diff(recording.tension_n[:, i], 3)
        inside = used[3:] & used[:-3] & np.isfinite(third)
        if np.sum(inside) < 10:
            continue
        noise = float(np.sqrt(np.mean(third[inside] ** 2) / 20.0))
        if noise > NOISE_WARNED * usual:
            severity = Severity.REFUSAL if noise > NOISE_REFUSED * usual else Severity.WARNING
            what = f"noise of {noise:.3g} N (standard deviation of a sample)"
            mend = "check the amplifier's filter, the screen of its wire and its earth"
            found.append(Finding("noise", severity, what, f"tension_{i + 1}_n", noise, NOISE_REFUSED * usual, mend))
    return found


def _speed_levels(recording: Recording, line: Line, used: BoolArray) -> list[Finding]:
    """A web that does not slip has one speed: each roller's against the median of all, v0 among them."""
    names = ["unwind_speed_m_per_s", *(f"speed_{i + 1}_m_per_s" for i in range(recording.n))]
    speeds = np.column_stack((recording.unwind_speed_m_per_s, recording.speed_m_per_s))[used]
    level = np.array([float(np.mean(x[np.isfinite(x)])) if np.isfinite(x).any() else np.nan for x in speeds.T])
    known = np.isfinite(level)
    web = float(np.median(level[known])) if known.any() else 0.0
    found: list[Finding] = []
    if abs(web) > 1.2 * line.limits.speed_max_m_per_s:
        what = f"the web runs at {web:.4g} m/s, the line's limit is {line.limits.speed_max_m_per_s:g} m/s"
        units = [u for u in speed_units(line, 0) if STANDSTILL < web / u.factor / line.limits.speed_max_m_per_s <= 1.2]
        mend = "give speeds in m/s" + (f": these may be {', '.join(u.name for u in units)}" if units else "")
        where = "all speeds"
        return [Finding("unit", Severity.REFUSAL, what, where, web, line.limits.speed_max_m_per_s, mend)]
    if abs(web) < STANDSTILL * line.limits.speed_max_m_per_s:
        what = f"the web stands ({web:.2g} m/s)"
        return [
            Finding("standstill", Severity.WARNING, what, "all speeds", web, STANDSTILL, "", "the line at its speed")
        ]
    for k in np.flatnonzero(known).tolist():
        allowed = SLIP + (line.rollers[k - 1].radius_m.tolerance if k else 0.0)
        ratio = float(level[k]) / web
        if abs(ratio - 1.0) <= allowed:
            continue
        unit = likely_units(ratio, speed_units(line, k - 1 if k else None), 1.0 + allowed)
        what = f"its mean is {level[k]:.4g} m/s, that of all speeds {web:.4g} m/s"
        mend = f"this may be in {unit}: give it in m/s" if unit else "check sign, radius, gear ratio and scale"
        kind = "unit" if unit else "level"
        found.append(Finding(kind, Severity.REFUSAL, what, names[k], ratio, 1.0 + allowed, mend))
    return found


def _tension_levels(recording: Recording, used: BoolArray) -> list[Finding]:
    """Under control a tension is near its set-point: a known unit's factor from it is no chance."""
    found: list[Finding] = []
    for i in range(recording.n):
        both = np.column_stack((recording.tension_n[used, i], recording.tension_setpoint_n[used, i]))
        both = both[np.isfinite(both).all(axis=1)]
        if not len(both):
            continue
        level, wanted = np.mean(both, axis=0).tolist()
        unit = likely_units(level / wanted, force_units(), 1.15) if wanted > 0.0 else ""
        if unit:
            what = f"its mean is {level:.4g} N, that of its set-points {wanted:.4g} N"
            mend = f"this may be in {unit}: give it in N"
            found.append(Finding("unit", Severity.REFUSAL, what, f"tension_{i + 1}_n", level / wanted, 1.15, mend))
        elif abs(level - wanted) > 0.3 * abs(wanted):
            what = f"its mean is {level:.4g} N, that of its set-points {wanted:.4g} N"
            mend = "check the load cell's zero and scale"
            found.append(
                Finding("level", Severity.WARNING, what, f"tension_{i + 1}_n", level / max(wanted, 1e-9), 0.3, mend)
            )
    return found

"""From a device's number to SI and back: the one place where a drive's units are converted."""

from ctypes import c_float
from math import floor
from typing import Protocol

from gateway.core.units import SI_PER_UNIT

_ANGULAR = {"rad/s", "rpm", "mrpm"}
_FLOATS = {"f32", "f64"}
ROUNDING = 1e-6  #: relative, of a number that was worked out or read as a float


class Field(Protocol):
    """A number in a map."""

    @property
    def type(self) -> str: ...
    @property
    def unit(self) -> str: ...
    @property
    def scale(self) -> float: ...


class TimeField(Field, Protocol):
    """A time that arming writes."""

    @property
    def range(self) -> list[float]: ...


def si_per_count(unit: str, scale: float) -> float:
    """What one count of a field is worth in SI: `scale` counts of `unit`."""
    return scale * SI_PER_UNIT[unit]


def speed_per_count(unit: str, scale: float, radius_m: float) -> float:
    """m/s of web per count. An angular speed is converted with the roller's nominal radius."""
    linear = si_per_count(unit, scale)
    return linear * radius_m if unit in _ANGULAR else linear


def speed_step(kind: str, unit: str, scale: float, radius_m: float) -> float:
    """m/s of web that a number of type `kind` moves by at least; 0 for a float, which has no such steps."""
    return 0.0 if kind in _FLOATS else speed_per_count(unit, scale, radius_m)


def torque_per_count(unit: str, scale: float, rated_torque_nm: float) -> float:
    """Nm per count. "rated torque" is a multiple of the drive's rated torque (CiA 402: per mille of it)."""
    return scale * rated_torque_nm if unit == "rated torque" else si_per_count(unit, scale)


def torque_step(kind: str, unit: str, scale: float, rated_torque_nm: float) -> float:
    """Nm that a number of type `kind` moves by at least; 0 for a float, which has no such steps."""
    return 0.0 if kind in _FLOATS else torque_per_count(unit, scale, rated_torque_nm)


def as_type(number: float, kind: str) -> float:
    """The number of type `kind` that is nearest: what is read back after it was written."""
    if kind in _FLOATS:
        return c_float(number).value if kind == "f32" else number
    return round(number)


def at_most(value: float, worth: float, kind: str) -> float:
    """The number of type `kind`, each `worth` so much, for `value`: a float as it is, else whole, and not more."""
    counts = value / worth
    return as_type(counts if kind in _FLOATS else floor(counts + 1e-9), kind)


def watchdog_counts(entry: TimeField, watchdog_s: float) -> float:
    """What is written for a watchdog: at most the time asked for. Raises ValueError where the device cannot do it."""
    counts, (low, high) = at_most(watchdog_s, si_per_count(entry.unit, entry.scale), entry.type), entry.range
    written = counts * entry.scale
    if counts > 0 and low * (1.0 - ROUNDING) <= written <= high * (1.0 + ROUNDING):
        return counts
    steps = f", in steps of {entry.scale:g}" if low <= watchdog_s / si_per_count(entry.unit, 1.0) <= high else ""
    raise ValueError(
        f"limits.watchdog_s = {watchdog_s} s is outside what it can do ({low:g} to {high:g} {entry.unit}{steps})"
    )

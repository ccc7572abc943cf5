"""From a device's number to SI and back: the one place where a drive's units are converted."""

from gateway.core.units import SI_PER_UNIT

_ANGULAR = {"rad/s", "rpm", "mrpm"}
_FLOATS = {"f32", "f64"}


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

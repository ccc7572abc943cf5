"""What a drive says of its own torques, against what the line's file says of it: by arming and by `doctor`. No I/O."""

from drivers.scaling import ROUNDING, Field, at_most, torque_per_count
from gateway.core.finding import Finding, finding

RATED_TORQUE_TOLERANCE = 1e-3  #: of the line's figure; more would scale every torque wrongly


def is_rated(found_nm: float, wanted_nm: float) -> bool:
    """Whether a drive's rated torque is the one of the line's file."""
    return abs(found_nm - wanted_nm) <= RATED_TORQUE_TOLERANCE * wanted_nm


def allows_torque(found_nm: float, limit_nm: float, step_nm: float) -> bool:
    """Whether a greatest torque in steps of `step_nm` (0: of a float) is what arming would set for `limit_nm`, or more.

    So up to a step may be missing, but a drive that gives nothing is never enough.
    """
    least_nm = step_nm * at_most(limit_nm, step_nm, "i32") if step_nm > 0.0 else limit_nm
    return found_nm > 0.0 and found_nm >= (1.0 - ROUNDING) * least_nm


def limit_counts(entry: Field, limit_nm: float, rated_nm: float) -> float:
    """What is written as a drive's greatest torque. Raises ValueError where that would be none."""
    nm_per_count = torque_per_count(entry.unit, entry.scale, rated_nm)
    counts = at_most(limit_nm, nm_per_count, entry.type)
    if counts <= 0:
        raise ValueError(f"limits.torque_nm = {limit_nm} Nm is less than one count of max_torque ({nm_per_count:g} Nm)")
    return counts


def scaling_rated_nm(found_nm: float | None, wanted_nm: float) -> float:
    """The rated torque that others are multiples of: the file's, as arming has it, but where the drive's is another."""
    return found_nm if found_nm and not is_rated(found_nm, wanted_nm) else wanted_nm


def against_rated_torque(drive: str, found_nm: float, wanted_nm: float) -> list[Finding]:
    if is_rated(found_nm, wanted_nm):
        return []
    return [finding("rated-torque-differs", drive=drive, found_nm=found_nm, wanted_nm=wanted_nm)]


def against_max_torque(drive: str, found_nm: float, limit_nm: float, step_nm: float) -> list[Finding]:
    if allows_torque(found_nm, limit_nm, step_nm):
        return []
    return [finding("max-torque-too-low", drive=drive, found_nm=found_nm, limit_nm=limit_nm)]

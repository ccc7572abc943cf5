"""What a drive says of its own torques, against what the line's file says of it. No I/O."""

from gateway.core.finding import Finding, finding

RATED_TORQUE_TOLERANCE = 1e-3  #: of the line's figure; more would scale every torque wrongly


def against_rated_torque(drive: str, found_nm: float, wanted_nm: float) -> list[Finding]:
    if abs(found_nm - wanted_nm) <= RATED_TORQUE_TOLERANCE * wanted_nm:
        return []
    return [finding("rated-torque-differs", drive=drive, found_nm=found_nm, wanted_nm=wanted_nm)]


def against_max_torque(drive: str, found_nm: float, limit_nm: float, rounding_nm: float) -> list[Finding]:
    if found_nm + rounding_nm >= limit_nm:
        return []
    return [finding("max-torque-too-low", drive=drive, found_nm=found_nm, limit_nm=limit_nm)]

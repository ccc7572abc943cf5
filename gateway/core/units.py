"""Units at the edges. Inside the product everything is SI; only drivers and the simulated devices convert."""

from math import pi

RAD_PER_S_PER_RPM = 2.0 * pi / 60.0

#: What one unit of a device's number is worth in SI, by the unit names that maps may use.
SI_PER_UNIT: dict[str, float] = {
    "1": 1.0,
    "N": 1.0,
    "mN": 1e-3,
    "kN": 1e3,
    "m/s": 1.0,
    "mm/s": 1e-3,
    "um/s": 1e-6,
    "m/min": 1.0 / 60.0,
    "rad/s": 1.0,
    "rpm": RAD_PER_S_PER_RPM,
    "mrpm": 1e-3 * RAD_PER_S_PER_RPM,
    "Nm": 1.0,
    "mNm": 1e-3,
    "s": 1.0,
    "ms": 1e-3,
}

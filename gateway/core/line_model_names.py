"""What a model file may name: parameters and their combinations, with units, by roller or span where they differ."""

import re
from collections.abc import Iterator

from gateway.core.nearest import nearest

MOST_SPANS = 60

#: What an interval may be of, with its unit. Those per span or roller may carry a number: "inertia_kg_m2[3]".
PER_SPAN = {
    "length_m": "m",
    "radius_m": "m",
    "inertia_kg_m2": "kg m²",
    "friction_nms_per_rad": "Nm s/rad",
    "coulomb_nm": "Nm",
    "stiffness_per_length": "N/m",
    "radius_per_inertia": "1/(kg m)",
    "friction_per_inertia": "1/s",
    "radius2_per_inertia": "1/kg",
}
OF_THE_LINE = {"stiffness_n": "N", "torque_lag_s": "s", "latency_s": "s"}
UNITS = {**OF_THE_LINE, **PER_SPAN}
COMBINATIONS = ("stiffness_per_length", "radius_per_inertia", "friction_per_inertia", "radius2_per_inertia")
PARAMETERS = tuple(name for name in UNITS if name not in COMBINATIONS)


def split_name(name: str) -> tuple[str, int | None]:
    """("inertia_kg_m2", 3) of "inertia_kg_m2[3]"; no number where there is none."""
    found = re.fullmatch(r"(.*)\[([1-9][0-9]{0,3})\]", name)
    return (found[1], int(found[2])) if found else (name, None)


def wrong_name(name: str, n: int, allowed: tuple[str, ...]) -> Iterator[str]:
    """Why it is the name of nothing that a model of n spans has, of those `allowed`; nothing where it is."""
    base, number = split_name(name)
    if base not in allowed:
        like = nearest(base, allowed)
        hint = f"; did you mean {like}?" if like else ""
        yield f"there is no such parameter; allowed: {', '.join(allowed)}{hint}"
    elif number is not None and base in OF_THE_LINE:
        yield f"there is no such one; allowed: {base}"
    elif number is not None and number > n:
        yield f"there is no such one; allowed: {base}, or {base}[1] to {base}[{n}]"

"""What an amplifier's counts of tension are worth, and which of them are none. No I/O."""

from drivers.canopen.map_cell import LoadCellMap
from drivers.map_rules import BYTES
from drivers.scaling import si_per_count
from gateway.core.finding import Finding, finding
from gateway.core.line import LoadCell

MOST_DIGITS = 6


def end_values(kind: str) -> tuple[int, ...]:
    """Where an object of this type stops, whatever the force; the 0 of an unsigned one is no end, but no force.

    A float has no ends: its amplifier has to say by its status that it is overloaded.
    """
    if kind == "f32":
        return ()
    bits = 8 * BYTES[kind]
    return (2**bits - 1,) if kind[0] == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def n_per_count(device: LoadCellMap, cell: LoadCell, digits: int) -> float | Finding:
    """Newtons per count of a channel with `digits` decimal digits (CiA 404, 6132h).

    A finding where that cannot be, and where a count stops before the capacity that the line's file says.
    """
    if not 0 <= digits <= MOST_DIGITS:
        return finding("cell-digits", cell=cell.name, digits=digits, most_digits=MOST_DIGITS)
    tension = device.objects.tension
    scale_n = si_per_count(tension.unit, tension.scale) * 10.0**-digits
    ends = end_values(tension.type)
    if ends and (full_scale_n := ends[-1] * scale_n) < cell.capacity_n:
        return finding("cell-range-short", cell=cell.name, full_scale_n=full_scale_n, capacity_n=cell.capacity_n)
    return scale_n

"""Two models side by side: each parameter and combination, how far they are apart, and how sure of it they are."""

from dataclasses import dataclass
from typing import Any

from gateway.core.line_model import LineModel, ModelRegion, ModelValidation
from gateway.core.line_model_names import UNITS, split_name
from gateway.core.line_model_quantities import SYMBOLS, Quantity, quantities, symbol_of

NOISE = {
    "tension_n": "noise of T, N",
    "speed_m_per_s": "noise of v, m/s",
    "acceleration_m_per_s1_5": "noise of dv/dt, m/s^1.5",
}


@dataclass(frozen=True)
class Compared:
    """One quantity of both models."""

    name: str
    unit: str
    a: Quantity | None
    b: Quantity | None

    @property
    def symbol(self) -> str:
        return symbol_of(self.name)

    @property
    def difference_pct(self) -> float | None:
        """Of a's value; None where there is none, or it is 0."""
        if self.a is None or self.b is None or not self.a.value:
            return None
        return 100.0 * (self.b.value - self.a.value) / abs(self.a.value)

    @property
    def exclusive(self) -> bool | None:
        """Whether the intervals have nothing in common; None where one model has none."""
        return None if self.a is None or self.b is None else self.a.excludes(self.b)


def compared(a: LineModel, b: LineModel) -> list[Compared]:
    """Every quantity that both or either have. One that all rollers share stands beside each that has its own."""
    of_a, of_b = quantities(a), quantities(b)
    rows: list[Compared] = []
    for base in SYMBOLS:
        names = list(dict.fromkeys(name for name in (*of_a, *of_b) if split_name(name)[0] == base))
        own = sorted((name for name in names if name != base), key=lambda name: split_name(name)[1] or 0)
        rows += [
            Compared(name, UNITS[base], of_a.get(name, of_a.get(base)), of_b.get(name, of_b.get(base)))
            for name in own or names
        ]
    return rows


def verdict(rows: list[Compared]) -> str:
    """What the comparison comes to, as a sentence."""
    both = [row for row in rows if row.exclusive is not None]
    apart = [row for row in both if row.exclusive]
    if not both:
        return "No quantity has an interval in both models: they cannot be told apart."
    if not apart:
        return f"The intervals of all {len(both)} quantities overlap: the models do not contradict each other."
    named = ", ".join(
        row.symbol if row.difference_pct is None else f"{row.symbol} ({row.difference_pct:+.2g} %)" for row in apart
    )
    return f"The intervals of {len(apart)} of {len(both)} quantities exclude each other: {named}."


def figures(validation: ModelValidation | None) -> list[tuple[str, str]]:
    """Names and figures of a validation; dashes where there was none."""
    names = (
        "held-out samples", "innovation of tensions, 1 expected", "innovation of speeds, 1 expected",
        "R2 of tensions", "R2 of speeds", "MAE of tensions, N", "MAE of speeds, m/s", "innovations",
    )  # fmt: skip
    if validation is None:
        return [(name, "-") for name in names]
    values = (
        str(validation.samples), spread([one for one in validation.innovation_tension if one is not None]),
        spread(validation.innovation_speed), _r2(validation.r2_tension), _r2(validation.r2_speed),
        f"{validation.mae_tension_n:.3g}", f"{validation.mae_speed_m_per_s:.3g}", validation.whiteness,
    )  # fmt: skip
    return list(zip(names, values, strict=True))


def seen(region: ModelRegion) -> list[tuple[str, str]]:
    """Names and ranges of a validity region."""
    rows = [("speed, m/s", f"{region.speed_from_m_per_s:.3g} to {region.speed_to_m_per_s:.3g}")]
    for i, (low, high) in enumerate(zip(region.tension_from_n, region.tension_to_n, strict=True), 1):
        rows.append((f"tension {i}, N", "-" if low is None or high is None else f"{low:.3g} to {high:.3g}"))
    return rows


def spread(values: list[float]) -> str:
    """Least to greatest."""
    if not values:
        return "-"
    least, most = f"{min(values):.3g}", f"{max(values):.3g}"
    return least if least == most else f"{least} to {most}"


def _r2(value: float | None) -> str:
    return "nothing moved" if value is None else f"{value:.4f}"


def as_data(rows: list[Compared]) -> list[dict[str, Any]]:
    """For JSON."""

    def of(one: Quantity | None) -> dict[str, float | None] | None:
        return None if one is None else vars(one).copy()

    return [
        {
            "name": row.name,
            "unit": row.unit,
            "a": of(row.a),
            "b": of(row.b),
            "difference_pct": row.difference_pct,
            "intervals_exclude_each_other": row.exclusive,
        }
        for row in rows
    ]

"""The models of a line as a page: what they are, and how each parameter has drifted from version to version."""

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from gateway.cli.models_compare import compared, figures, spread, verdict
from gateway.cli.models_view import SHORT, STRONG, prior
from gateway.cli.report.page import Chart, Page, Section, Series, Table
from gateway.core.line_model import LineModel
from gateway.core.line_model_names import PER_SPAN, UNITS
from gateway.core.line_model_quantities import SYMBOLS, Quantity, quantities, symbol_of, typical
from gateway.core.signals import FloatArray
from gateway.supervisor.models import Entry

NAMES = {
    "stiffness_n": "Stiffness EA",
    "length_m": "Length L",
    "radius_m": "Radius R",
    "inertia_kg_m2": "Inertia J",
    "friction_nms_per_rad": "Friction f",
    "coulomb_nm": "Coulomb friction",
    "torque_lag_s": "Torque lag",
    "latency_s": "Latency",
    "stiffness_per_length": "EA/L",
    "radius_per_inertia": "R/J",
    "friction_per_inertia": "f/J",
    "radius2_per_inertia": "R²/J",
}
X_LABEL = "Version"

Sound = tuple[Entry, LineModel]


def page_of(
    site: str, line: str, entries: Sequence[Entry], when: str, command: str, versions: dict[str, str], machine: str
) -> Page:
    """`render_page` makes the page of it. `entries` are those of one line, at least one."""
    sound = [(one, one.model) for one in entries if one.model is not None]
    sections = [_versions(entries)]
    if len(sound) > 1:
        sections += [_drift(sound), _each(sound)]
    sections += [_validations(sound)] if sound else []
    return Page(
        title="Models",
        origin=f"Line {site}/{line}",
        when=when,
        command=command,
        versions=versions,
        machine=machine,
        answer=tuple(_answer(entries, sound)),
        sections=tuple(sections),
        notes=(
            "Intervals are those of 95 % that each model was stored with. They cover what the data leave open, not "
            "what the model's structure leaves out.",
            "EA/L, R/J and f/J are what data from the line tell well; EA and L, or R and J, each by itself they tell "
            "badly, and a drift of one of them alone is to be looked at with its interval.",
        ),
    )


def _answer(entries: Sequence[Entry], sound: list[Sound]) -> list[str]:
    said = [f"{len(entries)} version{'' if len(entries) == 1 else 's'} of the model are stored."]
    if damaged := [str(one.version) for one in entries if one.damage]:
        said.append(f"Damaged, and left out below: {', '.join(damaged)}.")
    if len(sound) < 2:
        return [*said, "A drift needs two versions or more."]
    (first, a), (last, b) = sound[0], sound[-1]
    rows = [row for row in compared(a, b) if row.name in STRONG]
    moves = ", ".join(f"{row.symbol} {row.difference_pct:+.2g} %" for row in rows if row.difference_pct is not None)
    if moves:
        said.append(f"From version {first.version} to version {last.version}: {moves}.")
    said.append(verdict(compared(a, b)))
    return said


def _versions(entries: Sequence[Entry]) -> Section:
    numbers = {one.id: one.version for one in entries}
    rows = tuple(_row(one, numbers) for one in entries)
    heads = ("Version", "Id", "Created", "Method", *(f"{symbol_of(name)}, {UNITS[name]}" for name in STRONG))
    heads = (*heads, "Data", "Samples", "Prior", "State")
    marks = tuple(
        (
            str(one.version),
            datetime.fromtimestamp(mark.time_s, UTC).strftime("%Y-%m-%d %H:%M UTC"),
            mark.state,
            mark.reason,
        )
        for one in entries
        for mark in one.marks
    )
    tables = [Table("Every version, the oldest first.", heads, rows, frozenset({0, 8}))]
    if marks:
        heads = ("Version", "When", "State", "Reason")
        tables.append(Table("What became of them, in order.", heads, marks, frozenset({0})))
    return Section("Versions", (), tuple(tables))


def _row(one: Entry, numbers: dict[str, int]) -> tuple[str, ...]:
    model = one.model
    if model is None:
        return (str(one.version), one.id[:SHORT], "-", one.damage, *["-"] * 6, one.state or "-")
    return (
        str(one.version), one.id[:SHORT], _created(model), model.method,
        *(_cell(typical(model, name)) for name in STRONG), model.data.digest[:SHORT], str(model.data.samples),
        prior(model, numbers), one.state or "-",
    )  # fmt: skip


def _created(model: LineModel) -> str:
    """With hyphens at which no line breaks."""
    return datetime.fromisoformat(model.created).strftime("%Y-%m-%d %H:%M").replace("-", "\u2011")


def _cell(one: Quantity) -> str:
    width = one.half_width_pct
    return f"{one.value:.4g}" + ("" if width is None else f" ±\u00a0{width:.2g}\u00a0%")


def _drift(sound: list[Sound]) -> Section:
    """The strong combinations against the first version, in one chart."""
    x = _x(sound)
    series: list[Series] = []
    for name in STRONG:
        values: FloatArray = np.array([typical(model, name).value for _, model in sound])
        if values[0]:  # a line without friction has nothing to relate to
            series.append(Series(symbol_of(name), 100.0 * (values / values[0] - 1.0)))
    chart = Chart(f"Against version {sound[0][0].version}", "%", x, tuple(series), X_LABEL, points=True)
    said = "What data tell well, against the first version. A mean where rollers or spans differ."
    return Section("Drift", (said,), (), (chart,))


def _each(sound: list[Sound]) -> Section:
    """A chart for each parameter and combination, with the ends of its intervals."""
    charts = [_chart(name, sound) for name in (*STRONG, *(one for one in SYMBOLS if one not in STRONG))]
    there = [chart for chart in charts if any(np.nan_to_num(one.values).any() for one in chart.series)]
    return Section(
        "Parameters and combinations",
        ("Dashed: the ends of the intervals. A gap: that version says nothing of it.",),
        (),
        tuple(there),
    )


def _chart(name: str, sound: list[Sound]) -> Chart:
    found = [quantities(model) for _, model in sound]
    spans = max(model.n for _, model in sound)
    own = [f"{name}[{i}]" for i in range(1, spans + 1)] if name in PER_SPAN else []
    if any(one in each for each in found for one in own):
        series = tuple(Series(symbol_of(one), _values([each.get(one) for each in found])) for one in own)
        return Chart(NAMES[name], UNITS[name], _x(sound), series, X_LABEL, points=True)
    each = [one.get(name) for one in found]
    ends = (
        Series("from", np.array([_or_nan(one and one.low) for one in each]), dashed=True),
        Series("to", np.array([_or_nan(one and one.high) for one in each]), dashed=True),
    )
    return Chart(
        NAMES[name], UNITS[name], _x(sound), (Series(symbol_of(name), _values(each)), *ends), X_LABEL, points=True
    )


def _values(each: list[Quantity | None]) -> FloatArray:
    return np.array([_or_nan(one and one.value) for one in each])


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def _validations(sound: list[Sound]) -> Section:
    rows: list[tuple[str, ...]] = []
    heads: tuple[str, ...] = ()
    for one, model in sound:
        of_model = figures(model.validation)
        region = model.region
        tensions = [end for end in (*region.tension_from_n, *region.tension_to_n) if end is not None]
        speeds = spread([region.speed_from_m_per_s, region.speed_to_m_per_s])
        heads = ("Version", *(name.capitalize() for name, _ in of_model), "Speeds seen, m/s", "Tensions seen, N")
        rows.append((str(one.version), *(value for _, value in of_model), speeds, spread(tensions)))
    return Section(
        "Validation",
        ("How each version did on data that it was not made from, and what its own data went through.",),
        (Table("An innovation of 1 is what the model expects of its own errors.", heads, tuple(rows), frozenset({0})),),
    )


def _x(sound: list[Sound]) -> FloatArray:
    return np.array([one.version for one, _ in sound], dtype=np.float64)

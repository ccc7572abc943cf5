"""Models on the terminal: tables that fit 80 columns."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gateway.cli.model_place import Chosen
from gateway.cli.models_compare import NOISE, Compared, compared, figures, seen, verdict
from gateway.core.line_model import LineModel
from gateway.core.line_model_names import UNITS, split_name
from gateway.core.line_model_quantities import Quantity, quantities, symbol_of, typical
from gateway.core.line_problem import printable
from gateway.supervisor.models import Entry

STRONG = ("stiffness_per_length", "radius_per_inertia", "friction_per_inertia")
SHORT = 8  #: letters of a hash


def print_list(entries: Sequence[Entry], path: Path, console: Console) -> None:
    lines = dict.fromkeys((one.site, one.line) for one in entries)
    for site, line in lines:
        console.print(f"{site}/{line}", markup=False)
        console.print(_list([one for one in entries if (one.site, one.line) == (site, line)]))
        console.print()
    for one in entries:
        if one.damage:
            console.print(f"version {one.version} is damaged: {printable(one.damage)}", style="bold red", markup=False)
    console.print(f"repository: {path}", markup=False, soft_wrap=True)


def _list(entries: list[Entry]) -> Table:
    versions = {one.id: one.version for one in entries}
    table = _table("model", "created", "method", *map(_head, STRONG), "data\nprior", "state", gap=0)
    for one in entries:
        model = one.model
        first = f"v{one.version}\n{one.id[:SHORT]}"
        if model is None:
            table.add_row(first, _instant(one.stored_s), "DAMAGED", "", "", "", "", one.state or "-")
            continue
        table.add_row(
            first,
            _when(model),
            printable(model.method),
            *(_cell(typical(model, name), "\n") for name in STRONG),
            f"{model.data.digest[:SHORT]}\n{prior(model, versions)}",
            one.state or "-",
        )
    return table


def prior(model: LineModel, versions: dict[str, int]) -> str:
    """What the model was fitted towards, in a few letters."""
    if model.parent is None:
        return "file"
    return f"v{versions[model.parent]}" if model.parent in versions else model.parent[:SHORT]


def print_model(shown: Chosen, ancestors: Sequence[Entry], console: Console) -> None:
    """Everything that a model says."""
    model, entry = shown.model, shown.entry
    console.print(f"{shown.name} of {model.site}/{model.line}, {shown.id}", markup=False, soft_wrap=True)
    for name, value in _facts(model, entry, ancestors):
        console.print(f"  {name:<10} {printable(value)}", markup=False, soft_wrap=True)
    console.print()
    table = _table("", "value", "from", "to", "±", "unit")
    for name, one in quantities(model).items():
        ends = ["-" if end is None else f"{end:.5g}" for end in (one.low, one.high)]
        table.add_row(symbol_of(name), f"{one.value:.5g}", *ends, _width(one), UNITS[split_name(name)[0]])
    for name, value in model.noise or ():
        words, _, unit = NOISE[name].partition(", ")
        table.add_row(words, f"{value:.3g}", "-", "-", "", unit)
    console.print(table)
    console.print()
    _print_pairs("seen", [seen(model.region)], console)
    _print_pairs("on held-out data", [figures(model.validation)], console)
    for delay in model.alignment:
        text = f"{printable(delay.channel)} was {1e3 * delay.late_s:.2g} ms late"
        console.print(f"{text} ({1e3 * delay.low_s:.2g} to {1e3 * delay.high_s:.2g} ms): taken out", markup=False)


def _facts(model: LineModel, entry: Entry | None, ancestors: Sequence[Entry]) -> list[tuple[str, str]]:
    data, structure = model.data, model.structure
    named = {"per roller": structure.per_roller, "Coulomb friction": structure.coulomb, "lag": structure.torque_lag}
    terms = ", ".join(name for name, there in named.items() if there) or "as in the paper"
    chain = " <- ".join(f"v{one.version}" for one in ancestors)
    facts = [
        ("created", f"{model.created} by r2rgate {model.program_version}"),
        ("method", f"{model.method}; {terms}"),
        ("data", f"{data.digest[:12]}, {data.samples} samples at {1e3 * data.period_s:g} ms: {data.source}"),
        ("prior", "the line's file" if model.parent is None else chain or f"{model.parent[:12]}, which is not here"),
    ]
    if entry is not None:
        facts.append(("stored", _instant(entry.stored_s).replace("\n", " ") + " UTC"))
        for mark in entry.marks:
            facts.append((mark.state, f"{_instant(mark.time_s)} UTC: {mark.reason}".replace("\n", " ")))
    return facts


def print_comparison(a: Chosen, b: Chosen, console: Console) -> None:
    for letter, one in (("A", a), ("B", b)):
        model = one.model
        text = f"{letter}  {one.name}, {one.id[:12]}, {model.site}/{model.line}, {model.created}, {model.method}"
        console.print(printable(text), markup=False, soft_wrap=True)
    console.print()
    rows = compared(a.model, b.model)
    table = _table("", "A", "B", "B - A", "intervals")
    for row in rows:
        difference = "-" if row.difference_pct is None else f"{row.difference_pct:+.2f} %"
        table.add_row(
            f"{row.symbol}, {row.unit}", _cell(row.a), _cell(row.b), difference, intervals_word(row),
            style="bold" if row.exclusive else "",
        )  # fmt: skip
    for name, words in NOISE.items():
        of_a, of_b = (one.model.noise and float(getattr(one.model.noise, name)) for one in (a, b))
        known = ["-" if one is None else f"{one:.3g}" for one in (of_a, of_b)]
        change = "-" if of_a is None or of_b is None else f"{100.0 * (of_b - of_a) / of_a:+.2f} %"
        table.add_row(words, *known, change, "")
    console.print(table)
    console.print()
    _print_pairs("seen", [seen(one.model.region) for one in (a, b)], console)
    _print_pairs("on held-out data", [figures(one.model.validation) for one in (a, b)], console)
    console.print(verdict(rows), markup=False, soft_wrap=True)


def intervals_word(row: Compared) -> str:
    return "-" if row.exclusive is None else "exclude" if row.exclusive else "overlap"


def _print_pairs(title: str, columns: list[list[tuple[str, str]]], console: Console) -> None:
    """Names, and their values in one column a model."""
    letters = ["A", "B"] if len(columns) > 1 else [""]
    table = _table(title, *letters)
    names = list(dict.fromkeys(name for column in columns for name, _ in column))
    for name in names:
        table.add_row(name, *(dict(column).get(name, "-") for column in columns))
    console.print(table)
    console.print()


def _table(*heads: str, gap: int = 1) -> Table:
    """Columns with `gap` spaces and one more between them."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, gap, 0, 0))
    left = {"model", "method", "unit", "state", "intervals", heads[0]}
    for name in heads:
        words = name == "method"
        table.add_column(
            name, justify="left" if name in left else "right", no_wrap=not words, min_width=10 if words else None
        )
    return table


def _head(name: str) -> str:
    return f"{symbol_of(name)}\n{UNITS[name]}"


def _cell(one: Quantity | None, between: str = " ") -> str:
    if one is None:
        return "-"
    width = _width(one)
    return f"{one.value:.4g}" + (f"{between}±{width}" if width else "")


def _width(one: Quantity) -> str:
    width = one.half_width_pct
    return "" if width is None else f"{width:.2g} %"


def _when(model: LineModel) -> str:
    return datetime.fromisoformat(model.created).strftime("%Y-%m-%d\n%H:%M")


def _instant(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d\n%H:%M")

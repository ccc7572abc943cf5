"""Phase 0 on the terminal: what speaks against the data, the methods, the model, and what to make of it."""

from collections.abc import Mapping

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gateway.cli.identify_result import Found, IdentifyResult, IntervalRow, MethodRow, RecordingRow, ValidationRow
from gateway.core.line_model_names import UNITS
from gateway.core.line_model_quantities import symbol_of
from gateway.core.line_problem import printable

SHOWN = (
    "stiffness_per_length", "radius_per_inertia", "friction_per_inertia", "stiffness_n", "length_m", "radius_m",
    "inertia_kg_m2", "friction_nms_per_rad",
)  # fmt: skip
SHORT_METHODS = {"recursive least squares": "recursive LS"}
SHORT_SYMBOLS = {"coulomb_nm": "c", "torque_lag_s": "lag"}  #: names would be too long for 80 columns
SOME_OFFSET_PERIODS = 0.1  #: an interval that lies wholly beyond this counts; findings name its channel
AS_GOOD = 2.0  #: standard errors behind the best, up to which nothing can be said


def print_refusal(result: IdentifyResult, console: Console) -> None:
    """Every reason, with what would mend it."""
    refusals = [one for row in result.recordings for one in row.findings if one.severity == "refusal"]
    _say(console, f"no model: {len(result.refused)} reason{'' if len(result.refused) == 1 else 's'}", "bold red")
    for one in refusals:
        _say(console, f"- {one.where}: {one.what} [{one.kind}]")
        if one.mend:
            _say(console, f"    mend: {one.mend}")
        if one.kind == "offset":
            _say(console, "    with --align, offsets of tensions and speeds are taken out")
        if one.experiment:
            _say(console, f"    experiment: {one.experiment}")
    if not refusals:
        for reason in result.refused:
            _say(console, f"- {reason}")


def print_result(result: IdentifyResult, found: Found, console: Console) -> None:
    for row in result.recordings:
        for sentence in data_words(row):
            _say(console, sentence)
    console.print()
    _say(console, "Methods, from the first part of the data, judged on the rest", "bold")
    console.print(_methods(found))
    for sentence in method_words(found):
        _say(console, sentence)
    console.print()
    _say(console, "Structures", "bold")
    console.print(_structures(found))
    _say(console, f"chosen: {found.why}")
    for word in found.prior:
        _say(console, f"prior: {word}")
    for caution in found.cautions:
        _say(console, f"caution: {caution}")
    console.print()
    _say(console, "The model, from all data, against the line's file (intervals of 95 %)", "bold")
    console.print(_model(found))
    noise = found.noise
    _say(
        console,
        f"noise: tension {noise.tension_n:.3g} N, speed {noise.speed_m_per_s:.3g} m/s, disturbance "
        f"{noise.acceleration_m_per_s1_5:.3g} m/s^1.5",
    )
    for sentence in (*measured_words(result), *found.words):
        _say(console, sentence)
    console.print()
    _say(console, "On held-out data", "bold")
    console.print(_validation(found.validation))
    for sentence in validation_words(found.validation):
        _say(console, sentence)


def data_words(row: RecordingRow) -> list[str]:
    """What a recording is, what speaks against it, and how its channels lie in time."""
    said = [f"{row.source}: {row.samples} samples at {1e3 * row.period_s:g} ms, {row.controlled} under control"]
    for one in row.findings:
        parts = [
            f"  {one.severity}: {one.where}: {one.what}",
            one.mend,
            one.experiment and f"experiment: {one.experiment}",
        ]
        said.append("; ".join(part for part in parts if part))
    said += [
        f"  taken out: {one.channel} was {1e3 * one.offset_s:+.2f} ms late ({1e3 * (one.low_s or 0.0):.2f} to "
        f"{1e3 * (one.high_s or 0.0):.2f} ms)"
        for one in row.taken_out
    ]
    return [*said, *[f"  {one}" for one in offset_words(row)]]


def measured_words(result: IdentifyResult) -> list[str]:
    known = [
        f"{symbol_of(name)} = {one.value:g} (±{half_width_pct(one):.2g} %)" for name, one in result.measured.items()
    ]
    return [f"known by other means: {', '.join(known)}"] if known else []


def offset_words(row: RecordingRow) -> list[str]:
    known = [one for one in row.offsets if one.low_s is not None and one.high_s is not None and not one.reference]
    if not known:
        return ["time offsets between channels: the data do not say"] if row.offsets else []
    widest_ms = max(500.0 * ((one.high_s or 0.0) - (one.low_s or 0.0)) for one in known)
    some_s = SOME_OFFSET_PERIODS * row.period_s
    far = [one for one in known if max(one.low_s or 0.0, -(one.high_s or 0.0)) > some_s]
    unknown = [one.channel for one in row.offsets if one.low_s is None]
    said = [
        f"time offsets of {len(known)} channels known to ±{widest_ms:.2g} ms or better; surely beyond "
        f"{1e3 * some_s:.2g} ms: {len(far)}"
    ]
    return said + ([f"not known of: {', '.join(unknown)}"] if unknown else [])


def method_words(found: Found) -> list[str]:
    best, *others = found.methods
    said = [
        f"score: error of free runs of 1 s, {found.windows} of them, in standard deviations of the sensors' noise; "
        "behind: the best, in standard errors of the difference; seconds of prediction error: all structures together"
    ]
    if any("[" in name for one in found.methods for name in one.intervals):
        said.append("~: rollers or spans differ; their mean, and the widest interval")
    worse = [one.method for one in others if one.behind is None or one.behind >= AS_GOOD]
    same = [one.method for one in others if one.method not in worse]
    if same:
        said.append(f"{best.method} predicts best; {', '.join(same)} as well, for all these data can say")
    if worse:
        said.append(f"{best.method} predicts best; {', '.join(worse)} worse, beyond chance")
    return said + [f"{method} gave no estimate: {why}" for method, why in found.failed.items()]


def validation_words(one: ValidationRow) -> list[str]:
    """Verdict, findings, recommendations."""
    white = "not tested" if one.portmanteau is None else f"{one.portmanteau:.2f}, white up to 1"
    words = "the model holds" if one.valid else "the model does NOT hold"
    said = [
        f"verdict: {words} on {one.samples} samples that it has not seen; normalised innovation squared "
        f"{one.normalised:.3f} (1 is right), whiteness {white}"
    ]
    said += [f"finding: {finding}" for finding in one.findings]
    return said + [f"recommended: {advice}" for advice in one.recommendations]


def method_rows(methods: list[MethodRow]) -> list[tuple[str, ...]]:
    """A row for each quantity, a cell for each method."""
    rows = [(f"{symbol_of(name)}, {UNITS[name]}", *(summary(one.intervals, name) for one in methods)) for name in SHOWN]
    rows.append(("seconds", *(f"{one.seconds:.2f}" for one in methods)))
    rows.append(("score", *("ran away" if one.score is None else f"{one.score:.3f}" for one in methods)))
    rows.append(("behind", *("-" if one.behind is None else f"{one.behind:.1f}" for one in methods)))
    return rows


def summary(intervals: Mapping[str, IntervalRow], name: str) -> str:
    """Value and half-width; where rollers or spans differ, the mean value and the widest."""
    some = [one for key, one in intervals.items() if key.split("[")[0] == name]
    if not some:
        return "-"
    mark = "~" if len(some) > 1 else ""
    return f"{mark}{np.mean([one.value for one in some]):.4g} ±{max(half_width_pct(one) for one in some):.2g} %"


def half_width_pct(one: IntervalRow) -> float:
    return 50.0 * (one.high - one.low) / abs(one.value) if one.value else 0.0


def _methods(found: Found) -> Table:
    table = _table("", *(SHORT_METHODS.get(one.method, one.method) for one in found.methods))
    for row in method_rows(found.methods):
        table.add_row(*row)
    return table


def structure_rows(found: Found) -> list[tuple[str, ...]]:
    most = max(one.evidence for one in found.structures)
    return [
        (
            one.structure, str(one.parameters), f"{one.evidence - most:.1f}",
            "-" if one.held_out is None else f"{one.held_out:.3f}",
            "-" if one.normalised is None else f"{one.normalised:.3f}",
        )
        for one in found.structures
    ]  # fmt: skip


def _structures(found: Found) -> Table:
    table = _table("structure", "params", "evidence", "held-out", "innov.²")
    for one, row in zip(found.structures, structure_rows(found), strict=True):
        table.add_row(*row, style="bold" if one.chosen else "")
    return table


def _model(found: Found) -> Table:
    table = _table("", "unit", "file", "model", "from", "to", "±", "told")
    for one in found.parameters:
        m, base = one.model, one.name.split("[")[0]
        width = f"{half_width_pct(m):.2g} %"
        values = [f"{value:.4g}" for value in (one.file.value, m.value, m.low, m.high)]
        symbol = SHORT_SYMBOLS.get(base, symbol_of(base)) + one.name.removeprefix(base)
        table.add_row(symbol, UNITS[base], *values, width, one.told)
    return table


def validation_rows(one: ValidationRow) -> list[tuple[str, ...]]:
    return [
        (
            output.name, f"{output.normalised:.2f}", _figure(output.portmanteau, ".2f"), _figure(output.r2, ".4f"),
            _figure(output.r2_free, ".4f"), f"{output.mae:.2g}", _figure(output.mae_free, ".2g"),
        )
        for output in one.outputs
    ]  # fmt: skip


def _validation(one: ValidationRow) -> Table:
    table = _table("", "innovation²", "whiteness", "R²", "R² 1 s", "MAE", "MAE 1 s")
    for row in validation_rows(one):
        table.add_row(*row)
    return table


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def _table(*heads: str) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for head in heads:
        left = head in ("unit", "told", heads[0])
        table.add_column(head, justify="left" if left else "right", no_wrap=True)
    return table


def _say(console: Console, text: str, style: str = "") -> None:
    console.print(printable(text), markup=False, soft_wrap=True, style=style)

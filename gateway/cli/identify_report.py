"""Phase 0 as a page: the verdict, the model against the line's file, held-out data, innovations, structures."""

from dataclasses import dataclass

import numpy as np

from gateway.cli.identify_outcome import Data
from gateway.cli.identify_result import Found, IdentifyResult, ParameterRow
from gateway.cli.identify_table import (
    SHORT_METHODS,
    data_words,
    half_width_pct,
    measured_words,
    method_rows,
    method_words,
    structure_rows,
    validation_rows,
    validation_words,
)
from gateway.cli.report.page import Chart, Page, Section, Series, Table
from gateway.control.prediction import Predicted, free_run, predict
from gateway.core.line_model_names import UNITS
from gateway.core.line_model_quantities import symbol_of
from gateway.core.signals import FloatArray
from gateway.core.theta import Theta
from gateway.identification.identify import Identified, parts
from gateway.identification.prediction_error import stretches_of
from gateway.identification.validation import FREE_RUN_S, Output

SPANS = 3  #: that are drawn
LONGEST_S = 4.0  #: of held-out data that is drawn
BINS, REACH = 40, 4.0  #: of the histogram, in standard deviations
LAGS = 30


@dataclass(frozen=True)
class HeldOut:
    """Predictions of data that the chosen structure, from the part before, has not seen."""

    theta: Theta
    predicted: list[Predicted]

    @property
    def names(self) -> list[str]:
        """Of outputs: "tension 1"."""
        return list(self.predicted[0].stretch.names)


def held_out(data: Data, found: Identified) -> HeldOut:
    """As the validation has seen them."""
    fitted = found.choice.fitted
    theta = fitted.estimate.theta
    stretches = stretches_of(parts(data.recordings)[1], fitted.stretches[0].unwinder)
    return HeldOut(theta, [predict(theta, fitted.noise, stretch) for stretch in stretches])


def page_of(result: IdentifyResult, data: Data, found: Identified) -> Page:
    """`render_page` makes the page of it. `result` has a model."""
    assert result.found is not None
    told, held = result.found, held_out(data, found)
    return Page(
        title="Identified model",
        origin=f"Line {result.line}",
        when=result.date,
        command=result.command,
        versions=result.versions,
        machine=result.machine,
        answer=(_verdict(told), *(f"{sentence[0].upper()}{sentence[1:]}." for sentence in told.words)),
        sections=(
            _model(result, told),
            _courses(held, found),
            _innovations(told, held, found),
            _structures(told),
            _methods(told),
            _data(result),
        ),
        notes=(
            "The end of every stretch of data, three tenths of it, was held out: structure and methods were judged on "
            "it, and the model was then made from all data with the structure that had been chosen.",
            "Intervals are of 95 %. They cover what the data leave open, not what the model's structure leaves out; "
            "that shows in the innovations.",
            "The normalised innovation squared is the error of predicting one sample ahead, over the variance that "
            "the model expects: 1 is right, above is a model that is surer than it should be.",
        ),
    )


def _verdict(told: Found) -> str:
    """The first sentence that a reader sees."""
    one = told.validation
    chosen = next(structure for structure in told.structures if structure.chosen)
    holds = "holds" if one.valid else "does not hold"
    text = (
        f"The model ({chosen.structure}) {holds} on {one.samples} samples that it has not seen: normalised innovation "
        f"squared {one.normalised:.3f}."
    )
    return " ".join([text, *(f"{finding[0].upper()}{finding[1:]}." for finding in one.findings)])


def _model(result: IdentifyResult, told: Found) -> Section:
    heads = ("Quantity", "Line's file", "± file, %", "Model", "From", "To", "± model, %", "Told by the data")
    rows = tuple(_row(one) for one in told.parameters)
    noise = told.noise
    said = (
        f"Noise: tension {noise.tension_n:.3g} N, speed {noise.speed_m_per_s:.3g} m/s, disturbance of the rollers "
        f"{noise.acceleration_m_per_s1_5:.3g} m/s^1.5.",
        *[f"{text[0].upper()}{text[1:]}." for text in measured_words(result)],
    )
    combined = Table(
        "Independent combinations, the best known first.",
        ("Combination", "Information of the data over that of the prior"),
        tuple((one.combination, f"{one.information:.3g}") for one in told.combinations),
        frozenset({1}),
    )
    main = Table("Every parameter and combination, with its interval of 95 %.", heads, rows, frozenset(range(1, 7)))
    return Section("The model", said, (main, combined))


def _row(one: ParameterRow) -> tuple[str, ...]:
    m = one.model
    return (
        f"{symbol_of(one.name)}, {UNITS[one.name.split('[')[0]]}", f"{one.file.value:.4g}",
        f"{half_width_pct(one.file):.2g}", f"{m.value:.5g}", f"{m.low:.5g}", f"{m.high:.5g}",
        f"{half_width_pct(m):.2g}", one.told,
    )  # fmt: skip


def _courses(held: HeldOut, found: Identified) -> Section:
    """Measured against the model left to itself, of the spans that it tells worst, best, and in between."""
    one = max(held.predicted, key=lambda each: len(each.innovation))
    period_s = one.stretch.recording.period_s
    length = max(round(FREE_RUN_S / period_s), 2)
    end = min(len(one.innovation), max(round(LONGEST_S / period_s), length))
    pieces = [(begin, min(length, end - 1 - begin)) for begin in range(0, end - 1, length)]
    errors = np.vstack([free_run(held.theta, one, begin, count) for begin, count in pieces if count > 0])
    first = one.stretch.first + 2
    measured = one.stretch.measured[first : first + len(errors)]
    time_s = period_s * np.arange(len(errors))
    outputs = found.validation.outputs
    charts = [
        Chart(
            f"{outputs[j].name.capitalize()}, held out", unit, time_s,
            (Series("measured", measured[:, j]), Series("model", measured[:, j] - errors[:, j])),
        )
        for word, unit in (("tension", "N"), ("speed", "m/s"))
        for j in _some([(j, output) for j, output in enumerate(outputs) if output.name.startswith(word)])
    ]  # fmt: skip
    said = (
        f"The model starts from measurements every {FREE_RUN_S:g} s and then sees torques and the unwinder's speed "
        "only. What disturbs the rollers at random it cannot know: errors grow over each run. Shown are the spans and "
        "rollers with the largest, a middle, and the smallest innovations.",
    )
    return Section("Held-out data", said, (), tuple(charts))


def _some(outputs: list[tuple[int, Output]]) -> list[int]:
    """Indices of the worst, a middle and the best, in their own order."""
    ranked = [j for j, _ in sorted(outputs, key=lambda each: -each[1].normalised)]
    chosen = ranked if len(ranked) <= SPANS else [ranked[0], ranked[len(ranked) // 2], ranked[-1]]
    return sorted(chosen)


def _innovations(told: Found, held: HeldOut, found: Identified) -> Section:
    heads = ("Output", "Innovation²", "Whiteness", "R²", "R² after 1 s", "MAE", "MAE after 1 s")
    table = Table(
        "One sample ahead, and left to itself for 1 s.", heads, tuple(validation_rows(told.validation)),
        frozenset(range(1, 7)),
        note="MAE in N and m/s. Whiteness: portmanteau statistic over its quantile, white up to 1.",
    )  # fmt: skip
    sentences = tuple(f"{text[0].upper()}{text[1:]}." for text in validation_words(told.validation))
    return Section("Innovations", sentences, (table,), (_distribution(held), _autocorrelation(held, found)))


def _distribution(held: HeldOut) -> Chart:
    edges = np.linspace(-REACH, REACH, BINS + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    white = np.vstack([one.whitened for one in held.predicted])
    series: list[Series] = []
    for word in ("tension", "speed"):
        columns = [j for j, name in enumerate(held.names) if name.startswith(word)]
        if columns:
            values = np.clip(white[:, columns].ravel(), -REACH, REACH)
            series.append(Series(word, np.histogram(values, edges)[0] / (len(values) * (edges[1] - edges[0]))))
    normal = np.exp(-0.5 * np.square(middle)) / np.sqrt(2.0 * np.pi)
    return Chart(
        "Distribution of whitened innovations", "", middle, (*series, Series("expected", normal, dashed=True)),
        x_label="Standard deviations",
    )  # fmt: skip


def _autocorrelation(held: HeldOut, found: Identified) -> Chart:
    """Of the least white tension and speed, and in the mean of all outputs; with the band of a white sequence."""
    samples = sum(len(one.whitened) for one in held.predicted)
    least = min(len(one.whitened) for one in held.predicted)
    lags = np.arange(1, min(LAGS, least // 2) + 1)
    correlations = np.array([_correlation([one.whitened for one in held.predicted], int(lag)) for lag in lags])
    series = [Series("mean of all", correlations.mean(axis=1))]
    for word in ("tension", "speed"):
        some = [(j, output) for j, output in enumerate(found.validation.outputs) if output.name.startswith(word)]
        if some:
            j, output = max(some, key=lambda each: np.nan_to_num(each[1].portmanteau))
            series.append(Series(output.name, correlations[:, j]))
    band = np.full(len(lags), 1.96 / np.sqrt(samples))
    bounds = [Series("95 % of a white one, from", -band, dashed=True), Series("to", band, dashed=True)]
    return Chart(
        "Autocorrelation of whitened innovations", "", lags.astype(np.float64), (*series, *bounds),
        x_label="Lag, samples",
    )  # fmt: skip


def _correlation(parts_of_white: list[FloatArray], lag: int) -> FloatArray:
    """(m,), of stretches that do not follow one another."""
    products = sum((part[lag:] * part[:-lag]).sum(axis=0) for part in parts_of_white)
    return np.asarray(products / sum(np.square(part).sum(axis=0) for part in parts_of_white), dtype=np.float64)


def _structures(told: Found) -> Section:
    heads = ("Structure", "Parameters", "Log evidence", "Held-out likelihood", "Innovation²")
    table = Table(
        "The most evidence first; evidence as a difference to the best.", heads, tuple(structure_rows(told)),
        frozenset(range(1, 5)),
        note="Held-out likelihood: its logarithm per sample. Innovation²: normalised, 1 is right.",
    )  # fmt: skip
    cautions = tuple(f"Caution: {caution}." for caution in told.cautions)
    prior = tuple(f"Prior: {word}." for word in told.prior)
    return Section("Structures", (f"Chosen: {told.why}.", *prior, *cautions), (table,))


def _methods(told: Found) -> Section:
    names = tuple(SHORT_METHODS.get(one.method, one.method) for one in told.methods)
    rows = tuple(method_rows(told.methods))
    table = Table("The best first.", ("Quantity", *names), rows, frozenset(range(1, len(names) + 1)))
    return Section("Methods", tuple(f"{text[0].upper()}{text[1:]}." for text in method_words(told)), (table,))


def _data(result: IdentifyResult) -> Section:
    said = tuple(sentence.strip() for row in result.recordings for sentence in data_words(row))
    rows = tuple(
        (
            one.channel, f"{1e3 * one.offset_s:.2f}", "-" if one.low_s is None else f"{1e3 * one.low_s:.2f}",
            "-" if one.high_s is None else f"{1e3 * one.high_s:.2f}", "reference" if one.reference else "",
        )
        for row in result.recordings for one in row.offsets
    )  # fmt: skip
    table = Table("Time offsets of channels.", ("Channel", "Late, ms", "From", "To", ""), rows, frozenset({1, 2, 3}))
    return Section("Data", said, (table,) if rows else ())

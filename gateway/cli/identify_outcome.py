"""From what was given and what was identified to the result that is printed, kept and shown."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import exp, isfinite
from typing import Literal

from gateway.cli.identify_result import (
    CombinationRow,
    ErrorsRow,
    FindingRow,
    Found,
    IdentifyResult,
    IntervalRow,
    MethodRow,
    NoiseRow,
    OffsetRow,
    OutputRow,
    ParameterRow,
    RecordingRow,
    StructureRow,
    Told,
    ValidationRow,
)
from gateway.cli.origin import command_line, machine, now_iso, versions_of
from gateway.core.line import Line
from gateway.core.line_model import ChannelDelay
from gateway.core.recording import Recording
from gateway.identification.comparison import Errors, Row
from gateway.identification.estimate import Interval, Structure
from gateway.identification.findings import Assessment, Finding
from gateway.identification.identifiability import Identifiability, identifiability, symbol
from gateway.identification.identify import Identified
from gateway.identification.inheritance import Inherited
from gateway.identification.prediction_error import Z95, Fit
from gateway.identification.prior import prior_of
from gateway.identification.structure_choice import ENOUGH, Candidate, Choice
from gateway.identification.validation import Validation

LIBRARIES = ("r2rgate", "numpy", "scipy", "numba")


@dataclass(frozen=True)
class Data:
    """What was given."""

    line: Line
    recordings: Sequence[Recording]
    measured: dict[str, tuple[float, float]]  #: name: (value, tolerance)
    delays: Sequence[Sequence[ChannelDelay]] = ()  #: taken out of each recording; nothing given: of none


def result_of(
    data: Data,
    assessments: Sequence[Assessment],
    refused: Sequence[str],
    found: Identified | None,
    inherited: Inherited | None = None,
) -> IdentifyResult:
    """`assessments` may be fewer than recordings, where no data were looked at."""
    measured = {name: (value, value * (1.0 - t), value * (1.0 + t)) for name, (value, t) in data.measured.items()}
    return IdentifyResult(
        command=command_line(),
        date=now_iso(),
        versions=versions_of(LIBRARIES),
        machine=machine(),
        line=f"{data.line.site}/{data.line.line}",
        measured={name: IntervalRow(value=v, low=low, high=high) for name, (v, low, high) in measured.items()},
        recordings=[
            _recording(one, said, data.delays[k] if data.delays else ())
            for k, (one, said) in enumerate(zip(data.recordings, assessments, strict=False))
        ],
        refused=list(refused),
        found=None if found is None else _found(data.line, found, inherited),
    )


def _recording(recording: Recording, said: Assessment, delays: Sequence[ChannelDelay]) -> RecordingRow:
    return RecordingRow(
        source=recording.source,
        digest=recording.digest(),
        samples=recording.samples,
        controlled=int(recording.controlled.sum()),
        period_s=recording.period_s,
        findings=[_finding(one) for one in said.findings],
        offsets=[
            OffsetRow(
                channel=one.channel, offset_s=one.offset_s, low_s=_finite(one.low_s), high_s=_finite(one.high_s),
                reference=one.reference,
            )
            for one in said.alignments
        ],
        taken_out=[
            OffsetRow(channel=one.channel, offset_s=one.late_s, low_s=one.low_s, high_s=one.high_s, reference=False)
            for one in delays
        ],
        foreseen={name: _finite(value) for name, value in said.predicted.items()},
    )  # fmt: skip


def _finding(one: Finding) -> FindingRow:
    severity: dict[int, Literal["note", "warning", "refusal"]] = {0: "note", 1: "warning", 2: "refusal"}
    return FindingRow(
        kind=one.kind, severity=severity[int(one.severity)], where=one.where, what=one.what, value=_finite(one.value),
        limit=_finite(one.limit), mend=one.mend, experiment=one.experiment,
    )  # fmt: skip


def _found(line: Line, found: Identified, inherited: Inherited | None) -> Found:
    known, fitted = identifiability(found.fitted), found.fitted
    return Found(
        parameters=_parameters(line, found, known),
        noise=NoiseRow(**asdict(fitted.noise)),
        structures=[_structure(one, found.choice) for one in found.choice.candidates],
        why=why(found.choice),
        cautions=found.choice.cautions,
        prior=[] if inherited is None else inherited.words,
        parent=None if inherited is None else inherited.parent,
        methods=[_method(row) for row in found.comparison.rows],
        windows=found.comparison.windows,
        failed=found.failed,
        words=[*out_of_round(fitted), *known.words],
        combinations=[
            CombinationRow(combination=str(one), information=float(one.information)) for one in known.directions
        ],
        remedies=known.remedies,
        validation=_validation(found.validation),
    )


def _parameters(line: Line, found: Identified, known: Identifiability) -> list[ParameterRow]:
    of_file = prior_of(line, found.choice.chosen.structure)
    told: dict[str, Told] = {one.name: one.told for one in known.known}
    rows: list[ParameterRow] = []
    for name, row in of_file.parameters.maps.items():
        middle, deviation = float(row @ of_file.mean), float(row @ of_file.covariance @ row) ** 0.5
        ends = [exp(middle + Z95 * side * deviation) for side in (-1.0, 0.0, 1.0)]
        rows.append(
            ParameterRow(
                name=name, symbol=symbol(name), file=IntervalRow(value=ends[1], low=ends[0], high=ends[2]),
                model=_interval(found.fitted.interval(name)), told=told[name],
            )
        )  # fmt: skip
    return rows


def out_of_round(fitted: Fit) -> list[str]:
    """Which rollers are, and by how much, as a sentence; none where all are round."""
    told: list[str] = []
    for roller in fitted.parameters.structure.eccentric:
        found = fitted.eccentricity(roller)
        told.append(f"{roller} by {found.value:.2%} of its radius ({found.low:.2%} to {found.high:.2%})")
    return [f"out of round: roller {', roller '.join(told)}"] if told else []


def why(choice: Choice) -> str:
    """This structure was chosen, in a sentence."""
    best, chosen = choice.candidates[0], choice.chosen
    others = [one for one in choice.candidates if one is not chosen]
    name = _name(chosen.structure)
    if not others:
        return f"{name}: no other structure was tried"
    if choice.turned is not None:
        before, ahead = choice.turned
        if ahead < 0.0:
            return (
                f"{name}: a part of the data does not tell it from {_name(before.structure)}, which all of them leave "
                f"behind by {-ahead:.1f} in log evidence"
            )
        return (
            f"{name}: a part of the data prefers {_name(before.structure)}, to which all of them give only "
            f"{ahead:.1f} more log evidence; {ENOUGH:g} (20 to 1) would be needed for more parameters"
        )
    if chosen is not best:
        return (
            f"{name}: {_name(best.structure)} has more log evidence, but only by "
            f"{best.evidence - chosen.evidence:.1f}; {ENOUGH:g} (20 to 1) would be needed for more parameters"
        )
    ahead = chosen.evidence - others[0].evidence
    return f"{name}: the most evidence; {_name(others[0].structure)} is next, its log evidence {ahead:.1f} less"


def _name(structure: Structure) -> str:
    return f"'{structure}'"


def _structure(one: Candidate, choice: Choice) -> StructureRow:
    return StructureRow(
        structure=str(one.structure), parameters=one.fitted.parameters.size, evidence=one.evidence,
        held_out=one.held_out, normalised=one.normalised, chosen=one is choice.chosen,
    )  # fmt: skip


def _method(row: Row) -> MethodRow:
    return MethodRow(
        method=row.estimate.method, structure=str(row.estimate.structure), seconds=row.seconds,
        score=_finite(row.score), behind=_finite(row.behind), free_run=_errors(row.free_run),
        one_step=_errors(row.one_step),
        intervals={name: _interval(interval) for name, interval in row.estimate.intervals.items()},
    )  # fmt: skip


def _validation(one: Validation) -> ValidationRow:
    return ValidationRow(
        valid=one.valid, samples=one.samples, normalised=one.normalised, portmanteau=_finite(one.portmanteau),
        outputs=[
            OutputRow(
                name=output.name, normalised=output.normalised, portmanteau=_finite(output.portmanteau),
                r2=_finite(output.r2), r2_free=_finite(output.r2_free), mae=output.mae,
                mae_free=_finite(output.mae_free),
            )
            for output in one.outputs
        ],
        findings=one.findings, recommendations=one.recommendations,
    )  # fmt: skip


def _errors(errors: Errors) -> ErrorsRow:
    return ErrorsRow(tension=_finite(errors.tension), speed=_finite(errors.speed))


def _interval(one: Interval) -> IntervalRow:
    return IntervalRow(value=one.value, low=one.low, high=one.high)


def _finite(value: float) -> float | None:
    return float(value) if isfinite(value) else None

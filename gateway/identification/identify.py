"""Phase 0 whole: data are assessed, each method estimates from their greater part, the rest judges, all make the model.

What is offered is the prediction-error estimate of the structure that the data call for, made from all of them. How it
does on data that it has not seen is told of the same structure, made from the part before.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from gateway.control.prediction import Unpredictable
from gateway.core.line import Line
from gateway.core.recording import Recording, joined
from gateway.core.theta import Noise
from gateway.identification.assessment import assess
from gateway.identification.comparison import WINDOW_S, Comparison, compare
from gateway.identification.estimate import Estimate, Structure
from gateway.identification.findings import EXCITATION, Assessment, Finding, Severity, gravest_first
from gateway.identification.prediction_error import LEAST_S, Fit, stretches_of
from gateway.identification.prior import Prior
from gateway.identification.recursive import estimated_recursively, live
from gateway.identification.structure_choice import Choice, choose, decided
from gateway.identification.subspace import estimated_by_subspace
from gateway.identification.validation import Validation, validate

HELD_OUT = 0.3  #: of each stretch, its end
LEAST_HELD_OUT_S = WINDOW_S + 0.2  #: a window of the comparison, and what comes before it


class NotIdentified(Exception):
    """No model is made from these data. `reasons` has everything that speaks against it."""

    def __init__(self, reasons: Sequence[str], assessments: Sequence[Assessment] = ()) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = list(reasons)
        self.assessments = list(assessments)


@dataclass(frozen=True)
class Identified:
    assessments: list[Assessment]  #: of each recording
    choice: Choice  #: of the structure: candidates from the part before, decided by all data
    comparison: Comparison  #: of the methods, on the held-out part
    validation: Validation  #: of the chosen structure, on the held-out part
    failed: dict[str, str]  #: methods that gave no estimate, and why
    fitted: Fit  #: what is offered: from all data

    @property
    def estimate(self) -> Estimate:
        return self.fitted.estimate

    @property
    def warnings(self) -> list[Finding]:
        return [finding for assessment in self.assessments for finding in assessment.findings]


def identify(
    recordings: Sequence[Recording],
    line: Line,
    noise0: Noise,
    clock: Callable[[], float],
    *,
    measured: Mapping[str, tuple[float, float]] | None = None,
    tell: Callable[[str], None] = lambda text: None,
    priors: Callable[[Structure], Prior] | None = None,
) -> Identified:
    """`clock` in s, for what each method takes; `measured`: {name: (value, tolerance)} known by other means.

    `priors`: of a structure; without them the line's file speaks.

    Raises NotIdentified.
    """
    tell("assessing the data")
    assessments = _together([assess(recording, line) for recording in recordings])
    refusals = [str(finding) for assessment in assessments for finding in assessment.refusals]
    if refusals:
        raise NotIdentified(refusals, assessments)
    before, held_out = parts(recordings)
    if not held_out:
        raise NotIdentified([_too_short(recordings)], assessments)
    estimates: list[tuple[Estimate, float]] = []
    failed: dict[str, str] = {}
    try:
        tell("prediction error, structure by structure")
        began_s = clock()
        choice = choose(before, line, noise0, held_out, measured=dict(measured or {}), priors=priors)
        took_s = clock() - began_s
        tell("the model from all data")
        unwinder = choice.fitted.stretches[0].unwinder
        held = stretches_of(held_out, unwinder)
        choice, fitted = decided(choice, stretches_of(recordings, unwinder), held)
        estimates.append((choice.fitted.estimate, took_s))
        for name, method in _others(line, choice).items():
            tell(name)
            began_s = clock()
            try:
                estimates.append((method(before), clock() - began_s))
            except ValueError as error:
                failed[name] = str(error)
        tell("validating")
        validation = validate(choice.fitted.estimate.theta, choice.fitted.noise, held, noise0)
    except Unpredictable as error:
        raise NotIdentified([str(error)], assessments) from error
    comparison = compare(estimates, held_out, choice.fitted.noise)
    return Identified(assessments, choice, comparison, validation, failed, fitted)


def parts(recordings: Sequence[Recording]) -> tuple[list[Recording], list[Recording]]:
    """What estimates are made from, and what judges them: of every stretch its begin and its end."""
    before: list[Recording] = []
    after: list[Recording] = []
    for recording in recordings:
        held = round(LEAST_HELD_OUT_S / recording.period_s)
        for stretch in recording.stretches(round(LEAST_S / recording.period_s)):
            cut = round((1.0 - HELD_OUT) * stretch.samples)
            if stretch.samples - cut >= held:
                before.append(stretch.part(0, cut))
                after.append(stretch.part(cut, stretch.samples))
            else:
                before.append(stretch)
    return before, after


def _together(assessments: Sequence[Assessment]) -> list[Assessment]:
    """Beside a recording that tells enough, one that moves too little to tell by itself is no reason to refuse."""
    if all(EXCITATION in one.kinds() for one in assessments):
        return list(assessments)

    def beside(one: Finding) -> Finding:
        too_little = one.kind == EXCITATION and one.severity is Severity.REFUSAL
        what = f"{one.what}; another recording tells enough"
        return replace(one, severity=Severity.WARNING, what=what, experiment="") if too_little else one

    return [replace(one, findings=gravest_first(map(beside, one.findings))) for one in assessments]


def _others(line: Line, choice: Choice) -> dict[str, Callable[[Sequence[Recording]], Estimate]]:
    """The methods beside prediction error. Each takes one recording; several are one with gaps."""
    noise, structure = choice.fitted.noise, replace(choice.fitted.parameters.structure, torque_lag=False, eccentric=())
    return {
        "recursive least squares": lambda before: estimated_recursively(live(line, noise), joined(before), structure),
        "subspace": lambda before: estimated_by_subspace(line, joined(before)),
    }


def _too_short(recordings: Sequence[Recording]) -> str:
    sources = ", ".join(recording.source for recording in recordings)
    return (
        f"{sources}: no stretch is long enough to hold {HELD_OUT:.0%} of it back; record at least "
        f"{LEAST_HELD_OUT_S / HELD_OUT:g} s in a row under control, better 5 s at each of two speeds"
    )

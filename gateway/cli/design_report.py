"""Phase 1 as a page: the choice first, then the comparison, the courses, and every attempt with its reason."""

from collections.abc import Mapping, Sequence

import numpy as np

from gateway.cli.design_phase import Design
from gateway.cli.design_result import DesignResult, TuningResult
from gateway.cli.design_table import cells
from gateway.cli.design_tuning import Finished
from gateway.cli.report.page import Chart, Page, Section, Series, Table
from gateway.commissioning.architectures import ARCHITECTURES
from gateway.commissioning.decisions import RULES
from gateway.commissioning.records import Attempt, DecisionRecord
from gateway.commissioning.selection import TERMS
from gateway.core.finding import finding
from gateway.core.line import Priorities
from gateway.core.line_problem import quoted
from gateway.core.scenario import Scenario
from gateway.core.signals import FloatArray
from gateway.wording.catalogue import sentence

BEFORE_S, AFTER_S = 0.5, 2.5  #: of the change, that the charts show

HEADS = (
    "Law", "RMSE, N", "t_s, s", "Overshoot, %", "Effort, (Nm)² s", "R, N", "Step, µs", "Delay margin, ms",
    "S", "Gate",
)  # fmt: skip


def page_of(result: DesignResult, found: Design) -> Page:
    """`render_page` makes the page of it."""
    model, within = "nominal model", "the tolerances in the line's file"
    if result.model:
        model, within = f"identified model {result.model[:12]}", "its intervals, at least 2.5 % either way"
    return Page(
        title=f"Controller design: {result.chosen or 'none offered'}",
        origin=f"Line {result.line}",
        when=result.date,
        command=result.command,
        versions=result.versions,
        machine=result.machine,
        answer=tuple(result.explanation),
        sections=(
            Section("The line", tuple(result.assessment.sentences)),
            _decisions(result),
            _comparison(result),
            *(_courses(scenario, found) for scenario in result.scenarios),
            _tuning(result),
            *(_attempts(one) for one in result.tuning),
        ),
        notes=(
            *([f"Unconfirmed: {sentence(finding('design-unconfirmed'))}."] if result.chosen else []),
            f"Candidates run on the {model} and on {result.plants} lines drawn evenly from {within} (MPC is tuned on "
            "fewer of them), with noise, torque limits and latency. RMSE, settling time, overshoot and effort are "
            f"those of the {model}; R is how far any of the other lines is from it at any time.",
            "J is the integral of the squared tension error and of the squared torque times 1e-5, summed over the "
            "scenarios, in the mean over all these lines. Tuning lowers J; the choice among architectures is by S.",
        ),
    )


def _comparison(result: DesignResult) -> Section:
    rows = tuple((ARCHITECTURES[one.architecture].title, *cells(one)[1:]) for one in result.candidates)
    scored = [one for one in result.candidates if one.score is not None]
    parts = tuple((one.architecture, *(f"{part:.3f}" for part in one.terms), f"{one.score:.3f}") for one in scored)
    title = f"Each architecture at its best, the least score first. Chosen: {result.chosen or 'none'}."
    return Section(
        "Comparison",
        (),
        (
            Table(title, HEADS, rows, frozenset(range(1, len(HEADS)))),
            Table(
                "What the scores are made of: each metric times its weight.",
                ("Law", *(term.capitalize() for term in TERMS), "S"),
                parts,
                frozenset(range(1, len(TERMS) + 2)),
                note=f"Weights: {_weights(result.priorities)}.",
            ),
            *_other_scores(result),
        ),
    )


def _other_scores(result: DesignResult) -> tuple[Table, ...]:
    """S by the weights of the line's file beside S by those that somebody has proposed."""
    other = result.priorities_otherwise
    if other is None:
        return ()
    rows = tuple(
        (one.architecture, f"{one.score:.3f}", f"{one.score_otherwise:.3f}")
        for one in result.candidates
        if one.score is not None and one.score_otherwise is not None
    )
    return (
        Table(
            "The scores by other weights, which were proposed. The rules go by those of the line's file.",
            ("Law", "S, line's file", "S, proposed"),
            rows,
            frozenset({1, 2}),
            note=f"Proposed: {_weights(other)}.",
        ),
    )


def _weights(priorities: Priorities) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in priorities.model_dump().items())


def _decisions(result: DesignResult) -> Section:
    """What was left to judgement; who has decided, and what the rules would have."""
    rows = tuple(
        (
            one.task,
            one.option + "".join(f", {name} times {factor:g}" for name, factor in one.factors.items()),
            one.by,
            one.why if one.by == RULES else quoted(one.reason),
            f"asked, {one.instead}" if one.instead else "the same" if _as_usual(one) else f"{one.usual}: {one.why}",
        )
        for one in result.decisions
    )
    heads = ("Question", "Decided", "By", "Reason", "The rules")
    return Section("Decisions", (), (Table("What was left to judgement.", heads, rows, frozenset()),))


def _as_usual(one: DecisionRecord) -> bool:
    return one.option == one.usual and not one.factors


def _courses(scenario: Scenario, found: Design) -> Section:
    """Tension and torque of the span that is moved most, every law under the same noise."""
    with_traces = [one for one in found.finished if scenario.name in one.traces]
    span = _moved_most(scenario, with_traces)
    number = span + 1
    charts: list[Chart] = []
    if with_traces:
        first = with_traces[0].traces[scenario.name]
        around = np.abs(first.time_s - scenario.change_at_s - 0.5 * (AFTER_S - BEFORE_S)) <= 0.5 * (AFTER_S + BEFORE_S)
        tensions = [Series(one.architecture, one.traces[scenario.name].tension_n[around, span]) for one in with_traces]
        torques = [Series(one.architecture, one.traces[scenario.name].torque_nm[around, span]) for one in with_traces]
        setpoint = Series("set-point", first.setpoint_n[around, span], dashed=True)
        charts.append(Chart(f"Tension of span {number}", "N", first.time_s[around], (*tensions, setpoint)))
        charts.append(Chart(f"Torque of roller {number}", "Nm", first.time_s[around], tuple(torques)))
    return Section(scenario.heading, (scenario.description,) if scenario.description else (), (), tuple(charts))


def _moved_most(scenario: Scenario, finished: list[Finished]) -> int:
    """The span with the greatest step; where none steps, the one that strays furthest."""
    steps = np.abs(np.subtract(scenario.tension_end_n, scenario.tension_n))
    if steps.any() or not finished:
        return int(np.argmax(steps))
    strayed = [
        np.abs(one.traces[scenario.name].tension_n - one.traces[scenario.name].setpoint_n).max(axis=0)
        for one in finished
    ]
    return int(np.argmax(np.max(strayed, axis=0)))


def _tuning(result: DesignResult) -> Section:
    said = tuple(
        f"{one.architecture}: {len(one.history)} attempts, "
        + ("until nothing better was to be expected." if one.converged else "as many as allowed.")
        for one in result.tuning
    )
    most = max(len(one.history) for one in result.tuning)
    if most < 2:
        return Section("Tuning", said)
    series = tuple(Series(one.architecture, _best_so_far(one, most)) for one in result.tuning)
    number = np.arange(most, dtype=np.float64)
    chart = Chart("Cost of the best so far", "N² s", number, series, x_label="Attempt", log_y=True)
    return Section("Tuning", said, (), (chart,))


def _best_so_far(one: TuningResult, most: int) -> FloatArray:
    costs = np.full(most, np.nan)
    best = np.nan
    for attempt in one.history:
        if attempt.accepted and attempt.cost_n2s is not None:
            best = attempt.cost_n2s
        costs[attempt.number] = best
    costs[len(one.history) :] = best
    return costs


def _attempts(one: TuningResult) -> Section:
    knobs = [knob.name for knob in ARCHITECTURES[one.architecture].knobs]
    asked = any(attempt.by != RULES or attempt.instead for attempt in one.history)
    rows = tuple(
        (
            str(attempt.number),
            *_values(attempt.values, knobs),
            "-" if attempt.trial is None or attempt.trial.cost_n2s is None else f"{attempt.trial.cost_n2s:.2f}",
            "accepted" if attempt.accepted else attempt.refused or "not better",
            attempt.reason if attempt.by == RULES else quoted(attempt.reason),
            *((attempt.by, _rules_instead(attempt, knobs)) if asked else ()),
        )
        for attempt in one.history
    )
    numeric = frozenset(range(len(knobs) + 2))
    heads = ("No.", *knobs, "J, N² s", "Verdict", "Reason", *(("By", "The rules") if asked else ()))
    return Section(f"Attempts: {one.architecture}", _ended(one), (Table("Every attempt.", heads, rows, numeric),))


def _values(values: Mapping[str, float], knobs: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{values[name]:g}" if name in values else "-" for name in knobs)


def _rules_instead(attempt: Attempt, knobs: Sequence[str]) -> str:
    """What the rules would have tried, or why they have suggested it."""
    if attempt.usual is None:
        return f"asked, {attempt.instead}" if attempt.instead else ""
    if attempt.usual.values == attempt.values:
        return "the same"
    if not attempt.usual.values:
        return f"an end: {attempt.usual.reason}"
    return f"{', '.join(_values(attempt.usual.values, knobs))}: {attempt.usual.reason}"


def _ended(one: TuningResult) -> tuple[str, ...]:
    """Who has ended it, where that was not the rules."""
    if one.stopped is None:
        return ()
    return (f"Ended by {one.stopped.by}: {quoted(one.stopped.reason)} The rules: {one.stopped.usual.reason}.",)

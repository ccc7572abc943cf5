"""The whole demonstration as a page: what it came to beside the paper, the cases, the gate, the line in one view."""

import os
from collections.abc import Sequence

import numpy as np

from gateway.cli.audit_against import head_in
from gateway.cli.demo_adaptations import adaptations_section, selection_section
from gateway.cli.demo_analysis import CaseTrace, Evidence, trace_of
from gateway.cli.demo_asked_page import asked_section, in_short
from gateway.cli.demo_cases import Window
from gateway.cli.demo_line import STATED, Setup
from gateway.cli.demo_result import PAPER_RMSE_N, ChainResult, ChangeResult, DemoResult, paper_improvement_pct
from gateway.cli.demo_stepped import SEEDS
from gateway.cli.line_records import read_records, unconfirmed_in, verdicts_in
from gateway.cli.report import Chart, Page, Section, Series, Table, render_page
from gateway.core.controller import config_hash
from gateway.core.interactions import Interaction
from gateway.core.scenario import PAPER, Scenario

PLOT_EVERY = 10  #: milliseconds between the samples of a chart
WHOLE_EVERY = 200  #: the same where the whole run is shown
NONE = "-"


def page(
    setup: Setup,
    result: DemoResult,
    windows: list[Window],
    evidence: Evidence,
    interactions: Sequence[Interaction],
) -> str:
    """`report.html`."""
    chain = result.chain
    assert chain is not None
    traces = [trace_of(window, evidence) for window in windows]
    sections = [
        _beside_the_paper(result),
        selection_section(chain),
        adaptations_section(result, chain, verdicts_in(setup.gateway_data)),
    ]
    sections += [_against_stepped(result)]
    sections += [_case(case, result, [one for one in traces if one.window.case == case], evidence) for case in PAPER]
    sections += [
        asked_section(chain.asked, chain.changes, interactions, setup.data),
        _through_the_gate(chain),
        _whole_run(evidence),
        _safety(result, chain),
        _timing(result),
    ]
    return render_page(
        Page(
            title="r2rgate demonstration",
            origin=f"Line {setup.line.site}/{setup.line.line}, plant {evidence.summary['plant']}",
            when=result.date,
            audit_head=head_in(setup.gateway_data),
            command=result.command,
            versions=result.versions,
            machine=f"{os.cpu_count() or 1} processors. {'. '.join(result.machine)}",
            answer=tuple(answer(result, chain)),
            sections=tuple(sections),
            notes=(
                "Both cases are literal steps, as in the paper; each begins settled at its set-points.",
                "Tensions, torques and unsafe events are those of the recorder inside the simulated line, which shares "
                "nothing with the gateway. The gateway had the noisy signals of drives and load cells alone.",
                "The gateway's file of the line is wrong on purpose: stiffness, radius, inertia, friction and length "
                "differ from the simulated line's by 5 to 33 %.",
                *(
                    f"The line's file says {said.strip()}, not {default.strip('# ')}: {why}."
                    for default, said, why in STATED
                ),
                "The first configuration is simulated on corners of the line's file that do not reach as far as the "
                "true line lies: with the file's own defaults it would run no faster than 0.02 m/s until there is a "
                "model. Here nobody can be hurt.",
                *unconfirmed_in(read_records(setup.gateway_data).book),
                *(f"Not run: {one}." for one in chain.left_out),
                *(f"Begun anew after the line had stopped: {stop}" for stop in result.stops),
            ),
        )
    )


def answer(result: DemoResult, chain: ChainResult) -> list[str]:
    """The sentences that a reader sees first."""
    unsafe = sum(result.unsafe_events.values())
    safety = f"{unsafe} unsafe events at the drives." if unsafe else "No unsafe event at the drives."
    first, last = result.configurations[0], result.configurations[-1]
    came: list[str] = []
    for case in PAPER:
        before, now = result.rmse_n(0, case.name), result.rmse_n(len(result.configurations) - 1, case.name)
        if before is not None and now is not None and first is not last:
            came.append(
                f"{case.heading.lower()} from {before:.2f} to {now:.2f} N ({_signed(100.0 * (now / before - 1.0))})"
            )
    tried, let_through = len(chain.changes), sum(bool(one.approved_by) for one in chain.changes)
    return [
        f"{safety} {', '.join(one.name for one in result.configurations)} came to the running line through the gate"
        f"{': ' + ', '.join(came) if came else ''}.",
        f"The chain {'reached its aim' if chain.reached else 'ended before its aim'}: {chain.text}. "
        f"{tried} candidates, {let_through} let through and approved, {chain.deployments} deployments. "
        f"{_sentence(in_short(chain.asked))}.",
    ]


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}"


def _signed(percent: float) -> str:
    return f"{percent:+.1f} %".replace("-", "−")


def _share(value: float | None) -> str:
    """An improvement: less is better, so it is a minus."""
    return NONE if value is None else _signed(-value)


def _beside_the_paper(result: DemoResult) -> Section:
    rows: list[tuple[str, ...]] = []
    for k, one in enumerate(result.configurations):
        row = [f"{one.name} ({one.law.upper()})"]
        for case in PAPER:
            own, paper = result.rmse_n(k, case.name), PAPER_RMSE_N.get(one.name, {}).get(case.name)
            row += [
                "not run" if own is None else f"{own:.4f}",
                _share(result.improvement_pct(k, case.name)),
                NONE if paper is None else f"{paper:.4f}",
                _share(paper_improvement_pct(one.name, case.name)),
            ]
        rows.append(tuple(row))
    heads = ["Configuration"]
    foot = ["MPC designed on the true line, stepped time"]
    for case in PAPER:
        name = case.name.capitalize()
        heads += [f"{name}, RMSE, N", "change", "paper's RMSE, N", "paper's change"]
        foot += [f"{result.truth_rmse_n[case.name]:.4f}", NONE, NONE, NONE]
    table = Table(
        "RMSE: root of the time mean of the squared 2-norm of the tension error over all spans. Change: against the "
        "configuration in the row before.",
        tuple(heads), tuple(rows), frozenset(range(1, len(heads))), tuple(foot),
        "The paper does not state noise, limits, period and integration step. Within the limits of these drives no "
        "controller comes near its numbers with a literal step (make bench-control): compare the changes.",
    )  # fmt: skip
    return Section("Initial, Adapt1, Adapt2 beside the paper", tables=(table,))


def _against_stepped(result: DemoResult) -> Section:
    rows = tuple(
        (
            one.name, case.name, f"{case.rmse_n:.4f}", f"{case.stepped_rmse_n:.4f}", f"{case.ratio_to_stepped:.3f}",
            f"at most {case.limit_ratio:g}: {'met' if case.ratio_to_stepped <= case.limit_ratio else 'MISSED'}",
            f"{case.tension_min_n:.1f} to {case.tension_max_n:.1f}", str(case.unsafe_events), str(case.missed_periods),
        )
        for one in result.configurations for case in one.cases
    )  # fmt: skip
    heads = ("Configuration", "Case", "over the wires, N", "stepped time, N", "ratio", "goal", "true tension, N",
             "unsafe events", "missed periods")  # fmt: skip
    caption = (
        f"RMSE in real time over CANopen and Modbus TCP, and of the same configuration on the same plant in stepped "
        f"time: the whole cycle without wires and without waiting, mean of {SEEDS} runs."
    )
    table = Table(caption, heads, rows, frozenset({2, 3, 4, 7, 8}))
    return Section("In real time against stepped time", tables=(table,))


def _case(case: Scenario, result: DemoResult, traces: Sequence[CaseTrace], evidence: Evidence) -> Section:
    """The configurations under identical conditions, span by span."""
    if not traces:
        return Section(case.heading, (case.description, "It was not run."))
    names = {one.controller: one.name for one in result.configurations}
    length = min(len(evidence.truth_s[one.rows][::PLOT_EVERY]) for one in traces)
    time_s = np.arange(length) * PLOT_EVERY * 1e-3
    charts: list[Chart] = []
    for what, unit, values in (
        ("Tension", "N", evidence.recording.tension_n),
        ("Torque", "Nm", evidence.recording.torque_nm),
    ):
        for span in range(evidence.recording.spans):
            series = [
                Series(names[config_hash(one.window.config)], values[one.rows][::PLOT_EVERY][:length, span])
                for one in traces
            ]
            if what == "Tension":
                series.append(Series("set-point", traces[0].setpoint_n[::PLOT_EVERY][:length, span], dashed=True))
            place = "span" if what == "Tension" else "roller"
            charts.append(Chart(f"{what}, {place} {span + 1}", unit, time_s, tuple(series)))
    return Section(case.heading, (case.description,), charts=tuple(charts))


def _through_the_gate(chain: ChainResult) -> Section:
    rows = tuple(_row(one) for one in chain.changes)
    heads = ("Step", "What", "Verdict", "Came to", "Approved by")
    table = Table("Each candidate of the chain, in order. A proposal is accepted where every rule passes.", heads, rows)
    approved = tuple(
        (f"{one.step}, {one.name}", one.approved_over, one.certificate[:16])
        for one in chain.changes if one.approved_over
    )  # fmt: skip
    refused = tuple((f"{one.step}, {one.name}", text) for one in chain.changes for text in one.against)
    tables = [table]
    if approved:
        told = "What the operator's client had read over OPC UA of each that it approved; SHA-256 of its certificate."
        tables.append(Table(told, ("Candidate", "Read", "Certificate"), approved))
    if refused:
        tables.append(Table("What the gate has found against those it refused.", ("Candidate", "Rule"), refused))
    return Section("Through the gate", (f"{chain.deployments} deployments.",), tuple(tables))


def _row(one: ChangeResult) -> tuple[str, ...]:
    if not one.proposal:
        return f"{one.step}, {one.name}", one.why, NONE, "not made", NONE
    verdict = f"refused by {len(one.against)} of {one.rules} rules" if one.against else f"accepted by {one.rules} rules"
    speed = "" if one.speed_m_per_s is None else f", up to {one.speed_m_per_s:.3g} m/s"
    what = f"{one.reason} ({one.proposal[:12]})"
    return f"{one.step}, {one.name}", what, verdict + speed, one.stage, one.approved_by or NONE


def _whole_run(evidence: Evidence) -> Section:
    recording = evidence.recording
    time_s = recording.time_s[::WHOLE_EVERY]
    tension = tuple(Series(f"span {i + 1}", recording.tension_n[::WHOLE_EVERY, i]) for i in range(recording.spans))
    charts = (
        Chart("Tension", "N", time_s, tension),
        Chart("Speed of the unwinder", "m/s", time_s, (Series("v0", recording.unwind_speed_m_per_s[::WHOLE_EVERY]),)),
    )
    return Section(
        "The whole run",
        (f"Every {WHOLE_EVERY * 1e-3:g} s, as the recorder has it: tensioning, then cases and experiments in turn.",),
        charts=charts,
    )


def _safety(result: DemoResult, chain: ChainResult) -> Section:
    kinds = tuple((kind.replace("_", " "), str(count)) for kind, count in result.unsafe_events.items())
    names = {one.controller: one.name for one in result.configurations}
    swaps = tuple(
        (
            names.get(one.configuration, one.configuration[:12]),
            f"{one.at_s:.1f}",
            f"{one.largest_step_nm:.2f}",
            f"{one.before_nm:.2f}",
        )
        for one in chain.swaps
    )
    audit = chain.audit
    facts = (
        ("records", str(audit.records)),
        ("verified", "sound" if audit.sound else "; ".join(audit.problems)),
        ("head", audit.head),
    )
    return Section(
        "Was it safe, and is it on record",
        tables=(
            Table("Unsafe events at the drives, over the whole run: everything that was watched for.",
                  ("Kind", "Seen"), kinds, frozenset({1})),
            Table("Swaps: the largest change of any drive's torque from one command to the next, in the second around "
                  "each, and in the second before that.",
                  ("Configuration", "at, s", "around it, Nm", "before, Nm"), swaps, frozenset({1, 2, 3}),
                  note=f"Allowed in a period: {chain.step_allowed_nm:g} Nm. The largest of the whole run, in which "
                  f"set-points step: {chain.step_elsewhere_nm:.2f} Nm."),
            Table("The audit, verified after every process had ended (r2rgate audit verify).", ("", ""), facts),
        ),
    )  # fmt: skip


def _timing(result: DemoResult) -> Section:
    timing = result.timing
    rows = tuple(
        (name, *(f"{value:.0f}" for value in (one.p50, one.p99, one.p999, one.max)))
        for name, one in (
            ("Lateness: wake-up after the due time", timing.lateness_us),
            ("Cycle time: wake-up to the last write", timing.cycle_us),
        )
    )
    table = Table(
        f"Of {timing.periods} periods of {timing.period_s * 1e3:g} ms; missed: {timing.missed}.",
        ("", "p50, µs", "p99, µs", "p99.9, µs", "Largest, µs"), rows, frozenset({1, 2, 3, 4}),
    )  # fmt: skip
    return Section("Cycle timing", tables=(table,))

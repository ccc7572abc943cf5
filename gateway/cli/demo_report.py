"""The quick demonstration as a page."""

import os
from typing import Any

import numpy as np

from gateway.cli.demo_analysis import CaseTrace, Evidence, trace_of
from gateway.cli.demo_cases import Window
from gateway.cli.demo_line import Setup
from gateway.cli.demo_result import CaseResult, DemoResult
from gateway.cli.demo_stepped import SEEDS
from gateway.cli.line_records import read_records, unconfirmed_in
from gateway.cli.report import Case, Comparison, EventCount, Machine, Report, RunEvent, Timing, render_report

PLOT_EVERY = 10  #: milliseconds between the samples of a chart
SHOWN_EVENTS = ("unsafe", "watchdog", "emergency_stop", "drive_state")


def page(setup: Setup, result: DemoResult, windows: list[Window], evidence: Evidence) -> str:
    """`report.html`."""
    history = evidence.history
    start_s = float(history["time_s"][0])
    traces = [trace_of(window, evidence) for window in windows]
    report = Report(
        title="r2rgate demonstration",
        line=f"{setup.line.site}/{setup.line.line}",
        plant=evidence.summary["plant"],
        when=result.date,
        command=result.command,
        versions=result.versions,
        machine=Machine(os.cpu_count() or 1, result.machine[0], tuple(result.machine[1:])),
        cases=tuple(
            _chart(setup, trace, case, evidence)
            for trace, case in zip(traces, result.configurations[0].cases, strict=True)
        ),
        unsafe_events=tuple(EventCount(kind, count) for kind, count in result.unsafe_events.items()),
        timing=Timing(
            time_s=history["time_s"] - start_s,
            lateness_us=history["lateness_s"] * 1e6,
            cycle_us=history["cycle_s"] * 1e6,
            period_us=result.timing.period_s * 1e6,
            missed=result.timing.missed,
        ),
        events=_events(evidence, start_s),
        notes=(
            "Both cases are literal steps, as in the paper; the line starts each of them settled at its set-points.",
            "The controller is designed on the nominal model of the line file, which is wrong on purpose: stiffness, "
            "radius, inertia, friction and span length differ from the simulated line's by 5 to 33 %.",
            *(f"A case was repeated: {stop}" for stop in result.stops),
            *unconfirmed_in(read_records(setup.gateway_data).book),
            f"In stepped time: the mean of {SEEDS} runs of the whole cycle without wires and without waiting.",
        ),
    )
    return render_report(report)


def _chart(setup: Setup, trace: CaseTrace, result: CaseResult, evidence: Evidence) -> Case:
    recording, case, limits = evidence.recording, trace.window.case, setup.line.limits
    thinned = slice(trace.rows.start, trace.rows.stop, PLOT_EVERY)
    return Case(
        name=case.name,
        title=case.heading,
        description=case.description,
        law=f"{setup.config.kind.upper()}, designed on the line file's nominal model.",
        source="The recorder inside the simulated line: true tensions, speeds and torques. The gateway had only the "
        "noisy signals of drives and load cells.",
        time_s=recording.time_s[thinned] - recording.time_s[trace.rows.start],
        tension_n=recording.tension_n[thinned].T,
        setpoint_n=trace.setpoint_n[::PLOT_EVERY].T,
        torque_nm=recording.torque_nm[thinned].T,
        speed_m_per_s=recording.speed_m_per_s[thinned].T,
        unwind_speed_m_per_s=recording.unwind_speed_m_per_s[thinned],
        torque_limit_nm=limits.torque_nm,
        tension_min_n=limits.tension_min_n,
        tension_max_n=limits.tension_max_n,
        rmse_n=result.rmse_n,
        rmse_per_span_n=np.array(result.rmse_per_span_n),
        unsafe_events=result.unsafe_events,
        missed_cycles=result.missed_periods,
        goal=Comparison("15 % above the same case in stepped time", result.limit_ratio * result.stepped_rmse_n),
        comparisons=(Comparison("the same case and law in stepped time", result.stepped_rmse_n),),
        span_names=tuple(span.name for span in setup.line.spans),
    )


def _events(evidence: Evidence, start_s: float) -> tuple[RunEvent, ...]:
    """What happened at the devices; drives that change state together are one event."""
    found: list[RunEvent] = []
    together: dict[tuple[float, str, str], list[int]] = {}
    for event in evidence.recording.events:
        at_s = float(event.get("monotonic_s", start_s)) - start_s
        if event["kind"] == "drive_state":
            together.setdefault((round(at_s, 2), event["state"], event["cause"]), []).append(event["roller"])
        elif event["kind"] in SHOWN_EVENTS:
            found.append(RunEvent(at_s, event["kind"], _in_words(event)))
    for (at_s, state, cause), rollers in together.items():
        named = ", ".join(map(str, rollers))
        text = f"drives {named}: {state.replace('_', ' ').lower()} ({cause})"
        found.append(RunEvent(at_s, "drives", text))
    return tuple(sorted(found, key=lambda event: event.time_s))


def _in_words(event: dict[str, Any]) -> str:
    rest = {key: value for key, value in event.items() if key not in ("kind", "time_s", "monotonic_s")}
    return ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in rest.items())

"""From what the demonstration recorded to `result.json`, `report.html` and the table on the terminal.

Tensions come from the recorder inside the simulated line, which shares nothing with the gateway; set-points and timing
from the gateway's history, for nobody else knows them.
"""

import json
import os
import time
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from gateway.cli import report as page
from gateway.cli.cases import CHANGE_AT_S, DURATION_S
from gateway.cli.demo import DemoFailed, Setup, Window, command_line, machine_lines, now_iso
from gateway.cli.demo_result import CaseResult, DemoResult, Percentiles, TimingResult
from gateway.cli.report import render_report
from gateway.cli.stepped import run_case
from gateway.core.controller import config_hash
from gateway.core.metrics import rmse_n, rmse_per_span_n
from gateway.supervisor.historian import FILE_NAME
from gateway.supervisor.history import History
from sim_plant.plant import load_plant
from sim_plant.recorder import read_recording
from sim_plant.recording import Recording

LIMIT_RATIO = 1.15  #: on the wire in real time against stepped time
LIBRARIES = ("r2rgate", "numpy", "scipy", "python-can", "canopen", "pymodbus")
FIELDS = ("tension_setpoint_n", "speed_setpoint_m_per_s", "lateness_s", "cycle_s", "missed")
PLOT_EVERY = 10  #: milliseconds between the samples of a chart

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Evidence:
    """Everything that was recorded. Times on CLOCK_MONOTONIC."""

    recording: Recording
    truth_s: NDArray[Any]  #: (m,), of the recording's rows
    history: Arrays
    summary: dict[str, Any]


def analyse(setup: Setup, windows: list[Window], world_start_s: float, started_s: float, console: Console) -> None:
    """Measure, write both files, print the table."""
    evidence = _read(setup, windows, world_start_s)
    plant = load_plant(setup.out / "plant.toml")
    results, charts = [], []
    for window in windows:
        stepped = run_case(setup.line, setup.config, plant, window.case, setup.seed)
        result, chart = _case(setup, window, evidence, stepped.rmse_n)
        results.append(result)
        charts.append(chart)
    machine = machine_lines(setup.out / "logs" / "loop.log")
    timing = _timing(setup, evidence.history)
    result = DemoResult(
        command=command_line(),
        date=now_iso(),
        law=setup.config.kind,
        seed=setup.seed,
        controller=config_hash(setup.config),
        versions={name: version(name) for name in LIBRARIES},
        machine=machine,
        cases=results,
        timing=timing,
        unsafe_events=evidence.summary["unsafe_events"],
        wall_s=round(time.monotonic() - started_s, 1),
    )
    (setup.out / "result.json").write_text(result.model_dump_json(indent=2) + "\n", encoding="utf-8")
    (setup.out / "report.html").write_text(_page(setup, result, charts, evidence, windows), encoding="utf-8")
    _print(setup, result, console)


def _read(setup: Setup, windows: list[Window], world_start_s: float) -> Evidence:
    recording = read_recording(setup.out / "recording")
    with History(setup.out / "data" / FILE_NAME) as file:
        history = file.read(world_start_s, windows[-1].end_s + 60.0, FIELDS)
        if file.damaged:
            raise DemoFailed(f"the history is damaged: {'; '.join(file.damaged)}")
    summary = json.loads((setup.out / "recording" / "summary.json").read_text())
    return Evidence(recording, recording.time_s + world_start_s, history, summary)


def _case(setup: Setup, window: Window, evidence: Evidence, stepped_rmse_n: float) -> tuple[CaseResult, page.Case]:
    case, recording = window.case, evidence.recording
    begin_s = _change_s(window, evidence.history) - CHANGE_AT_S
    rows = slice(*np.searchsorted(evidence.truth_s, (begin_s, begin_s + DURATION_S)))
    tension = recording.tension_n[rows]
    setpoint = _held(evidence.history, "tension_setpoint_n", evidence.truth_s[rows])
    rmse, per_span = rmse_n(tension, setpoint), rmse_per_span_n(tension, setpoint)
    begin_world_s = recording.time_s[rows.start]
    unsafe = sum(
        event["kind"] == "unsafe" and begin_world_s <= event["time_s"] <= begin_world_s + DURATION_S
        for event in recording.events
    )
    inside = (evidence.history["time_s"] >= begin_s) & (evidence.history["time_s"] < begin_s + DURATION_S)
    missed = evidence.history["missed"][inside]
    result = CaseResult(
        name=case.name,
        rmse_n=rmse,
        rmse_per_span_n=per_span.tolist(),
        stepped_rmse_n=stepped_rmse_n,
        ratio_to_stepped=rmse / stepped_rmse_n,
        limit_ratio=LIMIT_RATIO,
        tension_min_n=float(tension.min()),
        tension_max_n=float(tension.max()),
        unsafe_events=unsafe,
        missed_periods=int(missed[-1] - missed[0]),
    )
    return result, _chart(setup, window, result, evidence, rows, setpoint)


def _change_s(window: Window, history: Arrays) -> float:
    """When the case's change took effect: the first period with other set-points than before."""
    time_s = history["time_s"]
    during = np.flatnonzero((time_s > window.begin_s) & (time_s < window.end_s))
    together = np.column_stack((history["tension_setpoint_n"][during], history["speed_setpoint_m_per_s"][during]))
    changed = np.flatnonzero((together != together[0]).any(axis=1))
    if not changed.size:
        raise DemoFailed(f"the history shows no change of set-point in the {window.case.title.lower()}")
    return float(time_s[during[changed[0]]])


def _held(history: Arrays, name: str, at_s: NDArray[Any]) -> NDArray[Any]:
    """The value of the last control period at or before each time."""
    return history[name][np.maximum(np.searchsorted(history["time_s"], at_s, side="right") - 1, 0)]


def _timing(setup: Setup, history: Arrays) -> TimingResult:
    def spread(name: str) -> Percentiles:
        p50, p99, p999 = np.percentile(history[name] * 1e6, (50, 99, 99.9))
        return Percentiles(p50=p50, p99=p99, p999=p999, max=float(history[name].max() * 1e6))

    return TimingResult(
        period_s=setup.line.control.period_s,
        periods=len(history["time_s"]),
        missed=int(history["missed"][-1]),
        lateness_us=spread("lateness_s"),
        cycle_us=spread("cycle_s"),
    )


def _chart(
    setup: Setup, window: Window, result: CaseResult, evidence: Evidence, rows: slice, setpoint: NDArray[Any]
) -> page.Case:
    recording, case = evidence.recording, window.case
    thinned = slice(rows.start, rows.stop, PLOT_EVERY)
    limits = setup.line.limits
    return page.Case(
        name=case.name,
        title=case.title,
        description=case.description,
        law=f"{setup.config.kind.upper()}, designed on the line file's nominal model; the simulated line differs from it.",
        source="Tensions, speeds and torques are the truth of the simulated line, as its recorder saw them; the gateway "
        "had the noisy signals of drives and load cells.",
        time_s=recording.time_s[thinned] - recording.time_s[rows.start],
        tension_n=recording.tension_n[thinned].T,
        setpoint_n=setpoint[::PLOT_EVERY].T,
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
        goal=page.Comparison("15 % above the same case in stepped time", LIMIT_RATIO * result.stepped_rmse_n),
        comparisons=(page.Comparison("the same case, law and seed in stepped time", result.stepped_rmse_n),),
        span_names=tuple(span.name for span in setup.line.spans),
    )


def _page(
    setup: Setup, result: DemoResult, charts: list[page.Case], evidence: Evidence, windows: list[Window]
) -> str:
    history = evidence.history
    start_s = float(history["time_s"][0])
    timing = page.Timing(
        time_s=history["time_s"] - start_s,
        lateness_us=history["lateness_s"] * 1e6,
        cycle_us=history["cycle_s"] * 1e6,
        period_us=result.timing.period_s * 1e6,
        missed=result.timing.missed,
    )
    events = [
        page.RunEvent(float(event["monotonic_s"]) - start_s, event["kind"], _event_text(event))
        for event in evidence.recording.events
        if event["kind"] in ("unsafe", "watchdog", "state", "emergency stop")
    ]
    return render_report(
        page.Report(
            title="r2rgate demonstration",
            line=f"{setup.line.site}/{setup.line.line}",
            plant=evidence.summary["plant"],
            when=result.date,
            command=result.command,
            versions=result.versions,
            machine=page.Machine(os.cpu_count() or 1, result.machine[0], tuple(result.machine[1:])),
            cases=tuple(charts),
            unsafe_events=tuple(page.EventCount(kind, count) for kind, count in result.unsafe_events.items()),
            timing=timing,
            events=tuple(sorted(events, key=lambda event: event.time_s)),
            notes=(
                "Both cases are literal steps, as in the paper; the line starts each of them settled at its set-points.",
                "The controller is designed on the nominal model of the line file, which is wrong on purpose: stiffness, "
                "radius, inertia, friction and span length of the simulated line differ by 5 to 50 %.",
            ),
        )
    )


def _event_text(event: dict[str, Any]) -> str:
    rest = {k: v for k, v in event.items() if k not in ("kind", "time_s", "monotonic_s")}
    return ", ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in rest.items())


def _print(setup: Setup, result: DemoResult, console: Console) -> None:
    table = Table(title=f"r2rgate demonstration: {result.law.upper()} on a mismatched line, real time over real wires")
    for name in ("case", "RMSE [N]", "stepped [N]", "ratio (goal)", "worst span", "tension [N]", "unsafe", "missed"):
        table.add_column(name, justify="left" if name == "case" else "right")
    for case in result.cases:
        worst = int(np.argmax(case.rmse_per_span_n))
        met = "" if case.ratio_to_stepped <= case.limit_ratio else " MISSED"
        table.add_row(
            case.name,
            f"{case.rmse_n:.3f}",
            f"{case.stepped_rmse_n:.3f}",
            f"{case.ratio_to_stepped:.3f} (<= {case.limit_ratio:g}){met}",
            f"{worst + 1}: {case.rmse_per_span_n[worst]:.3f} N",
            f"{case.tension_min_n:.1f} to {case.tension_max_n:.1f}",
            str(case.unsafe_events),
            str(case.missed_periods),
        )
    console.print(table)
    timing = result.timing
    console.print(
        f"{timing.periods} periods of {timing.period_s * 1e3:g} ms, {timing.missed} missed. Wake-up lateness p50/p99/max "
        f"{timing.lateness_us.p50:.0f}/{timing.lateness_us.p99:.0f}/{timing.lateness_us.max:.0f} us, cycle "
        f"{timing.cycle_us.p50:.0f}/{timing.cycle_us.p99:.0f}/{timing.cycle_us.max:.0f} us",
        soft_wrap=True,
    )
    for sentence in result.machine[1:]:
        console.print(sentence, markup=False, soft_wrap=True)
    unsafe = sum(result.unsafe_events.values())
    console.print(f"unsafe events at the drives, whole run: {unsafe}", style="bold red" if unsafe else "")
    console.print(f"result: {setup.out / 'result.json'}\nreport: {setup.out / 'report.html'}", markup=False, soft_wrap=True)

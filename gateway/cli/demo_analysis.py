"""From what the demonstration recorded to figures.

Tensions come from the recorder inside the simulated line, which shares nothing with the gateway, and are held against
the case's own set-points. The gateway's history gives timing, and the instant at which a step was made.
"""

import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gateway.cli.demo_cases import Window
from gateway.cli.demo_failed import DemoFailed
from gateway.cli.demo_line import Setup
from gateway.cli.demo_result import CaseResult, ChainResult, ConfigurationResult, DemoResult, Percentiles, TimingResult
from gateway.cli.demo_stepped import SteppedAside
from gateway.cli.origin import command_line, machine_lines, now_iso, versions_of
from gateway.core.controller import Controller, config_hash
from gateway.core.metrics import rmse_n, rmse_per_span_n
from gateway.core.scenario import PAPER
from gateway.supervisor.historian import FILE_NAME
from gateway.supervisor.history import History
from sim_plant.judge import UNSAFE
from sim_plant.process import SUMMARY_FILE
from sim_plant.recorder import read_recording
from sim_plant.recording import Recording

LIMIT_RATIO = 1.15  #: on the wire in real time against stepped time
LIBRARIES = ("r2rgate", "numpy", "scipy", "python-can", "canopen", "pymodbus")
FIELDS = ("tension_setpoint_n", "speed_setpoint_m_per_s", "lateness_s", "cycle_s", "missed")

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Evidence:
    """Everything that was recorded. Times on CLOCK_MONOTONIC, but for the recording's own."""

    recording: Recording
    truth_s: NDArray[Any]  #: (m,), of the recording's rows
    history: Arrays
    summary: dict[str, Any]


@dataclass(frozen=True)
class CaseTrace:
    """Where a case lies in the recording."""

    window: Window
    rows: slice
    setpoint_n: NDArray[Any]  #: (k, n)


def measure(
    setup: Setup,
    windows: list[Window],
    stops: list[str],
    evidence: Evidence,
    started_s: float,
    names: Callable[[int], str],
    chain: ChainResult | None,
    stepped: SteppedAside,
) -> DemoResult:
    """Every figure of the run, beside the same cases in stepped time. `names`: of a configuration, by its place."""
    found: list[ConfigurationResult] = []
    for config in _configurations(windows):
        cases = [_case(stepped, trace_of(one, evidence), evidence) for one in windows if one.config == config]
        found.append(
            ConfigurationResult(name=names(len(found)), law=config.kind, controller=config_hash(config), cases=cases)
        )
    return DemoResult(
        command=command_line(),
        date=now_iso(),
        seed=setup.seed,
        versions=versions_of(LIBRARIES),
        machine=machine_lines(setup.out / "logs" / "loop.log"),
        configurations=found,
        truth_rmse_n={case.name: stepped.rmse_n(stepped.on_truth(), case) for case in PAPER},
        chain=chain,
        timing=_timing(setup, evidence.history),
        unsafe_events=evidence.summary["unsafe_events"],
        stops=stops,
        wall_s=round(time.monotonic() - started_s, 1),
    )


def _configurations(windows: Sequence[Window]) -> list[Controller]:
    """In the order in which they ran."""
    found: list[Controller] = []
    for window in windows:
        if window.config not in found:
            found.append(window.config)
    return found


def read_evidence(setup: Setup, windows: list[Window], world_start_s: float) -> Evidence:
    """What recorder and gateway left. Raises DemoFailed when the history is damaged."""
    recording = read_recording(setup.out / "recording")
    with History(setup.gateway_data / FILE_NAME) as file:
        history = file.read(world_start_s, windows[-1].end_s + 60.0, FIELDS)
        if file.damaged:
            raise DemoFailed(f"the history is damaged: {'; '.join(file.damaged)}")
    return Evidence(recording, recording.time_s + world_start_s, history, summary_of(setup, recording))


def summary_of(setup: Setup, recording: Recording) -> dict[str, Any]:
    """As the simulated line wrote it at its end; while that runs, the same from what it has recorded until now."""
    file = setup.out / "recording" / SUMMARY_FILE
    if file.exists():
        return json.loads(file.read_text())
    seen = Counter(event["what"] for event in recording.of_kind("unsafe"))
    (header,) = recording.of_kind("recording")
    return {"plant": header["plant"], "unsafe_events": {kind.label: seen[kind.label] for kind in UNSAFE}}


def trace_of(window: Window, evidence: Evidence) -> CaseTrace:
    """The 15 s around the change, from 1 s before it on."""
    begin_s = _change_s(window, evidence.history) - window.case.change_at_s
    rows = slice(*np.searchsorted(evidence.truth_s, (begin_s, begin_s + window.case.duration_s)))
    return CaseTrace(window, rows, window.case.setpoints_n(evidence.truth_s[rows] - begin_s))


def _change_s(window: Window, history: Arrays) -> float:
    """When the case's change took effect: the first period with other set-points than before."""
    time_s = history["time_s"]
    during = np.flatnonzero((time_s > window.begin_s) & (time_s < window.end_s))
    together = np.column_stack((history["tension_setpoint_n"][during], history["speed_setpoint_m_per_s"][during]))
    changed = np.flatnonzero((together != together[0]).any(axis=1))
    if not changed.size:
        raise DemoFailed(f"the history shows no change of set-point in the {window.case.heading.lower()}")
    return float(time_s[during[changed[0]]])


def _case(stepped: SteppedAside, trace: CaseTrace, evidence: Evidence) -> CaseResult:
    case, recording = trace.window.case, evidence.recording
    tension = recording.tension_n[trace.rows]
    begin_s, end_s = evidence.truth_s[trace.rows][[0, -1]]
    missed = evidence.history["missed"][(evidence.history["time_s"] >= begin_s) & (evidence.history["time_s"] <= end_s)]
    rmse = rmse_n(tension, trace.setpoint_n)
    stepped_rmse = stepped.rmse_n(trace.window.config, case)
    return CaseResult(
        name=case.name,
        rmse_n=rmse,
        rmse_per_span_n=rmse_per_span_n(tension, trace.setpoint_n).tolist(),
        stepped_rmse_n=stepped_rmse,
        ratio_to_stepped=rmse / stepped_rmse,
        limit_ratio=LIMIT_RATIO,
        tension_min_n=float(tension.min()),
        tension_max_n=float(tension.max()),
        unsafe_events=int(sum(begin_s <= event["monotonic_s"] <= end_s for event in recording.of_kind("unsafe"))),
        missed_periods=int(missed[-1] - missed[0]),
    )


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

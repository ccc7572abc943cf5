"""The status of a line, made of the newest frames: what of the loop is known, and what is known no more."""

from collections.abc import Sequence
from enum import IntEnum
from math import isfinite

import numpy as np

from gateway.core.doubts import WORDS as DOUBTS
from gateway.core.doubts import Doubt, in_words
from gateway.core.line import Line
from gateway.core.signals import DriveState, Quality
from gateway.core.states import LoopState, Phase
from gateway.core.status import LoopStatus, SpanStatus, Spread, TimingStatus
from gateway.core.telemetry import VERSION, Frame
from gateway.supervisor.telemetry_sink import Cycle, TelemetrySink

LOST_S = 1.0  #: a loop whose newest frame is older than this is taken to be gone
START_LOOP = "start it with `r2rgate loop LINE.toml`"

_UNCOMPARED = DOUBTS[Doubt.TORQUE_UNCOMPARED]

#: What a state means, and what to do next.
WORDS: dict[str, tuple[str, str]] = {
    "SILENT": ("nothing is sent to the drives", "`r2rgate arm` proves limits and watchdogs"),
    "READY": ("armed, zero torque", "`r2rgate start` tensions the web and runs"),
    "RUN": ("tension and speed are controlled", "`r2rgate hold` brings it to standstill, `r2rgate stop` ends"),
    "HOLD": ("speed to standstill, tension stays on", "`r2rgate start` goes on, `r2rgate stop` takes torque off"),
    "STOP": ("controlled stop, then torque off; latched", "find the cause in the events, mend it, then `r2rgate arm`"),
    "UNKNOWN": ("loop not running", START_LOOP),
}


def loop_status(line: Line, sink: TelemetrySink, now_s: float) -> LoopStatus:
    age_s, frame = sink.age_s(now_s), sink.newest()
    running = age_s is not None and age_s <= LOST_S
    state = _name(LoopState, frame.state) if frame is not None and running else "UNKNOWN"
    phase = _name(Phase, frame.phase) if frame is not None and running else "UNKNOWN"
    text, what_next = WORDS[state]
    if not running and sink.other_version is not None:
        text = f"what comes from the loop is of version {sink.other_version}, this program reads {VERSION}: it may run"
        what_next = "stop the line, then start the loop anew, of the same version as the gateway"
    return LoopStatus(
        running=running,
        state=state,
        phase=phase,
        by_person=frame.by_person if frame is not None and running else False,
        standstill=frame.standstill if frame is not None and running else False,
        text=text,
        next=what_next,
        age_s=None if age_s is None else round(age_s, 3),
        period_s=line.control.period_s,
        held=frame.held if frame is not None and running else 0,
        saturated=frame.saturated if frame is not None and running else False,
        doubts=_doubts(line, frame) if frame is not None and running else [],
        restarts=sink.restarts,
    )


def _doubts(line: Line, frame: Frame) -> list[str]:
    """In words; with the names of the drives whose torque is not compared any more."""
    said = in_words(frame.doubts)
    if frame.doubts & Doubt.TORQUE_UNCOMPARED:
        unknown = np.isnan(frame.torque_actual_nm)
        names = ", ".join(drive.name for drive in line.drives if unknown[drive.roller - 1])
        named = f"{names}: torque asked and given are not compared any more: check the drive's torque reading"
        said = [named if text == _UNCOMPARED else text for text in said]
    return said


def span_statuses(line: Line, frame: Frame | None, running: bool) -> list[SpanStatus]:
    """With no loop the last values stay, marked STALE, and what the drives do is not known (ABSENT)."""
    return [_span_status(line, k, frame, running) for k in range(line.n)]


def _span_status(line: Line, k: int, frame: Frame | None, running: bool) -> SpanStatus:
    span = line.spans[k]
    tension_n = setpoint_n = error_n = speed = torque = actual = None
    quality, drive = Quality.MISSING.name, DriveState.ABSENT.name
    if frame is not None:
        tension_n, setpoint_n = known(frame.tension_n[k]), known(frame.tension_setpoint_n[k])
        error_n = known(frame.tension_n[k] - frame.tension_setpoint_n[k])
        speed, torque = known(frame.speed_m_per_s[k]), known(frame.torque_nm[k])
        actual = known(frame.torque_actual_nm[k])
        quality = _name(Quality, frame.tension_quality[k])
        if running:
            drive = _name(DriveState, frame.drive_state[k])
        elif quality == Quality.GOOD.name:
            quality = Quality.STALE.name
    return SpanStatus(
        number=k + 1,
        name=span.name,
        control=span.control,
        tension_n=tension_n,
        setpoint_n=setpoint_n,
        error_n=error_n,
        quality=quality,
        roller=line.rollers[k].name,
        speed_m_per_s=speed,
        torque_nm=torque,
        torque_actual_nm=actual,
        drive=drive,
        tension_min_n=span.tension_min_n,
        tension_max_n=span.tension_max_n,
        torque_limit_nm=line.rollers[k].torque_nm,
    )


def timing_status(cycles: Sequence[Cycle]) -> TimingStatus:
    if not cycles:
        return TimingStatus(frames=0, cycle=None, lateness=None, missed=0, missed_total=0)
    return TimingStatus(
        frames=len(cycles),
        cycle=_spread([cycle.cycle_s for cycle in cycles]),
        lateness=_spread([cycle.lateness_s for cycle in cycles]),
        missed=cycles[-1].missed - cycles[0].missed,
        missed_total=cycles[-1].missed,
    )


def _spread(values: list[float]) -> Spread | None:
    finite = [value for value in values if isfinite(value)]
    if not finite:
        return None
    p50, p99 = np.percentile(finite, (50, 99))
    return Spread(p50_s=round(float(p50), 7), p99_s=round(float(p99), 7), max_s=round(max(finite), 7))


def known(value: float) -> float | None:
    """A number for JSON: six decimals, null for what is not finite."""
    return round(float(value), 6) if isfinite(value) else None


def _name(names: type[IntEnum], code: int) -> str:
    try:
        return names(code).name
    except ValueError:  # a newer loop may know more states than this program
        return "UNKNOWN"

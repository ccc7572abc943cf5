"""The status of a line as the gateway tells it to people and machines. JSON, strict; see docs/schemas."""

from collections.abc import Sequence
from enum import IntEnum
from math import isfinite
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from gateway.core.doubts import in_words
from gateway.core.line import Line, Strict
from gateway.core.messages import BusReport
from gateway.core.proposal import Kind
from gateway.core.signals import DriveState, Quality
from gateway.core.states import LoopState
from gateway.core.telemetry import Frame
from gateway.supervisor.telemetry_sink import Cycle, TelemetrySink

LOST_S = 1.0  #: a loop whose newest frame is older than this is taken to be gone
START_LOOP = "start it with `r2rgate loop LINE.toml`"

#: What a state means, and what to do next.
WORDS: dict[str, tuple[str, str]] = {
    "SILENT": ("nothing is sent to the drives", "`r2rgate arm` proves limits and watchdogs"),
    "READY": ("armed, zero torque", "`r2rgate start` tensions the web and runs"),
    "RUN": ("tension and speed are controlled", "`r2rgate hold` brings it to standstill, `r2rgate stop` ends"),
    "HOLD": ("speed to standstill, tension stays on", "`r2rgate start` goes on, `r2rgate stop` takes torque off"),
    "STOP": ("controlled stop, then torque off; latched", "find the cause in the events, mend it, then `r2rgate arm`"),
    "UNKNOWN": ("loop not running", START_LOOP),
}


class LoopStatus(Strict):
    running: bool  #: frames arrive
    state: str  #: a name of LoopState; UNKNOWN without a loop
    text: str  #: the state in words
    next: str  #: what a person can do now
    age_s: float | None  #: of the newest frame
    period_s: float
    held: int  #: periods in a row in which a signal was missing
    saturated: bool  #: a torque or its rate is at its limit
    doubts: list[str]  #: why proposals are blocked, and what to do; empty when they are not
    restarts: int  #: seen by this gateway


class SpanStatus(Strict):
    """A span and the drive of the roller at its end. A value that is not known is null, never 0."""

    number: int
    name: str
    control: Literal["tension", "draw"]
    tension_n: float | None
    setpoint_n: float | None
    error_n: float | None  #: tension minus set-point
    quality: str  #: of the tension, a name of Quality
    roller: str
    speed_m_per_s: float | None
    torque_nm: float | None  #: applied
    torque_actual_nm: float | None  #: as the drive reports it
    drive: str  #: a name of DriveState


class Spread(Strict):
    p50_s: float
    p99_s: float
    max_s: float


class TimingStatus(Strict):
    """Over the last ten seconds of the loop that runs."""

    frames: int
    cycle: Spread | None
    lateness: Spread | None
    missed: int  #: periods skipped in these seconds
    missed_total: int  #: and since the loop's start


class LinkStatus(Strict):
    frames: int
    dropped_frames: int  #: gaps in the sequence: the loop ran, its telemetry was not taken in time
    malformed: int  #: frames and datagrams that were none
    refused: int  #: requests and connections turned away because there were too many


class HistorianStatus(Strict):
    storing: bool
    text: str
    path: str
    frames_stored: int
    frames_lost: int
    events_lost: int
    last_stored_age_s: float | None
    moved_aside: str  #: where a damaged history is kept


class EventStatus(Strict):
    wall_s: float  #: Unix time
    kind: str
    text: str


class LimitsStatus(Strict):
    tension_min_n: float
    tension_max_n: float
    torque_nm: float


class ChangeStatus(Strict):
    """What is being done to the line by a proposal: on its way, on probation, or an experiment."""

    proposal: str  #: hash
    kind: Kind
    stage: str  #: as `r2rgate proposals` has it
    since_wall_s: float | None  #: Unix time at which it came to this stage; None: its record does not say
    text: str  #: what is still missing; empty: nothing is


class BusStatus(Strict):
    """The bus of the agents."""

    open: bool
    text: str  #: why it is not; empty: it is
    agents: list[str]  #: that answer questions now
    refused: int  #: requests of agents turned away: too many, too long, for several keys


class GatewayStatus(Strict):
    format: Annotated[int, Field(ge=1, le=1)]
    site: str
    line: str
    wall_s: float  #: Unix time of this status
    uptime_s: float  #: of the gateway
    loop: LoopStatus
    unwind_speed_m_per_s: float | None
    speed_setpoint_m_per_s: float | None
    stands: bool  #: in RUN, and no set-point has moved for as long as a verdict asks for
    change: ChangeStatus | None  #: None: nothing is being changed
    limits: LimitsStatus
    spans: list[SpanStatus]
    timing: TimingStatus
    link: LinkStatus
    buses: list[BusReport]  #: as the loop sees them; empty until it has said so
    agents_bus: BusStatus
    historian: HistorianStatus
    events: list[EventStatus]  #: the last ones, the newest at the end


def loop_status(line: Line, sink: TelemetrySink, now_s: float) -> LoopStatus:
    age_s, frame = sink.age_s(now_s), sink.newest()
    running = age_s is not None and age_s <= LOST_S
    state = _name(LoopState, frame.state) if frame is not None and running else "UNKNOWN"
    text, what_next = WORDS[state]
    return LoopStatus(
        running=running,
        state=state,
        text=text,
        next=what_next,
        age_s=None if age_s is None else round(age_s, 3),
        period_s=line.control.period_s,
        held=frame.held if frame is not None and running else 0,
        saturated=frame.saturated if frame is not None and running else False,
        doubts=in_words(frame.doubts) if frame is not None and running else [],
        restarts=sink.restarts,
    )


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

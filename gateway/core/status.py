"""The status of a line as the gateway tells it to people and machines. JSON, strict; see docs/schemas."""

from typing import Annotated, Literal

from pydantic import Field

from gateway.core.alarms import AlarmStatus
from gateway.core.deployment import WiringStatus
from gateway.core.finding import Finding
from gateway.core.line import Strict
from gateway.core.messages import BusReport
from gateway.core.proposal import Kind


class LoopStatus(Strict):
    running: bool  #: frames arrive
    state: str  #: a name of LoopState; UNKNOWN without a loop
    phase: str = "UNKNOWN"  #: a name of Phase: where in that state it is; UNKNOWN without a loop, or one that is older
    by_person: bool = False  #: in STOP, because a person wanted it
    standstill: bool = False  #: no speed is asked for, and unwinder and rollers are known to stand still
    text: str  #: the state in words
    next: str  #: what a person can do now
    age_s: float | None  #: of the newest frame
    period_s: float
    held: int  #: periods in a row in which a signal was missing
    saturated: bool  #: a torque or its rate is at its limit
    doubts: list[str]  #: why proposals are blocked, and what to do; empty when they are not
    restarts: int  #: seen by this gateway
    false_loop: list[Finding] = []  #: what speaks as the loop and is not, or contradicts it, lately


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
    tension_min_n: float | None = None  #: of this span; null: that of `limits`
    tension_max_n: float | None = None
    torque_limit_nm: float | None = None  #: of its roller; null: that of `limits`


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
    untaken: int = 0  #: messages of processes that are not the loop, and frames of the past or the future


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
    findings: list[Finding] = []  #: what led to it


class LimitsStatus(Strict):
    tension_min_n: float
    tension_max_n: float
    torque_nm: float


def band_n(span: SpanStatus, limits: LimitsStatus) -> tuple[float, float]:
    """The tensions that `span` may have: its own where it has some."""
    least = limits.tension_min_n if span.tension_min_n is None else span.tension_min_n
    return least, limits.tension_max_n if span.tension_max_n is None else span.tension_max_n


def torque_limit_nm(span: SpanStatus, limits: LimitsStatus) -> float:
    """The torque that the drive of the span's roller may give, in either direction."""
    return limits.torque_nm if span.torque_limit_nm is None else span.torque_limit_nm


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


class TaskFaultStatus(Strict):
    """A long task of the gateway that has raised an exception, and has not succeeded for a while since."""

    task: str
    error: str  #: name of the exception's type
    text: str  #: of the exception
    since_wall_s: float  #: Unix time
    times: int  #: raised since
    in_a_row: int  #: turns that failed one after the other; 0: the last one succeeded


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
    events_left_out: int = 0  #: older ones, which the message had no room for; the history has them
    audit_head: str = ""  #: NUMBER:HASH of the audit's last record; empty: none is known
    alarms: list[AlarmStatus] = []  #: what needs a look first stands first
    unconfirmed: list[Finding] = []  #: what controls the line, where nobody has judged or confirmed it
    wiring: WiringStatus | None = None  #: whether it is as it was proved to be; None: the loop has not told
    unexplained: list[Finding] = []  #: changes of the loop, and attempts, that no record explains
    task_faults: list[TaskFaultStatus] = []  #: the oldest first

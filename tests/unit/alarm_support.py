"""A status of a line that runs as it should, and what may be wrong with it."""

from typing import Any

from gateway.core.messages import BusReport
from gateway.core.status import BusStatus as AgentsBusStatus
from gateway.core.status import (
    EventStatus,
    GatewayStatus,
    HistorianStatus,
    LimitsStatus,
    LinkStatus,
    LoopStatus,
    SpanStatus,
    TimingStatus,
)
from gateway.supervisor.audit import AuditState
from gateway.supervisor.audit_anchor import NOTHING_YET

RECORDING = AuditState(True, "recording", NOTHING_YET)


def span(number: int = 1, **changes: Any) -> SpanStatus:
    well = SpanStatus(
        number=number, name=f"zone-{number}", control="tension", tension_n=30.0, setpoint_n=30.0, error_n=0.0,
        quality="GOOD", roller=f"roller-{number}", speed_m_per_s=0.1, torque_nm=5.0, torque_actual_nm=5.0,
        drive="ENABLED",
    )  # fmt: skip
    return well.model_copy(update=changes)


def bus(absent: list[str], last_error: str = "") -> BusReport:
    return BusReport(name="can0", absent=absent, timeouts=0, malformed=0, reconnects=0, last_error=last_error)


def status(loop: dict[str, Any] | None = None, **changes: Any) -> GatewayStatus:
    runs = LoopStatus(
        running=True, state="RUN", phase="RUNNING", text="", next="", age_s=0.01, period_s=0.01,
        held=0, saturated=False, doubts=[], restarts=0,
    )  # fmt: skip
    well = GatewayStatus(
        format=1, site="demo", line="line", wall_s=1_700_000_000.0, uptime_s=10.0,
        loop=runs.model_copy(update=loop or {}),
        unwind_speed_m_per_s=0.1, speed_setpoint_m_per_s=0.1, stands=True, change=None,
        limits=LimitsStatus(tension_min_n=5.0, tension_max_n=60.0, torque_nm=20.0),
        spans=[span(1), span(2)],
        timing=TimingStatus(frames=1000, cycle=None, lateness=None, missed=0, missed_total=0),
        link=LinkStatus(frames=1000, dropped_frames=0, malformed=0, refused=0),
        buses=[bus([])],
        agents_bus=AgentsBusStatus(open=True, text="", agents=[], refused=0),
        historian=HistorianStatus(
            storing=True, text="storing", path="", frames_stored=0, frames_lost=0, events_lost=0,
            last_stored_age_s=0.1, moved_aside="",
        ),
        events=[],
    )  # fmt: skip
    return well.model_copy(update=changes)


def state_event(text: str, wall_s: float = 1_700_000_000.0) -> EventStatus:
    return EventStatus(wall_s=wall_s, kind="state", text=text)

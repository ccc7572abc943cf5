"""The alarms of a line: what each means, what follows, what to do. No more than a person can keep in mind.

A proposal that waits is no alarm: it is a prompt. Nothing here acts on the line; what must act is the loop's.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from gateway.core.finding import Finding
from gateway.core.line import Strict

Priority = Literal["high", "medium", "low"]
MOST_ALARMS = 14
LONGEST_SHELVED_S = 8.0 * 3600.0  #: a shift

AlarmName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,39}$")]


@dataclass(frozen=True)
class Alarm:
    """A row of the table."""

    name: str
    priority: Priority
    means: str  #: in a few words, for a list
    cause: str
    consequence: str  #: of doing nothing
    action: str
    after_s: float  #: for so long it must have been so
    gone_s: float  #: and so long not, for it to have ended
    follows: bool = False  #: others lead to it: it is never the first of several


ALARMS: tuple[Alarm, ...] = (
    Alarm(
        "device-absent", "high", "a device does not answer",
        cause="power, plug, cable or address of a drive, a load-cell amplifier or the line PLC; a bus that is cut",
        consequence="its signals are missing: a line that runs stops within some periods, another cannot be armed",
        action="look at the device that is named: power, plug, error lamp. Then `r2rgate doctor`, and arm",
        after_s=0.0, gone_s=5.0,
    ),
    Alarm(
        "drive-fault", "high", "a drive is at fault or safely off",
        cause="overload, overtemperature, encoder or supply of the drive; safe torque off by the hard-wired circuit",
        consequence="its roller gives no torque: the line stops, and the web may go slack there",
        action="read the drive's own error; close the safety circuit; arming acknowledges the fault",
        after_s=0.0, gone_s=2.0,
    ),
    Alarm(
        "load-cell", "high", "a load cell cannot be trusted",
        cause="cable or amplifier; a cell that is stuck, or whose zero has drifted; overload",
        consequence="tension is controlled on a wrong value, or the line stops; proposals are blocked",
        action="hold the line, slacken the web or hang a known weight, set the zero; else exchange the cell",
        after_s=0.0, gone_s=5.0,
    ),
    Alarm(
        "loop-lost", "high", "the control loop tells nothing any more",
        cause="its process has ended or hangs, or the computer is overloaded",
        consequence="nobody controls: the drives take torque off by their own watchdogs",
        action="see that the line stands; `journalctl` has the reason; start `r2rgate loop`, then arm",
        after_s=0.0, gone_s=1.0,
    ),
    Alarm(
        "false-loop", "high", "something speaks as the control loop and is not",
        cause="a second loop on this line; a program of the line's user that took its socket; a loop that contradicts"
        " itself",
        consequence="what it tells is not taken; but a stop may reach it instead of the loop, and do nothing",
        action="look at the line itself and stop it there if need be; end the process that is named",
        after_s=0.0, gone_s=5.0,
    ),
    Alarm(
        "torque-at-limit", "medium", "torques are at their limits",
        cause="set-points or speed too high for the drives; a bearing or a nip that drags; a web that is stuck",
        consequence="tension follows its set-point no longer; proposals are blocked",
        action="lower tension or speed; once the line stands, feel for a roller that turns hard",
        after_s=2.0, gone_s=5.0,
    ),
    Alarm(
        "tension-out-of-band", "high", "a tension is outside the line's limits",
        cause="a web that breaks, slips or catches; a splice; a set-point moved too fast",
        consequence="the web tears or wrinkles; the loop stops the line where it lasts",
        action="look at the web of that span; hold the line if it does not come back by itself",
        after_s=0.5, gone_s=3.0,
    ),
    Alarm(
        "tension-off", "medium", "a tension is more than a fifth off its set-point",
        cause="a disturbance that lasts: eccentric roll, slipping roller, a controller that does not fit the web",
        consequence="material out of its tolerance",
        action="look at the trend: does it swing or stay? `r2rgate rollback` after a change of the controller",
        after_s=5.0, gone_s=5.0,
    ),
    Alarm(
        "cycles-late", "medium", "the loop misses periods",
        cause="another program takes the processor; no real-time priority; a slow bus",
        consequence="control becomes worse, and with many in a row the line stops",
        action="end what else runs on the computer; `r2rgate doctor` measures the jitter",
        after_s=0.0, gone_s=10.0,
    ),
    Alarm(
        "line-stopped", "high", "the line has stopped by itself",
        cause="what its text says: a signal, a device or a limit",
        consequence="no production until a person arms it again",
        action="find the cause, mend it, then arm and start",
        after_s=0.0, gone_s=0.0, follows=True,
    ),
    Alarm(
        "audit-unavailable", "medium", "nothing can be put on record",
        cause="the disk is full or does not answer, or the audit's file is damaged",
        consequence="the line runs on, but no change of its controller is made, and none is kept",
        action="make room on the disk; `r2rgate audit verify` says what is wrong",
        after_s=10.0, gone_s=5.0,
    ),
    Alarm(
        "history-not-stored", "low", "telemetry is not stored",
        cause="the disk is full or does not answer",
        consequence="what happens now cannot be looked at later, and nothing is learned from it",
        action="make room on the disk, or lower keep_gb in the line's file",
        after_s=30.0, gone_s=5.0,
    ),
    Alarm(
        "gateway-task", "medium", "a task of the gateway fails",
        cause="a fault of this program, or of a file that it reads, which its text names",
        consequence="what that task does is not done, or late: a change on probation may fall back, an alarm not come",
        action="read the text; where it lasts, start the gateway anew: the line runs on. Report it with the log",
        after_s=0.0, gone_s=5.0,
    ),
    Alarm(
        "unexplained-change", "high", "somebody else than the gateway has changed the loop, or has tried to",
        cause="a program that speaks to the loop past the gateway; a file of the loop that was edited or put back; "
        "a controller that it was started with and nobody approved",
        consequence="what was changed goes no further than a first configuration; what was tried was refused",
        action="find out who: the text names process and user, `r2rgate audit show` the rest. Approve what is to run",
        after_s=0.0, gone_s=5.0,
    ),
)  # fmt: skip
STOPPED = "line-stopped"
BY_NAME = {alarm.name: alarm for alarm in ALARMS}


class AlarmStatus(Strict):
    """One alarm of the table that is active, has not been acknowledged, or is shelved."""

    name: AlarmName
    priority: Priority
    means: str
    text: str  #: with the measured values, as they were when it came
    findings: list[Finding] = []  #: what the text says, as far as it is data
    cause: str
    consequence: str
    action: str
    active: bool
    acknowledged: bool
    first_out: bool  #: the first of those that came together
    since_wall_s: float
    ended_wall_s: float | None  #: null: it is active
    acknowledged_by: str  #: empty: by nobody
    shelved_until_wall_s: float | None  #: null: it is not


class AcknowledgeAlarm(Strict):
    """A person has seen it."""

    command: Literal["acknowledge"] = "acknowledge"
    alarm: AlarmName
    since_wall_s: Annotated[float, Field(allow_inf_nan=False)] | None = None  #: of what was shown; null: as it is now
    comment: Annotated[str, Field(max_length=1000)] = ""


class ShelveAlarm(Strict):
    """Out of the way for a while: it is listed as shelved, comes back by itself, and never acts on the line."""

    command: Literal["shelve"] = "shelve"
    alarm: AlarmName
    for_s: Annotated[float, Field(ge=0.0, le=LONGEST_SHELVED_S)]  #: 0: back at once
    because: Annotated[str, Field(min_length=1, max_length=1000)]


AlarmSaid = AcknowledgeAlarm | ShelveAlarm
ALARM_SAID: TypeAdapter[AlarmSaid] = TypeAdapter(Annotated[AlarmSaid, Field(discriminator="command")])

"""What the recorder noted after a fault, and what that says of the loop's reaction. Pure."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sim_plant.recording import Event
from tests.bench.faults_rows import Row

ENABLE = 0x0F  #: controlword of a drive that follows its torque
TOLD = ("command", "nmt", "quick stop")  #: causes of a state change that are somebody's will
AT_ONCE_S = 1e-6
COUNT_NM = 0.061  #: a thousandth of rated torque, in which the drives are commanded


@dataclass(frozen=True, slots=True)
class Injection:
    """What came of one fault. Times in s from the injection; None: it did not happen."""

    row: str
    variant: str
    reaction: str  #: held, stop, or nothing
    detected_s: float | None
    met_s: float | None  #: from the first period that met the fault
    torque_off_s: float | None
    unsafe: dict[str, int]
    note: str = ""


@dataclass(frozen=True)
class Seen:
    """What the recorder noted since a fault, and what was before it. Times in s, on the line's clock."""

    events: list[Event]
    before: dict[int, Event]  #: the last command of each drive
    speed_before_m_per_s: float
    reach_nm: float  #: by which unloading moves a torque in a period
    period_s: float
    held_s: list[float] | None = None  #: periods in which the loop says that it held; None: nobody asked it

    def stop_s(self) -> float | None:
        """The first command that takes speed or torque away."""
        told_s = [event["time_s"] for event in self.events if self._takes_away(event)]
        unloading_s = self._unloading_s()
        return min([*told_s, *([] if unloading_s is None else [unloading_s])], default=None)

    def _takes_away(self, event: Event) -> bool:
        match event["kind"]:
            case "plc_command":
                return not event["run"] or event["speed_request_m_per_s"] < self.speed_before_m_per_s
            case "command":
                return event["controlword"] & 0x0F != ENABLE
            case "drive_state":
                return event["cause"] in TOLD and event["state"] != "OPERATION_ENABLED"
            case _:
                return False

    def _unloading_s(self) -> float | None:
        """When all torques that are commanded together went down by just what unloading takes in a period."""
        last = {roller: abs(event["target_torque_nm"]) for roller, event in self.before.items()}
        for time_s, commands in together(self.events, 0.5 * self.period_s):
            now = {event["roller"]: abs(event["target_torque_nm"]) for event in commands}
            missing_nm = [abs(now[roller] - max(last.get(roller, np.inf) - self.reach_nm, 0.0)) for roller in now]
            if len(now) > 1 and max(missing_nm) < COUNT_NM and any(last[roller] for roller in now):
                return time_s
            last |= now
        return None

    def ceased_s(self) -> float | None:
        """When the first command was due that did not come, where the watchdogs of all drives had to act."""
        tripped = {event["roller"] for event in self.events if event.get("cause") == "watchdog"}
        if tripped != set(self.before):
            return None
        last = dict(self.before) | {event["roller"]: event for event in self.events if event["kind"] == "command"}
        return min((last[roller]["time_s"] + self.period_s for roller in tripped), default=None)

    def hold_s(self) -> float | None:
        """When all torques were commanded again as before, in a period in which the loop says that it held them."""
        last = {roller: event["target_torque_nm"] for roller, event in self.before.items()}
        for time_s, commands in together(self.events, 0.5 * self.period_s):
            same = all(last.get(event["roller"]) == event["target_torque_nm"] for event in commands)
            if same and self._said_so(time_s):
                return time_s
            last |= {event["roller"]: event["target_torque_nm"] for event in commands}
        return None

    def _said_so(self, time_s: float) -> bool:
        return self.held_s is None or any(-AT_ONCE_S <= time_s - at_s < self.period_s for at_s in self.held_s)


def together(events: list[Event], within_s: float) -> Iterator[tuple[float, list[Event]]]:
    """Commands of one period: one for each drive, so soon after the first of them."""
    batch: list[Event] = []
    for event in events:
        if event["kind"] != "command":
            continue
        again = event["roller"] in {before["roller"] for before in batch}
        if again or (batch and event["time_s"] > batch[0]["time_s"] + within_s):
            yield batch[0]["time_s"], batch
            batch = []
        batch.append(event)
    if batch:
        yield batch[0]["time_s"], batch


def unsafe_of(events: list[Event], row: Row) -> dict[str, int]:
    found = [event["what"] for event in events if event["kind"] == "unsafe"]
    spared = {"tension-band"} if row.harms_web else set()
    return {what: found.count(what) for what in dict.fromkeys(found) if what not in spared}

"""The drill of the watchdogs: at rest their feed is withheld, and every device must be seen to take torque away.

Drives first, ready and without torque, then the line PLC, asked for transport at no speed, without which many a PLC
watches nothing. A device that has its deadline and ignores it is found by that, whatever it stores, and one that only
warns: of a drive its statusword counts, which has to bar the power stage, and of a line PLC that transport has ended.
What a device was seen to be before its feed was withheld counts for neither. Who shares a feed is not fed together.
Afterwards the devices are as after a fault: an arming resets them.

A reaction has to be seen within the deadline and `ROOM_PERIODS`. Every wire brings the status of a device once a
period, sampled at its beginning: that is one period at most until it is sampled and one until it is in; the third is
for an answer that is lost, or for the SDO transfer by which a CANopen drive is asked that has left operational.
"""

from enum import Enum, auto
from math import nan

import numpy as np

from drivers.port import Link
from gateway.core.line import Line
from gateway.core.signals import BoolArray, DriveCondition, DriveState, Inputs
from gateway.core.wiring_proof import WatchdogProved
from safety.actions import Action, Finding, found

READY_S = 3.0  #: for the drives to become ready
ROOM_PERIODS = 3  #: of the loop, beyond its deadline, for a reaction to be seen
RUN_S = 2.0  #: for a line PLC to say that transport is on
DONE = "every watchdog reacts"
BARRED = "commands withheld: its statusword said fault, or switch on disabled"
ENDED = "commands withheld: transport ended by itself"
NO_WATCHDOG = "nothing can be withheld on its link: no watchdog was seen"


class Stage(Enum):
    READY = auto()  #: the drives become ready, the line PLC warns
    DRIVES = auto()  #: are not fed
    TRANSPORT = auto()  #: the line PLC is asked for it
    PLC = auto()  #: is not fed
    OVER = auto()


class Drill:
    """Of a line's `links`. `watchdogs` is what the last one that came to its end has shown, empty before."""

    def __init__(self, line: Line, links: list[Link]) -> None:
        self._line = line
        self._links = links
        self.watchdogs: list[WatchdogProved] = []
        self.findings: list[Finding] = []
        self.stage = Stage.OVER
        self._begun_s = self._since_s = 0.0
        self._reacted_s = np.full(line.n, nan)  #: from the last command, per drive
        self._plc_reacted_s = nan
        self._warned = np.zeros(line.n, dtype=np.bool_)  #: drives (n,) that said something while they were not fed
        self._plc_warned = False
        self._transport = False  #: the line PLC has said that it is on

    @property
    def runs(self) -> bool:
        """Whether the line PLC is asked for transport, at no speed."""
        return self.stage in (Stage.TRANSPORT, Stage.PLC)

    @property
    def resets(self) -> bool:
        """Whether drives in fault are to be reset: many a line PLC gives transport only where no drive is in fault."""
        return self.stage in (Stage.READY, Stage.TRANSPORT)

    @property
    def room_s(self) -> float:
        """From the last command, within which a reaction has to be seen."""
        return self._line.limits.watchdog_s + ROOM_PERIODS * self._line.control.period_s

    def begin(self, now_s: float) -> None:
        """The links are prepared, and the line is at rest."""
        self.watchdogs, self.findings = [], []
        self._begun_s = now_s
        self._reacted_s = np.full(self._line.n, nan)
        self._plc_reacted_s, self._transport = nan, False
        self._warned[:], self._plc_warned = False, False
        self._enter(Stage.READY, now_s)

    def forget(self) -> None:
        """A device was exchanged: what was drilled is not what is there now."""
        self.watchdogs = []

    def end(self) -> None:
        """Feed all again, however it has ended."""
        self.stage = Stage.OVER
        for link in self._links:
            link.withhold(frozenset())

    def ending(self) -> str:
        """That it is over, in words; empty while it goes on."""
        if self.stage is not Stage.OVER:
            return ""
        return "; ".join(each.text for each in self.findings) or DONE

    def step(self, inputs: Inputs, not_ready: str, now_s: float) -> None:
        """Once a period. `not_ready`: drives that are not ready, in words."""
        if inputs.plc.local:
            self._give_up([found("line-local", Action.NONE)], now_s)
            return
        elapsed_s = now_s - self._since_s
        match self.stage:
            case Stage.READY:
                self._wait_for_drives(not_ready, elapsed_s, now_s)
            case Stage.DRIVES:
                self._watch_drives(inputs, elapsed_s, now_s)
            case Stage.TRANSPORT:
                self._wait_for_transport(inputs, elapsed_s, now_s)
            case Stage.PLC:
                self._watch_plc(inputs, elapsed_s, now_s)
            case Stage.OVER:
                pass

    def _wait_for_drives(self, not_ready: str, elapsed_s: float, now_s: float) -> None:
        if not_ready and elapsed_s > READY_S:
            self._give_up([found("drives-not-ready", Action.NONE, drives=not_ready, waited_s=READY_S)], now_s)
        elif not not_ready and now_s - self._begun_s >= self._line.stages.start_warning_s:
            self._enter(Stage.DRIVES if self._awaited().any() else Stage.TRANSPORT, now_s)

    def _awaited(self) -> BoolArray:
        """Drives (n,) that have a watchdog and have not reacted yet."""
        watched = self._watched()
        has = np.zeros(self._line.n, dtype=bool)
        for drive in self._line.drives:
            has[drive.roller - 1] = drive.name in watched
        return has & np.isnan(self._reacted_s)

    def _watched(self) -> frozenset[str]:
        return frozenset(name for link in self._links for name in link.watched)

    def _watch_drives(self, inputs: Inputs, elapsed_s: float, now_s: float) -> None:
        """Of each its power stage. That the driver counts it as in fault may come of a message that bars nothing."""
        in_time = elapsed_s <= self.room_s
        if in_time:
            self._reacted_s[inputs.power_barred & np.isnan(self._reacted_s)] = elapsed_s
        self._warned |= (inputs.drive_state == DriveState.FAULT) | (inputs.drive_condition & DriveCondition.WARNS != 0)
        if not in_time or not self._awaited().any():
            self._enter(Stage.TRANSPORT, now_s)

    def _wait_for_transport(self, inputs: Inputs, elapsed_s: float, now_s: float) -> None:
        if self._line.plc.name not in self._watched():
            self._conclude(now_s)
        elif self._is_new(inputs) and inputs.plc.running:
            self._transport = True
            self._enter(Stage.PLC, now_s)
        elif elapsed_s > RUN_S:
            self._conclude(now_s)

    def _watch_plc(self, inputs: Inputs, elapsed_s: float, now_s: float) -> None:
        """That it says that its watchdog has fired moves nothing: transport has to end."""
        in_time = elapsed_s <= self.room_s
        if self._is_new(inputs):
            self._plc_warned |= inputs.plc.tripped
            if in_time and not inputs.plc.running:
                self._plc_reacted_s = elapsed_s
        if not in_time or not np.isnan(self._plc_reacted_s):
            self._conclude(now_s)

    def _is_new(self, inputs: Inputs) -> bool:
        """Whether the line PLC has said it since this stage began."""
        return inputs.plc.time_s > self._since_s

    def _enter(self, stage: Stage, now_s: float) -> None:
        self.stage, self._since_s = stage, now_s
        names: frozenset[str] = frozenset()
        if stage is Stage.DRIVES:
            names = frozenset(drive.name for drive in self._line.drives)
        elif stage is Stage.PLC:
            names = frozenset([self._line.plc.name])
        for link in self._links:
            link.withhold(names)

    def _give_up(self, findings: list[Finding], now_s: float) -> None:
        self.findings = findings
        self._enter(Stage.OVER, now_s)

    def _conclude(self, now_s: float) -> None:
        seen = {drive.name: (float(self._reacted_s[drive.roller - 1]), BARRED) for drive in self._line.drives}
        seen[self._line.plc.name] = self._plc_reacted_s, ENDED
        watched, findings, deadline_s = self._watched(), list[Finding](), self._line.limits.watchdog_s
        proved: list[WatchdogProved] = []
        for name, (reacted_s, how) in seen.items():
            if name not in watched:
                proved.append(WatchdogProved(device=name, deadline_s=deadline_s, reacted_s=None, how=NO_WATCHDOG))
            elif np.isnan(reacted_s):
                findings.append(self._finding_against(name))
            else:
                proved.append(WatchdogProved(device=name, deadline_s=deadline_s, reacted_s=reacted_s, how=how))
        self.watchdogs = [] if findings else proved
        self._give_up(findings, now_s)

    def _finding_against(self, name: str) -> Finding:
        """What a device that has not reacted did instead."""
        is_plc = name == self._line.plc.name
        if is_plc and not self._transport:
            return found("transport-not-seen", Action.NONE, device=name, waited_s=RUN_S)
        if is_plc:
            code = "watchdog-keeps-transport" if self._plc_warned else "watchdog-ignored"
        else:
            warned = any(self._warned[drive.roller - 1] for drive in self._line.drives if drive.name == name)
            code = "watchdog-only-warns" if warned else "watchdog-ignored"
        deadline_s = self._line.limits.watchdog_s
        return found(code, Action.NONE, device=name, deadline_s=deadline_s, waited_s=self.room_s)

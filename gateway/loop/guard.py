"""The monitor of `safety` in the loop: what it must be told each period, and what it says of the law in service."""

import numpy as np

from gateway.control.engagement import memory
from gateway.control.flight import newest_first
from gateway.control.law import Measured
from gateway.core.line import Line
from gateway.core.signals import FloatArray
from gateway.loop.configurations import Configuration, Configurations
from gateway.loop.torque import TorquePath
from safety.actions import Finding
from safety.monitor import MonitorState, look, monitor_limits, recoverable

MOST_IN_FLIGHT = 12  #: periods that a torque takes to act, at most: a latency of 0.1 s at 10 ms, and a lag


class Guard:
    def __init__(self, line: Line) -> None:
        self._limits = monitor_limits(line)
        self._state = MonitorState()
        self._watched: Configuration | None = None  #: that `_state` belongs to
        self._sent_nm: FloatArray = np.zeros((MOST_IN_FLIGHT, line.n))  #: newest first

    def begin(self, torque_nm: FloatArray) -> None:
        """`torque_nm` (n,) has been sent for as long as anything is in flight."""
        self._sent_nm = np.tile(torque_nm, (MOST_IN_FLIGHT, 1))

    def off(self) -> None:
        """Control is off: what was seen does not count any more."""
        self._watched = None

    def sent(self, torque_nm: FloatArray) -> None:
        """Every period: what was sent (n,)."""
        self._sent_nm = newest_first(self._sent_nm, torque_nm)

    def against(
        self,
        configurations: Configurations,
        path: TorquePath,
        measured: Measured,
        setpoint_n: FloatArray,
        found: tuple[FloatArray, bool],
    ) -> list[Finding]:
        """What speaks against going on with the law in service, which wants to send `found` and was cut or not.

        Chattering and torques that are cut speak against a law on probation only: the last known good one is doubted
        for them (`watch`), not stopped.
        """
        torque_nm, cut = found
        running = configurations.running
        if running is not self._watched:
            self._watched, self._state = running, MonitorState()
        findings: list[Finding] = []
        if configurations.probation is not None:
            findings = look(self._limits, self._state, torque_nm, cut)
        recovery = running.recovery
        if recovery is not None:
            remembered = memory(path.state) if recovery.fallback == running.hash else None
            findings += recoverable(recovery, measured, setpoint_n, self._sent_nm, torque_nm, remembered)
        return findings

    def foresees(
        self, configurations: Configurations, path: TorquePath, measured: Measured, setpoint_n: FloatArray
    ) -> str:
        """What would come of set-points (n,), and an unwinder's speed, at once; empty: nothing that is not allowed.

        `against` would stop the line for it, or give up the law that runs. Without a prediction nothing is foreseen.
        """
        running = configurations.running
        recovery = running.recovery
        if recovery is None or configurations.probation is not None or path.state is None:
            return ""
        remembered = memory(path.state) if recovery.fallback == running.hash else None
        in_flight, sent = self._sent_nm[1 : 1 + recovery.depth], self._sent_nm[0]
        short = recovery.shortfall_of_step(measured, setpoint_n, in_flight, sent, remembered)
        if short is None:
            return ""
        # Under predictive control it is the linear law behind it that is looked at.
        return str(short) if remembered is None else short.foreseen

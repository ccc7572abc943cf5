"""The monitor of `safety` in the loop: what it must be told each period, and what it says of the law in service."""

from math import ceil

import numpy as np

from gateway.control.engagement import memory
from gateway.control.flight import newest_first
from gateway.control.law import Measured
from gateway.core.line import Line
from gateway.core.signals import FloatArray
from gateway.loop.configurations import Configuration, Configurations
from gateway.loop.torque import TorquePath
from safety.actions import Finding
from safety.first_configuration import FirstState, first_limits, look_at_first
from safety.monitor import MonitorState, look, monitor_limits, recoverable
from safety.recoverability import Shortfall

LAG_S = 0.05  #: of the drives, for which there is room from the beginning: as much as the gate lets a model have


class Guard:
    def __init__(self, line: Line) -> None:
        self._limits = monitor_limits(line)
        self._state = MonitorState()
        self._watched: Configuration | None = None  #: that `_state` belongs to
        self._first_limits = first_limits(line)
        self._first_state = FirstState()
        self._first: Configuration | None = None  #: that `_first_state` belongs to
        # In flight: through the latency, the lag, and the period in which a torque is computed.
        periods = 2 + ceil((line.control.latency_s + LAG_S) / line.control.period_s)
        self._sent_nm: FloatArray = np.zeros((periods, line.n))  #: newest first

    def begin(self, torque_nm: FloatArray) -> None:
        """`torque_nm` (n,) has been sent for as long as anything is in flight."""
        self._sent_nm = np.tile(torque_nm, (len(self._sent_nm), 1))

    def off(self) -> None:
        """Control is off: what was seen does not count any more."""
        self._watched = self._first = None

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
            self._remember(recovery.depth + 1)
            remembered = memory(path.state) if recovery.fallback == running.hash else None
            findings += recoverable(recovery, measured, setpoint_n, self._sent_nm, torque_nm, remembered)
        return findings

    def against_first(
        self, running: Configuration, path: TorquePath, measured: Measured, setpoint_n: FloatArray
    ) -> list[Finding]:
        """What speaks against a law that nobody has judged or confirmed yet, from its first period on."""
        if running is not self._first:
            self._first, self._first_state = running, FirstState()
        return look_at_first(
            self._first_limits, self._first_state, measured.tension_n, setpoint_n, path.asked_nm, self._sent_nm[0]
        )

    def foresees(
        self, configurations: Configurations, path: TorquePath, measured: Measured, setpoint_n: FloatArray
    ) -> Shortfall | None:
        """What would come of set-points (n,), and an unwinder's speed, at once; None: nothing that is not allowed.

        `against` would stop the line for it, or give up the law that runs. Without a prediction nothing is foreseen.
        """
        running = configurations.running
        recovery = running.recovery
        if recovery is None or configurations.probation is not None or path.state is None:
            return None
        self._remember(recovery.depth + 1)
        remembered = memory(path.state) if recovery.fallback == running.hash else None
        in_flight, sent = self._sent_nm[1 : 1 + recovery.depth], self._sent_nm[0]
        # Under predictive control it is the linear law behind it that is looked at.
        return recovery.shortfall_of_step(measured, setpoint_n, in_flight, sent, remembered)

    def _remember(self, periods: int) -> None:
        """Keep what was sent for so long: a model may say that it acts later than the line's file does.

        What was forgotten is taken to have been as the oldest that is known.
        """
        missing = periods - len(self._sent_nm)
        if missing > 0:
            self._sent_nm = np.vstack((self._sent_nm, np.tile(self._sent_nm[-1], (missing, 1))))

"""The line PLC: drives the unwinder, gives the permissive, watches the emergency stop and the gateway's life counter.

All times are world time in seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite

from sim_plant.devices.drive import Drive
from sim_plant.recorder import Recorder
from sim_plant.world import World

SERIAL = 0x52550000
_EMERGENCY_STOP = "emergency stop"


@dataclass(frozen=True, slots=True)
class LinePlcStatus:
    permissive: bool
    emergency_stop: bool  #: tripped
    running: bool  #: the unwinder follows the speed request
    watchdog_tripped: bool
    unwind_speed_m_per_s: float  #: v0 as measured
    life_echo: int
    local: bool = False  #: somebody has switched the line to local operation


class LinePlc:
    """`ramp_m_per_s2` is how fast v0 moves (inf: at once). With `drives`, an emergency stop takes their torque off
    safely (STO) after `sto_delay_s`, and its release gives it back, unless a drive has a reason of its own.

    After a loss of the permissive, an emergency stop or a tripped watchdog the unwinder starts again only on a new
    rising edge of the run bit: nothing restarts because a button was released.
    """

    def __init__(
        self,
        world: World,
        recorder: Recorder,
        ramp_m_per_s2: float = inf,
        drives: Sequence[Drive] = (),
        sto_delay_s: float = 0.5,
    ) -> None:
        self.interpolation_s = 0.0  #: in which v0 goes straight to each new request, as fast as its ramp lets it
        self.serial = SERIAL
        self.watchdog_is_dead = False  #: it takes its setting, and never acts on it
        self._frozen: LinePlcStatus | None = None
        self.watchdog_s = 0.0  #: v0 ramps to zero this long after the life counter's last change; 0 is off
        self._world = world
        self._recorder = recorder
        self._ramp_m_per_s2 = ramp_m_per_s2
        self._drives = tuple(drives)
        self._sto_delay_s = sto_delay_s
        self._permissive = True
        self._emergency_stop = False
        self._local = False
        self._warning = False
        self._watchdog_tripped = False
        self._watchdog_only_warns = False
        self._run = False
        self._running = False
        self._request_m_per_s = 0.0
        self._life = 0
        self._watchdog = world.timer(self._watchdog_expired)
        self._sto = world.timer(self._sto_due)

    @property
    def permissive(self) -> bool:
        return self._permissive

    @permissive.setter
    def permissive(self, value: bool) -> None:
        self._permissive = value
        self._recorder.note("permissive", self._world.now_s, active=value)
        self._stop_unless_allowed()

    @property
    def local(self) -> bool:
        """Whether somebody has switched the line to local operation: who works at it starts it there."""
        return self._local

    @local.setter
    def local(self, value: bool) -> None:
        self._local = value
        self._recorder.note("local", self._world.now_s, active=value)

    @property
    def warning(self) -> bool:
        """Whether lamp and horn are on."""
        return self._warning

    def warn(self, on: bool, now_s: float) -> None:
        """Lamp and horn, as the gateway asks for them. A program that stands still does nothing of it."""
        if self._frozen is None and on != self._warning:
            self._warning = on
            self._recorder.note("warning", now_s, active=on)

    @property
    def emergency_stop(self) -> bool:
        """Whether the emergency stop is tripped."""
        return self._emergency_stop

    @emergency_stop.setter
    def emergency_stop(self, value: bool) -> None:
        now_s = self._world.now_s
        self._emergency_stop = value
        self._recorder.note("emergency_stop", now_s, active=value)
        self._stop_unless_allowed()
        self._sto.due_s = now_s + self._sto_delay_s if value else inf
        if not value:
            for drive in self._drives:
                drive.set_sto(False, now_s, _EMERGENCY_STOP)

    def freeze(self, now_s: float) -> None:
        """Its program stands still: it shows what it shows now, and does nothing of what it is told."""
        self._frozen = self.status(now_s)
        self._watchdog.due_s = inf

    def thaw(self, now_s: float) -> None:
        """Its program goes on; its watchdog counts from the next change of the life counter."""
        self._world.advance(now_s)
        self._frozen = None

    def only_warn(self, only: bool) -> None:
        """When its watchdog fires it says so, and transport goes on; or transport ends again."""
        self._watchdog_only_warns = only

    def command(self, run: bool, speed_request_m_per_s: float, life: int, now_s: float) -> None:
        """What the gateway asks for. Raises ValueError when the speed is not finite."""
        if not isfinite(speed_request_m_per_s):
            raise ValueError(f"the speed request must be finite, got {speed_request_m_per_s}")
        self._world.advance(now_s)
        if self._frozen is not None:
            return
        if (run, speed_request_m_per_s) != (self._run, self._request_m_per_s):
            self._recorder.note("plc_command", now_s, run=run, speed_request_m_per_s=speed_request_m_per_s)
        started = run and not self._run
        alive = life != self._life or started
        self._run, self._life = run, life
        if started:
            self._watchdog_tripped = False
            self._running = self._allowed()
        if not run:
            self._running = False
            self._watchdog.due_s = inf
        elif alive:
            self._watchdog.due_s = now_s + self.watchdog_s if self.watchdog_s > 0.0 else inf
        self._request_m_per_s = speed_request_m_per_s
        self._drive_unwinder()

    def status(self, now_s: float) -> LinePlcStatus:
        self._world.advance(now_s)
        if self._frozen is not None:
            return self._frozen
        return LinePlcStatus(
            self._permissive,
            self._emergency_stop,
            self._running,
            self._watchdog_tripped,
            self._world.measure_unwind_speed_m_per_s(),
            self._life,
            self._local,
        )

    def poll(self, now_s: float) -> None:
        """Let time pass: the watchdog acts at its own time, however late this is called."""
        self._world.advance(now_s)

    def _allowed(self) -> bool:
        return self._permissive and not self._emergency_stop and not self._watchdog_tripped

    def _stop_unless_allowed(self) -> None:
        if not self._allowed():
            self._running = False
            self._drive_unwinder()

    def _drive_unwinder(self) -> None:
        target = self._request_m_per_s if self._running else 0.0
        rate = self._ramp_m_per_s2
        if self.interpolation_s > 0.0 and self._running:
            rate = min(rate, abs(target - self._world.unwind_speed_m_per_s) / self.interpolation_s)
        self._world.ramp_unwind_speed(target, rate)

    def _watchdog_expired(self, now_s: float) -> None:
        if self.watchdog_is_dead:
            return
        self._watchdog_tripped = True
        if self._watchdog_only_warns:
            return
        self._recorder.note("plc_watchdog", now_s, watchdog_s=self.watchdog_s)
        self._stop_unless_allowed()

    def _sto_due(self, now_s: float) -> None:
        for drive in self._drives:
            drive.set_sto(True, now_s, _EMERGENCY_STOP)

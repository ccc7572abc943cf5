"""A torque drive of one roller: CiA 402 machine, command latch, communication watchdog, quick stop, STO.

All times are world time in seconds. Bytes, object numbers and NMT belong to the faces.
"""

from collections.abc import Callable
from math import inf, isfinite
from typing import NamedTuple

from sim_plant.devices import cia402
from sim_plant.devices.cia402 import Machine, State
from sim_plant.devices.misreading import Misreading
from sim_plant.recorder import Recorder
from sim_plant.world import World

WATCHDOG_ERROR = 0x8250  #: RPDO deadline missed
QUICK_STOP_TIME_S = 0.1  #: the quick stop ramp takes this long from rated torque to zero


class DriveSample(NamedTuple):
    """What the drive tells at a SYNC."""

    statusword: int
    speed_m_per_s: float
    torque_nm: float


class _Command(NamedTuple):
    controlword: int
    target_torque_nm: float
    mode: int


class Drive:
    """The drive of roller `index` + 1 (`index` counts from 0, as the arrays of the world do)."""

    def __init__(
        self,
        index: int,
        world: World,
        recorder: Recorder,
        rated_torque_nm: float,
        max_torque_nm: float,
        torque_rate_nm_per_s: float = inf,
    ) -> None:
        self.index = index
        self.rated_torque_nm = rated_torque_nm
        self.max_torque_nm = max_torque_nm
        self.error_code = 0  #: 603Fh; 0 is no fault
        self.watchdog_s = 0.0  #: torque goes off this long after the last command; 0 is off. Acts from the next command
        self.watchdog_is_dead = False  #: a drive that takes the setting, and never acts on it
        self.encoder = Misreading()
        self.on_emergency: Callable[[int], None] | None = None  #: told the code of each fault, and 0 when it is cleared
        self._world = world
        self._recorder = recorder
        self._torque_rate_nm_per_s = torque_rate_nm_per_s
        self._machine = Machine()
        self._mode = 0
        self._limited = False
        self._sto: set[str] = set()  #: who demands that the torque is safely off
        self._operational = False
        self._staged: _Command | None = None
        self._watchdog = world.timer(self._watchdog_expired)
        self._quick_stop = world.timer(self._quick_stop_done)

    @property
    def state(self) -> State:
        return self._machine.state

    @property
    def mode(self) -> int:
        """Mode in effect (6061h)."""
        return self._mode

    @property
    def sto(self) -> bool:
        """Whether the torque is safely off (60FDh bit 16)."""
        return bool(self._sto)

    @property
    def operational(self) -> bool:
        """Whether the node is in NMT operational; only then commands are taken and the watchdog watches."""
        return self._operational

    @operational.setter
    def operational(self, value: bool) -> None:
        if value == self._operational:
            return
        self._operational = value
        self._forget_command()
        if not value:
            self._enter(cia402.without_power(self._machine), "nmt", self._world.now_s)

    def lose_power(self, now_s: float) -> None:
        """The supply fails for an instant, which nobody has told the drive: it is no longer operational."""
        self._world.advance(now_s)
        self._operational = False
        self._forget_command()
        self._enter(cia402.without_power(self._machine), "restart", now_s)

    def receive(
        self, controlword: int, target_torque_nm: float, mode: int, now_s: float, *, alive: bool = True
    ) -> None:
        """Stage a command for the next `sync`; one that is not `alive` does not renew the watchdog.

        Raises ValueError when the target is not finite.
        """
        if not isfinite(target_torque_nm):
            raise ValueError(f"target torque of drive {self.index + 1} must be finite, got {target_torque_nm}")
        self._world.advance(now_s)
        self._recorder.command(self.index, controlword, target_torque_nm, mode, now_s)
        if not self._operational:
            return
        self._staged = _Command(controlword, target_torque_nm, mode)
        if alive:
            self._watchdog.due_s = now_s + self.watchdog_s if self.watchdog_s > 0.0 else inf

    def sync(self, now_s: float) -> DriveSample:
        """Let what is staged act from now on, then sample."""
        self.act(now_s)
        return self.sample(now_s)

    def act(self, now_s: float) -> None:
        """Let what is staged act from now on."""
        self._world.advance(now_s)
        command, self._staged = self._staged, None
        if command is not None:
            self._latch(command, now_s)
        self._recorder.synced(self.index, self._world.torque_command_nm(self.index), now_s)

    def sample(self, now_s: float) -> DriveSample:
        """What the drive shows now. To the recorder it is not there: only a command is."""
        self._world.advance(now_s)
        return DriveSample(
            self.statusword,
            self.encoder.shown(self._world.measure_speed_m_per_s(self.index), self._world.steps),
            float(self._world.torque_nm[self.index]),
        )

    @property
    def statusword(self) -> int:
        enabled = self.state is State.OPERATION_ENABLED
        word = int(self.state) | cia402.MAKERS_OWN
        word |= 0 if self._sto else cia402.VOLTAGE_ENABLED
        word |= cia402.REMOTE if self._operational else 0
        word |= cia402.INTERNAL_LIMIT if enabled and self._limited else 0
        word |= cia402.FOLLOWS_COMMAND if enabled and self._mode == cia402.CYCLIC_SYNCHRONOUS_TORQUE else 0
        return word

    def poll(self, now_s: float) -> None:
        """Let time pass: watchdog and quick stop act at their own times, however late this is called."""
        self._world.advance(now_s)

    def fault(self, code: int, now_s: float) -> None:
        """An internal fault (code as in 603Fh): torque off at once, FAULT until it is reset."""
        self._world.advance(now_s)
        self._fail(code, "fault", now_s)

    def freeze_speed(self) -> None:
        """The encoder stays at the speed that it shows next, until `heal_speed`."""
        self.encoder.stick()

    def jump_speed(self, delta_m_per_s: float) -> None:
        """The encoder is off by this from now on, until `heal_speed`."""
        self.encoder.offset(delta_m_per_s, 0.0, self._world.steps)

    def heal_speed(self) -> None:
        """The encoder shows the speed again."""
        self.encoder.heal()

    def set_sto(self, active: bool, now_s: float, source: str = "drive") -> None:
        """The safe torque off input. It is active as long as one `source` (contact of its circuit) demands it.

        Released, the drive stays in SWITCH ON DISABLED until it is told otherwise.
        """
        self._world.advance(now_s)
        before = self.sto
        if active:
            self._sto.add(source)
        else:
            self._sto.discard(source)
        if self.sto != before:
            self._recorder.note("sto", now_s, roller=self.index + 1, active=self.sto)
        if active:
            self._enter(cia402.without_power(self._machine), "sto", now_s)

    def _forget_command(self) -> None:
        self._staged = None
        self._watchdog.due_s = inf

    def _latch(self, command: _Command, now_s: float) -> None:
        step = cia402.step_without_power if self._sto else cia402.step
        self._mode = command.mode
        self._enter(step(self._machine, command.controlword), "command", now_s)
        if self.state is not State.OPERATION_ENABLED:
            return
        wanted = command.target_torque_nm if command.mode == cia402.CYCLIC_SYNCHRONOUS_TORQUE else 0.0
        possible = max(-self.max_torque_nm, min(self.max_torque_nm, wanted))
        self._limited = possible != wanted
        self._world.ramp_torque_nm(self.index, possible, self._torque_rate_nm_per_s)

    def _enter(self, machine: Machine, cause: str, now_s: float) -> None:
        """Go to a state, with what entering it means for the torque."""
        before, self._machine = self.state, machine
        if machine.state is before:
            return
        self._quick_stop.due_s = inf
        if machine.state is State.QUICK_STOP_ACTIVE:
            self._begin_quick_stop(now_s)
        else:
            self._world.set_torque_nm(self.index, 0.0)
        self._recorder.drive_state(self.index, machine.state.name, cause, now_s)
        if before is State.FAULT:
            self.error_code = 0
            self._tell_emergency(0)

    def _begin_quick_stop(self, now_s: float) -> None:
        rate = self.rated_torque_nm / QUICK_STOP_TIME_S
        self._world.ramp_torque_nm(self.index, 0.0, rate)
        self._quick_stop.due_s = now_s + abs(self._world.torque_underway_nm(self.index)) / rate

    def _quick_stop_done(self, now_s: float) -> None:
        self._enter(cia402.quick_stop_done(self._machine), "quick stop", now_s)

    def _watchdog_expired(self, now_s: float) -> None:
        # In FAULT there is no torque to take off, and the code of the first fault says what went wrong.
        if self.watchdog_is_dead or self.state is State.FAULT:
            return
        self._recorder.note("watchdog", now_s, roller=self.index + 1, watchdog_s=self.watchdog_s)
        self._fail(WATCHDOG_ERROR, "watchdog", now_s)

    def _fail(self, code: int, cause: str, now_s: float) -> None:
        self._recorder.note("fault", now_s, roller=self.index + 1, code=code)
        self.error_code = code
        self._enter(cia402.faulted(self._machine), cause, now_s)
        self._tell_emergency(code)

    def _tell_emergency(self, code: int) -> None:
        if self.on_emergency is not None:
            self.on_emergency(code)

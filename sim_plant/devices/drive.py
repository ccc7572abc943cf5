"""A torque drive of one roller: CiA 402 machine, command latch, communication watchdog, quick stop, STO.

All times are world time in seconds. Bytes, object numbers and NMT belong to the faces.
"""

from collections.abc import Callable
from math import inf, isfinite
from typing import NamedTuple

from sim_plant.devices import cia402
from sim_plant.devices.cia402 import Machine, State
from sim_plant.devices.misreading import Misreading
from sim_plant.devices.shortcomings import Shortcomings
from sim_plant.recorder import Recorder
from sim_plant.world import World

WATCHDOG_ERROR = 0x8250  #: RPDO deadline missed
WATCHDOG_REGISTER = 0x11  #: 1001h with it: generic error, communication error
FIRST_SERIAL = 0x52530001  #: of roller 1, on Modbus and OPC UA
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
        self.serial = FIRST_SERIAL + index
        self.rated_torque_nm = rated_torque_nm
        self.max_torque_nm = max_torque_nm
        self.error_code = 0  #: 603Fh; 0 is no fault
        self.watchdog_s = 0.0  #: torque goes off this long after the last command; 0 is off. Acts from the next command
        self.watchdog_is_dead = False  #: a drive that takes the setting, and never acts on it
        self.encoder = Misreading()
        #: Told error code and error register of each warning, and 0, 0 when it is over.
        self.on_warning: Callable[[int, int], None] | None = None
        self.on_emergency: Callable[[int], None] | None = None  #: told the code of each fault, and 0 when it is cleared
        self._world = world
        self._recorder = recorder
        self._torque_rate_nm_per_s = torque_rate_nm_per_s
        self._machine = Machine()
        self._mode = 0
        self._limited = False
        self._short = Shortcomings()
        self._watchdog_only_warns = False
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
        return self._mode if self._short.lost_to_mode is None else self._short.lost_to_mode

    @property
    def shown_code(self) -> int:
        """The error code of its fault, or of what it warns of; 0 without."""
        return self.error_code or (self._short.warning[0] if self._short.warning else 0)

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
            self._short.direction
            * self.encoder.shown(self._world.measure_speed_m_per_s(self.index), self._world.steps),
            self._short.direction * float(self._world.torque_nm[self.index]),
        )

    @property
    def statusword(self) -> int:
        enabled = self.state is State.OPERATION_ENABLED
        word = int(self.state) | cia402.MAKERS_OWN
        word |= 0 if self._sto or self._short.unpowered else cia402.VOLTAGE_ENABLED
        word |= cia402.WARNING if self._short.warning else 0
        word |= cia402.REMOTE if self._operational else 0
        word |= cia402.INTERNAL_LIMIT if enabled and self._limited else 0
        follows = self.mode == cia402.CYCLIC_SYNCHRONOUS_TORQUE or self._short.says_follows
        word |= cia402.FOLLOWS_COMMAND if enabled and follows else 0
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

    def turn_encoder(self) -> None:
        """The encoder shows the speed with the wrong sign, until `heal_speed`."""
        self.encoder.scale(-1.0)

    def reverse(self, reverse: bool) -> None:
        """The motor turns the roller backwards, or forwards again, from the next command on."""
        self._short.direction = -1.0 if reverse else 1.0

    def heal_speed(self) -> None:
        """The encoder shows the speed again."""
        self.encoder.heal()

    def give_share(self, share: float) -> None:
        """From the next command on it gives so much of the torque that it is asked for, within its greatest torque."""
        self._short.torque_share = share

    def lose_mode(self, mode: int, now_s: float, *, says_follows: bool) -> None:
        """It leaves the mode that it was told for `mode`, and gives no torque.

        `says_follows`: its statusword (bit 12) says all the same that it follows its target torque.
        """
        self._world.advance(now_s)
        self._short.lost_to_mode, self._short.says_follows = mode, says_follows
        self._world.set_torque_nm(self.index, 0.0)

    def regain_mode(self) -> None:
        """It is in the mode again that it was told, and follows the next command."""
        self._short.lost_to_mode, self._short.says_follows = None, False

    def set_powered(self, powered: bool, now_s: float) -> None:
        """The supply of the power stage: without it nothing leaves READY TO SWITCH ON, and torque is off."""
        self._world.advance(now_s)
        self._short.unpowered = not powered
        if not powered and self.state in (State.SWITCHED_ON, State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE):
            self._enter(cia402.without_power(self._machine), "power", now_s)

    def warn(self, code: int, register: int) -> None:
        """It warns of something and goes on; code 0 takes that back."""
        self._short.warning = (code, register) if code else None
        if self.on_warning is not None:
            self.on_warning(code, register)

    def only_warn(self, only: bool) -> None:
        """When its watchdog fires it warns, and its state stays as it is; or it goes to fault again."""
        self._watchdog_only_warns = only
        if not only:
            self.warn(0, 0)

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
        after = step(self._machine, command.controlword)
        if self._short.unpowered and after.state in (State.SWITCHED_ON, State.OPERATION_ENABLED):
            after = Machine(self.state, command.controlword)  # it takes power to go there
        self._enter(after, "command", now_s)
        if self.state is not State.OPERATION_ENABLED:
            return
        wanted = command.target_torque_nm if self.mode == cia402.CYCLIC_SYNCHRONOUS_TORQUE else 0.0
        self._limited = abs(wanted) > self.max_torque_nm
        wanted *= self._short.torque_share * self._short.direction
        possible = max(-self.max_torque_nm, min(self.max_torque_nm, wanted))
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
        if self._watchdog_only_warns:
            self.warn(WATCHDOG_ERROR, WATCHDOG_REGISTER)
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

"""The power stage of a CiA 402 drive as the gateway knows and commands it, whatever carries the words. No I/O."""

from drivers.cia402 import DISABLE_VOLTAGE, QUICK_STOP, PowerState, controlword, drive_state, power_state
from drivers.map_fields import Bit
from gateway.core.signals import DriveRequest, DriveState

ORDERS_IGNORED = 5  #: orders to take torque off, in a row, until an enabled drive counts as disobedient


class PowerStage:
    """`follows_command` is the statusword's bit that says that the target torque is followed, where there is one."""

    def __init__(self, follows_command: Bit | None) -> None:
        self.power: PowerState | None = None  #: None: it has not said
        self.safe_torque_off = False
        self._follows_command = follows_command
        self._follows = False
        self._controlword = DISABLE_VOLTAGE
        self._request = int(DriveRequest.OFF)
        self._ignored = 0  #: orders to take torque off, in a row, to a drive that says it is enabled

    def on_statusword(self, statusword: int, safe_torque_off: bool | None) -> None:
        """What it says now; `safe_torque_off` is None where that is not told with the statusword."""
        self.power = power_state(statusword)
        bit = self._follows_command
        self._follows = bit is None or bit.is_set(statusword)
        if safe_torque_off is not None:
            self.safe_torque_off = safe_torque_off
        elif self.power is not PowerState.SWITCH_ON_DISABLED:
            self.safe_torque_off = False  # what was told before is over

    @property
    def state(self) -> DriveState:
        if self.power is None:
            return DriveState.OFF
        if self.safe_torque_off and self.power is PowerState.SWITCH_ON_DISABLED:
            return DriveState.STO
        if self.power is PowerState.OPERATION_ENABLED and not self._follows:
            return DriveState.READY  # no torque, whatever is commanded
        return drive_state(self.power)

    @property
    def gives_torque(self) -> bool:
        """Whether it may give torque now, as it says or as it is asked."""
        return self._request == DriveRequest.ENABLE or self.power is PowerState.OPERATION_ENABLED

    @property
    def fault_was_reset(self) -> bool:
        """Whether a reset was asked for and it is in no fault now."""
        in_fault = self.power is not None and drive_state(self.power) == DriveState.FAULT
        return self._request == DriveRequest.RESET_FAULT and not in_fault

    @property
    def disobeys(self) -> bool:
        """Whether it was told to take torque off and has not: only its watchdog, unfed, can stop it."""
        return self._ignored > ORDERS_IGNORED

    def command(self, request: int, torque_nm: float, state: DriveState, trusted: bool) -> tuple[int, float]:
        """Controlword and torque (Nm) towards `request`; `state` is what the whole drive counts as.

        A drive that is not trusted, or counts as in fault before its statusword shows it, is told to take torque off.
        """
        self._request = request
        in_fault = state == DriveState.FAULT and request != DriveRequest.RESET_FAULT
        if not trusted or in_fault or self.power is None:
            self._controlword = DISABLE_VOLTAGE
        else:
            self._controlword = controlword(self.power, request, self._controlword)
        # One that ramps down in a quick stop says so: it is not enabled any more.
        ignores = self.power is PowerState.OPERATION_ENABLED and self._controlword in (DISABLE_VOLTAGE, QUICK_STOP)
        self._ignored = self._ignored + 1 if ignores else 0
        follows = state == DriveState.ENABLED and request == DriveRequest.ENABLE
        return self._controlword, torque_nm if follows else 0.0

    def forget(self) -> None:
        """Nothing that it said or was told before counts any more."""
        self.power = None
        self._controlword = DISABLE_VOLTAGE
        self._request = int(DriveRequest.OFF)
        self._ignored = 0

"""The power stage of a CiA 402 drive as the gateway knows and commands it, whatever carries the words. No I/O."""

from drivers.cia402 import DISABLE_VOLTAGE, QUICK_STOP, PowerState, controlword, drive_state, is_barred, power_state
from drivers.map_fields import Bit
from gateway.core.signals import DriveCondition, DriveRequest, DriveState

# An enumeration's member takes as long to look up as several comparisons (Python 3.11), and there are many drives.
_ENABLED_POWER, _ENABLED, _FAULT = PowerState.OPERATION_ENABLED, DriveState.ENABLED, DriveState.FAULT
_ENABLE, _RESET_FAULT = DriveRequest.ENABLE, DriveRequest.RESET_FAULT
_IN_FAULT = (PowerState.FAULT_REACTION, PowerState.FAULT)
_WARNING_BIT, _LIMIT_BIT = 1 << 7, 1 << 11  #: of the statusword (IEC 61800-7-201, 8.4.3)
ORDERS_IGNORED = 5  #: orders to take torque off, in a row, until an enabled drive counts as disobedient


class PowerStage:
    """`follows_command` is the statusword's bit that says that the target torque is followed, `voltage_enabled` the one

    that says that the power stage is supplied, where there is one.
    """

    def __init__(self, follows_command: Bit | None, voltage_enabled: Bit | None = None) -> None:
        self.power: PowerState | None = None  #: None: it has not said
        self.state = DriveState.OFF  #: what it counts as
        self.condition = 0  #: what else its statusword says: a mask of DriveCondition
        self._statusword = -1
        self._voltage_enabled = voltage_enabled
        self._safe_torque_off = False
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
            self._safe_torque_off = safe_torque_off
        elif self.power is not PowerState.SWITCH_ON_DISABLED:
            self._safe_torque_off = False  # what was told before is over
        self.state = self._state_now()
        if statusword != self._statusword:
            self._statusword = statusword
            self.condition = self._condition_now()

    def on_safe_torque_off(self, active: bool) -> None:
        """What it said when asked, where that is not told with the statusword.

        The answer is older than the statusword, and was asked for because it might not switch on: of a drive that
        has gone on meanwhile it says nothing.
        """
        if self.power is None or self.power is PowerState.SWITCH_ON_DISABLED:
            self._safe_torque_off = active
            self.state = self._state_now()

    def _condition_now(self) -> int:
        word, voltage = self._statusword, self._voltage_enabled
        condition = DriveCondition.NONE
        if voltage is not None and not voltage.is_set(word):
            condition |= DriveCondition.NO_POWER
        if word & _LIMIT_BIT:
            condition |= DriveCondition.LIMITED
        if word & _WARNING_BIT:
            condition |= DriveCondition.WARNS
        return int(condition)

    def _state_now(self) -> DriveState:
        if self.power is None:
            return DriveState.OFF
        if self._safe_torque_off and self.power not in _IN_FAULT:
            return DriveState.STO  # no torque, whatever else it says
        if self.power is _ENABLED_POWER and not self._follows:
            return DriveState.READY  # no torque, whatever is commanded
        return drive_state(self.power)

    @property
    def barred(self) -> bool:
        """Whether its last statusword bars the power stage, see `is_barred`; not where safe torque off is why."""
        return not self._safe_torque_off and is_barred(self._statusword)

    @property
    def gives_torque(self) -> bool:
        """Whether it may give torque now, as it says or as it is asked."""
        return self._request == _ENABLE or self.power is _ENABLED_POWER

    @property
    def fault_was_reset(self) -> bool:
        """Whether a reset was asked for and it is in no fault now."""
        return self._request == _RESET_FAULT and self.power not in _IN_FAULT

    @property
    def disobeys(self) -> bool:
        """Whether it was told to take torque off and has not: only its watchdog, unfed, can stop it."""
        return self._ignored > ORDERS_IGNORED

    def command(self, request: int, torque_nm: float, state: DriveState, trusted: bool) -> tuple[int, float]:
        """Controlword and torque (Nm) towards `request`; `state` is what the whole drive counts as.

        A drive that is not trusted, or counts as in fault before its statusword shows it, is told to take torque off.
        """
        self._request = request
        in_fault = state == _FAULT and request != _RESET_FAULT
        if not trusted or in_fault or self.power is None:
            self._controlword = DISABLE_VOLTAGE
        else:
            self._controlword = controlword(self.power, request, self._controlword)
        # One that ramps down in a quick stop says so: it is not enabled any more. The statusword is asked and not
        # `state`, in which a wrong safe torque off flag hides 'operation enabled': such a drive is caught only here.
        ignores = self.power is _ENABLED_POWER and self._controlword in (DISABLE_VOLTAGE, QUICK_STOP)
        self._ignored = self._ignored + 1 if ignores else 0
        follows = state == _ENABLED and request == _ENABLE
        return self._controlword, torque_nm if follows else 0.0

    def forget(self) -> None:
        """Nothing that it said or was told before counts any more."""
        self.power = None
        self.state = DriveState.OFF
        self.condition, self._statusword = 0, -1
        self._controlword = DISABLE_VOLTAGE
        self._request = int(DriveRequest.OFF)
        self._ignored = 0

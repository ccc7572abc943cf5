"""Numbers that several wires of the simulated line show alike."""

from math import isfinite

from sim_plant.devices.line_plc import LinePlcStatus

UM_PER_M = 1e6
RUN_BIT = 1  #: of a line command
WARNING_BIT = 2
COMMAND_BITS = RUN_BIT | WARNING_BIT
PLC_WATCHDOG_MS = range(10, 1001)  #: of the line's command watchdog, beside 0 for off
INT16, INT32 = 0x7FFF, 0x7FFFFFFF


def saturated(value: float, highest: int) -> int:
    """The nearest number that the object can hold: a device shows its range's end, it does not wrap."""
    return max(-highest, min(highest, round(value)))


def speed_word(speed_m_per_s: float) -> int:
    """A speed in um/s, 32 bit."""
    return saturated(speed_m_per_s * UM_PER_M, INT32) if isfinite(speed_m_per_s) else INT32


def torque_word(torque_nm: float, rated_torque_nm: float) -> int:
    """A torque in 1/1000 of rated torque, 16 bit."""
    return saturated(1e3 * torque_nm / rated_torque_nm, INT16)


def status_word(status: LinePlcStatus) -> int:
    """Register 1 of line-plc."""
    return (
        status.permissive
        | (not status.emergency_stop) << 1
        | status.running << 2
        | status.watchdog_tripped << 3
        | status.local << 4
    )  # fmt: skip


def watchdog_allowed(time_ms: int, allowed: range) -> bool:
    """Whether a watchdog may be set to this: 0 is off."""
    return time_ms == 0 or time_ms in allowed

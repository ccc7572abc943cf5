"""What each fault of the table does to the line: which call begins it, and which one ends it."""

from collections.abc import Callable
from typing import Any

from sim_plant.faults.frame_effects import FRAME_FAULTS
from sim_plant.faults.parse import FaultRefused, Injection
from sim_plant.faults.table import FOLLOWS
from sim_plant.faults.targets import (
    FaultyAmplifier,
    FaultyDrive,
    FaultyLine,
    FaultyPlc,
    FaultyWeb,
    Freezable,
    HasWatchdog,
    Warns,
    key_of,
)

End = Callable[[float], dict[str, Any]]  #: ends the fault at a time; tells what is worth noting
Begin = Callable[[float], End | None]  #: does the fault at a time; None when there is nothing to end

_Prepare = Callable[[FaultyLine, Injection], Begin]


def prepare(line: FaultyLine, injection: Injection) -> Begin:
    """What is to be called when the time of a fault has come. Nothing has been done yet.

    Raises FaultRefused for what this line does not have.
    """
    line.check(injection.target)
    name = injection.fault.name
    return _frames(line, injection) if name in FRAME_FAULTS else EFFECTS[name](line, injection)


def _frames(line: FaultyLine, injection: Injection) -> Begin:
    faults, address = line.wire_of(injection.target)
    faults.check(injection)

    def begin(now_s: float) -> End:
        number = faults.begin(injection, address)

        def end(now_s: float) -> dict[str, Any]:
            return {"frames": faults.end(number)}

        return end

    return begin


def _lasting(begin: Callable[[float], object], end: Callable[[float], object]) -> Begin:
    def done(now_s: float) -> dict[str, Any]:
        end(now_s)
        return {}

    def do(now_s: float) -> End:
        begin(now_s)
        return done

    return do


def _once(begin: Callable[[float], object]) -> Begin:
    def do(now_s: float) -> None:
        begin(now_s)

    return do


def _fault_of_drive(line: FaultyLine, injection: Injection) -> Begin:
    drive, code = _drive(line, injection), int(injection.number("code"))
    return _once(lambda now_s: drive.fault(code, now_s))


def _sto(line: FaultyLine, injection: Injection) -> Begin:
    drive = _drive(line, injection)
    return _lasting(lambda now_s: drive.set_sto(True, now_s), lambda now_s: drive.set_sto(False, now_s))


def _torque_share(line: FaultyLine, injection: Injection) -> Begin:
    drive, share = _drive(line, injection), injection.number("share")
    return _lasting(lambda now_s: drive.give_share(share), lambda now_s: drive.give_share(1.0))


def _mode_lost(line: FaultyLine, injection: Injection) -> Begin:
    drive, mode = _drive(line, injection), int(injection.number("mode"))
    says = injection.word("says") == FOLLOWS
    return _lasting(lambda now_s: drive.lose_mode(mode, now_s, says_follows=says), lambda now_s: drive.regain_mode())


def _no_power(line: FaultyLine, injection: Injection) -> Begin:
    drive = _drive(line, injection)
    return _lasting(lambda now_s: drive.set_powered(False, now_s), lambda now_s: drive.set_powered(True, now_s))


def _drive_warning(line: FaultyLine, injection: Injection) -> Begin:
    drive = _drive(line, injection)
    if not isinstance(drive, Warns):
        raise FaultRefused(f"{injection}: the drives of this line have no words to warn with")
    warning, code, register = drive, int(injection.number("code")), int(injection.number("register"))
    return _lasting(lambda now_s: warning.warn(code, register), lambda now_s: warning.warn(0, 0))


def _with_watchdog(line: FaultyLine, injection: Injection) -> HasWatchdog:
    device = _plc(line, injection) if injection.target.number is None else _drive(line, injection)
    if not isinstance(device, HasWatchdog):
        raise FaultRefused(f"{injection}: {injection.target} has no communication watchdog here")
    return device


def _watchdog_dead(line: FaultyLine, injection: Injection) -> Begin:
    watchdog = _with_watchdog(line, injection)

    def set_dead(dead: bool) -> None:
        watchdog.watchdog_is_dead = dead

    return _lasting(lambda now_s: set_dead(True), lambda now_s: set_dead(False))


def _watchdog_warns(line: FaultyLine, injection: Injection) -> Begin:
    watchdog = _with_watchdog(line, injection)
    return _lasting(lambda now_s: watchdog.only_warn(True), lambda now_s: watchdog.only_warn(False))


def _restart(line: FaultyLine, injection: Injection) -> Begin:
    restart = line.restarts.get(key_of(injection.target))
    if restart is None:
        there = ", ".join(f"{kind} {number}" if number else kind for kind, number in line.restarts) or "nothing"
        raise FaultRefused(f"{injection.target} cannot be restarted alone on this line; what can: {there}")
    return _once(restart)


def _encoder_jump(line: FaultyLine, injection: Injection) -> Begin:
    drive, delta_m_per_s = _drive(line, injection), injection.number("delta_m_per_s")
    return _lasting(lambda now_s: drive.jump_speed(delta_m_per_s), lambda now_s: drive.heal_speed())


def _encoder_frozen(line: FaultyLine, injection: Injection) -> Begin:
    drive = _drive(line, injection)
    return _lasting(lambda now_s: drive.freeze_speed(), lambda now_s: drive.heal_speed())


def _encoder_reversed(line: FaultyLine, injection: Injection) -> Begin:
    drive = _drive(line, injection)
    return _lasting(lambda now_s: drive.turn_encoder(), lambda now_s: drive.heal_speed())


def _reversed(line: FaultyLine, injection: Injection) -> Begin:
    drive = _drive(line, injection)
    return _lasting(lambda now_s: drive.reverse(True), lambda now_s: drive.reverse(False))


def _cells_swapped(line: FaultyLine, injection: Injection) -> Begin:
    (amplifier, channel), other = _cell(line, injection), int(injection.number("other"))
    if other > line.spans or other == channel:
        raise FaultRefused(f"{injection}: other is {other}; allowed: another span, 1 to {line.spans}")
    return _lasting(lambda now_s: amplifier.swap(channel, other), lambda now_s: amplifier.swap(channel, other))


def _reading(mistake: Callable[[FaultyAmplifier, int, Injection], object]) -> _Prepare:
    """A load cell that shows something else until it is healed."""

    def prepared(line: FaultyLine, injection: Injection) -> Begin:
        amplifier, channel = _cell(line, injection)
        return _lasting(lambda now_s: mistake(amplifier, channel, injection), lambda now_s: amplifier.heal(channel))

    return prepared


def _spike(line: FaultyLine, injection: Injection) -> Begin:
    (amplifier, channel), height_n = _cell(line, injection), injection.number("height_n")
    return _once(lambda now_s: amplifier.spike(channel, height_n))


def _emergency_stop(line: FaultyLine, injection: Injection) -> Begin:
    plc = _plc(line, injection)

    def press(pressed: bool) -> None:
        plc.emergency_stop = pressed

    return _lasting(lambda now_s: press(True), lambda now_s: press(False))


def _permissive_lost(line: FaultyLine, injection: Injection) -> Begin:
    plc = _plc(line, injection)

    def give(given: bool) -> None:
        plc.permissive = given

    return _lasting(lambda now_s: give(False), lambda now_s: give(True))


def _local(line: FaultyLine, injection: Injection) -> Begin:
    plc = _plc(line, injection)

    def switch(local: bool) -> None:
        plc.local = local

    return _lasting(lambda now_s: switch(True), lambda now_s: switch(False))


def _plc_freeze(line: FaultyLine, injection: Injection) -> Begin:
    plc = _plc(line, injection)
    if not isinstance(plc, Freezable):
        raise FaultRefused(f"{injection}: the line PLC of this line cannot be frozen")
    freezable = plc
    return _lasting(lambda now_s: freezable.freeze(now_s), lambda now_s: freezable.thaw(now_s))


def _web_break(line: FaultyLine, injection: Injection) -> Begin:
    web, span = _web(line, injection)
    return _lasting(lambda now_s: web.break_web(span), lambda now_s: web.splice_web(span))


def _slip(line: FaultyLine, injection: Injection) -> Begin:
    (web, roller), factor = _web(line, injection), injection.number("factor")
    if roller == line.spans:
        raise FaultRefused(f"{injection}: the last roller is a nip or a reel, the web cannot slip there")
    return _lasting(lambda now_s: web.set_slip(roller, factor), lambda now_s: web.set_slip(roller, 1.0))


def _friction_rise(line: FaultyLine, injection: Injection) -> Begin:
    (web, roller), factor = _web(line, injection), injection.number("factor")
    return _lasting(
        lambda now_s: web.set_friction_factor(roller, factor), lambda now_s: web.set_friction_factor(roller, 1.0)
    )


def _slack(line: FaultyLine, injection: Injection) -> Begin:
    (web, span), length_m = _web(line, injection), injection.number("length_m")
    return _once(lambda now_s: web.slacken_web(span, length_m))


#: By the names of the table; the other faults of it are `FRAME_FAULTS`.
EFFECTS: dict[str, _Prepare] = {
    "restart": _restart,
    "drive-fault": _fault_of_drive,
    "sto": _sto,
    "torque-share": _torque_share,
    "mode-lost": _mode_lost,
    "no-power": _no_power,
    "drive-warning": _drive_warning,
    "watchdog-dead": _watchdog_dead,
    "watchdog-warns": _watchdog_warns,
    "encoder-jump": _encoder_jump,
    "encoder-frozen": _encoder_frozen,
    "encoder-reversed": _encoder_reversed,
    "reversed": _reversed,
    "cells-swapped": _cells_swapped,
    "cell-factor": _reading(lambda amplifier, channel, asked: amplifier.scale(channel, asked.number("factor"))),
    "nan": _reading(lambda amplifier, channel, _: amplifier.nan(channel)),
    "stuck": _reading(lambda amplifier, channel, _: amplifier.stick(channel)),
    "offset": _reading(lambda amplifier, channel, asked: amplifier.offset_n(channel, 0.0, asked.number("by_n"))),
    "drift": _reading(lambda amplifier, channel, asked: amplifier.offset_n(channel, asked.number("rate_n_per_s"))),
    "out-of-range": _reading(lambda amplifier, channel, asked: amplifier.show_n(channel, asked.number("tension_n"))),
    "spike": _spike,
    "emergency-stop": _emergency_stop,
    "permissive-lost": _permissive_lost,
    "local": _local,
    "plc-freeze": _plc_freeze,
    "web-break": _web_break,
    "slip": _slip,
    "friction-rise": _friction_rise,
    "slack": _slack,
}


def _drive(line: FaultyLine, injection: Injection) -> FaultyDrive:
    if not line.drives:
        raise FaultRefused(f"{injection.target}: this line has no drives that can be reached")
    return line.drives[(injection.target.number or 1) - 1]


def _plc(line: FaultyLine, injection: Injection) -> FaultyPlc:
    if line.plc is None:
        raise FaultRefused(f"{injection}: this line has no line PLC")
    return line.plc


def _cell(line: FaultyLine, injection: Injection) -> tuple[FaultyAmplifier, int]:
    if line.amplifier is None:
        raise FaultRefused(f"{injection}: this line has no load cells")
    return line.amplifier, injection.target.number or 1


def _web(line: FaultyLine, injection: Injection) -> tuple[FaultyWeb, int]:
    if line.web is None:
        raise FaultRefused(f"{injection}: this line has no web")
    line.web.compile_full_line()  # now, and not in the middle of a millisecond
    return line.web, injection.target.number or 1

"""What `doctor` makes of the facts that the drivers have found: a verdict on each, with what to do. Pure.

FAIL is what has to be repaired or corrected before the line can be armed. Safe torque off, an open emergency stop
circuit and a missing permissive are warnings: they keep the line from being armed, but somebody has set them so.
"""

from collections.abc import Iterator
from statistics import fmean, pstdev

from drivers.cia402 import PowerState
from drivers.inspection import BusFacts, CellFacts, DeviceFacts, DriveFacts, PlcFacts, WatchdogFacts
from drivers.torque_rules import allows_torque, is_rated
from gateway.cli.doctor_check import Check, Verdict
from gateway.core.can_load import ODD_LOAD, REFUSED_LOAD, bus_load
from gateway.core.line import Bus, CanopenBus, Drive, Line, LinePlc, LoadCell, ModbusTcpBus
from gateway.core.line_limits import motor_torque_limit_nm, torque_limit_key
from gateway.core.line_problem import printable
from safety.proving import zero_allowed_n

NOISE_DEVIATIONS = 2.0  #: of the readings, that a zero is not sure by
RESTLESS_SHARE = 0.02  #: of a cell's capacity, standard deviation at rest
AT_REST_SHARE = 0.01  #: of limits.speed_max_m_per_s
GROUPS = {Drive: "drives", LoadCell: "load cells", LinePlc: "line PLC"}

Item = Drive | LoadCell | LinePlc


def judged(line: Line, bus: Bus, facts: BusFacts) -> Iterator[Check]:
    """Every check of one bus and its devices."""
    items: list[Item] = [item for item in (*line.drives, *line.load_cells, line.plc) if item.bus == bus.name]
    yield from _of_bus(line, bus, facts)
    if facts.trouble or facts.not_asked:
        why = facts.trouble and "its bus is not open" or facts.not_asked
        for item in items:
            yield Check(GROUPS[type(item)], item.name, "", "skipped", why)
        return
    found = {device.name: device for device in facts.devices}
    for item in items:
        yield from of_device(line, item, found[item.name])


def _of_bus(line: Line, bus: Bus, facts: BusFacts) -> Iterator[Check]:
    if facts.trouble:
        yield Check("buses", bus.name, "", "FAIL", printable(facts.trouble), "opens", _way_to_open(bus))
        return
    if facts.not_asked:
        todo = "end the other master: two on one bus command the same drives"
        yield Check("buses", bus.name, "", "FAIL", facts.not_asked, "nobody but this gateway", todo)
    else:
        yield Check("buses", bus.name, "", "OK", f"{facts.where} is open")
    for note in facts.notes:
        todo = "check wiring, termination and bit rate"
        yield Check("buses", bus.name, "errors", "warning", printable(note), "none", todo)
    if isinstance(bus, CanopenBus) and facts.load is not None and facts.foreign_load is not None:
        yield _load(line, bus, facts.load, facts.foreign_load)


def _way_to_open(bus: Bus) -> str:
    if isinstance(bus, CanopenBus):
        return "see the message"
    if isinstance(bus, ModbusTcpBus):
        return f"is it on, does `ping {bus.host}` answer, is {bus.port} its port, does a firewall stand between?"
    return f"is the server on; `r2rgate scan opcua {bus.endpoint}` shows what it offers"


def _load(line: Line, bus: CanopenBus, now: float, foreign: float) -> Check:
    computed = bus_load(line, bus)
    expected = computed + foreign
    measured = (
        f"{now:.1%} now, {foreign:.1%} of it not of this line; {expected:.0%} expected in operation "
        f"({computed:.0%} computed from the line's file)"
    )
    wanted = f"at most {ODD_LOAD:.0%}"
    verdict: Verdict = "OK" if expected <= ODD_LOAD else "warning" if expected <= REFUSED_LOAD else "FAIL"
    todo = "" if verdict == "OK" else "take what is not of this line off the bus, lengthen the period, or use two buses"
    return Check("buses", bus.name, "load", verdict, measured, wanted, todo)


def of_device(line: Line, item: Item, facts: DeviceFacts) -> Iterator[Check]:
    """Every check of one device."""
    group, name = GROUPS[type(item)], item.name
    if facts.silent:
        todo = f"check its power, its cable and that it is {facts.place}; `r2rgate scan` shows who is there"
        yield Check(group, name, "", "FAIL", f"{facts.place}: {facts.silent}", "answers", todo)
        return
    yield _identity(group, item, facts)
    if not facts.believed:
        return
    for difference in facts.differences:
        todo = "set it in the device, or use a map of this device"
        yield Check(group, name, "settings", "FAIL", difference, "as its map says", todo)
    if facts.watchdog is not None:
        yield _watchdog(line, group, name, facts.watchdog)
    if facts.drive is not None and isinstance(item, Drive):
        yield from _drive(line, item, facts.drive)
    if isinstance(item, LoadCell):
        yield _cell(line, item, facts.cell, explained=bool(facts.differences))
    if facts.plc is not None:
        yield from _plc(line, name, facts.plc)


def _identity(group: str, item: Item, facts: DeviceFacts) -> Check:
    words = [f"{facts.place}", facts.standing, printable(facts.firmware)]
    if facts.identity is None:
        words.append("its map has no device id: compare it yourself")
        return Check(group, item.name, "identity", "OK", ", ".join(filter(None, words)))
    words.insert(1, facts.identity.found)
    measured = ", ".join(filter(None, words))
    if facts.identity.fits:
        return Check(group, item.name, "identity", "OK", measured, facts.identity.wanted)
    todo = f"correct `map` (now {item.map}) or `address` (now {item.address}) in the line's file"
    return Check(group, item.name, "identity", "FAIL", measured, facts.identity.wanted, todo)


def _watchdog(line: Line, group: str, name: str, watchdog: WatchdogFacts) -> Check:
    asked_s = line.limits.watchdog_s
    wanted = f"{1e3 * asked_s:g} ms (limits.watchdog_s)"
    if watchdog.now_s.value is None:
        todo = "a device whose watchdog cannot be read is not armed: correct its map, or use another device"
        return Check(group, name, "watchdog", "FAIL", f"cannot be read: {watchdog.now_s.trouble}", wanted, todo)
    takes = f"takes {1e3 * watchdog.low_s:g} to {1e3 * watchdog.high_s:g} ms"
    now = f"{1e3 * watchdog.now_s.value:g} ms now" if watchdog.now_s.value > 0.0 else "off until it is armed"
    if not watchdog.low_s <= asked_s <= watchdog.high_s:
        todo = "change limits.watchdog_s to what every device takes"
        return Check(group, name, "watchdog", "FAIL", f"{now}, {takes}", wanted, todo)
    return Check(group, name, "watchdog", "OK", f"{now}, {takes}", wanted)


def _drive(line: Line, item: Drive, drive: DriveFacts) -> Iterator[Check]:
    name, limit_nm, key = item.name, motor_torque_limit_nm(line, item), torque_limit_key(line, item.roller)
    if (rated := drive.rated_torque_nm) is not None:
        wanted = f"{item.rated_torque_nm:g} Nm (rated_torque_nm)"
        wrong = rated.value is None or not is_rated(rated.value, item.rated_torque_nm)
        measured = f"{rated.value:g} Nm" if rated.value is not None else f"cannot be read: {rated.trouble}"
        todo = "correct rated_torque_nm: every torque is scaled by it" if wrong else ""
        yield Check("drives", name, "rated torque", "FAIL" if wrong else "OK", measured, wanted, todo)
    if (most := drive.max_torque_nm) is not None:
        wanted = f"{limit_nm:g} Nm or more ({key})"
        wrong = most.value is None or not allows_torque(most.value, limit_nm, drive.max_torque_step_nm)
        measured = f"{most.value:g} Nm" if most.value is not None else f"cannot be read: {most.trouble}"
        todo = f"lower {key}, or raise it in the drive" if wrong else ""
        yield Check("drives", name, "max torque", "FAIL" if wrong else "OK", measured, wanted, todo)
    yield _state(name, drive)
    if not drive.safe_torque_off:  # which takes the supply off, too
        yield _power(name, drive)
    if drive.mode_wanted is not None:
        yield _mode(name, drive, drive.mode_wanted)


def _power(name: str, drive: DriveFacts) -> Check:
    if drive.supplied is None:
        why = "cannot be seen (no voltage_enabled in its map): without power it is found when it does not enable"
        return Check("drives", name, "power", "skipped", why)
    if drive.supplied:
        return Check("drives", name, "power", "OK", "its power stage is supplied", "supplied")
    todo = "switch on the supply of its power stage, and check fuses and contactor"
    return Check("drives", name, "power", "warning", "has no power (voltage enabled, 6041h, = 0)", "supplied", todo)


def _mode(name: str, drive: DriveFacts, wanted: int) -> Check:
    words, mode = f"{wanted} (arming sets it)", drive.mode
    if mode is None:
        why = "cannot be seen (no mode_displayed in its map): in another mode it is found by the torque that it gives"
        return Check("drives", name, "mode", "skipped", why)
    if mode.value is None:
        todo = "a drive whose mode cannot be read is not started: correct mode_displayed in its map"
        return Check("drives", name, "mode", "FAIL", f"cannot be read: {mode.trouble}", words, todo)
    shown = int(mode.value)
    if shown in (0, wanted):
        return Check("drives", name, "mode", "OK", f"{shown}", words)
    todo = "see who else sets it: another tool, the drive's own program"
    return Check("drives", name, "mode", "warning", f"{shown}", words, todo)


def _state(name: str, drive: DriveFacts) -> Check:
    wanted, power = "no fault, no torque", drive.power
    if power is None:
        todo = "without its state it is not armed: correct its map"
        return Check("drives", name, "state", "FAIL", f"cannot be read: {drive.statusword.trouble}", wanted, todo)
    says = power.name.lower().replace("_", " ")
    if power in (PowerState.FAULT, PowerState.FAULT_REACTION):
        measured = f"{says}, {drive.error}" if drive.error else says
        todo = "find out why in the drive's manual; `r2rgate arm` acknowledges a fault whose cause is gone"
        return Check("drives", name, "state", "FAIL", measured, wanted, todo)
    if power in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE):
        return Check("drives", name, "state", "FAIL", f"{says}: somebody commands it", wanted, "take its torque off")
    if drive.safe_torque_off:
        todo = "close the safety circuit (emergency stop, doors) before arming"
        return Check("drives", name, "state", "warning", f"safe torque off is active ({says})", wanted, todo)
    return Check("drives", name, "state", "OK", says, wanted)


def _cell(line: Line, item: LoadCell, cell: CellFacts | None, *, explained: bool) -> Check:
    group, name = GROUPS[LoadCell], item.name
    wanted = f"a moving value within {item.capacity_n:g} N (capacity_n)"
    if cell is None or (cell.trouble and not cell.samples_n):
        why = cell.trouble if cell is not None else "not read: see its settings" if explained else "not read"
        todo = "check cell, cable and amplifier"
        return Check(group, name, "value", "FAIL", why, wanted, todo)
    mean_n, spread_n, count = fmean(cell.samples_n), pstdev(cell.samples_n), len(cell.samples_n)
    measured = f"{mean_n:.2f} N, spread {spread_n:.3f} N over {count} readings"
    if cell.trouble:
        return Check(group, name, "value", "FAIL", f"{measured}; at times: {cell.trouble}", wanted, "check the cable")
    if cell.counter_moves is False:
        todo = "the amplifier is frozen: switch it off and on; see its manual"
        return Check(group, name, "value", "FAIL", f"{measured}; its sample counter stands still", wanted, todo)
    if max(map(abs, cell.samples_n)) > item.capacity_n:
        todo = "check capacity_n, the unit and scale of the map, zero and overload of the cell"
        return Check(group, name, "value", "FAIL", measured, wanted, todo)
    status, odd, todo = _odd_reading(line, item, mean_n, spread_n, still=len(set(cell.samples_n)) == 1)
    return Check(group, name, "value", status, measured + odd, wanted, todo)


def _odd_reading(
    line: Line, item: LoadCell, mean_n: float, spread_n: float, *, still: bool
) -> tuple[Verdict, str, str]:
    """What is odd about a reading that may be right, how bad that is, and what to do; empty where nothing is."""
    if still:
        stop = f"after {line.limits.stuck_s:g} s of one value the moving line is stopped (limits.stuck_s)"
        return "warning", "; always the same value", f"press on the roller: does it move? {stop}"
    allowed_n, sure_n = float(zero_allowed_n(line)[item.span - 1]), abs(mean_n) - NOISE_DEVIATIONS * spread_n
    if sure_n > allowed_n:
        beyond = f"; a slack web shows at most {allowed_n:.2g} N, either way"
        if mean_n * (-1.0 if item.sign == "inverted" else 1.0) < 0.0:
            return "FAIL", beyond, "it is not armed: take the web off and zero it; is it mounted the right way round?"
        return (
            "warning",
            beyond,
            "if the web is slack, zero the cell; if it is not, slacken it: `r2rgate prove` asks for it",
        )
    if spread_n > RESTLESS_SHARE * item.capacity_n:
        return "warning", "; restless at rest", "check shield, ground and filter of the amplifier"
    return "OK", "", ""


def _plc(line: Line, name: str, plc: PlcFacts) -> Iterator[Check]:
    group = GROUPS[LinePlc]
    if plc.trouble:
        todo = "without its status nothing is armed: correct its map"
        yield Check(group, name, "status", "FAIL", f"cannot be read: {plc.trouble}", "is read", todo)
        return
    if plc.emergency_stop:
        todo = "release it before arming"
        yield Check(group, name, "emergency stop", "warning", "the circuit is open", "closed", todo)
    else:
        yield Check(group, name, "emergency stop", "OK", "the circuit is closed", "closed")
    if plc.permissive:
        yield Check(group, name, "permissive", "OK", "given", "given")
    else:
        todo = "the line's own interlocks withhold it: see the PLC"
        yield Check(group, name, "permissive", "warning", "not given", "given", todo)
    if plc.local:
        todo = "somebody works at the line: it is not started from here until they have switched it back"
        yield Check(group, name, "local", "warning", "switched to local", "remote", todo)
    if plc.watchdog_tripped:
        todo = "the next start takes it back; it trips when the gateway was ended while the line ran"
        yield Check(group, name, "command watchdog", "warning", "has tripped", "quiet", todo)
    yield _unwinder(line, group, name, plc)


def _unwinder(line: Line, group: str, name: str, plc: PlcFacts) -> Check:
    v0, most = plc.speed_m_per_s, AT_REST_SHARE * line.limits.speed_max_m_per_s
    wanted = f"at rest, within {most:.2g} m/s"
    if v0.value is None:
        return Check(group, name, "v0", "FAIL", f"cannot be read: {v0.trouble}", wanted, "correct its map")
    moves = plc.running or abs(v0.value) > most
    measured = f"{round(v0.value, 4) + 0.0:.4f} m/s, transport {'runs' if plc.running else 'stands'}"
    todo = "somebody else runs the transport: stop it before arming" if moves else ""
    return Check(group, name, "v0", "warning" if moves else "OK", measured, wanted, todo)

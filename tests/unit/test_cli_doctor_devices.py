"""The verdicts of doctor on what the drivers have found."""

from dataclasses import replace

import pytest

from drivers.cia402 import PowerState
from drivers.inspection import (
    BusFacts,
    CellFacts,
    DeviceFacts,
    DriveFacts,
    Identity,
    Number,
    PlcFacts,
    WatchdogFacts,
)
from gateway.cli.doctor_check import Check, Verdict
from gateway.cli.doctor_devices import judged, of_device
from gateway.core.can_load import bus_load
from gateway.core.line import CanopenBus, Drive, LoadCell
from tests.protocol.driver_support import line

LINE = line(2)  # rated 80 Nm, limits.torque_nm 60, watchdog_s 0.1, cells of 100 N
FITS = Identity("vendor 1", "vendor 1", fits=True)
WATCHDOG = WatchdogFacts(Number(0.0), 0.01, 0.2)
DRIVE = DriveFacts(
    Number(0x250), PowerState.SWITCH_ON_DISABLED, False, "", Number(80.0), Number(80.0), True, Number(0.0), 10
)
CELL = CellFacts((0.1, 0.2, 0.0), "", True)
PLC = PlcFacts("", permissive=True, speed_m_per_s=Number(0.0))


def drive_checks(drive: DriveFacts = DRIVE, watchdog: WatchdogFacts = WATCHDOG) -> dict[str, Check]:
    item: Drive = LINE.drives[0]
    facts = DeviceFacts(item.name, "node 1", identity=FITS, watchdog=watchdog, drive=drive)
    return {check.name: check for check in of_device(LINE, item, facts)}


def cell_check(cell: CellFacts | None) -> Check:
    item: LoadCell = LINE.load_cells[0]
    (check,) = (c for c in of_device(LINE, item, DeviceFacts(item.name, "unit 1", cell=cell)) if c.name == "value")
    return check


def plc_checks(plc: PlcFacts) -> dict[str, Verdict]:
    facts = DeviceFacts(LINE.plc.name, "unit 2", identity=FITS, watchdog=WATCHDOG, plc=plc)
    return {check.name: check.verdict for check in of_device(LINE, LINE.plc, facts)}


def test_a_drive_at_rest_is_fine() -> None:
    assert {check.verdict for check in drive_checks().values()} == {"OK"}
    assert set(drive_checks()) == {"identity", "watchdog", "rated torque", "max torque", "state", "power", "mode"}
    assert "power" not in drive_checks(DRIVE._replace(supplied=False, safe_torque_off=True)), "STO takes it off, too"
    assert "mode" not in drive_checks(DRIVE._replace(mode_wanted=None)), "it has but one"


@pytest.mark.parametrize(
    ("drive", "name", "verdict", "says"),
    [
        (DRIVE._replace(power=PowerState.FAULT, error="error 8250h RPDO time-out"), "state", "FAIL", "8250h"),
        (DRIVE._replace(power=PowerState.FAULT_REACTION), "state", "FAIL", "fault reaction"),
        (DRIVE._replace(power=PowerState.OPERATION_ENABLED), "state", "FAIL", "somebody commands it"),
        (DRIVE._replace(power=None, statusword=Number(None, "aborted")), "state", "FAIL", "aborted"),
        (DRIVE._replace(safe_torque_off=True), "state", "warning", "safe torque off"),
        (DRIVE._replace(safe_torque_off=None), "state", "OK", "switch on disabled"),
        (DRIVE._replace(rated_torque_nm=Number(80.07)), "rated torque", "OK", "80.07"),
        (DRIVE._replace(rated_torque_nm=Number(80.2)), "rated torque", "FAIL", "80.2 Nm"),
        (DRIVE._replace(rated_torque_nm=Number(None, "aborted")), "rated torque", "FAIL", "aborted"),
        (DRIVE._replace(max_torque_nm=Number(60.0)), "max torque", "OK", "60 Nm"),
        (DRIVE._replace(max_torque_nm=Number(59.0)), "max torque", "FAIL", "59 Nm"),
        (DRIVE._replace(supplied=False), "power", "warning", "has no power"),
        (DRIVE._replace(mode=Number(10.0)), "mode", "OK", "10"),
        (DRIVE._replace(mode=Number(8.0)), "mode", "warning", "8"),
        (DRIVE._replace(mode=Number(None, "aborted")), "mode", "FAIL", "aborted"),
    ],
)
def test_a_drive(drive: DriveFacts, name: str, verdict: Verdict, says: str) -> None:
    check = drive_checks(drive)[name]
    assert check.verdict == verdict and says in check.measured
    assert bool(check.todo) == (verdict != "OK")


@pytest.mark.parametrize(
    ("drive", "name", "key"),
    [
        (DRIVE._replace(supplied=None), "power", "voltage_enabled"),
        (DRIVE._replace(mode=None), "mode", "mode_displayed"),
    ],
)
def test_what_a_map_does_not_say_is_told_as_not_seen(drive: DriveFacts, name: str, key: str) -> None:
    check = drive_checks(drive)[name]
    assert check.verdict == "skipped" and "cannot be seen" in check.measured and key in check.measured


@pytest.mark.parametrize(
    ("watchdog", "verdict", "says"),
    [
        (WatchdogFacts(Number(0.05), 0.01, 0.2), "OK", "50 ms now, takes 10 to 200 ms"),
        (WatchdogFacts(Number(0.0), 0.1, 0.1), "OK", "takes 100 to 100 ms"),
        (WatchdogFacts(Number(0.0), 0.01, 0.099), "FAIL", "takes 10 to 99 ms"),
        (WatchdogFacts(Number(0.0), 0.5, 5.0), "FAIL", "takes 500 to 5000 ms"),
        (WatchdogFacts(Number(None, "object 1400h sub 5: no such object"), 0.01, 0.2), "FAIL", "1400h"),
    ],
)
def test_a_watchdog(watchdog: WatchdogFacts, verdict: Verdict, says: str) -> None:
    check = drive_checks(watchdog=watchdog)["watchdog"]
    assert check.verdict == verdict and says in check.measured and check.wanted == "100 ms (limits.watchdog_s)"


@pytest.mark.parametrize(
    ("cell", "verdict", "says"),
    [
        (CELL, "OK", "0.10 N, spread 0.082 N over 3 readings"),
        (CELL._replace(counter_moves=None), "OK", "0.10 N"),
        (CELL._replace(counter_moves=False), "FAIL", "stands still"),
        (CELL._replace(samples_n=(20.0, 20.0, 20.0)), "warning", "always the same"),
        (CELL._replace(samples_n=(100.0, 99.9)), "warning", "99.95 N"),
        (CELL._replace(samples_n=(100.1, 99.9)), "FAIL", "100.00 N"),
        (CELL._replace(samples_n=(-100.1, -99.9)), "FAIL", "-100.00 N"),
        (CELL._replace(samples_n=(-3.1, -3.2)), "FAIL", "a slack web shows at most 2.9 N"),
        (CELL._replace(samples_n=(3.1, 3.2)), "warning", "a slack web shows at most 2.9 N"),
        (CELL._replace(samples_n=(-2.8, -2.7)), "OK", "-2.75 N"),
        (CELL._replace(samples_n=(3.4, 2.8)), "OK", "3.10 N"),  # its noise leaves it open
        (CELL._replace(samples_n=(0.0, 5.0)), "warning", "restless"),
        (CELL._replace(trouble="overload"), "FAIL", "at times: overload"),
        (CellFacts((), "wire break", True), "FAIL", "wire break"),
        (None, "FAIL", "not read"),
    ],
)
def test_a_load_cell(cell: CellFacts | None, verdict: Verdict, says: str) -> None:
    check = cell_check(cell)
    assert check.verdict == verdict and says in check.measured
    assert bool(check.todo) == (verdict != "OK")


@pytest.mark.parametrize(
    ("plc", "name", "verdict"),
    [
        (PLC, "permissive", "OK"),
        (PLC._replace(permissive=False), "permissive", "warning"),
        (PLC._replace(emergency_stop=True), "emergency stop", "warning"),
        (PLC._replace(watchdog_tripped=True), "command watchdog", "warning"),
        (PLC._replace(running=True), "v0", "warning"),
        (PLC._replace(speed_m_per_s=Number(0.009)), "v0", "OK"),  # limits.speed_max_m_per_s is 1
        (PLC._replace(speed_m_per_s=Number(-0.011)), "v0", "warning"),
        (PLC._replace(speed_m_per_s=Number(None, "aborted")), "v0", "FAIL"),
        (PlcFacts("aborted"), "status", "FAIL"),
    ],
)
def test_a_plc(plc: PlcFacts, name: str, verdict: Verdict) -> None:
    assert plc_checks(plc)[name] == verdict


def test_of_another_device_nothing_else_is_told() -> None:
    item = LINE.drives[0]
    facts = DeviceFacts(item.name, "node 1", identity=Identity("vendor 2", "vendor 1", fits=False))
    (check,) = of_device(LINE, item, facts)
    assert (check.verdict, check.name, check.wanted) == ("FAIL", "identity", "vendor 1")
    assert "cia402-torque" in check.todo


def test_settings_that_differ_from_the_map_fail() -> None:
    item = LINE.load_cells[0]
    facts = DeviceFacts(item.name, "node 9", identity=FITS, differences=("object 1A00h sub 1 is 0x0",))
    verdicts = {check.name: check.verdict for check in of_device(LINE, item, facts)}
    assert verdicts == {"identity": "OK", "settings": "FAIL", "value": "FAIL"}


BUS = LINE.buses[0]
assert isinstance(BUS, CanopenBus)
SILENT = tuple(DeviceFacts(drive.name, f"node {drive.address}", silent="does not answer") for drive in LINE.drives)
HEARD = BusFacts("drives", "virtual x", devices=SILENT, load=0.004, foreign_load=0.0)


def bus_checks(facts: BusFacts) -> list[Check]:
    return list(judged(LINE, BUS, facts))


def test_a_silent_drive_fails_and_names_its_place() -> None:
    failed = [check for check in bus_checks(HEARD) if check.verdict == "FAIL"]
    assert [check.subject for check in failed] == ["drive-1", "drive-2"]
    assert failed[0].measured == "node 1: does not answer"


def test_devices_of_a_bus_that_is_not_open_are_skipped() -> None:
    bus, *devices = bus_checks(BusFacts("drives", "can0", trouble="no such device"))
    assert bus.verdict == "FAIL" and {check.verdict for check in devices} == {"skipped"}
    bus, load, *devices = bus_checks(replace(HEARD, not_asked="SYNC is heard"))
    assert bus.verdict == "FAIL" and load.verdict == "OK" and {check.verdict for check in devices} == {"skipped"}


@pytest.mark.parametrize(("foreign", "verdict"), [(0.0, "OK"), (0.58, "OK"), (0.62, "warning"), (0.9, "FAIL")])
def test_the_load_is_what_check_computes_and_what_others_send(foreign: float, verdict: Verdict) -> None:
    assert isinstance(BUS, CanopenBus)
    assert bus_load(LINE, BUS) < 0.02
    (load,) = (check for check in bus_checks(replace(HEARD, foreign_load=foreign)) if check.name == "load")
    assert load.verdict == verdict


def test_a_drive_is_held_against_the_torque_limit_of_its_own_roller() -> None:
    item = LINE.drives[0]
    rollers = [roller.model_copy(update={"torque_nm": 20.0}) if i == item.roller else roller
               for i, roller in enumerate(LINE.rollers, 1)]  # fmt: skip
    own = LINE.model_copy(update={"rollers": rollers})
    for most_nm, verdict in ((20.0, "OK"), (19.0, "FAIL")):
        facts = DeviceFacts(item.name, "node 1", drive=DRIVE._replace(max_torque_nm=Number(most_nm)))
        (check,) = (check for check in of_device(own, item, facts) if check.name == "max torque")
        assert check.verdict == verdict and f"rollers[{item.roller}].torque_nm" in check.wanted

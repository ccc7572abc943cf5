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
DRIVE = DriveFacts(Number(0x250), PowerState.SWITCH_ON_DISABLED, False, "", Number(80.0), Number(80.0))
CELL = CellFacts((20.0, 20.1, 19.9), "", True)
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
    assert set(drive_checks()) == {"identity", "watchdog", "rated torque", "max torque", "state"}


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
    ],
)
def test_a_drive(drive: DriveFacts, name: str, verdict: Verdict, says: str) -> None:
    check = drive_checks(drive)[name]
    assert check.verdict == verdict and says in check.measured
    assert bool(check.todo) == (verdict != "OK")


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
        (CELL, "OK", "20.00 N, spread 0.082 N over 3 readings"),
        (CELL._replace(counter_moves=None), "OK", "20.00 N"),
        (CELL._replace(counter_moves=False), "FAIL", "stands still"),
        (CELL._replace(samples_n=(20.0, 20.0, 20.0)), "warning", "always the same"),
        (CELL._replace(samples_n=(100.0, 99.9)), "OK", "99.95 N"),
        (CELL._replace(samples_n=(100.1, 99.9)), "FAIL", "100.00 N"),
        (CELL._replace(samples_n=(-100.1, -99.9)), "FAIL", "-100.00 N"),
        (CELL._replace(samples_n=(-5.1, -5.2)), "warning", "below zero"),
        (CELL._replace(samples_n=(-4.9, -4.8)), "OK", "-4.85 N"),
        (CELL._replace(samples_n=(10.0, 15.0)), "warning", "restless"),
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

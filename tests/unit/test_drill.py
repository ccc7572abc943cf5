"""What counts in the drill of the watchdogs, of inputs that are made by hand."""

import pytest

from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.signals import DriveCondition, DriveState, Inputs
from gateway.loop.drill import READY_S, ROOM_PERIODS, RUN_S, Drill, Stage

LINE = load_line(line_template(3, "line.toml"), "line.toml")
PERIOD_S, DEADLINE_S = LINE.control.period_s, LINE.limits.watchdog_s
PLC, DRIVE = LINE.plc.name, LINE.drives[0].name


class FedLink:
    """All devices have a watchdog."""

    watched = frozenset([*(drive.name for drive in LINE.drives), PLC])
    withheld = frozenset()

    def withhold(self, devices):
        self.withheld = devices


class Drilled:
    """A drill and what it sees; in every period all is as it was, and told anew."""

    def __init__(self):
        self.link, self.inputs, self.now_s = FedLink(), Inputs(LINE.n), 0.0
        self.drill = Drill(LINE, [self.link])
        self.inputs.drive_state[:] = DriveState.READY
        self.plc_is_mute = False
        self.drill.begin(0.0)

    def step(self):
        self.now_s += PERIOD_S
        if not self.plc_is_mute:
            self.inputs.plc.time_s = self.now_s - 0.2 * PERIOD_S
        self.drill.step(self.inputs, "", self.now_s)

    def to(self, stage, within_s=2 * READY_S):
        end_s = self.now_s + within_s
        while self.drill.stage is not stage and self.now_s < end_s:
            self.step()
        assert self.drill.stage is stage

    def told(self):
        self.to(Stage.OVER)
        return [(each.as_data().code, each.as_data().parameters["device"]) for each in self.drill.findings]

    def through_drives(self):
        """All drives react, and are reset."""
        self.to(Stage.DRIVES, LINE.stages.start_warning_s + READY_S)
        self.inputs.power_barred[:] = True
        self.to(Stage.TRANSPORT)

    def to_plc(self):
        self.through_drives()
        self.inputs.plc.running = True
        self.to(Stage.PLC)


def test_a_drive_that_counts_as_in_fault_has_not_barred_its_power_stage():
    drilled = Drilled()
    drilled.to(Stage.DRIVES, LINE.stages.start_warning_s + READY_S)
    drilled.inputs.power_barred[1:] = True
    drilled.inputs.drive_state[:] = DriveState.FAULT
    drilled.to(Stage.TRANSPORT)
    drilled.inputs.plc.running = True
    drilled.to(Stage.PLC)
    drilled.inputs.plc.running = False
    assert drilled.told() == [("watchdog-only-warns", DRIVE)]
    assert not drilled.drill.watchdogs


def test_a_drive_that_warns_has_not_barred_its_power_stage():
    drilled = Drilled()
    drilled.to(Stage.DRIVES, LINE.stages.start_warning_s + READY_S)
    drilled.inputs.power_barred[1:] = True
    drilled.inputs.drive_condition[0] = DriveCondition.WARNS
    drilled.to(Stage.TRANSPORT)
    drilled.inputs.plc.running = True
    drilled.to(Stage.PLC)
    drilled.inputs.plc.running = False
    assert drilled.told() == [("watchdog-only-warns", DRIVE)]


@pytest.mark.parametrize("periods_late", [ROOM_PERIODS - 1, ROOM_PERIODS + 1])
def test_a_reaction_counts_within_the_deadline_and_a_few_periods(periods_late):
    drilled = Drilled()
    drilled.to(Stage.DRIVES, LINE.stages.start_warning_s + READY_S)
    begun_s = drilled.now_s
    while drilled.drill.stage is Stage.DRIVES:
        if drilled.now_s - begun_s >= DEADLINE_S + (periods_late - 1.5) * PERIOD_S:
            drilled.inputs.power_barred[:] = True  # in the next period
        drilled.step()
    drilled.inputs.plc.running = True
    drilled.to(Stage.PLC)
    drilled.inputs.plc.running = False
    assert bool(drilled.told()) is (periods_late > ROOM_PERIODS)


def test_a_line_plc_whose_transport_ends_is_proved():
    drilled = Drilled()
    drilled.to_plc()
    assert drilled.link.withheld == {PLC}
    drilled.inputs.plc.running = False
    assert drilled.told() == []
    assert {each.device for each in drilled.drill.watchdogs} == FedLink.watched


def test_a_line_plc_that_says_that_it_has_tripped_and_runs_on_is_refused():
    drilled = Drilled()
    drilled.to_plc()
    drilled.inputs.plc.tripped = True
    assert drilled.told() == [("watchdog-keeps-transport", PLC)]


def test_a_line_plc_that_is_not_heard_any_more_has_shown_nothing():
    drilled = Drilled()
    drilled.to_plc()
    drilled.plc_is_mute, drilled.inputs.plc.running = True, False
    assert drilled.told() == [("watchdog-ignored", PLC)]


def test_where_transport_was_not_seen_nothing_is_known_of_a_line_plcs_watchdog():
    drilled = Drilled()
    drilled.through_drives()
    drilled.inputs.plc.tripped = True
    begun_s = drilled.now_s
    assert drilled.told() == [("transport-not-seen", PLC)]
    assert drilled.now_s - begun_s >= RUN_S


def test_drives_in_fault_are_reset_before_transport_is_asked_for():
    drilled = Drilled()
    drilled.through_drives()
    assert drilled.drill.resets and drilled.drill.runs and drilled.link.withheld == frozenset()

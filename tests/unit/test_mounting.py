"""How drives and load cells are mounted: between what devices say and what the loop knows, nowhere else."""

import numpy as np

from drivers.registry import build_links, drive_tells, speed_steps_m_per_s
from gateway.core.line import Line
from gateway.core.line_checks import RULES
from gateway.core.line_file import load_line
from gateway.core.line_limits import motor_radius_m, motor_torque_limit_nm
from gateway.core.line_template import line_template
from gateway.core.signals import DriveState, Inputs, Outputs, Quality
from gateway.loop.mounting import Mounting

N = 2
PLAIN = load_line(line_template(N, "line.toml"), "line.toml")


def mounted(direction: str = "reversed", gear: float = 4.0, sign: str = "inverted") -> Line:
    """Drive 1 and load cell 2 are mounted so."""
    first, *drives = PLAIN.drives
    *cells, last = PLAIN.load_cells
    return PLAIN.model_copy(
        update={
            "drives": [first.model_copy(update={"direction": direction, "gear": gear}), *drives],
            "load_cells": [*cells, last.model_copy(update={"sign": sign})],
        }
    )


def test_a_line_that_is_mounted_forwards_is_handed_through() -> None:
    inputs, outputs = Inputs(N), Outputs(N)
    mounting = Mounting(PLAIN, inputs)
    mounting.take()
    assert mounting.raw is inputs and mounting.given(outputs) is outputs


def test_what_devices_say_comes_as_rollers_and_webs_have_it() -> None:
    inputs = Inputs(N)
    mounting = Mounting(mounted(), inputs)
    for i in range(N):
        mounting.raw.tension.put(i, 20.0, 1.0)
        mounting.raw.speed.put(i, 0.5, 1.0)
        mounting.raw.torque.put(i, 3.0, 1.0)
    mounting.raw.unwind_speed.put(0, 0.4, 1.0)
    mounting.raw.drive_state[:] = DriveState.ENABLED
    mounting.raw.power_barred[1] = True
    mounting.raw.plc.permissive = True
    for _ in range(2):  # a sample that did not come keeps its sign
        mounting.take()
        assert inputs.tension.value.tolist() == [20.0, -20.0]
        assert inputs.speed.value.tolist() == [-0.5, 0.5]
        assert inputs.torque.value.tolist() == [-12.0, 3.0]
        assert inputs.unwind_speed.value[0] == 0.4 and inputs.plc.permissive
        assert (inputs.drive_state == DriveState.ENABLED).all() and inputs.power_barred.tolist() == [False, True]
        mounting.raw.speed.miss(0)
    assert inputs.speed.quality.tolist() == [Quality.STALE, Quality.GOOD]


def test_what_is_asked_goes_out_as_motors_have_it() -> None:
    outputs = Outputs(N)
    outputs.torque_nm = np.array([8.0, 8.0])
    outputs.run, outputs.warning, outputs.speed_request_m_per_s = True, True, 0.1
    given = Mounting(mounted(), Inputs(N)).given(outputs)
    assert given.torque_nm.tolist() == [-2.0, 8.0] and outputs.torque_nm.tolist() == [8.0, 8.0]
    assert (given.run, given.warning, given.speed_request_m_per_s) == (True, True, 0.1)


def test_behind_a_gear_the_motor_turns_faster_and_gives_less() -> None:
    line = mounted()
    geared, plain = line.drives
    assert motor_radius_m(line, geared) == line.rollers[0].radius_m.value / 4.0
    assert motor_torque_limit_nm(line, geared) == line.limits.torque_nm / 4.0
    assert motor_torque_limit_nm(line, plain) == line.limits.torque_nm
    assert geared.roller_torque_nm == 4.0 * geared.rated_torque_nm
    steps, before = speed_steps_m_per_s(line), speed_steps_m_per_s(PLAIN)
    assert steps[0] in (before[0], before[0] / 4.0) and steps[1] == before[1]
    assert drive_tells(line).torque_step_nm[0] == 4.0 * drive_tells(PLAIN).torque_step_nm[0]
    assert build_links(line)


def test_a_small_motor_behind_a_gear_gives_what_the_line_asks() -> None:
    first, *drives = mounted().drives
    small = first.model_copy(update={"rated_torque_nm": PLAIN.limits.torque_nm / 4.0})
    line = mounted().model_copy(update={"drives": [small, *drives]})
    assert not [finding for rule in RULES for finding in rule.check(line) if "drives" in finding.path]
    without = line.model_copy(update={"drives": [small.model_copy(update={"gear": 1.0}), *drives]})
    assert [finding for rule in RULES for finding in rule.check(without) if "drives" in finding.path]

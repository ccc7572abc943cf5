"""What `check` says of brakes, of rollers that run on after a web break, and of spans without a load cell."""

import tomllib

import pytest

from gateway.core.braking import brakes_of
from gateway.core.line import Line
from gateway.core.line_rules_braking import brakes_are_whole, one_resistor_is_given_once, rollers_come_to_rest
from gateway.core.line_rules_estimate import estimates_are_bounds
from gateway.core.line_template import line_template
from tests.support.reel_line import reel_line
from tests.unit.line_checks_support import check, edited, problems, table

DRIVE = "# braking_torque_nm = 60.0"


def with_drive(line: Line, i: int, **keys: float) -> Line:
    drives = list(line.drives)
    drives[i] = drives[i].model_copy(update=keys)
    return line.model_copy(update={"drives": drives})


@pytest.mark.parametrize(
    ("keys", "path", "wrong"),
    [
        ({"braking_torque_nm": 40.0}, "braking_torque_nm", "DC link"),
        ({"braking_power_w": 40.0}, "braking_power_w", "without a torque"),
        ({"braking_energy_j": 40.0}, "braking_energy_j", "without a torque"),
        ({"braking_torque_nm": 61.0, "braking_power_w": 40.0}, "braking_torque_nm", "more than a torque may be"),
    ],
)
def test_a_brake_is_given_whole_and_within_the_torque(keys, path, wrong):
    line = Line.model_validate(tomllib.loads(line_template(2)))
    assert not list(brakes_are_whole(line))
    (found,) = brakes_are_whole(with_drive(line, 1, **keys))
    assert found.path == ("drives", 1, path) and wrong in found.wrong and found.severity == "error"


def test_the_keys_of_a_brake_are_taken_from_the_file():
    text = edited((DRIVE, "braking_torque_nm = 60.0"), ("# braking_power_w = 500.0", "braking_power_w = 500.0"))
    drive = check(text).line.drives[0]
    assert (drive.braking_torque_nm, drive.braking_power_w, drive.braking_energy_j) == (60.0, 500.0, None)
    assert "DC link" in str(problems(edited((DRIVE, "braking_torque_nm = 60.0")))[0])


def test_a_reel_without_a_brake_is_said_to_coast_and_for_how_long():
    found = list(rollers_come_to_rest(reel_line(brakes=False)))
    assert len(found) == 3 and {one.severity for one in found} == {"warning"}
    assert "roller 3 (roller-3) coasts for 1168 s from 8 m/s" in found[2].wrong  # 83.6 / 0.28 ln 50
    assert not list(rollers_come_to_rest(reel_line()))


def test_brakes_that_are_too_weak_or_too_small_are_odd():
    (weak,) = rollers_come_to_rest(with_drive(reel_line(), 2, braking_torque_nm=60.0))
    assert weak.path == ("drives", 2, "braking_torque_nm") and "to rest, at worst" in weak.wrong
    (small,) = rollers_come_to_rest(with_drive(reel_line(), 2, braking_energy_j=3000.0))
    assert small.path == ("drives", 2, "braking_energy_j") and "it would coast from 7.07" in small.wrong


def test_a_roller_is_braked_within_its_own_torque_limit():
    """What is planned with more would be cut, and the web pulled at by those that brake as planned."""
    line = reel_line()
    rollers = [line.rollers[0], line.rollers[1].model_copy(update={"torque_nm": 90.0}), line.rollers[2]]
    own = line.model_copy(update={"rollers": rollers})
    assert brakes_of(own).torque_nm.tolist() == [280.0, 90.0, 280.0]
    (found,) = brakes_are_whole(own)
    assert (
        found.path == ("drives", 1, "braking_torque_nm")
        and found.allowed == "up to the torque limit of roller 2, 90 Nm"
    )


def test_axes_of_one_device_share_its_brake_resistor():
    line = reel_line()
    drives = [
        drive.model_copy(update={"address": 7 if i else 1, "channel": max(i, 1), "braking_energy_j": 9000.0})
        for i, drive in enumerate(line.drives)
    ]
    shared = line.model_copy(update={"drives": drives})
    brakes = brakes_of(shared)
    masses = [15.0 / 0.15**2, 76.0 / 0.45**2]
    assert brakes.power_w[0] == 5000.0 and brakes.power_w[1:].sum() == pytest.approx(5000.0)
    assert brakes.power_w[1] == pytest.approx(5000.0 * masses[0] / sum(masses))
    assert brakes.energy_j[1] == pytest.approx(9000.0 * masses[0] / sum(masses))
    assert not list(one_resistor_is_given_once(shared)) and not list(one_resistor_is_given_once(line))
    (small,) = one_resistor_is_given_once(with_drive(shared, 2, braking_power_w=2000.0))
    assert small.path == ("drives", 1, "braking_power_w") and small.severity == "warning"
    assert "drive-2, drive-3 are axes of one device" in small.wrong and "2000" in small.wrong
    (least,) = one_resistor_is_given_once(with_drive(shared, 1, braking_energy_j=4000.0))
    assert least.path == ("drives", 2, "braking_energy_j") and "4000" in least.wrong


def test_rollers_without_a_drive_are_another_rules():
    line = reel_line()
    assert not list(rollers_come_to_rest(line.model_copy(update={"drives": line.drives[:2]})))


def test_a_span_without_a_bound_is_refused_with_numbers_and_what_would_do():
    span = 'name = "span-4"\nlength_m = { value = 1.0, tolerance = 0.3 }\ncontrol = "tension"'
    text = edited((span, span.replace('"tension"', '"draw"')), (table("[[load_cells]]", "load-cell-4"), ""))
    (problem,) = problems(text)
    assert "span 4 has no bound" in problem.wrong and "its band is 58 N wide" in problem.wrong
    assert problem.allowed == "a [[load_cells]] table with span = 4"  # at full speed no tolerance would do


def test_where_tolerances_would_do_that_is_said():
    line = reel_line()
    rough = [
        roller.model_copy(
            update={"friction_nms_per_rad": roller.friction_nms_per_rad.model_copy(update={"value": 15.0})}
        )
        for roller in line.rollers
    ]
    (found,) = estimates_are_bounds(line.model_copy(update={"load_cells": line.load_cells[:2], "rollers": rough}))
    assert found.allowed.startswith("a [[load_cells]] table with span = 3, or rollers of which more is known")


def test_what_is_refused_for_other_reasons_is_left_to_them():
    line = reel_line()
    unseen = line.model_copy(update={"load_cells": line.load_cells[:2]})
    recipe = line.recipes[0].model_copy(update={"tension_n": [150.0]})
    assert not list(estimates_are_bounds(unseen.model_copy(update={"recipes": [recipe]})))
    stiff = line.recipes[0].model_copy(update={"tension_n": [5e4, 5e4, 5e4]})
    assert not list(estimates_are_bounds(unseen.model_copy(update={"recipes": [stiff]})))
    assert not list(estimates_are_bounds(unseen)) and not list(estimates_are_bounds(line))


def test_where_no_tolerance_would_do_only_a_load_cell_is_asked_for():
    line = reel_line()
    heavy = [
        roller.model_copy(
            update={"friction_nms_per_rad": roller.friction_nms_per_rad.model_copy(update={"value": 900.0})}
        )
        for roller in line.rollers
    ]
    unseen = line.model_copy(update={"load_cells": line.load_cells[:2], "rollers": heavy})
    (found,) = estimates_are_bounds(unseen)
    assert found.allowed == "a [[load_cells]] table with span = 3"

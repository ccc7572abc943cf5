"""Load cells against the balance of forces, by hand: what blames one, what blames none."""

import tomllib

import numpy as np
import pytest

from gateway.core.line import Line
from gateway.core.line_template import line_template
from gateway.core.signals import Inputs
from safety.actions import Action
from safety.cell_balance import BEFORE, CODE, WINDOWS, CellState, cell_limits, find_contradicted

N, RADIUS_M, FRICTION, INERTIA, SPEED = 4, 0.1, 0.05, 0.4, 2.0
TRUE_N = np.array((50.0, 40.0, 60.0, 55.0))


def line_of(unseen=()) -> Line:
    document = tomllib.loads(line_template(N))
    document["limits"] |= {"tension_min_n": 10.0, "tension_max_n": 100.0, "speed_max_m_per_s": 4.0}
    for roller in document["rollers"]:
        roller |= {
            "radius_m": {"value": RADIUS_M, "tolerance": 0.02},
            "inertia_kg_m2": {"value": INERTIA, "tolerance": 0.1},
            "friction_nms_per_rad": {"value": FRICTION, "tolerance": 0.1},
        }
    for span in unseen:
        document["spans"][span - 1]["control"] = "draw"
    document["load_cells"] = [cell for cell in document["load_cells"] if cell["span"] not in unseen]
    return Line.model_validate(document)


def found(line, shown_n, torque_nm, before=None, acceleration=0.0, speed=SPEED):
    """What is told after a long time at `before` (shown, torques) and a second of these; None: these all the time."""
    limits, state, inputs = cell_limits(line), CellState(), Inputs(N)
    seen = {cell.span - 1 for cell in line.load_cells}
    settled = limits.block_periods * (BEFORE + max(WINDOWS) + 1)
    now_s, told, v = 0.0, [], np.full(N, speed)
    for k in range(settled + 4 * max(WINDOWS) * limits.block_periods):
        shown, torque = (shown_n, torque_nm) if before is None or k >= settled else before
        for i in range(N):
            inputs.speed.put(i, v[i], now_s)
            if i in seen:
                inputs.tension.put(i, shown[i], now_s)
        told += find_contradicted(limits, state, inputs, torque)
        if before is None or k >= settled:
            v = v + acceleration * line.control.period_s
        now_s += line.control.period_s
    return told


def torques(true_n, acceleration=0.0, friction=FRICTION):
    behind = np.append(true_n[1:], 0.0)
    return RADIUS_M * (true_n - behind) + friction * SPEED / RADIUS_M + INERTIA / RADIUS_M * acceleration


HEALTHY = TRUE_N, torques(TRUE_N)


def with_cell(i, off_n):
    shown_n = TRUE_N.copy()
    shown_n[i] += off_n
    return shown_n


@pytest.mark.parametrize("off_n", [-30.0, 30.0])
@pytest.mark.parametrize("i", range(N))
def test_a_cell_that_changes_is_named_with_the_way_it_is_off(i, off_n):
    told = found(line_of(), with_cell(i, off_n), torques(TRUE_N), HEALTHY)
    assert {(one.rule, one.action, one.parameters["span"]) for one in told} == {(CODE, Action.BRAKE, i + 1)}
    assert 0.5 * abs(off_n) < np.sign(off_n) * told[0].parameters["off_n"] <= abs(off_n)


def test_one_that_was_wrong_from_the_beginning_is_named_as_far_as_friction_leaves_it_open():
    free = line_of()
    free = free.model_copy(update={"gate": free.gate.model_copy(update={"stress_coulomb_nm": 0.0})})
    told = found(free, with_cell(2, -45.0), torques(TRUE_N))
    assert {one.parameters["span"] for one in told} == {3}


@pytest.mark.parametrize(
    "torque_nm",
    [
        torques(TRUE_N) + np.array((0.0, 4.0, 0.0, 0.0)),  # one drive gives less than it says
        torques(TRUE_N, friction=1.1 * FRICTION),
        torques(TRUE_N),
    ],
    ids=["a drive", "friction", "nothing"],
)
def test_what_is_not_a_cells_fault_blames_none(torque_nm):
    assert found(line_of(), TRUE_N, torque_nm, HEALTHY) == []


def test_tensions_that_move_by_their_torques_blame_none():
    true_n = with_cell(1, 35.0)
    assert found(line_of(), true_n, torques(true_n), HEALTHY) == []
    assert found(line_of(), TRUE_N, torques(TRUE_N, acceleration=0.2), HEALTHY, acceleration=0.2) == []


def test_beside_a_span_without_a_cell_nothing_is_said():
    assert found(line_of(unseen=(3,)), with_cell(1, 30.0), torques(TRUE_N), HEALTHY) == []
    told = found(line_of(unseen=(4,)), with_cell(1, 30.0), torques(TRUE_N), HEALTHY)
    assert {one.parameters["span"] for one in told} == {2}

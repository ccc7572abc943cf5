"""Every rule on limits, moves and recipes: a mistake that only it can find, the line, and what is said."""

from math import isclose
from random import Random

import pytest

from gateway.core import line_rules_process
from gateway.core.line_rules_process import recipe_torque
from tests.unit.line_checks_support import (
    TEMPLATE,
    Edit,
    Refused,
    assert_refused,
    check,
    edited,
    problems,
    rules_in_table,
    rules_written,
)

REFUSED: list[Refused] = [
    (
        "tension_limits_ordered",
        [("tension_min_n = 2.0", "tension_min_n = 60.0")],
        "limits.tension_min_n",
        "tension_min_n",
        "leaves no band; allowed: below limits.tension_max_n, 60 N",
    ),
    (
        "own_limits_within_common",
        [("# torque_nm = 40.0 ", "torque_nm = 61.0 ")],
        "rollers[1].torque_nm",
        "torque_nm = 61.0",
        "= 61.0: is more than all drives have in common; allowed: up to limits.torque_nm, 60 Nm, which is the greatest "
        "of all drives",
    ),
    (
        "own_limits_within_common",
        [("# tension_max_n = 50.0 ", "tension_max_n = 61.0 ")],
        "spans[1].tension_max_n",
        "tension_max_n = 61.0",
        "= 61.0: is outside of what all spans have in common; allowed: 2 to 60 N, as in [limits]",
    ),
    (
        "web_bears_the_tension",
        [("value = 2400.0", "value = 80.0")],
        "web.stiffness_n",
        "stiffness_n",
        "the softest web (56 N) would double its length within limits.tension_max_n; allowed: "
        "value * (1 - tolerance) above 60 N",
    ),
    (
        "steps_within_limits",
        [("tension_step_max_n = 24.0", "tension_step_max_n = 58.1")],
        "limits.tension_step_max_n",
        "tension_step_max_n",
        "= 58.1: is larger than the tension band; allowed: 0 to 58 N",
    ),
    (
        "steps_within_limits",
        [("speed_step_max_m_per_s = 0.09", "speed_step_max_m_per_s = 0.13")],
        "limits.speed_step_max_m_per_s",
        "speed_step_max_m_per_s",
        "is larger than the highest speed; allowed: 0 to limits.speed_max_m_per_s, 0.12 m/s",
    ),
    (
        "latency_is_possible",
        [("latency_s = 0.010", "latency_s = 0.009")],
        "control.latency_s",
        "latency_s",
        "= 0.009: is shorter than the wire gives: a torque acts with the next cycle, 10 ms later; "
        "allowed: control.period_s (0.01 s) or more",
    ),
    (
        "watchdog_outlasts_a_late_cycle",
        [("watchdog_s = 0.1", "watchdog_s = 0.019")],
        "limits.watchdog_s",
        "watchdog_s",
        "the drives would switch off after a single late cycle; allowed: at least two periods (0.02 s), up to 0.2 s",
    ),
    (
        "stop_is_possible",
        [("stop_time_s = 10.0", "stop_time_s = 1.1")],
        "moves.stop_time_s",
        "stop_time_s",
        "torque would go off on a moving web: from 0.12 m/s at 0.1 m/s2 a stop takes 1.2 s; "
        "allowed: at least 1.2 s, or a larger moves.stop_rate_m_per_s2",
    ),
    (
        "stop_is_possible",
        [("torque_off_rate_nm_per_s = 200.0", "torque_off_rate_nm_per_s = 1001.0")],
        "moves.torque_off_rate_nm_per_s",
        "torque_off_rate",
        "is faster than a torque may change; allowed: up to limits.torque_rate_nm_per_s, 1000 Nm/s",
    ),
    (
        "drives_give_the_torque",
        [("rated_torque_nm = 60.0\n", "rated_torque_nm = 59.9\n")],
        "drives[2].rated_torque_nm",
        "rated_torque_nm = 59.9",
        "the limit asks for more than the drive gives; allowed: limits.torque_nm (60 Nm) or more",
    ),
    (
        "load_cells_see_the_tension",
        [("capacity_n = 100.0\n", "capacity_n = 59.9\n")],
        "load_cells[2].capacity_n",
        "capacity_n = 59.9",
        "cannot measure what the limits allow; allowed: limits.tension_max_n (60 N) or more",
    ),
    (
        "recipes_match_spans",
        [("24.0, 32.0]", "24.0]")],
        "recipes[1].tension_n",
        "tension_n",
        "5 tensions for 6 spans; allowed: a list of 6 numbers, one per span",
    ),
    (
        "recipes_within_tension",
        [("[28.0, 36.0", "[28.0, 60.0")],
        "recipes[1].tension_n[2]",
        "tension_n",
        "= 60.0: the limits exclude this set-point; allowed: 3 to 59 N: limits.tension_margin_n (1 N) "
        "inside the tension limits",
    ),
    (
        "recipes_within_tension",
        [("[28.0, 36.0", "[28.0, 2.0")],
        "recipes[1].tension_n[2]",
        "tension_n",
        "the limits exclude this set-point",
    ),
    (
        "recipes_within_tension",
        [("[28.0, 36.0", "[28.0, 59.1")],
        "recipes[1].tension_n[2]",
        "tension_n",
        "= 59.1: is too near to a limit; allowed: 3 to 59 N: limits.tension_margin_n (1 N) inside the tension limits",
    ),
    (
        "recipes_within_tension",
        [("[28.0, 36.0", "[28.0, 60.0"), ("tension_margin_n = 1.0", "tension_margin_n = 0.0")],
        "recipes[1].tension_n[2]",
        "tension_n",
        "the limits exclude this set-point",
    ),
    (
        "tension_limits_ordered",
        [("tension_margin_n = 1.0", "tension_margin_n = 29.0")],
        "limits.tension_margin_n",
        "tension_margin_n",
        "= 29.0: leaves no room for a set-point; allowed: 0 or more, and below 29 N, half of the band of 2 to 60 N",
    ),
    (
        "recipes_within_speed",
        [("speed_m_per_s = 0.01\n", "speed_m_per_s = 0.13\n")],
        "recipes[2].speed_m_per_s",
        "speed_m_per_s = 0.13",
        "= 0.13: the limits exclude this set-point; the stretched web reaches 0.1316 m/s; allowed: "
        "up to 0.12 m/s at every roller",
    ),
    (
        "recipes_within_speed",
        [("speed_m_per_s = 0.01\n", "speed_m_per_s = 0.12\n")],
        "recipes[2].speed_m_per_s",
        "speed_m_per_s = 0.12",
        "the stretched web reaches 0.1215 m/s",
    ),
    (
        "tensioning_in_time",
        [("tensioning_time_s = 20.0", "tensioning_time_s = 2.0")],
        "recipes[1].tension_n",
        "tension_n",
        "at moves.tension_rate_n_per_s (20 N/s) the ramp takes 3.75 s, limits.tensioning_time_s is 2 "
        "s; allowed: a faster rate, a longer time or lower tensions",
    ),
    (
        "tensioning_is_slow",
        [("# roller_speed_max_m_per_s = 0.01", "roller_speed_max_m_per_s = 0.02")],
        "stages.tensioning.roller_speed_max_m_per_s",
        "roller_speed_max_m_per_s = 0.02",
        "= 0.02: is too fast for a web that may not be there; allowed: up to 0.012 m/s: a tenth of "
        "limits.speed_max_m_per_s (0.12 m/s), and at most 0.1 m/s",
    ),
    (
        "tensioning_keeps_the_speed",
        [("tension_rate_n_per_s = 20.0", "tension_rate_n_per_s = 49.0")],
        "moves.tension_rate_n_per_s",
        "tension_rate_n_per_s",
        "moving all tensions at this rate pulls the last roller at 0.122 m/s, limits.speed_max_m_per_s is 0.12 "
        "m/s; allowed: at most 48 N/s",
    ),
    (
        "recipes_within_torque",
        [
            ("speed_m_per_s = 0.01\n", "speed_m_per_s = 0.1\n"),
            (
                '{ value = 10.0, tolerance = 0.75 }\n\n[[rollers]]\nname = "roller-3"',
                '{ value = 30.0, tolerance = 0.75 }\n\n[[rollers]]\nname = "roller-3"',
            ),
        ],
        "recipes[2]",
        "[[recipes]]",
        '"velocity" needs 75.95 Nm at roller 2 (roller-2; nominal model); allowed: '
        "limits.torque_nm, 60 Nm: lower the speed or the tension differences",
    ),
]


@pytest.mark.parametrize(("rule", "edits", "key", "row", "said"), REFUSED)
def test_each_rule_refuses_what_it_is_for(rule: str, edits: list[Edit], key: str, row: str, said: str) -> None:
    assert_refused(edits, key, row, said)


def test_every_rule_is_tested() -> None:
    tested = {rule for rule, *_ in REFUSED} | {"speed_limit_within_torque"}  # which only warns
    assert tested == rules_written(line_rules_process) == rules_in_table(line_rules_process)


def test_a_stop_that_takes_minutes_is_refused() -> None:
    assert check(edited(("stop_time_s = 10.0", "stop_time_s = 120.0"))).warnings == []
    (problem,) = problems(edited(("stop_time_s = 10.0", "stop_time_s = 120.1")))
    assert "is too large; allowed: a number above 0 up to 120 s" in str(problem)


def test_recipe_torque_is_the_paper_equation_and_its_worst_corner_is_the_worst() -> None:
    line = check(TEMPLATE).line
    recipe = line.recipes[0]
    torque = recipe_torque(line, recipe)

    def needed(stiffness: float, radius: list[float], friction: list[float], v0: float) -> list[float]:
        tension = [0.0, *recipe.tension_n, 0.0]
        speed, torques = v0, []
        for i in range(1, 7):
            speed *= (stiffness - tension[i - 1]) / (stiffness - tension[i])
            torques.append(friction[i - 1] * speed / radius[i - 1] - radius[i - 1] * (tension[i + 1] - tension[i]))
        return torques

    for ours, paper in zip(torque.running, needed(2400.0, [0.04] * 6, [10.0] * 6, 0.01), strict=True):
        assert isclose(ours, paper, rel_tol=1e-12)
    random, reached = Random(1), [0.0] * 6
    for _ in range(3000):
        # corners and inside, every roller on its own
        def pick(value: float, tolerance: float) -> float:
            return value * (1.0 + tolerance * random.choice([-1.0, 1.0, random.uniform(-1.0, 1.0)]))

        radius, friction = [pick(0.04, 0.2) for _ in range(6)], [pick(10.0, 0.75) for _ in range(6)]
        drawn = needed(pick(2400.0, 0.3), radius, friction, random.choice([0.0, 0.01]))
        reached = [max(most, abs(value)) for most, value in zip(reached, drawn, strict=True)]
    for bound, most in zip(torque.worst, reached, strict=True):
        assert bound * 0.999 <= most <= bound * (1.0 + 1e-12)

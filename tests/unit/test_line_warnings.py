"""Lines that are odd but legal are accepted with a warning, those that are just within a limit without."""

import pytest

from tests.unit.line_checks_support import Edit, check, edited

WARNED: list[tuple[list[Edit], str, str]] = [
    (
        [("[28.0, 36.0", "[28.0, 54.3")],
        "recipes[1].tension_n[2]",
        "within 5.8 N of a limit of 2 to 60 N: overshoot stops the line",
    ),
    (
        [("speed_m_per_s = 0.01\n", "speed_m_per_s = 0.11\n")],
        "recipes[2].speed_m_per_s",
        "within 10 % of limits.speed_max_m_per_s (0.12 m/s)",
    ),
    (
        [("1_000_000", "250_000")],
        "buses[1].bitrate_bit_per_s",
        "the bus is loaded to 61% at a period of 10 ms; above 80% it would be refused",
    ),
    ([("latency_s = 0.010", "latency_s = 0.05")], "control.latency_s", "is 5 periods: the wire gives one"),
    (
        [("stop_rate_m_per_s2 = 0.1", "stop_rate_m_per_s2 = 0.04")],
        "moves.stop_rate_m_per_s2",
        "a controlled stop is slower than an ordinary speed change",
    ),
    (
        [("rated_torque_nm = 60.0\n", "rated_torque_nm = 6000.0\n")],
        "drives[2].rated_torque_nm",
        "commands have steps of 6 Nm, coarse against a limit of 60 Nm",
    ),
    (
        [("capacity_n = 100.0\n", "capacity_n = 65.0\n")],
        "load_cells[2].capacity_n",
        "hardly above limits.tension_max_n",
    ),
    (
        [("value = 2400.0", "value = 700.0"), ("tension_rate_n_per_s = 20.0", "tension_rate_n_per_s = 10.0")],
        "web.stiffness_n",
        "at limits.tension_max_n the web stretches by 12%",
    ),
    (
        [("speed_max_m_per_s = 0.12", "speed_max_m_per_s = 0.3")],
        "limits.speed_max_m_per_s",
        'at this speed "tension" needs 77.29 Nm',
    ),
]


@pytest.mark.parametrize(("edits", "key", "said"), WARNED)
def test_odd_but_legal_lines_are_accepted_with_a_warning(edits: list[Edit], key: str, said: str) -> None:
    warnings = {warning.key: str(warning) for warning in check(edited(*edits)).warnings}
    assert key in warnings
    assert len(warnings) <= 2  # a faster recipe needs more torque, too
    assert said in warnings[key]


ALLOWED: list[list[Edit]] = [
    [("tension_step_max_n = 24.0", "tension_step_max_n = 58.0")],
    [("tension_step_max_n = 24.0", "tension_step_max_n = 0.0")],
    [("speed_step_max_m_per_s = 0.09", "speed_step_max_m_per_s = 0.12")],
    [("latency_s = 0.010", "latency_s = 0.015")],
    [("latency_s = 0.010", "latency_s = 0.04")],
    [("watchdog_s = 0.1", "watchdog_s = 0.02")],
    [("stop_time_s = 10.0", "stop_time_s = 1.2")],
    [("stop_rate_m_per_s2 = 0.1", "stop_rate_m_per_s2 = 0.05")],
    [("torque_off_rate_nm_per_s = 200.0", "torque_off_rate_nm_per_s = 1000.0")],
    [("rated_torque_nm = 60.0\n", "rated_torque_nm = 1200.0\n")],
    [("capacity_n = 100.0\n", "capacity_n = 66.0\n")],
    [("[28.0, 36.0", "[28.0, 7.9")],
    [("[28.0, 36.0", "[28.0, 54.1")],
    [("tensioning_time_s = 20.0", "tensioning_time_s = 3.8")],
    [("address = 3\n", "address = 127\n")],
    [('"udp_multicast"', '"virtual"'), ("port = 43113 ", "# ")],
    [('"udp_multicast"', '"socketcan"'), ("port = 43113 ", "# "), ('"239.74.163.2"', '"can0"')],
    [('"udp_multicast"', '"socketcan"'), ("port = 43113 ", "# "), ('"239.74.163.2"', '"slcan0123456789"')],
    [('"239.74.163.2"', '"ff15::2"')],
    [('"127.0.0.1"', '"::1"')],
    [('"127.0.0.1"', '"io-rack.hall-3"')],
]


@pytest.mark.parametrize("edits", ALLOWED)
def test_what_is_just_allowed_is_accepted_without_a_word(edits: list[Edit]) -> None:
    assert check(edited(*edits)).warnings == []


def test_at_the_limit_is_accepted() -> None:
    (warning,) = check(edited(("capacity_n = 100.0\n", "capacity_n = 60.0\n"))).warnings
    assert "hardly above" in str(warning)
    # T_0 = 20 N shortens the stretch: 0.119 m/s * 2380 / 2370 = 0.1195 m/s
    text = edited(
        ("tension_before_n = 0.0", "tension_before_n = 20.0"), ("speed_m_per_s = 0.01\n", "speed_m_per_s = 0.119\n")
    )
    assert "recipes[2].speed_m_per_s" in {warning.key for warning in check(text).warnings}


def test_a_recipe_as_near_to_a_limit_as_allowed_is_accepted() -> None:
    for tension_n in ("59.0", "3.0"):
        (warning,) = check(edited(("[28.0, 36.0", f"[28.0, {tension_n}"))).warnings
        assert "overshoot stops the line" in str(warning)


def test_torque_that_only_a_corner_of_the_tolerances_needs_is_a_warning() -> None:
    text = edited(("speed_m_per_s = 0.01\n", "speed_m_per_s = 0.1\n"), ("torque_nm = 60.0", "torque_nm = 54.0"))
    warnings = {warning.key: str(warning) for warning in check(text).warnings}
    assert "at roller 6 (roller-6; worst corner of the tolerances)" in warnings["recipes[2]"]
    text = edited(
        ("torque_nm = 60.0", "torque_nm = 4.2"),
        ("speed_max_m_per_s = 0.12", "speed_max_m_per_s = 0.0102"),
        ("speed_step_max_m_per_s = 0.09", "speed_step_max_m_per_s = 0"),
        ("tension_rate_n_per_s = 20.0", "tension_rate_n_per_s = 4.0"),
    )
    warnings = {warning.key: str(warning) for warning in check(text).warnings}
    assert "needs 3.814 Nm at roller 6 (roller-6; nominal model)" in warnings["recipes[1]"]

"""Every rule across tables: a mistake that only it can find, the line, and what is said."""

from math import isclose
from random import Random

import pytest

from gateway.core import line_rules_process, line_rules_wiring
from gateway.core.can_load import bus_load, can_load, fitting_buses, fitting_period_s, frame_bits
from gateway.core.line import CanopenBus
from gateway.core.line_checks import RULES
from gateway.core.line_file import CheckedLine, check_line
from gateway.core.line_problem import LineRefused, Problem
from gateway.core.line_rules_process import recipe_torque
from gateway.core.line_template import line_template

MAPS = {
    "cia402-torque": ("canopen", "drive", ""),
    "other-drive": ("canopen", "drive", ""),
    "loadcell-amp": ("modbus-tcp", "load-cell", ""),
    "line-plc": ("modbus-tcp", "line-plc", ""),
}
RACK = {
    "rack-drive": ("modbus-tcp", "drive", "rack"),
    "rack-cells": ("modbus-tcp", "load-cell", "rack"),
    "rack-plc": ("modbus-tcp", "line-plc", "rack"),
}
TEMPLATE = line_template(6)
Edit = tuple[str, str]


def edited(*edits: Edit, spans: int = 6) -> str:
    text = line_template(spans)
    for old, new in edits:
        assert old in text, f"{old!r} is not in the template"
        text = text.replace(old, new, 1)
    return text


def check(text: str) -> CheckedLine:
    return check_line(text, "line.toml", MAPS)


def problems(text: str) -> list[Problem]:
    with pytest.raises(LineRefused) as refused:
        check(text)
    return refused.value.problems


def table(header: str, name: str, text: str = TEMPLATE) -> str:
    """The text of the table with this name, to be taken away or doubled."""
    return next(block for block in text.split("\n\n") if block.startswith(header) and f'name = "{name}"\n' in block)


#: name of the rule; edits; key of the only problem; text of the line it must be on; what must be said
REFUSED: list[tuple[str, list[Edit], str, str, str]] = [
    (
        "rollers_match_spans",
        [(table("[[rollers]]", "roller-6"), ""), (table("[[drives]]", "drive-6"), "")],
        "rollers",
        "[[rollers]]",
        "5 rollers and 6 spans; allowed: one [[rollers]] table per [[spans]] table: span i ends at roller i",
    ),
    (
        "one_drive_per_roller",
        [(table("[[drives]]", "drive-3"), "")],
        "rollers[3]",
        "[[rollers]]",
        "roller 3 has no drive; allowed: a [[drives]] table with roller = 3",
    ),
    (
        "one_load_cell_per_span",
        [(table("[[load_cells]]", "load-cell-4"), "")],
        "spans[4]",
        "[[spans]]",
        'span 4 has no load cell; allowed: a [[load_cells]] table with span = 4, or control = "draw" on this span',
    ),
    (
        "unique_names",
        [('name = "roller-2"', 'name = "roller-1"')],
        "rollers[2].name",
        'name = "roller-1"',
        "is already the name of rollers[1]; allowed: each of the [[rollers]] its own name",
    ),
    (
        "unique_names",
        [('name = "span-2"', 'name = "span-1"')],
        "spans[2].name",
        'name = "span-1"',
        "is already the name of spans[1]",
    ),
    (
        "unique_names",
        [('name = "velocity"', 'name = "tension"')],
        "recipes[2].name",
        'name = "tension"',
        "is already the name of recipes[1]",
    ),
    (
        "unique_device_names",
        [('name = "load-cell-2"', 'name = "drive-2"')],
        "load_cells[2].name",
        'name = "drive-2"',
        "is already the name of drives[2]; allowed: each device its own name",
    ),
    (
        "buses_exist",
        [('bus = "drives"', 'bus = "drive"')],
        "drives[1].bus",
        'bus = "drive"',
        '= "drive": there is no such bus; allowed: one of "drives", "io"; did you mean "drives"?',
    ),
    ("buses_exist", [('bus = "io"', 'bus = "oi"')], "load_cells[1].bus", 'bus = "oi"', 'did you mean "io"?'),
    (
        "buses_are_used",
        [("# Drives:", '[[buses]]\nname = "spare"\nprotocol = "modbus-tcp"\nhost = "h"\n\n# Drives:')],
        "buses[3].name",
        'name = "spare"',
        "no device is on this bus; allowed: a bus that some device names, or no table",
    ),
    (
        "addresses_differ",
        [("address = 3\n", "address = 2\n")],
        "drives[3].address",
        "address = 2",
        '= 2: is already the address of drives[2] on bus "drives"; allowed: each device its own '
        "address on its bus; did you mean 3?",
    ),
    (
        "addresses_differ",
        [("channel = 3\n", "channel = 2\n")],
        "load_cells[3].channel",
        "channel = 2",
        "= 2: is already the channel of load_cells[2]; allowed: each its own channel of the device they share; "
        "did you mean 3?",
    ),
    (
        "canopen_addresses",
        [("address = 3\n", "address = 128\n")],
        "drives[3].address",
        "address = 128",
        "= 128: is no CANopen node; allowed: a whole number from 1 to 127 on a CANopen bus",
    ),
    (
        "maps_fit",
        [('map = "cia402-torque"', 'map = "cia402-torqe"')],
        "drives[1].map",
        'map = "cia402-torqe"',
        'there is no such map; allowed: for a drive on canopen: "cia402-torque", "other-drive"; '
        'did you mean "cia402-torque"?',
    ),
    (
        "maps_fit",
        [('map = "cia402-torque"', 'map = "line-plc"')],
        "drives[1].map",
        'map = "line-plc"',
        "is a map for a line-plc on modbus-tcp; allowed: for a drive on canopen",
    ),
    (
        "maps_fit",
        [('map = "line-plc"', 'map = "loadcell-amp"')],
        "plc.map",
        'map = "loadcell-amp"',
        "is a map for a load-cell on modbus-tcp; allowed: for a line-plc on modbus-tcp: "
        '"line-plc"; did you mean "line-plc"?',
    ),
    (
        "buses_are_reachable",
        [('"239.74.163.2"', '"192.168.0.2"')],
        "buses[1].channel",
        "channel",
        "is no multicast address; allowed: 224.0.0.0 to 239.255.255.255",
    ),
    ("buses_are_reachable", [('"239.74.163.2"', '"can0"')], "buses[1].channel", "channel", "is no multicast address"),
    (
        "buses_are_reachable",
        [("port = 43113 ", "# ")],
        "buses[1].port",
        "[[buses]]",
        "is missing; allowed: a whole number from 1 to 65535 (udp_multicast needs it)",
    ),
    (
        "buses_are_reachable",
        [('"udp_multicast"', '"virtual"')],
        "buses[1].port",
        "port = 43113",
        'interface "virtual" has no port; allowed: no such key',
    ),
    (
        "buses_are_reachable",
        [('"udp_multicast"', '"socketcan"'), ("port = 43113 ", "# ")],
        "buses[1].channel",
        "channel",
        "is no CAN network interface",
    ),
    (
        "buses_are_reachable",
        [('"127.0.0.1"', '"tcp://plc-1/"')],
        "buses[2].host",
        "host",
        'is no host; allowed: an address or a name, as "192.168.0.10"; did you mean "plc-1"?',
    ),
    (
        "can_buses_have_room",
        [("1_000_000", "125_000")],
        "buses[1].bitrate_bit_per_s",
        "bitrate_bit_per_s",
        "the bus is loaded to 123% at a period of 10 ms; allowed: at most 80%: a higher bitrate, "
        "or control.period_s = 0.016 or longer, or the drives spread over 2 buses",
    ),
    (
        "tension_limits_ordered",
        [("tension_min_n = 2.0", "tension_min_n = 60.0")],
        "limits.tension_min_n",
        "tension_min_n",
        "leaves no band; allowed: below limits.tension_max_n, 60 N",
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
        "at moves.tension_rate_n_per_s (20 N/s) the ramp takes 2 s, limits.tensioning_time_s is 2 "
        "s; allowed: a faster rate, a longer time or lower tensions",
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
    text = edited(*edits)
    found = problems(text)
    mine = [problem for problem in found if problem.key == key]
    assert len(mine) == 1, "\n".join(map(str, found))
    assert said in str(mine[0])
    assert text.split("\n")[mine[0].line - 1].startswith(row)
    # The same file may break one rule more (a load cell is missing because a span was misnumbered), but not the world.
    assert len(found) <= 2, "\n".join(map(str, found))


def test_every_rule_is_tested() -> None:
    tested = {rule for rule, *_ in REFUSED} | {"speed_limit_within_torque"}  # which only warns
    names = {getattr(rule.check, "func", rule.check).__name__ for rule in RULES}
    names |= {"addresses_differ", "maps_fit"}  # which need the maps
    assert names == tested
    written = {
        name
        for module in (line_rules_process, line_rules_wiring)
        for name, function in vars(module).items()
        if getattr(function, "__module__", "") == module.__name__
        and "Iterator[gateway.core.line_problem.Finding]"
        in str(getattr(function, "__annotations__", {}).get("return", ""))
        and not name.startswith("_")
    }
    assert written == tested


def test_wrong_roller_and_span_numbers_name_the_free_one() -> None:
    found = {problem.key: str(problem) for problem in problems(edited(("roller = 3\n", "roller = 7\n")))}
    assert (
        "= 7: there is no such roller; allowed: 1 to 6, in the order of the [[rollers]] tables; "
        "did you mean 3?" in (found["drives[3].roller"])
    )
    found = {problem.key: str(problem) for problem in problems(edited(("span = 5\n", "span = 4\n")))}
    assert "span 4 already has a load cell, load_cells[4]" in found["load_cells[5].span"]
    assert "did you mean 5?" in found["load_cells[5].span"]
    found = {problem.key: str(problem) for problem in problems(edited(("roller = 3\n", "roller = 2\n")))}
    assert "roller 2 already has a drive, drives[2]" in found["drives[3].roller"]


def test_plc_and_amplifier_must_not_share_a_unit() -> None:
    text = edited(("address = 2                             # Modbus unit", "address = 1  # Modbus unit"))
    assert [problem.key for problem in problems(text)] == ["plc.address"]


def test_two_tables_for_one_wire_are_refused() -> None:
    text = edited(("address = 24\n", "address = 1\n"), spans=48).replace("43114", "43113")
    assert "is the same wire as buses[1]; allowed: one table per wire" in str(
        next(problem for problem in problems(text) if problem.key == "buses[2].channel")
    )


def test_a_draw_span_needs_no_load_cell_and_one_on_it_only_indicates() -> None:
    draw = ('name = "span-4"\nlength_m = { value = 1.0, tolerance = 0.3 }\ncontrol = "tension"',) * 2
    draw = (draw[0], draw[1].replace('"tension"', '"draw"'))
    assert check(edited(draw, (table("[[load_cells]]", "load-cell-4"), ""))).warnings == []
    (warning,) = check(edited(draw)).warnings
    assert warning.key == "load_cells[4].span"
    assert "span 4 is draw-controlled: this load cell only indicates" in str(warning)


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
    [("tensioning_time_s = 20.0", "tensioning_time_s = 2.1")],
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


def test_an_empty_virtual_channel_is_refused() -> None:
    text = edited(('"udp_multicast"', '"virtual"'), ("port = 43113 ", "# "), ('"239.74.163.2"', '""'))
    assert ["buses[1].channel"] == [problem.key for problem in problems(text)]


def test_amplifiers_of_two_types_must_not_share_a_unit() -> None:
    text = edited(("channel = 2\n", "channel = 2 \n"), ('map = "loadcell-amp"\n', 'map = "other-amp"\n'))
    with pytest.raises(LineRefused) as refused:
        check_line(text, "line.toml", {**MAPS, "other-amp": ("modbus-tcp", "load-cell", "")})
    # load cell 2 clashes with 1, and 3 to 6 with 2: each is told
    assert [problem.key for problem in refused.value.problems] == [f"load_cells[{i}].address" for i in range(2, 7)]


def in_a_rack(*edits: Edit) -> str:
    """Everything behind unit 1 of the bus io, as devices of one family; drives by channel."""
    blocks = TEMPLATE.split("\n\n")
    blocks.remove(next(block for block in blocks if "[[buses]]" in block and 'name = "drives"' in block))
    for i, block in enumerate(blocks):
        if "[[drives]]" in block:
            rows = [row for row in block.split("\n") if not row.startswith(("address", "# channel", "bus", "map", "#"))]
            number = rows[1].split('"')[1].removeprefix("drive-")
            blocks[i] = "\n".join([*rows, 'bus = "io"', 'map = "rack-drive"', "address = 1", f"channel = {number}"])
    text = "\n\n".join(blocks)
    text = text.replace('map = "loadcell-amp"', 'map = "rack-cells"').replace('map = "line-plc"', 'map = "rack-plc"')
    text = text.replace("address = 2                             # Modbus unit", "address = 1  # Modbus unit")
    for old, new in edits:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


def test_devices_of_one_family_share_an_address() -> None:
    assert check_line(in_a_rack(), "line.toml", RACK).warnings == []


@pytest.mark.parametrize(
    ("edits", "key", "said"),
    [
        ([("address = 1\nchannel = 3", "address = 1\nchannel = 2")], "drives[3].channel", "channel of drives[2]"),
        ([("address = 1\nchannel = 3\n\n", "address = 1\n\n")], "drives[3].channel", "channel of drives[1]"),
        ([("channel = 3\nspan", "channel = 2\nspan")], "load_cells[3].channel", "channel of load_cells[2]"),
    ],
)
def test_channels_of_a_family_differ_by_kind(edits: list[Edit], key: str, said: str) -> None:
    with pytest.raises(LineRefused) as refused:
        check_line(in_a_rack(*edits), "line.toml", RACK)
    (problem,) = refused.value.problems
    assert problem.key == key and problem.nearest == "3"
    assert said in str(problem)


def test_another_family_or_none_does_not_share_an_address() -> None:
    for family in ("", "other"):
        maps = {**RACK, "rack-plc": ("modbus-tcp", "line-plc", family)}
        with pytest.raises(LineRefused) as refused:
            check_line(in_a_rack(), "line.toml", maps)
        assert [problem.key for problem in refused.value.problems] == ["plc.address"]


def test_a_wrong_map_is_told_once_and_not_as_clashes_of_addresses() -> None:
    # All load cells share the amplifier's address. With the map of one mistyped only that is wrong.
    for wrong in ("loadcel-amp", "line-plc"):
        (problem,) = problems(edited(('map = "loadcell-amp"', f'map = "{wrong}"')))
        assert (problem.key, problem.nearest) == ("load_cells[1].map", '"loadcell-amp"')


def test_a_recipe_as_near_to_a_limit_as_allowed_is_accepted() -> None:
    for tension_n in ("59.0", "3.0"):
        (warning,) = check(edited(("[28.0, 36.0", f"[28.0, {tension_n}"))).warnings
        assert "overshoot stops the line" in str(warning)


def test_a_stop_that_takes_minutes_is_refused() -> None:
    assert check(edited(("stop_time_s = 10.0", "stop_time_s = 120.0"))).warnings == []
    (problem,) = problems(edited(("stop_time_s = 10.0", "stop_time_s = 120.1")))
    assert "is too large; allowed: a number above 0 up to 120 s" in str(problem)


def test_the_free_address_is_that_of_the_same_bus() -> None:
    (problem,) = problems(edited(("address = 5\n", "address = 4\n")))
    assert (problem.key, problem.nearest) == ("drives[5].address", "5")


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


def stuffed_worst(data_bytes: int) -> int:
    """Longest frame by construction: a stuff bit after the first five of 34 + 8 s bits and "
    "after every four more."""
    exposed = 34 + 8 * data_bytes
    stuff_bits = sum(1 for position in range(5, exposed + 1) if (position - 5) % 4 == 0)
    unstuffed_tail = 10 + 3  # CRC delimiter, acknowledge slot and delimiter, end of frame; interframe space
    return exposed + stuff_bits + unstuffed_tail


def test_can_load_counts_every_bit_of_the_cycle() -> None:
    for size in range(9):
        assert frame_bits(size) == stuffed_worst(size)
    # 6 drives at 4 ms on 1 Mbit/s: 55 + 6 * (105 + 135) bits a period, 6 * 65 bits every 100 ms
    assert isclose(can_load(6, 0, 1_000_000, 0.004), (1495 / 0.004 + 390 / 0.1) / 1e6)
    bus = check(TEMPLATE).line.buses[0]
    assert isinstance(bus, CanopenBus)
    assert isclose(bus_load(check(TEMPLATE).line, bus), (1495 / 0.010 + 3900) / 1e6)


def test_what_would_fit_does_fit() -> None:
    period = fitting_period_s(60, 0, 500_000)
    assert period is not None
    assert can_load(60, 0, 500_000, period) <= 0.8 < can_load(60, 0, 500_000, period - 0.001)
    assert fitting_buses(60, 1_000_000, 0.010) == 2
    assert fitting_buses(1, 125_000, 0.001) is None
    assert fitting_period_s(127, 0, 125_000) is None


def test_a_bus_just_below_the_limit_passes_and_one_drive_more_is_refused() -> None:
    # 32 drives: (55 + 32 * 240) / 10 ms + 32 * 650 = 79.4 %; 33: 81.9 %
    def on_one_bus(drives: int) -> str:
        text = line_template(drives).replace('bus = "drives-2"', 'bus = "drives-1"')
        for node in range(drives, (drives + 1) // 2, -1):
            text = text.replace(
                f"address = {node - (drives + 1) // 2}\nroller = {node}\n", f"address = {node}\nroller = {node}\n"
            )
        return text.replace(next(b for b in text.split("\n\n") if 'name = "drives-2"\n' in b), "")

    (warning,) = check(on_one_bus(32)).warnings
    assert "loaded to 79%" in str(warning)
    (problem,) = problems(on_one_bus(33))
    assert "loaded to 82%" in str(problem)
    assert problem.allowed == ("at most 80%: control.period_s = 0.011 or longer, or the drives spread over 2 buses")
    slow = problems(on_one_bus(48).replace("1_000_000", "125_000"))
    assert slow[0].allowed == "at most 80%: a higher bitrate, or the drives spread over 16 buses"

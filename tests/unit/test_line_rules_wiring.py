"""Every rule on rollers, spans, devices and buses: a mistake that only it can find, the line, and what is said."""

import pytest

from gateway.core import line_rules_wiring
from tests.unit.line_checks_support import (
    Edit,
    Refused,
    assert_refused,
    check,
    edited,
    problems,
    rules_in_table,
    rules_written,
    table,
)

REFUSED: list[Refused] = [
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
]


@pytest.mark.parametrize(("rule", "edits", "key", "row", "said"), REFUSED)
def test_each_rule_refuses_what_it_is_for(rule: str, edits: list[Edit], key: str, row: str, said: str) -> None:
    assert_refused(edits, key, row, said)


def test_every_rule_is_tested() -> None:
    tested = {rule for rule, *_ in REFUSED}
    assert tested == rules_written(line_rules_wiring)
    assert tested == rules_in_table(line_rules_wiring) | {"addresses_differ", "maps_fit"}  # which need the maps


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


def test_two_tables_for_one_wire_are_refused() -> None:
    text = edited(("address = 24\n", "address = 1\n"), spans=48).replace("43114", "43113")
    assert "is the same wire as buses[1]; allowed: one table per wire" in str(
        next(problem for problem in problems(text) if problem.key == "buses[2].channel")
    )


def test_a_draw_span_needs_no_load_cell_and_one_on_it_only_indicates() -> None:
    draw = ('name = "span-4"\nlength_m = { value = 1.0, tolerance = 0.3 }\ncontrol = "tension"',) * 2
    draw = (draw[0], draw[1].replace('"tension"', '"draw"'))
    known = edited(draw, (table("[[load_cells]]", "load-cell-4"), ""))
    known = known.replace("tolerance = 0.75", "tolerance = 0.002").replace(
        "0.04, tolerance = 0.2", "0.04, tolerance = 0.001"
    )
    assert check(known).warnings == []
    (warning,) = check(edited(draw)).warnings
    assert warning.key == "load_cells[4].span"
    assert "span 4 is draw-controlled: this load cell only indicates" in str(warning)


def test_an_empty_virtual_channel_is_refused() -> None:
    text = edited(('"udp_multicast"', '"virtual"'), ("port = 43113 ", "# "), ('"239.74.163.2"', '""'))
    assert ["buses[1].channel"] == [problem.key for problem in problems(text)]

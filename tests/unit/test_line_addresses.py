"""Which devices may share an address, and what is said where one must not."""

import pytest

from gateway.core.line_file import check_line
from gateway.core.line_problem import LineRefused
from tests.unit.line_checks_support import MAPS, TEMPLATE, Edit, edited, problems

RACK = {
    "rack-drive": ("modbus-tcp", "drive", "rack"),
    "rack-cells": ("modbus-tcp", "load-cell", "rack"),
    "rack-plc": ("modbus-tcp", "line-plc", "rack"),
}


def test_plc_and_amplifier_must_not_share_a_unit() -> None:
    text = edited(("address = 2                             # Modbus unit", "address = 1  # Modbus unit"))
    assert [problem.key for problem in problems(text)] == ["plc.address"]


def test_amplifiers_of_two_types_must_not_share_a_unit() -> None:
    text = edited(("channel = 2\n", "channel = 2 \n"), ('map = "loadcell-amp"\n', 'map = "other-amp"\n'))
    with pytest.raises(LineRefused) as refused:
        check_line(text, "line.toml", {**MAPS, "other-amp": ("modbus-tcp", "load-cell", "")})
    # load cell 2 clashes with 1, and 3 to 6 with 2: each is told
    assert [problem.key for problem in refused.value.problems] == [f"load_cells[{i}].address" for i in range(2, 7)]


def test_the_free_address_is_that_of_the_same_bus() -> None:
    (problem,) = problems(edited(("address = 5\n", "address = 4\n")))
    assert (problem.key, problem.nearest) == ("drives[5].address", "5")


def test_a_wrong_map_is_told_once_and_not_as_clashes_of_addresses() -> None:
    # All load cells share the amplifier's address. With the map of one mistyped only that is wrong.
    for wrong in ("loadcel-amp", "line-plc"):
        (problem,) = problems(edited(('map = "loadcell-amp"', f'map = "{wrong}"')))
        assert (problem.key, problem.nearest) == ("load_cells[1].map", '"loadcell-amp"')


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

"""Devices that give no usable value when the line is armed are named with what their bus has told of them."""

import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.finding import LONGEST_PARAMETER, Finding
from gateway.core.signals import LinkHealth
from gateway.loop.arming import unheard
from tests.closed_loop.conftest import demo_line, real_plant

LINE, PLANT = demo_line(), real_plant()
CELL = LINE.load_cells[0]


class Silent:
    """A bus on which nothing answers."""

    def __init__(self, name: str, last_error: str) -> None:
        self.name = name
        self.health = LinkHealth(last_error=last_error)


def found(last_error: str) -> list[Finding]:
    """Of a line whose buses have all told that, and from which no sample has ever come."""
    loop = SteppedLoop(LINE, design_lqi(task_of(LINE)), PLANT, 1)
    loop.cycle.links[:] = [Silent(bus.name, last_error) for bus in LINE.buses]
    return unheard(loop.cycle)


def devices(findings: list[Finding]) -> list[tuple[str, object]]:
    return [(one.code, one.parameters.get("plc", one.parameters.get("cell"))) for one in findings]


UNHEARD = [("plc-unheard", LINE.plc.name), *(("load-cell-unheard", cell.name) for cell in LINE.load_cells)]


@pytest.mark.parametrize("told", ["bus plant: BadTooManySessions", "gaierror: the name cannot be resolved"])
def test_what_the_buses_of_unheard_devices_have_told_is_told_once(told: str) -> None:
    findings = found(told)
    assert devices([one for one in findings if one.code != "bus-told"]) == UNHEARD
    buses = [one.parameters for one in findings if one.code == "bus-told"]
    assert buses == [{"bus": bus, "told": told} for bus in dict.fromkeys(each.bus for each in (LINE.plc, CELL))]


def test_what_is_anothers_trouble_is_no_cause_and_nothing_is_told_where_nothing_was() -> None:
    told = f"{CELL.name}: no connection to 10.0.0.7:502"
    codes = [one.code for one in found(told)]
    assert codes[:3] == ["plc-unheard", "load-cell-unheard", "bus-told"] and codes.count("bus-told") == 1
    assert devices(found("")) == UNHEARD


def test_what_a_device_has_written_plays_no_tricks_with_a_terminal() -> None:
    told = next(one for one in found("bus x: \x1b[31m" + "far too long " * 100) if one.code == "bus-told")
    assert "\x1b" not in str(told.parameters["told"]) and len(str(told.parameters["told"])) == LONGEST_PARAMETER

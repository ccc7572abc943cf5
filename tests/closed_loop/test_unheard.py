"""Devices that give no usable value when the line is armed are named with what their bus has told of them."""

import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.signals import LinkHealth
from gateway.loop.arming import LONGEST_TROUBLE, unheard
from tests.closed_loop.conftest import demo_line, real_plant

LINE, PLANT = demo_line(), real_plant()
CELL = LINE.load_cells[0]


class Silent:
    """A bus on which nothing answers."""

    def __init__(self, name: str, last_error: str) -> None:
        self.name = name
        self.health = LinkHealth(last_error=last_error)


def reasons(last_error: str) -> dict[str, str]:
    """By device, of a line whose buses have all told that, and from which no sample has ever come."""
    loop = SteppedLoop(LINE, design_lqi(task_of(LINE)), PLANT, 1)
    loop.cycle.links[:] = [Silent(bus.name, last_error) for bus in LINE.buses]
    said = [one for one in unheard(loop.cycle) if isinstance(one, str)]
    devices = [LINE.plc, *LINE.load_cells]
    return {one.name: next(text for text in said if one.name in text) for one in devices}


@pytest.mark.parametrize("told", ["bus plant: BadTooManySessions", "gaierror: the name cannot be resolved"])
def test_the_cause_stands_behind_each_device_of_that_bus(told: str) -> None:
    found = reasons(told)
    assert all(text.endswith(f"; its bus told last: {told}") for text in found.values())
    assert "no usable answer" in found[LINE.plc.name] and "no usable value" in found[CELL.name]


def test_what_is_anothers_trouble_is_no_cause_and_nothing_is_appended_where_nothing_was_told() -> None:
    found = reasons(f"{CELL.name}: no connection to 10.0.0.7:502")
    assert [name for name, text in found.items() if "10.0.0.7" in text] == [CELL.name]
    assert not any("told last" in text for text in reasons("").values())


def test_what_a_device_has_written_plays_no_tricks_with_a_terminal() -> None:
    text = reasons("bus x: \x1b[31m" + "far too long " * 100)[CELL.name]
    assert "\x1b" not in text and len(text) < LONGEST_TROUBLE + 120

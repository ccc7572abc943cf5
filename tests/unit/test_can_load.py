"""The load of a CAN bus: every bit of a cycle, and what would fit."""

from math import isclose

from gateway.core.can_load import bus_load, can_load, fitting_buses, fitting_period_s, frame_bits
from gateway.core.line import CanopenBus
from gateway.core.line_template import line_template
from tests.unit.line_checks_support import TEMPLATE, check, problems


def stuffed_worst(data_bytes: int) -> int:
    """Longest frame by construction: a stuff bit after the first five of 34 + 8 s bits and after every four more."""
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

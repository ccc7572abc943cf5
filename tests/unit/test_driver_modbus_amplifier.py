"""A load-cell amplifier that lacks what others have: no sample counter, no channel count, a status in some bits."""

import pytest

from drivers.device_map import MAPS, load_map
from drivers.modbus.amplifier import Amplifier
from drivers.modbus.device import Standing
from drivers.modbus.maps import LoadCellMap
from gateway.core.line import LoadCell
from gateway.core.signals import Inputs, Quality

CELL = LoadCell(name="cell", bus="io", map="hbm-wtx", address=1, span=1, capacity_n=200.0)
STANDING = Standing()


def terminal() -> Amplifier:
    device = load_map(MAPS / "hbm-wtx.toml")
    assert isinstance(device, LoadCellMap)
    return Amplifier(device, [CELL])


def test_a_force_in_grams_becomes_newtons() -> None:
    amplifier, inputs = terminal(), Inputs(1)
    assert list(amplifier.wish.reads) == [(2, "i32"), (4, "u16")]
    for grams, newtons in ((10_000, 98.0665), (-5, -0.04903), (10_000, 98.0665), (10_000, 98.0665)):
        assert amplifier.fill(inputs, (grams, 0x1010), STANDING, 1.0) == [], "no counter is asked for"
        assert inputs.tension.value[0] == pytest.approx(newtons, abs=1e-5) and inputs.tension.good()


@pytest.mark.parametrize(
    ("status", "text"),
    [
        (0x0001, "general weight error"),
        (0x1018, "overload"),
        (0x000C, "above the safe load limit"),
        (0x000F, "channel status 15"),
    ],
)
def test_only_the_bits_of_the_mask_speak(status: int, text: str) -> None:
    amplifier, inputs = terminal(), Inputs(1)
    assert amplifier.fill(inputs, (100, status), STANDING, 1.0) == [f"cell: {text}"]
    assert inputs.tension.quality[0] == Quality.BAD


@pytest.mark.parametrize(
    ("word", "fits"), [(0x0030, True), (0xC03C, True), (0x0020, False), (0x00B0, False), (0x31, False)]
)
def test_a_terminal_that_counts_in_another_unit_is_refused(word: int, fits: bool) -> None:
    (check,) = terminal().proofs.identity
    assert check.register.address == 5
    assert (check.judge(word) == []) is fits

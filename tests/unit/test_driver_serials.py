"""Serial numbers of devices as their maps name them: numbers, texts, and what a map may not say."""

import pytest
from pydantic import ValidationError

from drivers.device_map import MAPS, MapRefused, load_map
from drivers.modbus.maps import ModbusMap, SerialRegister
from drivers.modbus.registers import SerialNumber


@pytest.mark.parametrize(
    ("entry", "order", "registers", "told"),
    [
        ({"type": "u16"}, "high-first", [4711], "4711"),
        ({"type": "u32"}, "high-first", [1, 2], "65538"),
        ({"type": "u32"}, "low-first", [2, 1], "65538"),
        ({"type": "u64"}, "low-first", [4, 3, 2, 1], str(0x0001_0002_0003_0004)),
        ({"type": "u64"}, "high-first", [0] * 4, ""),
        ({"type": "text", "registers": 4}, "low-first", [0x2053, 0x4E2D, 0x3720, 0], "SN-7"),
        ({"type": "text", "registers": 2}, "high-first", [0x411B, 0x20FF], r"A\u001b \xff"),
        ({"type": "text", "registers": 2}, "high-first", [0x2020, 0], ""),
    ],
)
def test_registers_are_a_number_or_a_text(
    entry: dict[str, object], order: str, registers: list[int], told: str
) -> None:
    device = load_map(MAPS / "line-plc.toml")
    assert isinstance(device, ModbusMap)
    serial = SerialRegister.model_validate({"address": 41, **entry})
    changed = device.model_copy(update={"address_base": 1, "word_order": order, "serial": serial})
    number = SerialNumber.of(changed)
    assert number is not None and (number.printed, number.address, number.count) == (41, 40, len(registers))
    assert number.decode(registers) == told
    with pytest.raises(ValueError, match="registers, asked for"):
        number.decode([*registers, 0])


def test_a_text_says_how_long_it_is_and_no_register_means_two_things(tmp_path) -> None:
    for wrong in ({"type": "text"}, {"type": "u32", "registers": 2}):
        with pytest.raises(ValidationError, match="a text needs it"):
            SerialRegister.model_validate({"address": 1, **wrong})
    text = (MAPS / "line-plc.toml").read_text(encoding="utf-8")
    (tmp_path / "line-plc.toml").write_text(text.replace("serial = { address = 5", "serial = { address = 3"))
    with pytest.raises(MapRefused) as refusal:
        load_map(tmp_path / "line-plc.toml")
    told = refusal.value.reasons
    assert [reason.split(": ", 1)[1] for reason in told] == [
        "serial.address: 3 overlaps read.speed", "serial.address: 3 overlaps read.life_echo",
    ]  # fmt: skip

"""Maps of OPC UA devices and what is built of them: what does not fit is refused by name."""

from pathlib import Path

import pytest

from drivers.device_map import MAPS, MapRefused, load_map
from drivers.opcua.maps import Flag
from drivers.registry import LinksRefused, build_links
from tests.protocol.driver_opcua_support import line


def refusal(tmp_path: Path, name: str, old: str, new: str) -> str:
    text = (MAPS / f"{name}.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / f"{name}.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(MapRefused) as refused:
        load_map(path)
    return "; ".join(refused.value.reasons)


@pytest.mark.parametrize("name", ["r2r-opcua-drive", "r2r-opcua-amplifier", "r2r-opcua-plc"])
def test_the_projects_own_maps_load(name: str) -> None:
    assert load_map(MAPS / f"{name}.toml").protocol == "opcua"


MISTAKES = [
    ("drive", '"Axis{channel}.Speed"', '"Axis{channel}.Torque"', "torque.node: 'Axis{channel}.Torque' is already"),
    ("drive", 'unit = "m/s"', 'unit = "m/min "', "nodes.speed.unit: 'm/min '; allowed: m/s"),
    ("drive", 'type = "f64", unit = "Nm" }\nsafe', 'type = "f46", unit = "Nm" }\nsafe', "did you mean 'f64'?"),
    ("drive", "bit = 12", "bit = 16", "follows_command.bit: 16 is not in a u16; allowed: 0 to 15"),
    ("drive", "range = [10, 1000]", "range = [10, 70000]", "watchdog.range: [10.0, 70000.0] does not fit a u16"),
    ("drive", "range = [10, 1000]", "range = [1000, 10]", "watchdog.range: [1000.0, 10.0] must rise"),
    ("drive", "format = 1", "format = 1\nsource_time = 'changed'", "source_time: 'changed'; allowed: sample, change"),
    ("plc", "format = 1", "format = 1\nsource_time = 'change'", "source_time: unknown key"),
    ("drive", "[watchdog]", "[watchdogs]", "watchdog: is missing"),
    ("drive", 'Axis{channel}.Life"', 'Axis{channel}.Life", typ = "u16"', "nodes.life.typ: unknown key; allowed: node"),
    ("drive", '"Axis{channel}.Life"', '""', "nodes.life.node"),
    ("drive", '"Axis{channel}.Life"', '"i=axis"', "nodes.life.node: 'i=axis'; allowed: i= and a number, or a name"),
    (
        "drive",
        'MaxTorque", type = "f64", unit = "Nm"',
        'MaxTorque", type = "f64", unit = "N"',
        "nodes.max_torque.unit: 'N'; allowed: rated torque, Nm, mNm",
    ),
    (
        "drive",
        'RatedTorque", type = "f64", unit = "Nm"',
        'RatedTorque", type = "f64", unit = "rated torque"',
        "'rated torque' of itself says nothing",
    ),
    ("amplifier", "Cell{channel}.Tension", "Cell1.Tension", "channels.tension.node: 'Cell1.Tension' has no {channel}"),
    ("amplifier", "Amplifier.Healthy", "Amplifier{channel}.Healthy", "healthy.node: 'Amplifier{channel}.Healthy'"),
    ("amplifier", '"Amplifier.Healthy"', '"Amplifier.Healthy", type = "u16"', "bit: is missing; a u16 needs it"),
    ("amplifier", '"Amplifier.Healthy"', '"Amplifier.Healthy", bit = 0', "healthy.bit: a bool has none"),
    ("plc", "Line.Run\"", "Line{channel}.Run\"", "write.run.node: 'Line{channel}.Run' names a channel; a PLC has none"),
    ("plc", "range = [-50, 50]", "range = [50, -50]", "read.speed.range: [50.0, -50.0] must rise"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "old", "new", "reason"), MISTAKES, ids=[mistake[3] for mistake in MISTAKES])
def test_a_mistake_is_refused_by_name(tmp_path: Path, name: str, old: str, new: str, reason: str) -> None:
    assert reason in refusal(tmp_path, f"r2r-opcua-{name}", old, new)


def test_address_and_channel_are_put_into_the_node() -> None:
    flag = Flag(node='"DB"."Axis"[{address}].{channel}.{x}')
    assert flag.identifier(7, 3) == '"DB"."Axis"[7].3.{x}'
    assert Flag(node="i=10{channel}").identifier(1, 5) == "i=105"
    with pytest.raises(ValueError, match="up to 4294967295"):
        Flag(node="i=999999999{channel}").identifier(1, 12)


def test_flags_may_be_bits_of_one_word_and_inverted() -> None:
    assert Flag(node="W", type="u16", bit=2).is_set(4.0)
    assert not Flag(node="W", type="u16", bit=2, inverted=True).is_set(4.0)
    assert Flag(node="B").is_set(1.0) and not Flag(node="B").is_set(0.0)


def test_a_watchdog_that_a_device_cannot_do_and_a_channel_it_has_not_are_named(tmp_path: Path) -> None:
    for path in MAPS.glob("*.toml"):
        text = path.read_text(encoding="utf-8")
        if path.stem == "r2r-opcua-drive":
            text = text.replace("range = [10, 1000]", "range = [200, 1000]")
        if path.stem == "r2r-opcua-amplifier":
            text = text.replace("count = 60", "count = 1")
        (tmp_path / path.name).write_text(text, encoding="utf-8")
    with pytest.raises(LinksRefused) as refused:
        build_links(line("opc.tcp://127.0.0.1:4840"), tmp_path)
    assert refused.value.reasons == [
        "drive-1: limits.watchdog_s = 0.1 s is outside what it can do (200 to 1000 ms)",
        "drive-2: limits.watchdog_s = 0.1 s is outside what it can do (200 to 1000 ms)",
        "cell-2: channel 2; allowed: 1 to 1",
    ]

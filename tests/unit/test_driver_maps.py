"""Device maps: the shipped ones load, and what is wrong in one is refused with file, key, allowed and nearest."""

import asyncio
import re
import shutil
import struct
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import get_args

import pytest

from drivers.canopen.configure import DriveSettings, drive_expected, drive_steps
from drivers.canopen.maps import DriveMap
from drivers.canopen.pdo import PdoCodec
from drivers.device_map import MAPS, MapRefused, load_map, map_names
from drivers.map_fields import SpeedUnit, TensionUnit, TimeUnit, TorqueUnit, WebSpeedUnit
from drivers.modbus.maps import LoadCellMap, PlcMap
from drivers.port import PrepareRefused
from drivers.registry import LinksRefused, build_links
from gateway.core.line import Line
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs
from gateway.core.units import SI_PER_UNIT
from tests.protocol.driver_support import ENABLED, GROUP, Drive, Drives, cycle, line, until
from tests.support.ports import free_port


def test_the_shipped_maps_load_and_each_is_for_a_role_on_its_wire() -> None:
    loaded = {name: load_map(MAPS / f"{name}.toml") for name in map_names()}
    assert {"cia402-torque": DriveMap, "line-plc": PlcMap, "loadcell-amp": LoadCellMap}.items() <= {
        name: type(device) for name, device in loaded.items()
    }.items()
    kinds = {(device.protocol, device.role) for device in loaded.values()}
    assert kinds == set(product(("canopen", "modbus-tcp", "opcua"), ("drive", "load-cell", "line-plc")))


def test_what_was_never_tried_on_hardware_says_so() -> None:
    ours = {"cia402-torque", "line-plc", "line-plc-can", "loadcell-amp"}
    for name in map_names():
        if name not in ours and not name.startswith("r2r-"):
            assert "not tried on hardware" in (MAPS / f"{name}.toml").read_text(encoding="utf-8").lower(), name


def test_units_go_by_the_names_of_the_vocabulary() -> None:
    for names in (SpeedUnit, WebSpeedUnit, TorqueUnit, TensionUnit, TimeUnit):
        assert set(get_args(names)) - {"rated torque"} <= set(SI_PER_UNIT)


def refused(tmp_path: Path, name: str, change: Callable[[str], str]) -> list[str]:
    text = (MAPS / f"{name}.toml").read_text()
    changed = change(text)
    assert changed != text, "the change did not apply"
    (tmp_path / f"{name}.toml").write_text(changed)
    with pytest.raises(MapRefused) as refusal:
        load_map(tmp_path / f"{name}.toml")
    assert all(re.match(rf"{name}\.toml:\d+: ", reason) for reason in refusal.value.reasons)
    return refusal.value.reasons


@pytest.mark.parametrize(
    ("name", "old", "new", "key", "words"),
    [
        ("cia402-torque", "heartbeat]", "hartbeat]", "hartbeat", ["unknown key", "did you mean 'heartbeat'"]),
        ("cia402-torque", 'unit = "um/s"', 'unit = "um/sec"', "objects.speed.unit", ["allowed", "'um/s'", "mean"]),
        ("cia402-torque", 'unit = "um/s"', 'unit = "Nm"', "objects.speed.unit", ["'Nm'", "rpm"]),
        ("cia402-torque", "index = 0x6041", 'index = "0x6041"', "objects.statusword.index", ["integer"]),
        ("cia402-torque", "index = 0x6041", "index = 0x6040", "objects.statusword", ["6040h", "objects.controlword"]),
        ("cia402-torque", "index = 0x6041, ", "", "objects.statusword.index", ["missing"]),
        ("cia402-torque", '"speed", "torque"]', '"speed"]', "transmit_pdo.objects", ["lacks torque"]),
        ("cia402-torque", '"speed", "torque"]', '"speed", "torque", "speed"]', "transmit_pdo", ["speed listed twice"]),
        ("cia402-torque", '"torque"]', '"torque", "safe_torque_off"]', "transmit_pdo", ["12 bytes", "at most 8"]),
        ("cia402-torque", '"torque"]', '"torque", "torqe"]', "transmit_pdo.objects.3", ["allowed", "'torque'"]),
        ("cia402-torque", "value = 100", "value = 5", "heartbeat.value", ["[10.0, 10000.0]"]),
        ("cia402-torque", "range = [10, 200]", "range = [200, 10]", "watchdog.range", ["rise"]),
        ("cia402-torque", "range = [10, 200]", "range = [10]", "watchdog.range", ["at least 2"]),
        ("cia402-torque", "scale = 0.001 }", "scale = nan }", "objects.target_torque.scale", ["finite"]),
        ("cia402-torque", "scale = 0.001 }", "scale = true }", "objects.target_torque.scale", ["number"]),
        ("cia402-torque", "format = 1", "format = true", "format", ["integer"]),
        ("cia402-torque", 'role = "drive"', 'role = "servo"', "protocol", ["'servo'", "'line-plc'"]),
        ("cia402-torque", 'role = "drive"', "role = []", "protocol", ["role []", "'line-plc'"]),
        ("cia402-torque", "[watchdog]", "[watch]", "watchdog", ["missing", "unknown key"]),
        ("cia402-torque", "format = 1", "format = 1\nformat = 1", "column 11", ["toml:4: ", "keep one"]),
        ("loadcell-amp", "address_base = 0", "address_base = 2", "address_base", ["less than or equal to 1"]),
        ("loadcell-amp", "address_base = 0", "address_base = 1", "device_id", ["below address_base 1"]),
        ("loadcell-amp", '"high-first"', '"big"', "word_order", ["high-first, low-first"]),
        ("loadcell-amp", 'type = "f32"', 'type = "f64"', "channels.tension.type", ["f32"]),
        ("loadcell-amp", "offset = 2, ok", "offset = 1, ok", "channels.status", ["register 1", "channels.tension"]),
        ("loadcell-amp", "stride = 4", "stride = 2", "channels.status.offset", ["stride 2"]),
        ("loadcell-amp", "first = 16", "first = 3", "sample_counter.address", ["overlaps channels"]),
        ("line-plc", "speed = { address = 11", "speed = { address = 12", "write.life", ["register 13", "write.speed"]),
        ("line-plc", "life = { address = 13 }", "life = { address = 20 }", "write", ["side by side"]),
        ("line-plc", "life_echo = { address = 4 }", "life_echo = { address = 3 }", "read.life_echo", ["read.speed"]),
        ("line-plc", "read_function = 3", "read_function = 4", "read_function", ["allowed: 3"]),
        ("line-plc", 'unit = "um/s"', 'unit = "rpm"', "read.speed.unit", ["allowed: m/s"]),
        ("cia402-torque", '0x6040, type = "u16"', '0x6040, type = "i16"', "objects.controlword.type", ["allowed: u16"]),
        ("cia402-torque", '0x6041, type = "u16"', '0x6041, type = "f32"', "objects.statusword.type", ["allowed: u16"]),
        ("cia402-torque", '0x6060, type = "i8"', '0x6060, type = "u8"', "objects.mode.type", ["allowed: i8"]),
        ("cia402-torque", 'unit = "mNm"', 'unit = "rated torque"', "objects.rated_torque.unit", ["allowed: Nm, mNm"]),
        ("cia402-torque", "{ bit = 12 }", "{ bit = 16 }", "follows_command.bit", ["allowed: 0 to 15"]),
        ("cia402-torque", '"u32", bit = 16', '"u16", bit = 16', "objects.safe_torque_off.bit", ["allowed: 0 to 15"]),
        ("cia402-torque", '"u32", bit = 16', '"f32", bit = 16', "objects.safe_torque_off.type", ["allowed: u8, i8"]),
        ("cia402-torque", "range = [10, 200]", "range = [10, 70000]", "watchdog.range", ["u16", "0 to 65535"]),
        (
            "loadcell-amp",
            "status = { address = 2",
            'status = { type = "f32", address = 12',
            "status.type",
            ["u16, u32"],
        ),
        ("loadcell-amp", "counter = { address = 3", 'counter = { type = "i16", address = 3', "sample_counter.type", []),
        ("loadcell-amp", "count = { address = 1", 'count = { type = "f32", address = 10', "channel_count.type", []),
        ("loadcell-amp", "offset = 2, ok", 'type = "i16", offset = 2, ok', "channels.status.type", ["u16, u32"]),
        ("loadcell-amp", "bit = 0", "bit = 16", "status.healthy.bit", ["16", "u16", "0 to 15"]),
        (
            "line-plc",
            "status = { address = 1",
            'status = { type = "i16", address = 1',
            "read.status.type",
            ["u16, u32"],
        ),
        ("line-plc", "echo = { address = 4", 'echo = { type = "f32", address = 4', "read.life_echo.type", ["u16, u32"]),
        ("line-plc", "life = { address = 13", 'life = { type = "i16", address = 13', "write.life.type", ["u16, u32"]),
        ("line-plc", "{ bit = 3 }", "{ bit = 31 }", "read.watchdog_tripped.bit", ["31", "0 to 15"]),
        ("line-plc", "run = { bit = 0", "run = { bit = 17", "write.run.bit", ["17", "0 to 15"]),
        ("line-plc", "address = 14", "address = 10", "write.command", ["register 10", "watchdog"]),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, name: str, old: str, new: str, key: str, words: list[str]) -> None:
    reasons = refused(tmp_path, name, lambda text: text.replace(old, new, 1))
    text = " / ".join(reasons)
    assert re.search(rf"toml:\d+: {re.escape(key)}", text), text
    assert all(word in text for word in words), text


def test_every_error_comes_at_once(tmp_path: Path) -> None:
    reasons = refused(
        tmp_path,
        "line-plc",
        lambda text: text.replace("device_id", "divice_id").replace('"um/s"', '"um"').replace("bit = 2", "bit = 99"),
    )
    assert len(reasons) == 5  # the unknown key, the missing one, two units, the bit


# The registry


def reasons_for(line: Line, folder: Path = MAPS) -> list[str]:
    with pytest.raises(LinksRefused) as refusal:
        build_links(line, folder)
    return refusal.value.reasons


def changed(**tables: object) -> Line:
    return line().model_copy(update=tables)


def test_unknown_and_unfitting_maps_are_refused_together() -> None:
    good = line()
    maps = ("cia402-torq", "line-plc")
    drives = [drive.model_copy(update={"map": name}) for drive, name in zip(good.drives, maps, strict=True)]
    cells = [good.load_cells[0].model_copy(update={"bus": "drives"}), good.load_cells[1]]
    plc = good.plc.model_copy(update={"bus": "oi"})
    reasons = reasons_for(changed(drives=drives, load_cells=cells, plc=plc))
    assert len(reasons) == 4
    assert reasons[0].startswith("drive-1: map 'cia402-torq' is unknown") and "mean 'cia402-torque'" in reasons[0]
    assert reasons[1].startswith("drive-2: map 'line-plc' is for a line-plc") and "allowed: cia402-torque" in reasons[1]
    assert reasons[2] == "cell-1: map 'loadcell-amp' speaks modbus-tcp, bus 'drives' is canopen"
    assert reasons[3] == "plc: bus 'oi' is unknown; allowed: drives, io"


def test_a_watchdog_that_a_drive_cannot_do_is_refused() -> None:
    good = line()
    reasons = reasons_for(changed(limits=good.limits.model_copy(update={"watchdog_s": 0.005})))
    assert len(reasons) == 3 and "10 to 200 ms" in reasons[0] and "10 to 1000 ms" in reasons[2]


def test_a_new_drive_is_a_map(tmp_path: Path) -> None:
    """The worked example of docs/adding-a-device.md: the files on that page are enough for a link."""
    shutil.copytree(MAPS, tmp_path, dirs_exist_ok=True)
    page = (Path(__file__).parents[2] / "docs/adding-a-device.md").read_text()
    (tmp_path / "acme-spin.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    good = line()
    drives = [drive.model_copy(update={"map": "acme-spin"}) for drive in good.drives]
    assert len(build_links(changed(drives=drives), tmp_path)) == 2
    device = load_map(tmp_path / "acme-spin.toml")
    assert isinstance(device, DriveMap)
    steps = drive_steps(device, DriveSettings(1, 80.0, 60.0, 0.1))
    assert [step.value for step in steps if (step.index, step.sub) == (0x6072, 0)] == [750], "writable: 60 of 80 Nm"


# A maker's drive: what its manual says, and that it can be driven

NANOTEC = "nanotec-pd2-cb42c-can"


class Pd2(Drive):
    """The objects that the map needs as the drive is delivered, and 60A9h as it is to be commissioned."""

    def __init__(self, node: int) -> None:
        super().__init__(node)
        del self.objects[0x1400, 5], self.objects[0x6076, 0]
        self.objects |= {
            (0x1016, 1): bytes(4),
            (0x1018, 1): struct.pack("<I", 0x26C),
            (0x1018, 2): struct.pack("<I", 0x20),
            (0x1400, 2): b"\xff",
            (0x6007, 0): struct.pack("<h", 1),
            (0x605E, 0): struct.pack("<h", 2),
            (0x6072, 0): struct.pack("<H", 100),
            (0x60A9, 0): struct.pack("<I", 0xFDB44700),
        }


def test_what_nanotecs_manual_says() -> None:
    device = load_map(MAPS / f"{NANOTEC}.toml")
    assert isinstance(device, DriveMap)
    assert (device.identity.vendor_id, device.identity.product_code) == (0x26C, 0x20)
    steps = {(step.index, step.sub): step.value for step in drive_steps(device, DriveSettings(3, 0.5, 0.4, 0.1))}
    needed = {
        (0x1016, 1): 0x007F0064,  # 100 ms of node 127
        (0x1017, 0): 100,
        (0x1400, 1): 0x203,
        (0x1400, 2): 1,  # with the next SYNC
        (0x1800, 1): 0x183,
        (0x1800, 2): 1,
        (0x6007, 0): 2,  # disable voltage
        (0x605E, 0): 0,  # free to turn
        (0x6060, 0): 10,
        (0x6072, 0): 800,
    }
    assert steps.items() >= needed.items()
    assert (0x60A9, 0) not in steps, "6080h and the ramps count in it"
    assert [(entry.index, entry.value) for entry in drive_expected(device, 3)] == [(0x60A9, 0xFDB44700)]
    codec = PdoCodec(device, rated_torque_nm=0.5, radius_m=0.04)
    sample = codec.decode(bytes.fromhex("3712 60EA0000 F401"))
    assert sample.speed_m_per_s == pytest.approx(0.2513, abs=1e-4), "60 rpm in thousandths"
    assert sample.torque_nm == pytest.approx(0.25), "500 is half of the rated torque"
    assert codec.encode(0x0F, -0.55) == bytes.fromhex("0F00 B4FB 0A"), "1100 is 110 % of it"


def nanotec_line(port: int) -> Line:
    good = line(2, can_bus={"interface": "udp_multicast", "channel": GROUP, "port": port})
    drives = [drive.model_copy(update={"map": NANOTEC, "rated_torque_nm": 0.5}) for drive in good.drives]
    return good.model_copy(update={"drives": drives, "limits": good.limits.model_copy(update={"torque_nm": 0.4})})


async def drive_the_pd2s(drives: list[Pd2], port: int) -> None:
    link = build_links(nanotec_line(port))[0]
    inputs, outputs = Inputs(2), Outputs(2)
    async with Drives([*drives], interface="udp_multicast", channel=GROUP, port=port, hop_limit=0, fd=False):
        await link.open()
        try:
            await link.prepare()
            for drive in drives:
                drive.statusword, drive.speed_um_per_s, drive.torque_per_mille = ENABLED, 60_000, 500  # the fields
            await cycle(link, inputs)
            outputs.drive_request[:] = DriveRequest.ENABLE
            outputs.torque_nm[:] = (0.25, -0.1)
            link.write(outputs)
            await until(lambda: all(drive.rpdos for drive in drives))
        finally:
            await link.close()
    assert list(inputs.drive_state) == [DriveState.ENABLED] * 2
    assert inputs.speed.value == pytest.approx([0.2513] * 2, abs=1e-4)
    assert inputs.torque.value == pytest.approx([0.25] * 2)


def test_a_nanotec_drive_is_configured_and_driven() -> None:
    drives = [Pd2(1), Pd2(2)]
    asyncio.run(drive_the_pd2s(drives, free_port()))
    for drive, per_mille in zip(drives, (500, -200), strict=True):
        assert drive.rpdos == [struct.pack("<Hhb", 0x0F, per_mille, 10)]
        assert drive.objects[0x1016, 1] == bytes.fromhex("6400 7F00")
        assert (drive.objects[0x6007, 0], drive.objects[0x605E, 0]) == (b"\2\0", b"\0\0")
        assert struct.unpack("<H", drive.objects[0x6072, 0]) == (800,)


@pytest.mark.parametrize(
    ("place", "value", "code"),
    [
        ((0x60A9, 0), 0x00B44700, "object-differs"),  # whole rpm, as delivered
        ((0x1018, 2), 0x11, "node-is-another"),  # a C5-E-2-09
    ],
)
def test_a_nanotec_drive_that_is_otherwise_is_refused(place: tuple[int, int], value: int, code: str) -> None:
    drives = [Pd2(1), Pd2(2)]
    drives[1].objects[place] = struct.pack("<I", value)
    with pytest.raises(PrepareRefused, match=f"^{code}$"):
        asyncio.run(drive_the_pd2s(drives, free_port()))
    assert drives[0].writes == drives[1].writes == []

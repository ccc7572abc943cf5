"""The parts of CANopen nodes without a bus: error frames, stations, maps of amplifiers and PLCs, codecs."""

import asyncio
import struct
import threading
from pathlib import Path
from typing import cast

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.amplifier import AmplifierNode
from drivers.canopen.can_errors import error_text, is_bus_off
from drivers.canopen.configure import DriveSettings, cell_expected, drive_expected, drive_steps
from drivers.canopen.counts import end_values, n_per_count
from drivers.canopen.map_parts import CanObject, HeartbeatObject
from drivers.canopen.maps import DriveMap, LoadCellMap, PlcMap
from drivers.canopen.pdo import MalformedPdo, PdoLayout, mapping_entries
from drivers.canopen.plc import PlcNode
from drivers.canopen.station import ANSWERS_ALLOWED, Station
from drivers.canopen.wire import FetchedWire
from drivers.device_map import MAPS, MapRefused, load_map
from gateway.core.finding import Finding, finding
from gateway.core.line import LinePlc, LoadCell
from gateway.core.signals import Inputs, Outputs, Quality

HEARTBEAT = HeartbeatObject(index=0x1017, type="u16", unit="ms", range=[10.0, 10000.0], value=100.0)


# error frames


@pytest.mark.parametrize(
    ("identifier", "data", "words"),
    [
        (0x040, bytes(8), "CAN error: bus-off"),
        (0x020, bytes(8), "nobody acknowledges"),
        (0x004, bytes([0, 0x01, 0, 0, 0, 0, 0, 0]), "controller: receive buffer overflow"),
        (0x004, bytes([0, 0x30, 0, 0, 0, 0, 0, 0]), "controller: error passive, receiving, error passive, sending"),
        (0x004, b"", "CAN error: controller"),
        (0x28C, bytes([0, 0x08, 0, 0, 0, 0, 130, 4]), "130 transmit and 4 receive errors counted"),
        (0x100, bytes(8), "the controller was restarted"),
        (0x000, b"\x01\x02", "class 0x0 0102"),
    ],
)
def test_error_frames_in_words(identifier: int, data: bytes, words: str) -> None:
    assert words in error_text(identifier, data)
    assert is_bus_off(identifier) == (identifier == 0x040)


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_every_error_frame_has_a_text(identifier: int, data: bytes) -> None:
    assert error_text(identifier, data).startswith("CAN error: ")


# stations


def station(frames: int = 1) -> Station:
    node = Station("node", 5, HEARTBEAT, frames=frames)
    node.on_heartbeat(b"\x05", 0.0)
    return node


def sync(node: Station, frames: int) -> None:
    node.begin_sync()
    for _ in range(frames):
        node.on_frame()
    node.end_sync()


def test_a_station_is_absent_after_three_syncs_and_waited_for_when_it_is_heard_again() -> None:
    node = station()
    for missed in range(1, ANSWERS_ALLOWED + 1):
        sync(node, 0)
        assert node.absent(0.0, relied_on=True) == (missed == ANSWERS_ALLOWED)
    node.begin_sync()
    assert not node.awaited
    node.on_late_frame()
    node.end_sync()
    node.begin_sync()
    assert node.awaited
    node.on_frame()
    assert not node.absent(0.0, relied_on=True)


def test_an_answer_of_several_frames_counts_when_it_is_complete() -> None:
    node = station(frames=2)
    for _ in range(ANSWERS_ALLOWED):
        sync(node, 1)
    assert node.absent(0.0, relied_on=True)
    assert node.trouble(0.0, relied_on=True) == finding("sync-unanswered", device="node", syncs=3)
    sync(node, 2)
    assert not node.absent(0.0, relied_on=True)


def test_heartbeats_count_strictly_where_something_moves_by_them() -> None:
    node = station()
    assert not node.absent(0.15, relied_on=True) and node.absent(0.1501, relied_on=True)
    assert not node.absent(0.3, relied_on=False) and node.absent(0.3001, relied_on=False)


# maps


def refused(tmp_path: Path, name: str, old: str, new: str) -> str:
    text = (MAPS / f"{name}.toml").read_text()
    assert old in text, "the change did not apply"
    (tmp_path / f"{name}.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(MapRefused) as refusal:
        load_map(tmp_path / f"{name}.toml")
    return " / ".join(refusal.value.reasons)


CELL, PLC = "r2r-cell-can", "line-plc-can"


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        (CELL, '"tension", "status", "tension", "status", ', '"status", "status", ', "lacks tension"),
        (CELL, ', "sample_counter"]', "]", "lacks sample_counter"),
        (CELL, ', "sample_counter"]', ', "sample_counter", "sample_counter"]', "sample_counter listed twice"),
        (CELL, '"status", "sample', '"sample', "1 times status; allowed: 2"),
        (CELL, '"status", "sample', '"statu", "sample', "transmit_pdos.objects.3: 'statu'; allowed"),
        (CELL, 'tension = { index = 0x7130, type = "i16"', 'tension = { index = 0x9130, type = "i32"', "12 bytes"),
        (CELL, "count = 4", "count = 5", "transmit_pdos.count: 5"),
        (CELL, 'index = 0x2130, type = "u16"', 'index = 0x2130, type = "i16"', "objects.sample_counter.type: i16"),
        (CELL, 'type = "u8"\nok', 'type = "i8"\nok', "objects.status.type: i8"),
        (CELL, 'type = "u8", bit = 0', 'type = "u8", bit = 8', "objects.healthy.bit: 8"),
        (CELL, 'digits = { index = 0x6132, type = "u8"', 'digits = { index = 0x6132, type = "f32"', "digits.type: f32"),
        (CELL, "value = 100", "value = 5", "heartbeat.value"),
        (CELL, "[heartbeat]", "[heart]", "heartbeat: is missing"),
        (PLC, '["command", "speed", "life"]', '["command", "speed"]', "receive_pdo.objects: lacks life"),
        (PLC, '["status", "speed", "life_echo"]', '["status", "life_echo"]', "transmit_pdo.objects: lacks speed"),
        (PLC, "sub = 3", "sub = 1", "read.life_echo: 2000h sub 1 is already read.status"),
        (PLC, "index = 0x2002", "index = 0x1017", "1017h sub 0 is already watchdog"),
        (PLC, "{ bit = 3 }", "{ bit = 16 }", "read.watchdog_tripped.bit: 16"),
        (PLC, "run = { bit = 0 }", "run = { bit = 16 }", "write.run.bit: 16"),
        (PLC, 'sub = 3, type = "u16" }\n\n[write]', 'sub = 3, type = "u8" }\n\n[write]', "read.life_echo.type: u8"),
        (PLC, 'unit = "um/s"', 'unit = "rpm"', "read.speed.unit: 'rpm'; allowed: m/s"),
        (PLC, "range = [10, 1000]", "range = [10, 70000]", "watchdog.range"),
        (PLC, "[watchdog] #", '[watchdog]\nkind = "heartbeat-consumer" #', "watchdog.kind"),
    ],
)
def test_what_is_wrong_in_a_map_is_named(tmp_path: Path, name: str, old: str, new: str, words: str) -> None:
    text = refused(tmp_path, name, old, new)
    assert words in text, text


def cell_map() -> LoadCellMap:
    device = load_map(MAPS / f"{CELL}.toml")
    assert isinstance(device, LoadCellMap)
    return device


def test_each_pdo_of_an_amplifier_has_its_own_channels() -> None:
    device = cell_map()
    assert device.channels == 8
    assert mapping_entries(device.objects_of(0)) == [0x71300110, 0x61500108, 0x71300210, 0x61500208, 0x21300010]
    assert mapping_entries(device.objects_of(3)) == [0x71300710, 0x61500708, 0x71300810, 0x61500808, 0x21300010]
    last = device.transmit_pdo(3)
    assert (last.communication, last.mapping, last.cob_id) == (0x1803, 0x1A03, 0x480)
    assert cell_expected(device, 20, [3])[0].value == 0x480 + 20


def test_a_mapping_that_may_be_written_is_written() -> None:
    device = cell_map()
    loose = device.model_copy(update={"transmit_pdos": device.transmit_pdos.model_copy(update={"writable": True})})
    cell = LoadCell(name="c", bus="b", map=CELL, address=20, channel=3, span=1, capacity_n=100.0)
    steps = [(step.index, step.sub, step.value) for step in AmplifierNode(loose, [cell]).steps()]
    assert steps[:3] == [(0x1801, 1, 0x80000294), (0x1801, 2, 1), (0x1A01, 0, 0)]
    assert steps[3] == (0x1A01, 1, 0x71300310) and steps[-3:] == [(0x1A01, 0, 5), (0x1801, 1, 0x294), (0x1017, 0, 100)]
    assert cell_expected(loose, 20, [1]) == []


def test_a_fixed_mapping_of_a_drive_is_compared() -> None:
    device = load_map(MAPS / "cia402-torque.toml")
    assert isinstance(device, DriveMap)
    fixed = device.model_copy(update={"transmit_pdo": device.transmit_pdo.model_copy(update={"writable": False})})
    steps = drive_steps(fixed, DriveSettings(1, 80.0, 60.0, 0.1))
    assert not {0x1800, 0x1A00} & {step.index for step in steps} and 0x1600 in {step.index for step in steps}
    places = [(entry.index, entry.sub, entry.value) for entry in drive_expected(fixed, 1)]
    assert places[:3] == [(0x1800, 1, 0x181), (0x1800, 2, 1), (0x1A00, 0, 3)]
    assert drive_expected(device, 1) == []


def cell(capacity_n: float = 100.0) -> LoadCell:
    return LoadCell(name="c", bus="b", map=CELL, address=20, channel=1, span=1, capacity_n=capacity_n)


@pytest.mark.parametrize(
    ("kind", "ends"),
    [
        ("i8", (-128, 127)),
        ("u8", (255,)),
        ("i16", (-0x8000, 0x7FFF)),
        ("u16", (0xFFFF,)),
        ("i32", (-(2**31), 2**31 - 1)),
        ("u32", (2**32 - 1,)),
        ("f32", ()),
    ],
)
def test_where_a_type_ends(kind: str, ends: tuple[int, ...]) -> None:
    assert end_values(kind) == ends


@pytest.mark.parametrize("counts", [0x7FFF, -0x8000])
def test_a_saturated_channel_is_no_tension_whatever_its_capacity(counts: int) -> None:
    amplifier, inputs = AmplifierNode(cell_map(), [cell(capacity_n=327.67)]), Inputs(1)
    amplifier.station.on_heartbeat(b"\x05", 0.0)
    amplifier._cells[0].n_per_count = 0.01  # noqa: SLF001
    for value, counter, quality in ((counts, 1, Quality.BAD), (0x7FFE, 2, Quality.GOOD)):
        amplifier.begin_sync()
        amplifier.on_answer(0x180 + 20, struct.pack("<hBhBH", value, 0, 0, 1, counter))
        troubles = amplifier.fill(inputs, 0.0, active=True)
        assert inputs.tension.quality[0] == quality and bool(troubles) == (quality == Quality.BAD)
    assert inputs.tension.value[0] == pytest.approx(327.66)


def test_digits_and_full_scale() -> None:
    device = cell_map()
    assert [n_per_count(device, cell(0.03), digits) for digits in (0, 2, 6)] == pytest.approx([1.0, 0.01, 1e-6])
    assert n_per_count(device, cell(327.67), 2) == 0.01
    short = {"full_scale_n": pytest.approx(327.67), "capacity_n": 327.68}
    refused = n_per_count(device, cell(327.68), 2)
    assert isinstance(refused, Finding) and refused.code == "cell-range-short"
    assert refused.parameters == {"cell": cell().name, **short}
    for digits in (-1, 7, 200):
        assert n_per_count(device, cell(), digits) == finding(
            "cell-digits", cell=cell().name, digits=digits, most_digits=6
        )
    objects = device.objects.model_copy(update={"tension": device.objects.tension.model_copy(update={"type": "f32"})})
    assert n_per_count(device.model_copy(update={"objects": objects}), cell(1e9), 0) == 1.0, "a float has no end"


# the PLC's bytes


def plc_node() -> PlcNode:
    device = load_map(MAPS / f"{PLC}.toml")
    assert isinstance(device, PlcMap)
    plc = PlcNode(device, LinePlc(name="plc", bus="b", map=PLC, address=30), watchdog_s=0.1)
    plc.station.on_heartbeat(b"\x05", 0.0)
    return plc


@given(st.integers(0, 0xFFFF), st.integers(-50_000_000, 50_000_000), st.integers(0, 0xFFFF))
def test_status_round_trip(word: int, speed_um_per_s: int, echo: int) -> None:
    plc, inputs = plc_node(), Inputs(1)
    plc.begin_sync()
    plc.on_answer(0x180 + 30, struct.pack("<HiH", word, speed_um_per_s, echo))
    plc.fill(inputs, 0.0, active=True)
    assert inputs.plc.quality == Quality.GOOD
    assert round(inputs.unwind_speed.value[0] * 1e6) == speed_um_per_s
    found = (inputs.plc.permissive, not inputs.plc.emergency_stop, inputs.plc.running)
    assert found == (bool(word & 1), bool(word & 2), bool(word & 4))


@pytest.mark.parametrize("speed_um_per_s", [50_000_001, -50_000_001, 2**31 - 1])
def test_a_speed_out_of_range_is_bad(speed_um_per_s: int) -> None:
    plc, inputs = plc_node(), Inputs(1)
    plc.begin_sync()
    plc.on_answer(0x180 + 30, struct.pack("<HiH", 3, speed_um_per_s, 0))
    assert "outside [-5e+07, 5e+07] um/s" in plc.fill(inputs, 0.0, active=True)[0]
    assert inputs.unwind_speed.quality[0] != Quality.GOOD and inputs.plc.quality == Quality.GOOD


@given(st.floats(-50.0, 50.0), st.booleans())
def test_command_round_trip(speed_m_per_s: float, run: bool) -> None:
    plc, outputs = plc_node(), Outputs(1)
    outputs.speed_request_m_per_s, outputs.run = speed_m_per_s, run
    frame = plc.command(outputs, 0.0)
    assert frame is not None and frame[0] == 0x200 + 30
    word, speed_um_per_s, life = struct.unpack("<HiH", frame[1])
    assert (word, life) == (run, 1) and abs(speed_um_per_s - speed_m_per_s * 1e6) <= 0.5 + 1e-6


@given(st.binary(max_size=16).filter(lambda data: len(data) != 8))
def test_a_wrong_length_is_refused(data: bytes) -> None:
    plc = plc_node()
    plc.begin_sync()
    with pytest.raises(MalformedPdo):
        plc.on_answer(0x180 + 30, data)
    with pytest.raises(MalformedPdo):
        plc.check_answer(0x180 + 30, data)


KINDS = {"u8": (0, 255), "i8": (-128, 127), "u16": (0, 65535), "i16": (-32768, 32767), "i32": (-(2**31), 2**31 - 1)}


@given(st.lists(st.sampled_from(sorted(KINDS)), min_size=1, max_size=8), st.data())
def test_layouts_round_trip(kinds: list[str], data: st.DataObject) -> None:
    layout = PdoLayout([CanObject.model_validate({"index": 0x2000 + k, "type": kind}) for k, kind in enumerate(kinds)])
    numbers = [data.draw(st.integers(*KINDS[kind])) for kind in kinds]
    assert list(layout.decode(layout.encode(numbers))) == numbers
    with pytest.raises(ValueError, match=r"."):
        layout.encode([KINDS[kinds[0]][1] + 1, *numbers[1:]])


@pytest.mark.wires
def test_whatever_an_interface_raises_its_thread_goes_on_and_it_is_told_as_a_failure_of_the_bus() -> None:
    class Interface:
        def __init__(self) -> None:
            self.raises: list[Exception] = [RuntimeError("a fault of its library")]
            self.messages = [can.Message(arbitration_id=0x181, data=b"\x01", is_extended_id=False)]

        def recv(self, timeout: float) -> can.Message | None:
            if self.raises:
                raise self.raises.pop(0)
            if self.messages:
                return self.messages.pop()
            threading.Event().wait(timeout)
            return None

    async def scene() -> None:
        arrived = asyncio.Event()
        wire = FetchedWire(cast(can.BusABC, Interface()), "test")
        wire.read_with(arrived.set)
        await arrived.wait()
        with pytest.raises(can.CanError, match="RuntimeError: a fault of its library"):
            wire.receive()
        while (found := wire.receive()) is None:  # noqa: ASYNC110
            await asyncio.sleep(0.001)
        assert found == (0x181, b"\x01")
        await wire.close()

    asyncio.run(scene())

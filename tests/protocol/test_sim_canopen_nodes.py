"""Load-cell amplifiers and line PLC as CANopen nodes, in stepped time: raw frames and the canopen library as peers."""

import struct
import uuid
from collections.abc import Iterator
from pathlib import Path

import can
import canopen
import pytest
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.exceptions import SdoAbortedError

from sim_plant.devices.amplifier import Amplifier, ChannelStatus
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.canopen import CanopenFace
from sim_plant.faces.canopen_cell import CellDevice, cell_dictionary, decimal_digits
from sim_plant.faces.canopen_plc import PlcDevice, plc_dictionary
from sim_plant.plant import plant_of
from sim_plant.recorder import Recorder
from sim_plant.world import World

SPANS = 11  #: an amplifier of eight channels, and one of three
PLANT = plant_of(
    {
        "format": 1,
        "name": "eleven",
        "spans": SPANS,
        "web": {"stiffness_n": 2200.0, "length_m": 1.2},
        "rollers": {"radius_m": 0.035, "inertia_kg_m2": 1.0, "friction_nms_per_rad": 15.0},
    }
)
DOCUMENTS = Path(__file__).parents[2] / "docs/devices"
CELLS, MORE_CELLS, PLC = 101, 102, 120
TPDOS = (0x180, 0x280, 0x380, 0x480)


class Bench(canopen.Network):
    """Two amplifiers and a PLC on a virtual bus, and a master without a thread: what it sends is answered at once."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0
        channel = uuid.uuid4().hex
        self.world = World(PLANT, 3)
        self.recorder = Recorder(self.world)
        self.amplifier = Amplifier(self.world)
        self.plc = LinePlc(self.world, self.recorder)
        self.bus = can.Bus(channel, "virtual")
        self.face = CanopenFace(can.Bus(channel, "virtual"), [], 1, lambda: self.now_s)
        connected = set(range(1, SPANS + 1)) - {7}
        self.face.add(CELLS, CellDevice(self.amplifier, 1, connected, 2))
        self.face.add(MORE_CELLS, CellDevice(self.amplifier, 9, connected, 2))
        self.face.add(PLC, PlcDevice(self.plc))
        self.frames: list[tuple[int, bytes]] = []
        dictionaries = {CELLS: cell_dictionary(8), MORE_CELLS: cell_dictionary(3), PLC: plc_dictionary()}
        for node, dictionary in dictionaries.items():
            self.add_node(canopen.RemoteNode(node, dictionary)).sdo.RESPONSE_TIMEOUT = 0.01

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        super().send_message(can_id, data, remote)
        self.face.pump()
        self.collect()

    def collect(self) -> None:
        while message := self.bus.recv(0):
            self.frames.append((message.arbitration_id, bytes(message.data)))
            self.notify(message.arbitration_id, message.data, message.timestamp)

    def take(self) -> list[tuple[int, bytes]]:
        """The frames since the last call."""
        self.collect()
        frames, self.frames = self.frames, []
        return frames

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds * 1000)):
            self.now_s = round(self.now_s + 0.001, 6)
            self.world.advance(self.now_s)
            self.face.poll()

    def latch(self) -> list[tuple[int, bytes]]:
        """What a SYNC brings."""
        self.take()
        self.send_message(0x80, b"")
        return self.take()

    def start(self) -> None:
        self.send_message(0, bytes((1, 0)))

    def upload(self, node: int, index: int, subindex: int = 0) -> bytes:
        return self.nodes[node].sdo.upload(index, subindex)

    def number(self, node: int, index: int, subindex: int = 0) -> int:
        return int.from_bytes(self.upload(node, index, subindex), "little")


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    bench.face.boot()
    yield bench
    bench.face.bus.shutdown()
    bench.bus.shutdown()


def aborted(code: int) -> "pytest.RaisesExc[SdoAbortedError]":
    return pytest.raises(SdoAbortedError, check=lambda error: error.code == code)


# What all nodes have in common


def test_nodes_of_every_kind_boot_beat_and_say_who_they_are(bench: Bench) -> None:
    assert bench.take() == [(0x700 + node, b"\0") for node in (CELLS, MORE_CELLS, PLC)]
    bench.wait(0.101)
    assert bench.take() == [(0x700 + node, b"\x7f") for node in (CELLS, MORE_CELLS, PLC)]
    identities = {CELLS: (0x00020194, 0x520, 0x404), PLC: (0, 0x520, 0x401)}
    for node, identity in identities.items():
        told = bench.number(node, 0x1000), bench.number(node, 0x1018, 1), bench.number(node, 0x1018, 2)
        assert told == identity
    bench.nodes[PLC].sdo.download(0x1017, 0, struct.pack("<H", 20))
    bench.take()
    bench.wait(0.05)
    assert bench.take() == [(0x700 + PLC, b"\x7f")] * 2


@pytest.mark.parametrize(("node", "document"), [(CELLS, "r2r-cell-can"), (PLC, "line-plc-can")])
def test_every_object_can_be_read_and_stands_in_a_document(bench: Bench, node: int, document: str) -> None:
    text = (DOCUMENTS / f"{document}.md").read_text() + (DOCUMENTS / "r2r-drive.md").read_text()
    dictionary: ObjectDictionary = bench.nodes[node].object_dictionary
    for entry in dictionary.values():
        for variable in entry.subindices.values() if hasattr(entry, "subindices") else [entry]:
            data = bench.upload(node, variable.index, variable.subindex)
            if variable.index not in (0x1008, 0x1009, 0x100A):
                assert 8 * len(data) == len(variable), variable
    ranges = {0x1801, 0x1802, 0x1803, 0x1A01, 0x1A02}  # named as "1A00h to 1A03h", and as communication records
    assert [f"{k:04X}h" for k in dictionary if f"{k:04X}h" not in text and k not in ranges] == []


@pytest.mark.parametrize("node", [CELLS, PLC])
def test_a_fixed_pdo_is_put_off_and_on_and_changed_no_more(bench: Bench, node: int) -> None:
    sdo = bench.nodes[node].sdo
    cob_id = 0x40000180 + node
    assert bench.number(node, 0x1800, 1) == cob_id and bench.number(node, 0x1800, 2) == 1
    for index, subindex in ((0x1800, 2), (0x1A00, 0), (0x1A00, 1)):
        with aborted(0x06010002):
            sdo.download(index, subindex, bytes(len(bench.upload(node, index, subindex))))
    for other in (0x180, 0x181 + node, 0x20000180 + node):
        with aborted(0x06090030):
            sdo.download(0x1800, 1, struct.pack("<I", other))
    bench.start()
    for value, sent in ((0x80000000 | cob_id, 0), (cob_id, 1)):
        sdo.download(0x1800, 1, struct.pack("<I", value))
        assert [can_id for can_id, _ in bench.latch()].count(0x180 + node) == sent


# Load cells


def channels(frames: list[tuple[int, bytes]], node: int) -> list[tuple[int, int, int]]:
    """Counts, status and sample counter of each channel, in order, from the TPDOs of one SYNC."""
    sent = {can_id: data for can_id, data in frames if can_id - node in TPDOS}
    found = []
    for base in TPDOS:
        if data := sent.get(base + node):
            first, first_status, second, second_status, counter = struct.unpack("<hBhBH", data)
            found += [(first, first_status, counter), (second, second_status, counter)]
    return found


def test_all_channels_are_measured_at_one_instant(bench: Bench) -> None:
    bench.world.start_at_equilibrium(bench.world.tension_n + [20.0 + k for k in range(SPANS)], 0.1)
    bench.wait(0.25)
    assert bench.latch() == []  # not operational yet
    bench.start()
    frames = bench.latch()
    shown, more = channels(frames, CELLS), channels(frames, MORE_CELLS)
    assert [can_id for can_id, _ in frames if can_id & 0x7F == MORE_CELLS] == [0x180 + MORE_CELLS, 0x280 + MORE_CELLS]
    assert {counter for _, _, counter in shown + more} == {250}
    for span, (counts, status, _) in enumerate(shown + more[:3], start=1):
        if span == 7:  # nothing is connected there
            assert (counts, status) == (0x7FFF, 4)
        else:
            assert status == 0
            assert counts == pytest.approx(100 * bench.amplifier.tension_n(span, 0.25), abs=0.51)
    assert more[3][:2] == (0, 1)  # of the channel that the three-channel amplifier does not have
    assert struct.unpack("<f", bench.upload(CELLS, 0x6130, 2))[0] == pytest.approx(
        bench.amplifier.tension_n(2, 0.25), rel=1e-6
    )
    assert [bench.number(node, 0x2131) for node in (CELLS, MORE_CELLS)] == [8, 3]
    assert bench.number(CELLS, 0x6131, 1) == 0x00210000 and bench.number(CELLS, 0x6132, 8) == 2
    assert bench.number(CELLS, 0x2132) == 1


@pytest.mark.parametrize(
    ("status", "code", "has_value"),
    [
        (ChannelStatus.OVERLOAD, 2, True),
        (ChannelStatus.WIRE_BREAK, 4, False),
        (ChannelStatus.NOT_CALIBRATED, 8, True),
    ],
)
def test_a_channel_that_is_not_well_says_so(bench: Bench, status: ChannelStatus, code: int, has_value: bool) -> None:
    bench.start()
    bench.amplifier.set_status(3, status)
    counts, shown, _ = channels(bench.latch(), CELLS)[2]
    assert shown == code == bench.number(CELLS, 0x6150, 3)
    assert (counts != 0x7FFF) == has_value
    [tension_n] = struct.unpack("<f", bench.upload(CELLS, 0x6130, 3))
    assert (tension_n == tension_n) == has_value


def test_counts_have_no_nan_so_the_status_tells(bench: Bench) -> None:
    bench.start()
    bench.amplifier.nan(3)
    assert channels(bench.latch(), CELLS)[2][:2] == (0x7FFF, 1)


def test_counts_saturate_and_resolution_follows_the_plant(bench: Bench) -> None:
    bench.start()
    bench.amplifier.show_n(1, 400.0)
    bench.amplifier.show_n(2, -400.0)
    assert [counts for counts, _, _ in channels(bench.latch(), CELLS)[:2]] == [0x7FFF, -0x8000]
    assert [decimal_digits(tension_n) for tension_n in (60.0, 327.67, 327.68)] == [2, 2, 1]


def test_an_unhealthy_amplifier_tells_it_once_and_shows_nothing_valid(bench: Bench) -> None:
    bench.start()
    bench.take()
    bench.amplifier.healthy = False
    bench.wait(0.003)
    emergencies = [(0x80 + node, struct.pack("<HB5x", 0xFF01, 0x81)) for node in (CELLS, MORE_CELLS)]
    assert bench.take() == emergencies
    assert {status for _, status, _ in channels(bench.latch(), CELLS)} == {1}
    assert (bench.number(CELLS, 0x1001), bench.number(CELLS, 0x2132)) == (0x81, 0)
    bench.take()
    bench.amplifier.healthy = True
    bench.wait(0.003)
    assert bench.take() == [(0x80 + node, bytes(8)) for node in (CELLS, MORE_CELLS)]
    assert bench.number(CELLS, 0x1003, 1) == 0xFF01


# Line PLC


def order(bench: Bench, run: int, speed_um_per_s: int, life: int) -> None:
    bench.send_message(0x200 + PLC, struct.pack("<HiH", run, speed_um_per_s, life))


def answer(bench: Bench) -> tuple[int, int, int]:
    [data] = [data for can_id, data in bench.latch() if can_id == 0x180 + PLC]
    return struct.unpack("<HiH", data)


def test_the_unwinder_follows_with_the_sync(bench: Bench) -> None:
    order(bench, 1, 100_000, 7)
    bench.latch()
    assert bench.world.unwind_speed_m_per_s == 0.0  # not operational yet
    bench.start()
    assert answer(bench)[0] == 0b0011  # what came before operational was not kept
    order(bench, 1, 100_000, 8)
    assert bench.world.unwind_speed_m_per_s == 0.0
    status, speed_um_per_s, life = answer(bench)
    assert (status, life) == (0b0111, 8) and speed_um_per_s == pytest.approx(100_000, abs=600)
    assert bench.world.unwind_speed_m_per_s == 0.1
    order(bench, 1, -50_000, 9)
    assert answer(bench)[1] == pytest.approx(-50_000, abs=600)
    assert [bench.number(PLC, 0x2001, k) for k in (1, 3)] == [1, 9]
    with aborted(0x06010002):
        bench.nodes[PLC].sdo.download(0x2001, 1, b"\0\0")


@pytest.mark.parametrize("command", [2, 128, 129, 130])
def test_leaving_operational_counts_as_no_run(bench: Bench, command: int) -> None:
    bench.start()
    order(bench, 1, 100_000, 1)
    answer(bench)
    bench.send_message(0, bytes((command, PLC)))
    assert bench.world.unwind_speed_m_per_s == 0.0
    bench.start()
    assert answer(bench)[0] == 0b0011
    order(bench, 1, 100_000, 2)
    assert answer(bench)[0] == 0b0111  # a new edge of run


def test_the_command_watchdog_of_the_line(bench: Bench) -> None:
    sdo = bench.nodes[PLC].sdo
    for refused in (9, 1001):
        with aborted(0x06090030):
            sdo.download(0x2002, 0, struct.pack("<H", refused))
    sdo.download(0x2002, 0, struct.pack("<H", 100))
    bench.start()
    order(bench, 1, 100_000, 1)
    answer(bench)
    for _ in range(3):  # SYNC and RPDO go on, the counter stands still
        bench.wait(0.04)
        order(bench, 1, 100_000, 1)
        status, _, _ = answer(bench)
    assert status == 0b1011 and bench.world.unwind_speed_m_per_s == 0.0
    [trip] = bench.recorder.recording().of_kind("plc_watchdog")
    assert trip["time_s"] == pytest.approx(0.1)
    bench.send_message(0, bytes((129, PLC)))
    assert bench.number(PLC, 0x2002) == 0 and bench.plc.watchdog_s == 0.0


def test_a_command_that_means_nothing_is_not_taken(bench: Bench) -> None:
    bench.start()
    order(bench, 4 | 1, 100_000, 5)
    assert bench.face.malformed == 1
    assert answer(bench) == (0b0011, pytest.approx(0, abs=600), 0)
    bench.take()
    bench.send_message(0x200 + PLC, bytes(7))
    assert (0x80 + PLC, struct.pack("<HB5x", 0x8210, 0x11)) in bench.take()
    assert bench.face.malformed == 2
    order(bench, 1, 100_000, 6)
    assert answer(bench)[2] == 6

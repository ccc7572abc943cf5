"""The CANopen face in stepped time: raw frames and the canopen library's master as peers on a virtual bus."""

import struct
import threading
import uuid
from collections.abc import Iterator
from pathlib import Path

import can
import canopen
import pytest
from canopen.sdo.exceptions import SdoAbortedError

from sim_plant.devices.drive import Drive
from sim_plant.faces.canopen import CanopenFace
from sim_plant.faces.canopen_sdo import EDS_PATH
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.world import World

PLANT = load_plant(Path(__file__).parents[2] / "sim_plant/plants/s_real.toml")
RATED_NM = PLANT.drives.rated_torque_nm
FIRST_NODE = 11
SHUTDOWN, SWITCH_ON, ENABLE, RESET = 0x06, 0x07, 0x0F, 0x80
SWITCH_ON_DISABLED, READY, OPERATION_ENABLED, FAULT = 0x40, 0x21, 0x27, 0x08


class Bench(canopen.Network):
    """Two drives on a virtual bus, and a master without a thread: what it sends is answered before it looks."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0
        channel = uuid.uuid4().hex
        self.world = World(PLANT, 3)
        self.recorder = Recorder(self.world)
        self.drives = [Drive(k, self.world, self.recorder, RATED_NM, PLANT.drives.max_torque_nm) for k in range(2)]
        self.drive = self.drives[0]
        self.bus = can.Bus(channel, "virtual")
        self.face = CanopenFace(can.Bus(channel, "virtual"), self.drives, FIRST_NODE, lambda: self.now_s)
        self.frames: list[tuple[int, bytes]] = []
        self.remote = self.add_node(canopen.RemoteNode(FIRST_NODE, str(EDS_PATH)))
        self.remote.sdo.RESPONSE_TIMEOUT = 0.01

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
        """Let time pass, a millisecond at a time."""
        for _ in range(round(seconds * 1000)):
            self.now_s = round(self.now_s + 0.001, 6)
            self.world.advance(self.now_s)
            self.face.poll()

    def start(self) -> None:
        self.send_message(0, bytes((1, FIRST_NODE)))

    def command(self, controlword: int, torque_per_mille: int = 0, mode: int = 10) -> None:
        self.send_message(0x200 + FIRST_NODE, struct.pack("<HhB", controlword, torque_per_mille, mode))

    def latch(self) -> tuple[int, int, int]:
        """Statusword, speed in um/s and torque in per mille, from the TPDO that the SYNC brought."""
        self.take()
        self.send_message(0x80, b"")
        [data] = [data for can_id, data in self.take() if can_id == 0x180 + FIRST_NODE]
        return struct.unpack("<Hih", data)

    def enable(self) -> None:
        for controlword in (SHUTDOWN, SWITCH_ON, ENABLE):
            self.command(controlword)
            status, _, _ = self.latch()
        assert status & 0x6F == OPERATION_ENABLED

    def sdo(self, index: int, subindex: int = 0) -> int:
        return int.from_bytes(self.remote.sdo.upload(index, subindex), "little")


@pytest.fixture
def bench() -> Iterator[Bench]:
    before = threading.active_count()
    bench = Bench()
    bench.face.boot()
    yield bench
    assert threading.active_count() == before  # the canopen library starts threads where it is let
    bench.face.bus.shutdown()
    bench.bus.shutdown()


def aborted(code: int) -> "pytest.RaisesExc[SdoAbortedError]":
    return pytest.raises(SdoAbortedError, check=lambda error: error.code == code)


# Network management


def test_boots_and_beats(bench: Bench) -> None:
    assert bench.take() == [(0x700 + FIRST_NODE, b"\0"), (0x701 + FIRST_NODE, b"\0")]
    bench.wait(0.099)
    assert bench.take() == []
    bench.wait(0.002)
    assert bench.take() == [(0x700 + FIRST_NODE, b"\x7f"), (0x701 + FIRST_NODE, b"\x7f")]
    bench.start()
    bench.wait(0.3)
    assert bench.take() == [(0x700 + FIRST_NODE, b"\x05"), (0x701 + FIRST_NODE, b"\x7f")] * 3


def test_heartbeat_time_takes_effect(bench: Bench) -> None:
    bench.remote.sdo[0x1017].raw = 20
    bench.take()
    bench.wait(0.1)
    assert bench.take().count((0x700 + FIRST_NODE, b"\x7f")) == 5
    with aborted(0x06090030):
        bench.remote.sdo[0x1017].raw = 9
    bench.remote.sdo[0x1017].raw = 0
    bench.take()
    bench.wait(1.0)
    assert all(can_id != 0x700 + FIRST_NODE for can_id, _ in bench.take())


def test_reset_brings_the_defaults_back(bench: Bench) -> None:
    bench.remote.sdo[0x1017].raw = 20
    bench.remote.sdo[0x1400][5].raw = 100
    bench.remote.sdo[0x1800][1].raw = 0x80000000 | 0x180 + FIRST_NODE
    bench.start()
    for reset in (129, 130):
        bench.take()
        bench.send_message(0, bytes((reset, 0)))
        assert bench.take() == [(0x700 + FIRST_NODE, b"\0"), (0x701 + FIRST_NODE, b"\0")]
        assert bench.sdo(0x1017) == 100
        assert bench.sdo(0x1400, 5) == 0 and bench.drive.watchdog_s == 0.0
        assert bench.sdo(0x1800, 1) == 0x40000180 + FIRST_NODE
        assert not bench.drive.operational


def test_a_node_that_restarts_boots_alone_with_its_defaults(bench: Bench) -> None:
    bench.remote.sdo[0x1400][5].raw = 100
    bench.remote.sdo[0x1400][1].raw = 0x80000200 + FIRST_NODE
    bench.start()
    bench.take()
    bench.face.restart(FIRST_NODE, bench.now_s)
    assert bench.take() == [(0x700 + FIRST_NODE, b"\0")]
    assert bench.sdo(0x1400, 5) == 0 and not bench.drive.operational
    bench.start()
    bench.command(SHUTDOWN)  # its command PDO is there again
    assert bench.latch()[0] & 0x6F == READY
    with pytest.raises(KeyError):
        bench.face.restart(99, bench.now_s)


def test_only_operational_nodes_do_process_data(bench: Bench) -> None:
    bench.command(SHUTDOWN)
    bench.take()
    bench.send_message(0x80, b"")
    assert bench.take() == []
    bench.start()
    status, _, _ = bench.latch()
    assert status & 0x4F == SWITCH_ON_DISABLED  # the command of before was not kept
    bench.send_message(0, bytes((2, 0)))
    bench.take()
    bench.send_message(0x80, b"")
    bench.send_message(0x600 + FIRST_NODE, bytes.fromhex("4000100000000000"))
    assert bench.take() == []  # stopped: not even SDO
    bench.send_message(0, bytes((128, FIRST_NODE)))
    assert bench.sdo(0x1000) == 0x00020192


def test_leaving_operational_takes_the_torque_off(bench: Bench) -> None:
    bench.start()
    bench.enable()
    bench.command(ENABLE, 100)
    bench.latch()
    assert bench.world.torque_nm[0] != 0.0
    bench.send_message(0, bytes((128, FIRST_NODE)))
    assert bench.world.torque_nm[0] == 0.0
    assert bench.sdo(0x6041) & 0x4F == SWITCH_ON_DISABLED


# Objects


def test_tells_who_it_is(bench: Bench) -> None:
    assert bench.sdo(0x1000) == 0x00020192
    assert [bench.sdo(0x1018, k) for k in range(5)] == [4, 0x520, 0x402, 0x10000, 0x52520000 + FIRST_NODE]
    assert bench.remote.sdo[0x1008].raw == "r2r-drive"  # segmented
    assert bench.sdo(0x6076) == round(1000 * RATED_NM)
    assert bench.sdo(0x6072) == round(1000 * PLANT.drives.max_torque_nm / RATED_NM)
    assert bench.sdo(0x6502) == 1 << 9
    assert bench.sdo(0x1200, 1) == 0x600 + FIRST_NODE


def test_every_object_of_the_data_sheet_can_be_read(bench: Bench) -> None:
    """The sheet promises types: what is read must have the length of its type."""
    for entry in bench.remote.object_dictionary.values():
        variables = entry.subindices.values() if hasattr(entry, "subindices") else [entry]
        for variable in variables:
            data = bench.remote.sdo.upload(variable.index, variable.subindex)
            if variable.index not in (0x1008, 0x1009, 0x100A):
                assert 8 * len(data) == len(variable), variable


def test_the_device_document_names_every_object_of_the_data_sheet(bench: Bench) -> None:
    document = (Path(__file__).parents[2] / "docs/devices/r2r-drive.md").read_text()
    assert [f"{index:04X}h" for index in bench.remote.object_dictionary if f"{index:04X}h" not in document] == []


def test_refuses_what_is_not_there(bench: Bench) -> None:
    sdo = bench.remote.sdo
    for index, subindex, code in [(0x2000, 0, 0x06020000), (0x1018, 5, 0x06090011), (0x6041, 1, 0x06090011)]:
        with aborted(code):
            sdo.upload(index, subindex)
    for index, data, code in [
        (0x6041, b"\0\0", 0x06010002),
        (0x6076, bytes(4), 0x06010002),
        (0x1017, b"\0", 0x06070010),
        (0x1017, bytes(20), 0x06070010),
        (0x605A, b"\x05\0", 0x06090030),
        (0x6060, b"\x08", 0x06090030),
        (0x1003, b"\1", 0x06090030),
    ]:
        with aborted(code):
            sdo.download(index, 0, data)


def test_watchdog_time_is_checked(bench: Bench) -> None:
    timer = bench.remote.sdo[0x1400][5]
    for allowed in (10, 200, 0, 100):
        timer.raw = allowed
        assert timer.raw == allowed
    for refused in (1, 9, 201, 65535):
        with aborted(0x06090030):
            timer.raw = refused
        assert timer.raw == 100
    assert bench.drive.watchdog_s == 0.1


def test_sdo_requests_out_of_order_are_aborted(bench: Bench) -> None:
    for command in range(256):
        bench.take()
        bench.send_message(0x600 + FIRST_NODE, bytes((command, 0x17, 0x10, 0, 1, 2, 3, 4)))
        answers = bench.take()
        assert len(answers) <= 1 and all(can_id == 0x580 + FIRST_NODE for can_id, _ in answers)
    assert bench.sdo(0x1000) == 0x00020192
    # A download that never ends is cut off.
    bench.send_message(0x600 + FIRST_NODE, bytes.fromhex("2017100000000000"))
    bench.take()
    for k in range(12):
        bench.send_message(0x600 + FIRST_NODE, bytes((0x10 * (k % 2), *[0] * 7)))
    assert (0x580 + FIRST_NODE, struct.pack("<BHBI", 0x80, 0x1017, 0, 0x05040005)) in bench.take()


# Process data


def test_torque_acts_with_the_sync_and_not_before(bench: Bench) -> None:
    bench.start()
    bench.enable()
    bench.command(ENABLE, 250)
    bench.wait(0.005)
    assert bench.world.torque_nm[0] == 0.0
    latched_s = bench.now_s
    _, _, torque = bench.latch()
    assert torque == 250
    assert bench.world.torque_nm[0] == pytest.approx(0.25 * RATED_NM)
    last = bench.recorder.recording().of_kind("torque")[-1]
    assert (last["roller"], last["time_s"]) == (1, latched_s)
    assert last["torque_nm"] == pytest.approx(0.25 * RATED_NM)
    bench.wait(0.01)
    assert bench.latch()[2] == 250  # no new command: it goes on
    bench.command(ENABLE, 100)
    bench.command(ENABLE, -40)
    assert bench.latch()[2] == -40  # the last one counts


def test_speed_is_that_of_the_web_in_um_per_s(bench: Bench) -> None:
    bench.world.start_at_equilibrium(bench.world.tension_n + 20.0, 0.1)
    bench.start()
    _, speed, _ = bench.latch()
    assert speed == pytest.approx(bench.world.speed_m_per_s[0] * 1e6, abs=600)  # noise of 100 um/s
    assert abs(speed - 100_000) < 5000


def test_one_step_for_each_command_with_a_sync(bench: Bench) -> None:
    bench.start()
    states = []
    for controlword in (0, SHUTDOWN, SWITCH_ON, ENABLE, SWITCH_ON, SHUTDOWN, 0):
        bench.command(controlword)
        states.append(bench.latch()[0] & 0x6F)
    assert [s & 0x4F if s & 0x4F == 0x40 else s for s in states] == [0x40, 0x21, 0x23, 0x27, 0x23, 0x21, 0x40]


def test_mapping_written_by_the_library_is_honoured(bench: Bench) -> None:
    node = bench.remote
    node.rpdo.read()
    node.tpdo.read()
    assert [v.index for v in node.rpdo[1].map] == [0x6040, 0x6071, 0x6060]
    assert [v.index for v in node.tpdo[1].map] == [0x6041, 0x606C, 0x6077]
    tpdo = node.tpdo[1]
    tpdo.clear()
    for index in (0x6077, 0x603F, 0x60FD):
        tpdo.add_variable(index)
    tpdo.cob_id = 0x280 + FIRST_NODE
    tpdo.save()
    rpdo = node.rpdo[1]
    rpdo.clear()
    rpdo.add_variable(0x6071)
    rpdo.add_variable(0x6040)
    rpdo.cob_id = 0x300 + FIRST_NODE
    rpdo.save()
    node.sdo[0x6060].raw = 10  # no longer in the PDO
    bench.start()
    for controlword, torque in [(SHUTDOWN, 0), (ENABLE, 0), (ENABLE, 50)]:
        bench.send_message(0x300 + FIRST_NODE, struct.pack("<hH", torque, controlword))
        bench.take()
        bench.send_message(0x80, b"")
    [(can_id, data)] = bench.take()
    assert can_id == 0x280 + FIRST_NODE
    assert struct.unpack("<hHI", data) == (50, 0, 0)
    bench.command(ENABLE, 77)  # on the identifier of before: for nobody
    bench.take()
    bench.send_message(0x80, b"")
    [(_, data)] = bench.take()
    assert struct.unpack_from("<h", data) == (50,)


def test_mapping_is_refused_with_the_right_code(bench: Bench) -> None:
    sdo = bench.remote.sdo
    with aborted(0x08000022):
        sdo[0x1600][0].raw = 0  # the PDO is on
    with aborted(0x08000022):
        sdo[0x1400][1].raw = 0x300 + FIRST_NODE
    sdo[0x1400][1].raw = 0x80000200 + FIRST_NODE
    sdo[0x1800][1].raw = 0x80000180 + FIRST_NODE
    with aborted(0x08000022):
        sdo[0x1600][1].raw = 0x60710010  # the number is not 0
    sdo[0x1600][0].raw = 0
    sdo[0x1A00][0].raw = 0
    for entry in (0x60770010, 0x20000010, 0x60400020, 0x60400110):
        with aborted(0x06040041):
            sdo[0x1600][1].raw = entry
    assert sdo[0x1600][1].raw == 0x60400010
    with aborted(0x06040041):
        sdo[0x1A00][1].raw = 0x60400010  # a command cannot be sent
    with aborted(0x06090030):
        sdo[0x1600][0].raw = 9
    with aborted(0x06040041):
        sdo[0x1600][0].raw = 4  # the fourth is empty
    for k, entry in enumerate((0x606C0020, 0x60FD0020, 0x60410010), start=1):
        sdo[0x1A00][k].raw = entry
    with aborted(0x06040042):
        sdo[0x1A00][0].raw = 3  # ten bytes
    sdo[0x1A00][0].raw = 2
    with aborted(0x06090030):
        sdo[0x1800][2].raw = 255
    for cob_id in (0x20000200, 0x80, 0x600 + FIRST_NODE, 0x800):
        with aborted(0x06090030):
            sdo[0x1400][1].raw = cob_id


# Faults


def test_watchdog_takes_the_torque_off(bench: Bench) -> None:
    bench.remote.sdo[0x1400][5].raw = 50
    bench.start()
    bench.wait(0.3)  # not supervised before the first command
    bench.enable()
    bench.wait(0.02)  # 18 Nm at 1000 Nm/s
    bench.command(ENABLE, 300)
    commanded_s = bench.now_s
    bench.latch()
    bench.take()
    bench.wait(0.049)
    assert bench.world.torque_nm[0] == pytest.approx(0.3 * RATED_NM)
    bench.wait(0.002)
    assert bench.world.torque_nm[0] == 0.0
    assert (0x80 + FIRST_NODE, bytes.fromhex("5082110000000000")) in bench.take()
    recording = bench.recorder.recording()
    [trip] = recording.of_kind("watchdog")
    assert trip["time_s"] == pytest.approx(commanded_s + 0.05)
    off = recording.of_kind("torque")[-1]
    assert off["torque_nm"] == 0.0 and off["time_s"] == pytest.approx(commanded_s + 0.05)
    assert bench.sdo(0x603F) == 0x8250 and bench.sdo(0x1001) == 0x11
    assert bench.latch()[0] & 0x4F == FAULT
    assert bench.recorder.unsafe_total == 0


def test_fault_reset_enables_nothing(bench: Bench) -> None:
    bench.start()
    bench.enable()
    bench.drive.fault(0x2310, bench.now_s)
    assert (0x80 + FIRST_NODE, bytes.fromhex("1023030000000000")) in bench.take()
    bench.command(ENABLE, 200)
    assert bench.latch()[0] & 0x4F == FAULT
    bench.command(RESET | ENABLE, 200)
    bench.take()
    bench.send_message(0x80, b"")
    frames = dict(bench.take())
    assert frames[0x80 + FIRST_NODE] == bytes(8)  # error reset
    assert frames[0x180 + FIRST_NODE][0] & 0x4F == SWITCH_ON_DISABLED
    bench.command(ENABLE, 200)
    status, _, torque = bench.latch()
    assert status & 0x4F == SWITCH_ON_DISABLED and torque == 0
    assert [bench.sdo(0x1003, k) for k in range(3)] == [1, 0x2310, 0]
    bench.remote.sdo[0x1003][0].raw = 0
    assert bench.sdo(0x1003, 1) == 0


def test_safe_torque_off_is_told_and_refuses_to_enable(bench: Bench) -> None:
    bench.start()
    bench.enable()
    bench.drive.set_sto(True, bench.now_s)
    assert bench.sdo(0x60FD) == 1 << 16
    for controlword in (SHUTDOWN, ENABLE):
        bench.command(controlword, 100)
        assert bench.latch()[0] & 0x4F == SWITCH_ON_DISABLED
    bench.drive.set_sto(False, bench.now_s)
    assert bench.sdo(0x60FD) == 0


def test_quick_stop_ramps_and_switches_off(bench: Bench) -> None:
    bench.start()
    bench.enable()
    bench.command(ENABLE, 500)
    bench.latch()
    bench.command(0x02)
    assert bench.latch()[0] & 0x6F == 0x07
    bench.wait(0.02)
    assert 0.0 < bench.world.torque_nm[0] < 0.5 * RATED_NM
    bench.wait(0.2)
    assert bench.world.torque_nm[0] == 0.0
    assert bench.latch()[0] & 0x4F == SWITCH_ON_DISABLED


# What does not belong on the bus


@pytest.mark.parametrize(
    "message",
    [
        can.Message(arbitration_id=0x200 + FIRST_NODE, data=bytes(5), is_extended_id=True),
        can.Message(arbitration_id=0x200 + FIRST_NODE, dlc=5, data=bytes(3), is_extended_id=False),
        can.Message(arbitration_id=0x180 + FIRST_NODE, is_remote_frame=True, is_extended_id=False),
        can.Message(arbitration_id=0x80, data=b"\1", is_extended_id=False),
        can.Message(arbitration_id=0x80, is_error_frame=True, is_extended_id=False),
        can.Message(arbitration_id=0x600 + FIRST_NODE, data=bytes(7), is_extended_id=False),
        can.Message(arbitration_id=0x000, data=b"\1", is_extended_id=False),
        can.Message(arbitration_id=0x000, data=bytes((77, FIRST_NODE)), is_extended_id=False),
        can.Message(arbitration_id=0x80, data=bytes(12), is_fd=True, is_extended_id=False),
    ],
)
def test_malformed_frames_are_counted_and_change_nothing(bench: Bench, message: can.Message) -> None:
    bench.start()
    bench.enable()
    bench.take()
    before = bench.drive.state, len(bench.recorder.recording().events)
    bench.bus.send(message)
    bench.face.pump()
    assert bench.face.malformed == 1
    assert (bench.drive.state, len(bench.recorder.recording().events)) == before
    assert bench.take() == []


def test_a_command_that_is_too_long_counts_as_far_as_it_is_mapped(bench: Bench) -> None:
    bench.start()
    bench.enable()
    bench.send_message(0x200 + FIRST_NODE, struct.pack("<HhBHB", ENABLE, 100, 10, 0xFFFF, 0xFF))
    bench.latch()
    assert bench.world.torque_nm[0] == pytest.approx(0.1 * RATED_NM)
    assert bench.face.malformed == 0


def test_a_command_that_is_too_short_is_told_once_and_feeds_no_watchdog(bench: Bench) -> None:
    bench.remote.sdo[0x1400][5].raw = 50
    bench.start()
    bench.enable()
    emergency = (0x80 + FIRST_NODE, struct.pack("<HB5x", 0x8210, 0x11))
    for expected in ([emergency], []):
        bench.wait(0.02)
        bench.take()
        bench.send_message(0x200 + FIRST_NODE, bytes(4))
        assert bench.take() == expected
        assert bench.drive.state.name == "OPERATION_ENABLED", "it goes on as it was"
    assert bench.face.malformed == 2
    assert (bench.sdo(0x1001), bench.sdo(0x1003, 1)) == (0x11, 0x8210)
    bench.take()
    bench.command(ENABLE)
    assert bench.take() == [(0x80 + FIRST_NODE, bytes(8))]
    assert bench.sdo(0x1001) == 0
    for _ in range(3):
        bench.wait(0.02)
        bench.send_message(0x200 + FIRST_NODE, bytes(4))
    assert bench.drive.error_code == 0x8250
    bench.take()
    bench.command(ENABLE)
    assert bench.take() == [], "there is still a fault"


@pytest.mark.parametrize(("can_id", "data"), [(0x263, bytes(5)), (0x663, bytes(8)), (0x000, b"\1\x63"), (0x100, b"")])
def test_frames_for_others_are_counted(bench: Bench, can_id: int, data: bytes) -> None:
    bench.take()
    bench.send_message(can_id, data)
    assert (bench.face.foreign, bench.face.malformed) == (1, 0)
    assert bench.take() == []

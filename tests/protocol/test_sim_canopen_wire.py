"""The wire time of the simulated CAN bus: bits of a frame, arbitration, and a bus of six drives in injected time."""

import asyncio
import re
import struct
import uuid
from collections.abc import Iterator
from math import inf
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.can_load import frame_bits as worst_bits
from sim_plant.devices.drive import Drive
from sim_plant.faces import can_wire
from sim_plant.faces.can_bits import INTERMISSION_BITS, arbitration_key, crc15, frame_bits, stuff_bits
from sim_plant.faces.can_wire import CanWire
from sim_plant.faces.canopen import CanopenFace
from sim_plant.faces.canopen_drive import DriveDevice
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.world import World
from tests.protocol.test_sim_process import GROUP
from tests.support.ports import free_port

PLANT = load_plant(Path(__file__).parents[2] / "sim_plant/plants/s_real.toml")
BITRATE = 1_000_000
BIT_S = 1.0 / BITRATE
NODES = range(1, 7)
LEAST_BITS = 44  #: of a frame without data and without stuff bits


def frame(can_id: int, data: bytes = b"", extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=extended)


def written_out(message: can.Message) -> str:
    """Start of frame to check sequence as text, by long division and by a substitution: apart from the code."""
    if message.is_extended_id:
        head = f"0{message.arbitration_id >> 18:011b}11{message.arbitration_id & 0x3FFFF:018b}"
        head += f"{int(message.is_remote_frame)}00"
    else:
        head = f"0{message.arbitration_id:011b}{int(message.is_remote_frame)}00"
    content = head + f"{message.dlc:04b}" + "".join(f"{byte:08b}" for byte in message.data)
    rest, divisor = int(content, 2) << 15, 0xC599  # x^15 + ..., with its leading term
    for shift in range(len(content) - 1, -1, -1):
        if rest >> shift + 15 & 1:
            rest ^= divisor << shift
    bits, at = content + f"{rest:015b}", 0
    while found := re.compile("00000|11111").search(bits, at):
        end = found.end()
        bits = bits[:end] + "10"[int(bits[end - 1])] + bits[end:]
        at = end
    return bits


messages = st.builds(
    lambda can_id, data: frame(can_id, data), st.integers(0, 0x7FF), st.binary(max_size=8)
) | st.builds(lambda can_id, data: frame(can_id, data, True), st.integers(0, 0x1FFFFFFF), st.binary(max_size=8))


@given(messages)
def test_a_frame_is_as_long_as_it_is_written_out(message: can.Message) -> None:
    assert frame_bits(message) == len(written_out(message)) + 10


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_no_frame_is_longer_than_the_published_worst_case(can_id: int, data: bytes) -> None:
    """Davis, Burns, Bril, Lukkien 2007, eq. 1, interframe space included."""
    bits = frame_bits(frame(can_id, data)) + INTERMISSION_BITS
    assert LEAST_BITS + INTERMISSION_BITS + 8 * len(data) <= bits <= worst_bits(len(data))


def test_the_check_sequence_is_the_catalogues() -> None:
    """CRC-15/CAN: check value 059E for the digits 1 to 9 (G. Cook, catalogue of parametrised CRC algorithms)."""
    assert crc15(b"123456789") == 0x059E


@pytest.mark.parametrize(("bits", "count"), [("0000", 0), ("00000", 1), ("000001111", 2), ("0000011110000", 3)])
def test_a_stuff_bit_begins_the_next_run(bits: str, count: int) -> None:
    """The pattern of most stuff bits: after the first one, one for every four bits."""
    assert stuff_bits(int(bits, 2), len(bits)) == count


def test_a_remote_frame_carries_no_data() -> None:
    message = can.Message(arbitration_id=0x555, dlc=8, is_remote_frame=True, is_extended_id=False)
    assert frame_bits(message) == len(written_out(message)) + 10 < 60


# Arbitration


def carried(wire: CanWire, until_s: float = 1e6) -> list[tuple[int, float]]:
    """Identifier and time of each frame, in the order of the wire."""
    return [(message.arbitration_id, end_s) for message, end_s in wire.through(until_s)]


def test_the_lowest_identifier_that_waits_goes_first() -> None:
    wire = CanWire(BITRATE)
    for can_id in (0x300, 0x100, 0x200, 0x080):
        wire.request(frame(can_id), 1.0)
    wire.request(frame(0x001), 1.0 + 10 * BIT_S)  # comes while the first is on the wire
    order = carried(wire)
    assert [can_id for can_id, _ in order] == [0x080, 0x001, 0x100, 0x200, 0x300]
    ends = [end_s for _, end_s in order]
    assert ends[0] == pytest.approx(1.0 + frame_bits(frame(0x080)) * BIT_S)
    for (can_id, end_s), before_s in zip(order[1:], ends, strict=False):
        assert end_s - before_s == pytest.approx((INTERMISSION_BITS + frame_bits(frame(can_id))) * BIT_S)
    taken = sum(frame_bits(frame(can_id)) + INTERMISSION_BITS for can_id, _ in order)
    assert wire.busy_s == pytest.approx(taken * BIT_S)


def test_frames_of_one_identifier_keep_their_order_and_an_idle_wire_is_taken_at_once() -> None:
    wire = CanWire(BITRATE)
    for k in range(3):
        wire.request(frame(0x123, bytes((k,))), 0.0)
    assert [message.data[0] for message, _ in wire.through(1.0)] == [0, 1, 2]
    assert wire.next_s() == inf
    wire.request(frame(0x123), 5.0)
    assert wire.next_s() == 5.0
    assert carried(wire, 5.0) == []
    [(_, end_s)] = carried(wire, 6.0)
    assert end_s == pytest.approx(5.0 + frame_bits(frame(0x123)) * BIT_S)


def test_a_frame_that_is_told_late_waits_for_the_one_on_the_wire() -> None:
    wire = CanWire(BITRATE)
    wire.request(frame(0x300), 1.0)
    assert carried(wire, 1.0) == []
    wire.request(frame(0x100), 0.9)
    assert [can_id for can_id, _ in carried(wire)] == [0x300, 0x100]


def test_a_base_frame_goes_before_an_extended_one_with_the_same_first_bits() -> None:
    base, extended = frame(0x123), frame(0x123 << 18, extended=True)
    assert arbitration_key(base) < arbitration_key(extended) < arbitration_key(frame(0x124))
    remote = can.Message(arbitration_id=0x123, is_remote_frame=True, is_extended_id=False)
    assert arbitration_key(base) < arbitration_key(remote) < arbitration_key(extended)


def test_what_nobody_could_queue_is_lost_and_counted() -> None:
    wire = CanWire(10_000)
    for _ in range(can_wire.MOST_WAITING + 3):
        wire.request(frame(0x100), 0.0)
    assert wire.overflows == 3
    assert len(carried(wire)) == can_wire.MOST_WAITING


# A bus of six drives


class Bench:
    """Six drives, added in the wrong order, and a bare master on a virtual bus in injected time."""

    def __init__(self) -> None:
        self.now_s = 0.0
        channel = uuid.uuid4().hex
        self.world = World(PLANT, 3)
        self.recorder = Recorder(self.world)
        self.drives = [Drive(k, self.world, self.recorder, 60.0, 60.0) for k in range(6)]
        self.bus, self.wire = can.Bus(channel, "virtual"), CanWire(BITRATE)
        self.face = CanopenFace(can.Bus(channel, "virtual"), [], 1, lambda: self.now_s, wire=self.wire)
        for node in reversed(NODES):
            self.face.add(node, DriveDevice(self.drives[node - 1]))

    def until_idle(self) -> list[tuple[float, can.Message]]:
        """Let time pass from event to event until the wire is free. What came to the master, and when."""
        came: list[tuple[float, can.Message]] = []
        self.face.pump()
        while self.wire.next_s() < inf:
            self.now_s = max(self.now_s, self.wire.next_s())
            self.face.pump()
            while message := self.bus.recv(0):
                came.append((self.now_s, message))
        return came


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    bench.face.boot()
    bench.until_idle()
    bench.bus.send(frame(0x000, b"\1\0"))
    bench.until_idle()
    bench.now_s = 0.5
    yield bench
    bench.face.bus.shutdown()
    bench.bus.shutdown()


def test_the_answers_to_a_sync_come_one_after_the_other_at_their_calculated_times(bench: Bench) -> None:
    bench.bus.send(frame(0x080))
    came = bench.until_idle()
    assert [message.arbitration_id for _, message in came] == [0x180 + node for node in NODES]
    at_s = 0.5 + (len(written_out(frame(0x080))) + 10) * BIT_S
    worst_s = 0.5 + worst_bits(0) * BIT_S
    for came_s, message in came:
        at_s += (3 + len(written_out(message)) + 10) * BIT_S
        worst_s += worst_bits(8) * BIT_S
        assert came_s == pytest.approx(at_s, abs=1e-9)
        assert came_s <= worst_s
    # Six answers of 8 bytes can be no shorter than 111 bits each: what `udp_multicast` hides is 0.7 ms.
    assert came[-1][0] - 0.5 > 6 * 111 * BIT_S


def test_commands_wait_behind_the_answers_and_act_when_they_are_through(bench: Bench) -> None:
    bench.bus.send(frame(0x080))
    for node in reversed(NODES):
        bench.bus.send(frame(0x200 + node, struct.pack("<HhB", 0x06, 0, 10)))
    answers = bench.until_idle()
    events = bench.recorder.recording().of_kind("command")
    assert [event["roller"] for event in events] == list(NODES)
    at_s = answers[-1][0]  # 0x18n goes before 0x20n
    for event in events:
        command = frame(0x200 + event["roller"], struct.pack("<HhB", 0x06, 0, 10))
        at_s += (3 + len(written_out(command)) + 10) * BIT_S
        assert event["time_s"] == pytest.approx(at_s, abs=1e-9)


def test_nothing_is_handed_over_before_its_time(bench: Bench) -> None:
    bench.bus.send(frame(0x080))
    bench.face.pump()
    bench.now_s = bench.wire.next_s() + 50 * BIT_S  # SYNC is through, the first answer is on its way
    bench.face.pump()
    assert bench.bus.recv(0) is None
    bench.now_s = bench.wire.next_s() - 1e-9
    bench.face.pump()
    assert bench.bus.recv(0) is None
    bench.now_s = bench.wire.next_s()
    bench.face.pump()
    message = bench.bus.recv(0)
    assert message is not None and message.arbitration_id == 0x181


def test_a_bus_that_takes_nothing_is_told_at_power_on(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()

    def refuse(*_: object, **__: object) -> None:
        raise can.CanOperationError("no route")

    monkeypatch.setattr(bench.face.bus, "send", refuse)
    with pytest.raises(can.CanOperationError, match="no route"):
        bench.face.boot()
    bench.face.bus.shutdown()
    bench.bus.shutdown()


def test_own_frames_that_come_back_take_no_time(bench: Bench) -> None:
    bench.face.take(frame(0x181, bytes(8)))
    bench.face.take(frame(0x701, b"\5"))
    assert bench.wire.next_s() == inf


def test_malformed_frames_take_their_time_and_change_nothing(bench: Bench) -> None:
    bench.bus.send(frame(0x080, b"\1"))
    bench.bus.send(frame(0x12345, bytes(8), extended=True))
    before = bench.wire.busy_s
    assert bench.until_idle() == []
    assert bench.face.malformed == 2
    bits = frame_bits(frame(0x080, b"\1")) + frame_bits(frame(0x12345, bytes(8), extended=True)) + 6
    assert bench.wire.busy_s - before == pytest.approx(bits * BIT_S)


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_the_event_loop_hands_frames_over_without_being_asked(scale: float) -> None:
    async def run() -> None:
        loop = asyncio.get_running_loop()
        world = World(PLANT, 3)
        drive = Drive(0, world, Recorder(world), 60.0, 60.0)
        port, begin_s = free_port(), loop.time()
        here, there = (can.Bus(GROUP, "udp_multicast", port=port, hop_limit=0, fd=False) for _ in range(2))
        wire = CanWire(20_000)
        face = CanopenFace(there, [drive], 5, lambda: scale * (loop.time() - begin_s), wire=wire)
        seen: asyncio.Queue[int] = asyncio.Queue()

        def listen() -> None:
            message = here.recv(0)
            if message is not None:
                seen.put_nowait(message.arbitration_id)

        loop.add_reader(here.fileno(), listen)
        try:
            face.boot()
            face.attach(loop, scale)
            async with asyncio.timeout(10):
                assert await seen.get() == 0x705
                sent_s = loop.time()
                for message in (frame(0x000, b"\1\5"), frame(0x080)):
                    here.send(message)
                while await seen.get() != 0x185:
                    pass
                bits = 44 + 16 + 44 + 44 + 64 + 6  # at the least
                assert loop.time() - sent_s >= bits / 20_000 / scale
        finally:
            face.detach()
            loop.remove_reader(here.fileno())
            here.shutdown()
            there.shutdown()

    asyncio.run(run())

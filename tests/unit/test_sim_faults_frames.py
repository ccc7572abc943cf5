"""Faults of frames, without any wire: what becomes of each frame."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_plant.faults import mbap_frames, opcua_frames
from sim_plant.faults.can_frames import CanFrames, node_of
from sim_plant.faults.frames import Direction
from sim_plant.faults.framing import DelayLine, Framer
from sim_plant.faults.mbap_frames import MbapFrames
from sim_plant.faults.opcua_frames import OpcUaFrames
from sim_plant.faults.parse import FaultRefused, parse_fault
from sim_plant.faults.wire_faults import WireFaults

TO, FROM = Direction.TO_DEVICE, Direction.FROM_DEVICE


def mbap(transaction: int, unit: int, pdu: bytes) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


def chunk(kind: bytes, body: bytes) -> bytes:
    return kind + struct.pack("<I", 8 + len(body)) + body


def message(request_id: int, handle: int, service: bytes, rest: bytes) -> bytes:
    body = struct.pack("<IIII", 1, 1, request_id, request_id) + service + bytes(8) + struct.pack("<I", handle) + rest
    return chunk(b"MSGF", body)


can_frames = st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8))
modbus_frames = st.builds(mbap, st.integers(0, 0xFFFF), st.integers(0, 255), st.binary(min_size=1, max_size=253))
chunks = st.builds(
    chunk, st.sampled_from([b"HELF", b"MSGF", b"MSGC", b"MSGA", b"OPNF", b"CLOF"]), st.binary(max_size=80)
)
KINDS = [(CanFrames(), can_frames), (MbapFrames(), modbus_frames), (OpcUaFrames(), chunks)]
each_kind = pytest.mark.parametrize(("kind", "frames"), KINDS, ids=["can", "mbap", "opcua"])


def faults_of(kind, *texts: str, seed: int = 0) -> WireFaults:
    faults = WireFaults(kind, seed)
    for text in texts:
        faults.begin(parse_fault(text), parse_fault(text).target.number)
    return faults


@each_kind
@given(data=st.data())
def test_without_faults_every_frame_passes_as_it_is(kind, frames, data):
    faults = WireFaults(kind)
    frame, way = data.draw(frames), data.draw(st.sampled_from(Direction))
    assert faults.pass_(way, 1, frame) == [(0.0, frame)]


@each_kind
@given(data=st.data())
def test_after_faults_nothing_is_left_of_them(kind, frames, data):
    """Frames that are held back come once, in order, and then everything passes again."""
    faults = WireFaults(kind)
    number = faults.begin(parse_fault("canopen reorder direction=both"), None)
    first, second = data.draw(frames), data.draw(frames)
    assert faults.pass_(FROM, 1, first) == []
    faults.end(number)
    assert faults.pass_(TO, 1, second) == [(0.0, second)]
    assert faults.pass_(FROM, 1, second) == [(0.0, first), (0.0, second)]
    assert faults.pass_(FROM, 1, second) == [(0.0, second)]


@each_kind
@pytest.mark.parametrize(
    "fault", ["drop", "delay delay_s=1", "duplicate", "corrupt", "wrong-function", "wrong-length by=1", "mute"]
)
@given(data=st.data())
def test_a_fault_of_one_address_touches_no_other(kind, frames, fault, data):
    faults = faults_of(kind, f"canopen 3 {fault}")
    frame = data.draw(frames)
    assert faults.pass_(FROM, 4, frame) == faults.pass_(FROM, 0, frame) == [(0.0, frame)]


@each_kind
@given(data=st.data(), count=st.integers(1, 10), extra=st.integers(0, 10), probability=st.sampled_from([0.3, 1.0]))
def test_counts_are_exact(kind, frames, data, count, extra, probability):
    frame = data.draw(frames)
    faults = WireFaults(kind)
    number = faults.begin(parse_fault(f"canopen drop count={count} probability={probability}"), None)
    passed = sum(len(faults.pass_(FROM, 1, frame)) for _ in range(200))
    assert passed == 200 - count
    assert sum(len(faults.pass_(FROM, 1, frame)) for _ in range(extra)) == extra
    assert faults.end(number) == count


def test_the_dice_depend_on_seed_and_frames_alone():
    def dropped(seed: int) -> list[bool]:
        faults = faults_of(CanFrames(), "canopen drop probability=0.5", seed=seed)
        return [not faults.pass_(FROM, 1, (0x181, b"")) for _ in range(200)]

    assert dropped(1) == dropped(1) != dropped(2)
    assert 60 < sum(dropped(1)) < 140


@each_kind
@given(data=st.data())
def test_corruption_inverts_one_bit_and_keeps_the_frame(kind, frames, data):
    frame = data.draw(frames)
    for _, after in faults_of(kind, "canopen corrupt").pass_(FROM, 1, frame):
        before, now = (f[1] if isinstance(f, tuple) else f for f in (frame, after))
        assert len(before) == len(now)
        assert sum((a ^ b).bit_count() for a, b in zip(before, now, strict=True)) == 1
        if isinstance(kind, MbapFrames):
            assert before[:7] == now[:7]
        if isinstance(kind, OpcUaFrames):
            assert before[:8] == now[:8]


def test_what_has_no_content_is_lost_by_corruption():
    assert faults_of(CanFrames(), "canopen corrupt").pass_(FROM, 1, (0x080, b"")) == []
    assert faults_of(OpcUaFrames(), "opcua corrupt").pass_(FROM, 0, chunk(b"CLOF", b"")) == []


@given(modbus_frames, st.integers(-64, 64), st.booleans())
def test_the_length_field_of_modbus_fits_or_lies(frame, by, fits):
    faults = faults_of(MbapFrames(), f"modbus-tcp wrong-length by={by} field={'fits' if fits else 'lies'}")
    ((_, after),) = faults.pass_(FROM, 1, frame)
    assert len(after) == min(260, max(8, len(frame) + by))
    told = struct.unpack_from(">H", after, 4)[0]
    assert told == (len(after) if fits else len(frame)) - 6
    assert after[:4] == frame[:4] and after[6:8] == frame[6:8]


@given(chunks, st.integers(-64, 64), st.booleans())
def test_the_size_of_a_chunk_fits_or_lies(frame, by, fits):
    ((_, after),) = faults_of(OpcUaFrames(), f"opcua wrong-length by={by} field={'fits' if fits else 'lies'}").pass_(
        FROM, 0, frame
    )
    assert len(after) == max(8, len(frame) + by)
    assert struct.unpack_from("<I", after, 4)[0] == len(after if fits else frame)


@given(can_frames, st.integers(-64, 64))
def test_a_can_frame_has_0_to_8_bytes(frame, by):
    ((_, (can_id, data)),) = faults_of(CanFrames(), f"canopen wrong-length by={by}").pass_(FROM, 1, frame)
    assert can_id == frame[0] and len(data) == min(8, max(0, len(frame[1]) + by))


@pytest.mark.parametrize(
    ("before", "after"),
    [(0x03, 0x04), (0x04, 0x03), (0x17, 0x03), (0x06, 0x10), (0x10, 0x06), (0x83, 0x84), (0x2B, 0x2A)],
)
def test_another_modbus_function_keeps_frame_and_exception(before, after):
    ((_, frame),) = faults_of(MbapFrames(), "modbus-tcp wrong-function").pass_(FROM, 1, mbap(7, 1, bytes((before, 9))))
    assert frame == mbap(7, 1, bytes((after, 9)))


def test_another_can_function_keeps_the_node():
    faults = faults_of(CanFrames(), "canopen wrong-function direction=both")
    assert [faults.pass_(FROM, 3, (i, b"x"))[0][1][0] for i in (0x183, 0x203, 0x703)] == [0x103, 0x283, 0x783]


def test_another_opcua_type_keeps_the_chunk():
    ((_, after),) = faults_of(OpcUaFrames(), "opcua wrong-function").pass_(FROM, 0, chunk(b"MSGF", b"abc"))
    assert after == chunk(b"OPNF", b"abc")


def test_frames_of_one_way_are_swapped_in_pairs_and_ways_do_not_mix():
    faults = faults_of(CanFrames(), "canopen reorder direction=both")
    frames = [(0x181, bytes((k,))) for k in range(4)]
    assert faults.pass_(FROM, 1, frames[0]) == []
    assert faults.pass_(TO, 1, frames[1]) == []
    assert faults.pass_(FROM, 2, frames[1]) == []
    assert faults.pass_(FROM, 1, frames[2]) == [(0.0, frames[2]), (0.0, frames[0])]
    assert faults.pass_(FROM, 1, frames[3]) == []


def test_several_faults_act_one_after_the_other():
    faults = faults_of(CanFrames(), "canopen duplicate copies=3", "canopen delay delay_s=0.25", "canopen drop count=1")
    frame = (0x181, b"ab")
    assert faults.pass_(FROM, 1, frame) == [(0.25, frame)] * 2
    assert faults.pass_(FROM, 1, frame) == [(0.25, frame)] * 3
    assert faults.pass_(TO, 1, frame) == [(0.0, frame)]


def test_one_way_and_mute():
    faults = faults_of(CanFrames(), "canopen one-way direction=to-device")
    frame = (0x181, b"ab")
    assert faults.pass_(TO, 1, frame) == [(0.0, frame)] and faults.pass_(FROM, 1, frame) == []
    muted = faults_of(CanFrames(), "canopen mute")
    assert muted.pass_(TO, 1, frame) == muted.pass_(FROM, 1, frame) == []


def test_a_disconnected_wire_says_so_and_passes_nothing():
    faults = WireFaults(MbapFrames())
    broken_off: list[bool] = []
    faults.on_disconnect = lambda: broken_off.append(faults.disconnected)
    number = faults.begin(parse_fault("modbus-tcp disconnect"), None)
    assert broken_off == [True] and faults.pass_(TO, 1, mbap(1, 1, b"\3")) == []
    faults.end(number)
    assert not faults.disconnected


def test_time_comes_as_far_as_the_frame_and_no_further():
    faults, seen = WireFaults(MbapFrames()), []
    faults.before_request = seen.append
    for way in (TO, FROM):
        faults.carry(way, 1, mbap(1, 1, b"\3"), lambda frame, delay_s: None, lambda delay_s, call: None, 12.5)
    faults.pass_(TO, 1, mbap(1, 1, b"\3"))
    assert seen == [12.5, None]


def test_time_can_bring_a_fault_before_the_request_that_it_meets():
    faults = WireFaults(CanFrames())
    faults.before_request = lambda _: faults.begin(parse_fault("canopen mute"), None)
    assert faults.pass_(FROM, 1, (0x181, b"")) == [(0.0, (0x181, b""))]
    assert faults.pass_(TO, 1, (0x201, b"")) == []


# Freeze: old content, correctly framed.


def test_a_frozen_modbus_device_answers_each_question_with_its_first_answer():
    faults = faults_of(MbapFrames(), "modbus-tcp freeze")

    def exchange(transaction: int, request: bytes, answer: bytes) -> bytes:
        faults.pass_(TO, 1, mbap(transaction, 1, request))
        ((_, after),) = faults.pass_(FROM, 1, mbap(transaction, 1, answer))
        return after

    read, other = b"\x04\0\0\0\2", b"\x04\0\5\0\2"
    assert exchange(1, read, b"\x04\4AAAA") == mbap(1, 1, b"\x04\4AAAA")
    assert exchange(2, other, b"\x04\4BBBB") == mbap(2, 1, b"\x04\4BBBB")
    assert exchange(3, read, b"\x04\4CCCC") == mbap(3, 1, b"\x04\4AAAA")
    # function 23 writes other values each time and asks for the same
    assert exchange(4, b"\x17\0\0\0\1\0\x0a\0\1\2ab", b"\x17\2XX") == mbap(4, 1, b"\x17\2XX")
    assert exchange(5, b"\x17\0\0\0\1\0\x0a\0\1\2cd", b"\x17\2YY") == mbap(5, 1, b"\x17\2XX")


def test_a_frozen_node_sends_its_first_pdo_and_its_first_answer_for_each_object():
    faults = faults_of(CanFrames(), "canopen freeze")

    def sent(can_id: int, data: bytes) -> bytes:
        return faults.pass_(FROM, 1, (can_id, data))[0][1][1]

    assert [sent(0x181, b"1"), sent(0x281, b"2"), sent(0x181, b"3")] == [b"1", b"2", b"1"]
    a, b = b"\x43\x41\x60\0aaaa", b"\x43\x42\x60\0bbbb"
    assert [sent(0x581, a), sent(0x581, b), sent(0x581, a[:4] + b"cccc")] == [a, b, a]
    assert faults.pass_(TO, 1, (0x201, b"new")) == [(0.0, (0x201, b"new"))]


def test_a_frozen_opcua_server_answers_with_old_values_under_the_new_ids():
    faults = faults_of(OpcUaFrames(), "opcua freeze")
    read, answer = b"\1\0\x77\2", b"\1\0\x7a\2"
    faults.pass_(TO, 0, message(1, 11, read, b"nodes"))
    ((_, first),) = faults.pass_(FROM, 0, message(1, 11, answer, b"old values"))
    assert first == message(1, 11, answer, b"old values")
    faults.pass_(TO, 0, message(2, 12, read, b"nodes"))
    ((_, second),) = faults.pass_(FROM, 0, message(2, 12, answer, b"new, longer values"))
    assert second == message(2, 12, answer, b"old values")
    faults.pass_(TO, 0, message(3, 13, read, b"other nodes"))
    assert faults.pass_(FROM, 0, message(3, 13, answer, b"x")) == [(0.0, message(3, 13, answer, b"x"))]
    unasked = chunk(b"ERRF", b"abc")
    assert faults.pass_(FROM, 0, unasked) == [(0.0, unasked)]


@each_kind
@given(data=st.data())
def test_freezing_takes_any_frames(kind, frames, data):
    faults = faults_of(kind, "canopen freeze")
    for way, frame in data.draw(st.lists(st.tuples(st.sampled_from(Direction), frames), max_size=10)):
        assert len(faults.pass_(way, 1, frame)) == 1


# CANopen.


def test_only_heartbeats_are_lost_and_the_boot_up_message_is_none():
    faults = faults_of(CanFrames(), "canopen 3 heartbeat-lost")
    assert faults.pass_(FROM, 3, (0x703, b"\5")) == []
    for can_id, data in ((0x703, b"\0"), (0x183, b"\5"), (0x583, b"\5")):
        assert faults.pass_(FROM, 3, (can_id, data)) == [(0.0, (can_id, data))]
    assert faults.pass_(FROM, 4, (0x704, b"\5")) != []


def test_an_aborted_download_never_reaches_its_object():
    faults = faults_of(CanFrames(), "canopen 3 sdo-abort index=0x1400 code=0x06090030 count=1")
    download = b"\x2b\x00\x14\x05\x64\0\0\0"
    ((_, (can_id, asked)),) = faults.pass_(TO, 3, (0x603, download))
    assert can_id == 0x603 and asked == b"\x40\0\0\0\0\0\0\0"
    refusal = b"\x80\0\0\0\0\0\2\6"
    ((_, told),) = faults.pass_(FROM, 3, (0x583, refusal))
    assert told == (0x583, b"\x80\x00\x14\x05\x30\0\x09\6")
    assert faults.pass_(TO, 3, (0x603, download)) == [(0.0, (0x603, download))]
    assert faults.pass_(FROM, 3, (0x583, refusal)) == [(0.0, (0x583, refusal))]


@pytest.mark.parametrize(
    "data",
    [b"\x2b\x10\x14\0\0\0\0\0", b"\0\0\x14\0\0\0\0\0", b"\x60\0\x14\0\0\0\0\0", b"\x80\0\x14\0\0\0\0\0", b"\x2b\0\x14"],
)
def test_other_objects_segments_and_aborts_pass(data):
    faults = faults_of(CanFrames(), "canopen 3 sdo-abort index=0x1400")
    assert faults.pass_(TO, 3, (0x603, data)) == [(0.0, (0x603, data))]


@pytest.mark.parametrize("kind", [MbapFrames(), OpcUaFrames()], ids=["mbap", "opcua"])
@pytest.mark.parametrize("fault", ["heartbeat-lost", "sdo-abort"])
def test_what_a_wire_does_not_have_is_refused(kind, fault):
    faults = WireFaults(kind)
    with pytest.raises(FaultRefused, match="no such fault"):
        faults.begin(parse_fault(f"drive 1 {fault}"), 1)
    with pytest.raises(FaultRefused, match="no such fault"):
        faults.check(parse_fault(f"drive 1 {fault}"))


def test_whose_frame_it_is():
    assert [node_of(i, b"\1\3") for i in (0x000, 0x080, 0x083, 0x183, 0x503, 0x703)] == [3, 0, 3, 3, 3, 3]
    assert node_of(0x000, b"\1\0") == 0 and node_of(0x000, b"") == 0


# Framing of streams.

FRAMERS = [
    (lambda: Framer(mbap_frames.HEADER, mbap_frames.size_of), modbus_frames),
    (lambda: Framer(opcua_frames.HEADER, opcua_frames.size_of), chunks),
]


@pytest.mark.parametrize(("framer", "frames"), FRAMERS, ids=["mbap", "opcua"])
@given(data=st.data())
def test_frames_are_found_whatever_segments_they_come_in(framer, frames, data):
    sent = data.draw(st.lists(frames, max_size=6))
    stream = b"".join(sent)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    cutter, found = framer(), []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += cutter.feed(stream[begin:end])
    assert found == sent and cutter.framed and cutter.rest() == b""


@pytest.mark.parametrize(("framer", "frames"), FRAMERS, ids=["mbap", "opcua"])
@given(data=st.data())
def test_nothing_of_a_stream_is_lost_whatever_it_is(framer, frames, data):
    pieces = data.draw(st.lists(frames | st.binary(max_size=40), max_size=6))
    cutter, joined = framer(), b""
    for piece in pieces:
        joined += b"".join(cutter.feed(piece))
        if not cutter.framed:
            joined += cutter.rest()
    assert joined + cutter.rest() == b"".join(pieces)


@given(st.lists(st.floats(0, 10)), st.lists(st.floats(0, 10)))
def test_late_frames_go_at_their_time_and_in_order(times, looks):
    line: DelayLine[int] = DelayLine()
    for k, due_s in enumerate(times):
        line.put(due_s, k)
    gone: list[int] = []
    for now_s in sorted(looks):
        taken = line.take(now_s)
        assert all(times[k] <= now_s for k in taken) and line.due_s > now_s
        gone += taken
    gone += line.take(10.0)
    assert gone == sorted(range(len(times)), key=lambda k: (times[k], k))

"""Frames as bytes on an interface's socket, against python-can's own reading and writing of them."""

import asyncio
import errno
import os
import socket
import struct

import can
import msgpack
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame
from can.interfaces.udp_multicast.utils import pack_message, unpack_message
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.bus import CanBus
from drivers.canopen.wire import SocketcanWire, packed, unpacked
from gateway.core.line import CanopenBus
from tests.protocol.driver_support import GROUP
from tests.support.ports import free_port

cob_ids, payloads = st.integers(0, 0x7FF), st.binary(max_size=8)


def data_frame(cob_id: int, data: bytes, **more: bool) -> can.Message:
    return can.Message(arbitration_id=cob_id, data=data, is_extended_id=False, **more)


OTHERS = [
    can.Message(arbitration_id=0x181, data=b"\1", is_extended_id=True),
    can.Message(arbitration_id=0x18181, data=b"\1", is_extended_id=True),
    can.Message(arbitration_id=0x181, is_remote_frame=True, dlc=4, is_extended_id=False),
    data_frame(0x040, bytes(8), is_error_frame=True),
]


# udp_multicast


@given(cob_ids, payloads)
def test_a_datagram_is_what_python_can_makes_of_the_frame(cob_id: int, data: bytes) -> None:
    assert packed(cob_id, data) == pack_message(data_frame(cob_id, data))
    assert unpacked(packed(cob_id, data)) == (cob_id, data)


@pytest.mark.parametrize("message", [*OTHERS, data_frame(0x181, bytes(12), is_fd=True)])
def test_what_is_no_plain_data_frame_stays_a_message(message: can.Message) -> None:
    found = unpacked(pack_message(message))
    assert isinstance(found, can.Message) and found.equals(message)


WRONG = {
    "arbitration_id": [0x800, -1, "385", 1.5, None],
    "dlc": [9, 3, -1, "1"],
    "data": [bytes(9), "text", None],
    "is_fd": [True],
    "bitrate_switch": [True],
    "error_state_indicator": [True],
    "is_extended_id": [True],
    "is_remote_frame": [True],
    "is_error_frame": [True],
    "surplus": [1],
}


@given(
    st.one_of(
        st.binary(max_size=40),
        st.tuples(cob_ids, payloads, st.sampled_from([(key, value) for key in WRONG for value in WRONG[key]])).map(
            lambda case: msgpack.packb(msgpack.unpackb(packed(*case[:2])) | dict([case[2]]))
        ),
        st.tuples(cob_ids, payloads, st.sampled_from(list(msgpack.unpackb(packed(0, b""))))).map(
            lambda case: msgpack.packb({k: v for k, v in msgpack.unpackb(packed(*case[:2])).items() if k != case[2]})
        ),
    )
)
def test_a_datagram_is_taken_where_python_can_takes_it(datagram: bytes) -> None:
    try:
        wanted = unpack_message(datagram, replace={"timestamp": 0.0}, check=True)
    except Exception:
        with pytest.raises(ValueError, match="no frame"):
            unpacked(datagram)
        return
    found = unpacked(datagram)
    if isinstance(found, tuple):
        found = data_frame(found[0], bytes(found[1]))
    assert found.equals(wanted, check_channel=False)


@pytest.mark.parametrize("data", [1, 1_000_000_000, [1, 2], True, {}])
def test_data_that_is_no_bytes_never_gets_as_far_as_a_message(data: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """python-can takes a number for that many bytes: a short datagram would cost gigabytes."""
    monkeypatch.setattr("drivers.canopen.wire.unpack_message", lambda *_, **__: pytest.fail("a message was made"))
    with pytest.raises(ValueError, match="^a datagram that is no frame$"):
        unpacked(msgpack.packb(msgpack.unpackb(packed(0x181, b"")) | {"data": data}))


def test_a_datagram_that_is_no_frame_is_not_quoted() -> None:
    """Its text goes to logs and terminals."""
    with pytest.raises(ValueError, match="^a datagram that is no frame$"):
        unpacked(msgpack.packb(msgpack.unpackb(packed(0x181, b"")) | {"\x1b[2J\nFAKE " + "A" * 3000: 1}))


def test_what_is_sent_and_received_meets_python_can() -> None:
    port = free_port()
    came: list[tuple[int, bytes]] = []

    async def run() -> None:
        config = CanopenBus(name="b", protocol="canopen", interface="udp_multicast", channel=GROUP, port=port)
        bus = CanBus(config, [0x181], lambda cob_id, data, _: came.append((cob_id, bytes(data))), print)
        peer = can.Bus(interface="udp_multicast", channel=GROUP, port=port, hop_limit=0, fd=False)
        try:
            bus.open()
            peer.send(data_frame(0x181, b"\1\2\3"))
            assert bus.send(0x201, b"\4\5")
            async with asyncio.timeout(5.0):
                while (0x181, b"\1\2\3") not in came:  # noqa: ASYNC110 (what happens, happens in sockets)
                    await asyncio.sleep(0)
            received = [peer.recv(5.0), peer.recv(5.0)]
            assert (0x201, b"\4\5") in [(m.arbitration_id, bytes(m.data)) for m in received if m is not None]
        finally:
            peer.shutdown()
            await bus.close()

    asyncio.run(run())


# socketcan


def socketcan() -> tuple[SocketcanWire, socket.socket]:
    """In place of the kernel's CAN socket, one that keeps messages apart as it does."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    return SocketcanWire(ours), theirs


@given(cob_ids, payloads)
def test_a_frame_of_socketcan_is_what_python_can_makes_of_it(cob_id: int, data: bytes) -> None:
    wire, kernel = socketcan()
    with kernel:
        wire.send(cob_id, data)
        wanted = bytearray(build_can_frame(data_frame(cob_id, data)))
        wanted[7] = 0  # len8_dlc: python-can says the length again, the kernel needs nothing there
        assert kernel.recv(100) == wanted
        kernel.send(build_can_frame(data_frame(cob_id, data)))
        assert wire.receive() == (cob_id, data)
        assert wire.receive() is None
        asyncio.run(wire.close())


@pytest.mark.parametrize("message", OTHERS)
def test_other_frames_of_socketcan_are_told_apart(message: can.Message) -> None:
    wire, kernel = socketcan()
    with kernel:
        kernel.send(build_can_frame(message))
        found = wire.receive()
        assert isinstance(found, can.Message) and found.equals(message)
        kernel.send(b"half")
        with pytest.raises(ValueError, match="4 bytes are no frame"):
            wire.receive()
        asyncio.run(wire.close())


def test_a_full_socket_is_said_and_not_waited_for() -> None:
    wire, kernel = socketcan()
    with kernel:
        with pytest.raises(OSError) as full:
            for _ in range(100_000):
                wire.send(0x201, bytes(8))
        assert full.value.errno in (errno.EAGAIN, errno.ENOBUFS), os.strerror(full.value.errno or 0)
        asyncio.run(wire.close())
    assert struct.calcsize("=IB3x8s") == 16

"""The simulated line's bus on a multicast group, against python-can's own."""

import socket
import time
from collections.abc import Iterator

import can
import pytest

from sim_plant.faces.canopen_multicast import MulticastBus

GROUP = "239.74.163.2"


@pytest.fixture
def buses() -> Iterator[tuple[MulticastBus, can.BusABC]]:
    """The device's, and another's."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    device, other = MulticastBus(GROUP, port), can.Bus(GROUP, "udp_multicast", port=port, hop_limit=0, fd=True)
    yield device, other
    device.shutdown()
    other.shutdown()


def frame(can_id: int, data: bytes = b"", **kind: bool) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, **({"is_extended_id": False} | kind))


def test_frames_are_those_of_python_can_in_both_directions(buses: tuple[MulticastBus, can.BusABC]) -> None:
    device, other = buses
    sent = [frame(0x080), frame(0x201, bytes(range(8))), frame(0x12345, b"x", is_extended_id=True)]
    for message in sent:
        other.send(message)
    for message in sent:
        received = device.recv(0)
        assert received is not None and received.equals(message, timestamp_delta=None, check_direction=False)
        assert time.time() - 60.0 < received.timestamp <= time.time()  # the kernel's, not the sender's
    assert device.recv(0) is None
    device.send(sent[1])
    heard = [other.recv(1.0) for _ in range(4)]  # its own three come back to it
    assert heard[3] is not None and heard[3].equals(sent[1], timestamp_delta=None, check_direction=False)


def test_what_it_has_sent_does_not_come_back(buses: tuple[MulticastBus, can.BusABC]) -> None:
    device, other = buses
    device.send(frame(0x181, bytes(8)))
    other.send(frame(0x181, b"other"))
    device.send(frame(0x182, bytes(8)))
    received = device.recv(1.0) if (first := device.recv(0)) is None else first
    assert received is not None and received.data == b"other"
    assert device.recv(0) is None


def test_what_is_no_classic_frame(buses: tuple[MulticastBus, can.BusABC]) -> None:
    device, other = buses
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for garbage in (b"", b"hello", b"\xc0", bytes(5000)):
            stranger.sendto(garbage, (GROUP, device._multicast.port))  # noqa: SLF001
            with pytest.raises(can.CanOperationError):
                device.recv(0)
    other.send(frame(0x100, bytes(12), is_fd=True))
    other.send(frame(0x101))
    received = device.recv(0)
    assert received is not None and received.arbitration_id == 0x101

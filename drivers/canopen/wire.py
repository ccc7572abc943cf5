"""How frames go through an interface that python-can has opened.

python-can's own `recv` and `send` spend more on system calls, clock readings and `Message` objects than a control cycle
with some twenty frames can give. So where the format on the interface's socket is public (socketcan, udp_multicast),
frames go through that socket directly, in the same format. What is not a plain frame is left to python-can to judge.
An interface without a socket (virtual) is read by one thread, which only fetches.
"""

import asyncio
import os
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable
from operator import itemgetter
from typing import Any, Protocol

import can
import msgpack  # comes with python-can[multicast]
from can.interfaces.udp_multicast.utils import unpack_message

from gateway.core.line import CanopenBus

LARGEST_ID = 0x7FF  #: of 11 bits; CANopen uses no others
FAILURES = (can.CanError, OSError, ValueError)  #: what `receive` and `send` raise
THREAD_POLL_S = 0.02  #: how soon the fetching thread notices that the interface is closed

Frame = tuple[int, bytes | bytearray]  #: identifier of 11 bits and data


class Wire(Protocol):
    """An open interface. `receive` and `send` never wait."""

    def read_with(self, on_arrival: Callable[[], None]) -> None:
        """Have the running loop call `on_arrival` when there is something to `receive`."""
        ...

    def stop_reading(self) -> None:
        """Idempotent."""
        ...

    def receive(self) -> Frame | can.Message | None:
        """What has arrived next, None when nothing has; a message where it is no data frame with 11 bits.

        Raises one of FAILURES.
        """
        ...

    def send(self, cob_id: int, data: bytes) -> None:
        """Raises one of FAILURES when the interface does not take the frame."""
        ...

    async def close(self) -> None:
        """Release what was added to python-can's own; that is closed by whoever has opened it. Idempotent."""
        ...


def wire_of(config: CanopenBus, bus: can.BusABC) -> Wire:
    """Of an interface that python-can has opened. Raises OSError."""
    if config.interface == "socketcan":
        return SocketcanWire(_own(bus))
    if config.interface == "udp_multicast":
        return MulticastWire(_own(bus), config.channel)
    return FetchedWire(bus, config.name)


def _own(bus: can.BusABC) -> socket.socket:
    """The interface's socket under a descriptor of our own."""
    return socket.socket(fileno=os.dup(bus.fileno()))


class _SocketWire:
    """What the interfaces with a socket share."""

    def __init__(self, interface: socket.socket) -> None:
        self._socket = interface
        self._socket.setblocking(False)
        self._loop: asyncio.AbstractEventLoop | None = None

    def read_with(self, on_arrival: Callable[[], None]) -> None:
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._socket, on_arrival)

    def stop_reading(self) -> None:
        loop, self._loop = self._loop, None
        if loop is not None:
            loop.remove_reader(self._socket)

    async def close(self) -> None:
        self.stop_reading()
        self._socket.close()


class SocketcanWire(_SocketWire):
    """Linux, include/uapi/linux/can.h: struct can_frame."""

    _FRAME = struct.Struct("=IB3x8s")
    _EXTENDED, _REMOTE, _ERROR = 1 << 31, 1 << 30, 1 << 29

    def receive(self) -> Frame | can.Message | None:
        try:
            received = self._socket.recv(self._FRAME.size)
        except BlockingIOError:
            return None
        if len(received) != self._FRAME.size:
            raise ValueError(f"{len(received)} bytes are no frame of CAN")
        identifier, length, data = self._FRAME.unpack(received)
        if identifier <= LARGEST_ID:
            return identifier, data[:length]
        return can.Message(
            arbitration_id=identifier & (self._ERROR - 1),
            is_extended_id=bool(identifier & self._EXTENDED),
            is_remote_frame=bool(identifier & self._REMOTE),
            is_error_frame=bool(identifier & self._ERROR),
            dlc=length,
            data=data[:length],
        )

    def send(self, cob_id: int, data: bytes) -> None:
        self._socket.send(self._FRAME.pack(cob_id, len(data), data))


class MulticastWire(_SocketWire):
    """python-can's udp_multicast: the fields of a `can.Message`, packed with msgpack, one a datagram."""

    _MOST_BYTES = 4096  #: of a datagram, as python-can has it

    def __init__(self, interface: socket.socket, group: str) -> None:
        super().__init__(interface)
        self._group = (group, interface.getsockname()[1])

    def receive(self) -> Frame | can.Message | None:
        try:
            datagram = self._socket.recv(self._MOST_BYTES)
        except BlockingIOError:
            return None
        return unpacked(datagram)

    def send(self, cob_id: int, data: bytes) -> None:
        self._socket.sendto(packed(cob_id, data), self._group)


_FLAGS = (
    "is_extended_id",
    "is_remote_frame",
    "is_error_frame",
    "is_fd",
    "bitrate_switch",
    "error_state_indicator",
)
_KEYS = {"timestamp", "arbitration_id", "channel", "dlc", "data", *_FLAGS}
_PLAIN = (False,) * len(_FLAGS)
_flags = itemgetter(*_FLAGS)
_NO_FRAME = "a datagram that is no frame"


def packed(cob_id: int, data: bytes) -> bytes:
    """The datagram of a data frame, as `can.interfaces.udp_multicast.utils.pack_message` has it."""
    fields = {
        "timestamp": 0.0,
        "arbitration_id": cob_id,
        "is_extended_id": False,
        "is_remote_frame": False,
        "is_error_frame": False,
        "channel": None,
        "dlc": len(data),
        "data": data,
        "is_fd": False,
        "bitrate_switch": False,
        "error_state_indicator": False,
    }
    datagram = msgpack.packb(fields, use_bin_type=True)
    assert datagram is not None  # only a stream of its own has it elsewhere
    return datagram


def unpacked(datagram: bytes) -> Frame | can.Message:
    """What a datagram carries. Raises ValueError for one that carries no frame."""
    try:
        fields = msgpack.unpackb(datagram, raw=False)
        if _is_plain(fields):
            return fields["arbitration_id"], fields["data"]
        if _may_be_message(fields):
            return unpack_message(datagram, replace={"timestamp": 0.0}, check=True)
    except Exception as error:  # msgpack and Message raise whatever comes of what is in it, in the peer's words
        raise ValueError(_NO_FRAME) from error
    raise ValueError(_NO_FRAME)


def _is_plain(fields: Any) -> bool:
    """Whether python-can would take it for a data frame with an identifier of 11 bits."""
    if type(fields) is not dict or fields.keys() != _KEYS or _flags(fields) != _PLAIN:
        return False
    cob_id, data = fields["arbitration_id"], fields["data"]
    return type(cob_id) is int and 0 <= cob_id <= LARGEST_ID and type(data) is bytes and fields["dlc"] == len(data) <= 8


def _may_be_message(fields: Any) -> bool:
    """Whether python-can may look at it: a Message takes a number for data as that many bytes, and makes them."""
    return type(fields) is dict and type(fields.get("data")) in (bytes, type(None))


class FetchedWire:
    """An interface that has no socket."""

    def __init__(self, bus: can.BusABC, name: str) -> None:
        self._bus = bus
        self._name = name
        self._thread: threading.Thread | None = None
        self._fetched: deque[can.Message | Exception] = deque()
        self._closing = threading.Event()

    def read_with(self, on_arrival: Callable[[], None]) -> None:
        loop = asyncio.get_running_loop()
        self._thread = threading.Thread(
            target=self._fetch, args=(loop, on_arrival), name=f"can-{self._name}", daemon=True
        )
        self._thread.start()

    def _fetch(self, loop: asyncio.AbstractEventLoop, on_arrival: Callable[[], None]) -> None:
        while not self._closing.is_set():
            try:
                fetched: can.Message | Exception | None = self._bus.recv(timeout=THREAD_POLL_S)
            except FAILURES as error:
                fetched = error
                self._closing.wait(THREAD_POLL_S)
            except Exception as error:  # a thread that ended would look like a bus on which nobody speaks
                fetched = can.CanError(f"{type(error).__name__}: {error}")
                self._closing.wait(THREAD_POLL_S)
            if fetched is not None and not self._closing.is_set():
                self._fetched.append(fetched)
                loop.call_soon_threadsafe(on_arrival)

    def stop_reading(self) -> None:
        """The thread goes on until `close`: it harms nobody."""

    def receive(self) -> Frame | can.Message | None:
        if not self._fetched:
            return None
        fetched = self._fetched.popleft()
        if isinstance(fetched, Exception):
            raise fetched
        if fetched.is_error_frame or fetched.is_extended_id or fetched.is_remote_frame or fetched.is_fd:
            return fetched
        return fetched.arbitration_id, fetched.data

    def send(self, cob_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False), timeout=0)

    async def close(self) -> None:
        thread, self._thread = self._thread, None
        if thread is not None:
            self._closing.set()
            await asyncio.to_thread(thread.join)
        self._fetched.clear()

"""One CAN bus: a python-can interface whose frames the running event loop reads. The clock of arrivals is here.

python-can's own notifier is not used: it loses errors and can leave readers behind. Interfaces with a file
descriptor (socketcan, udp_multicast) are read by the loop itself; those without (virtual) by one thread that
only fetches.
"""

import asyncio
import errno
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import can

from gateway.core.line import CanopenBus

FRAMES_PER_WAKEUP = 256  #: a flooded bus does not hold the loop
MOST_FRAMES_WAITING = 4096  #: several times what a socket's buffer holds
THREAD_POLL_S = 0.02  #: how soon the fetching thread notices that the bus is closed

FrameHandler = Callable[[int, bytes | bytearray, float], None]


class CanBus:
    """`on_frame(cob_id, data, now_s)` is called in the loop for every data frame with an 11-bit identifier."""

    def __init__(self, config: CanopenBus, on_frame: FrameHandler, on_error: Callable[[str], None]) -> None:
        self._config = config
        self._on_frame = on_frame
        self._on_error = on_error
        self._bus: can.BusABC | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._fileno = -1
        self._thread: threading.Thread | None = None
        self._fetched: deque[can.Message | can.CanError] = deque()
        self._closing = threading.Event()

    def open(self) -> None:
        """Open the interface and read it; sends nothing. Idempotent. Raises OSError with what to do about it."""
        if self._bus is not None:
            return
        config = self._config
        options: dict[str, Any] = {"interface": config.interface, "channel": config.channel}
        if config.interface == "udp_multicast":
            # Zero hops: frames stay on this machine.
            options |= {"hop_limit": 0, "fd": False}
            if config.port is not None:
                options["port"] = config.port
        try:
            self._bus = can.Bus(ignore_config=True, **options)
        except (can.CanError, OSError, ValueError, ImportError) as error:
            where = f"{config.interface} {config.channel}"
            raise OSError(f"bus {config.name}: cannot open {where}: {error}; {_advice(config, error)}") from error
        self._loop = asyncio.get_running_loop()
        try:
            self._fileno = self._bus.fileno()
        except NotImplementedError:
            self._fileno = -1
        if self._fileno >= 0:
            self._loop.add_reader(self._fileno, self.drain)
        else:
            self._closing.clear()
            self._thread = threading.Thread(target=self._fetch, name=f"can-{config.name}", daemon=True)
            self._thread.start()

    def send(self, cob_id: int, data: bytes) -> bool:
        """Hand a frame to the interface without waiting. False, and `on_error`, when it did not take it."""
        if self._bus is None:
            return False
        message = can.Message(arbitration_id=cob_id, data=data, is_extended_id=False)
        try:
            self._bus.send(message, timeout=0)
        except (can.CanError, OSError) as error:
            self._on_error(f"COB-ID {cob_id:03X}h not sent: {error}")
            return False
        return True

    def drain(self) -> None:
        """Hand over frames that have arrived, as many as the loop can wait for."""
        self._drain(FRAMES_PER_WAKEUP)

    def drain_all(self) -> None:
        """Hand over all frames that have arrived."""
        self._drain(MOST_FRAMES_WAITING)

    def _drain(self, most: int) -> None:
        if self._loop is None:
            return
        now_s = self._loop.time()
        for _ in range(most):
            try:
                message = self._receive()
            except (can.CanError, OSError, ValueError) as error:
                self._on_error(f"frame discarded: {error}")
                continue
            if message is None:
                return
            if message.is_error_frame:
                self._on_error(f"error frame: {bytes(message.data).hex()}")
            elif not (message.is_extended_id or message.is_remote_frame or message.is_fd):
                self._on_frame(message.arbitration_id, message.data, now_s)

    def _receive(self) -> can.Message | None:
        if self._thread is None:
            return self._bus.recv(timeout=0) if self._bus is not None else None
        if not self._fetched:
            return None
        fetched = self._fetched.popleft()
        if isinstance(fetched, can.CanError):
            raise fetched
        return fetched

    def _fetch(self) -> None:
        """The thread of an interface without a file descriptor."""
        assert self._bus is not None and self._loop is not None
        while not self._closing.is_set():
            try:
                fetched: can.Message | can.CanError | None = self._bus.recv(timeout=THREAD_POLL_S)
            except can.CanError as error:
                fetched = error
                self._closing.wait(THREAD_POLL_S)
            if fetched is not None and not self._closing.is_set():
                self._fetched.append(fetched)
                self._loop.call_soon_threadsafe(self.drain)

    async def close(self) -> None:
        """Stop reading and release the interface. Idempotent."""
        bus, self._bus = self._bus, None
        if bus is None:
            return
        if self._loop is not None and self._fileno >= 0:
            self._loop.remove_reader(self._fileno)
        if self._thread is not None:
            self._closing.set()
            await asyncio.to_thread(self._thread.join)
            self._thread = None
        self._fetched.clear()
        bus.shutdown()


def _advice(config: CanopenBus, error: BaseException) -> str:
    if config.interface == "udp_multicast":
        return "channel must be a multicast group, and a route to it must exist"
    if config.interface != "socketcan":
        return "check interface and channel"
    if isinstance(error, OSError) and error.errno == errno.EAFNOSUPPORT:
        return "this kernel has no CAN: load its modules can and can_raw, or use another machine"
    return f"is it up? `ip link set {config.channel} up type can bitrate {config.bitrate_bit_per_s}`"

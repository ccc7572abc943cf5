"""One CAN bus: a python-can interface whose frames the running event loop reads. The clock of arrivals is here.

python-can's own notifier is not used: it loses errors and can leave readers behind. Interfaces with a file
descriptor (socketcan, udp_multicast) are read by the loop itself; those without (virtual) by one thread that
only fetches.

An interface that is gone is not read any more, and is opened again beside the cycle, with growing pauses. Frames are
lost meanwhile, and nothing else is done about them: whoever waits for them sees that they do not come.
"""

import asyncio
import errno
import threading
from collections import deque
from collections.abc import Callable, Collection
from typing import Any

import can

from drivers.canopen.can_errors import error_text, is_bus_off
from gateway.core.line import CanopenBus

FRAMES_PER_WAKEUP = 256  #: a flooded bus does not hold the loop
MOST_FRAMES_WAITING = 4096  #: several times what a socket's buffer holds
THREAD_POLL_S = 0.02  #: how soon the fetching thread notices that the bus is closed
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0  #: between attempts to open it again
FAILURES_ALLOWED = 64  #: in a row, of one direction, without a cause that the system names, until it counts as gone
FILTERS_ALLOWED = 512  #: CAN_RAW_FILTER_MAX of Linux

FrameHandler = Callable[[int, bytes | bytearray, float], None]
_FAILURES = (can.CanError, OSError, ValueError)


class CanBus:
    """`on_frame(cob_id, data, now_s)` is called in the loop for every data frame with an 11-bit identifier.

    `cob_ids` are the identifiers that are of interest: an interface that can leaves the others to the kernel.
    """

    def __init__(
        self,
        config: CanopenBus,
        cob_ids: Collection[int],
        on_frame: FrameHandler,
        on_error: Callable[[str], None],
    ) -> None:
        self.gone = ""  #: why the interface is not used any more, until it is open again
        self.reopened = 0  #: times
        self._config = config
        self._cob_ids = sorted(cob_ids)
        self._on_frame = on_frame
        self._on_error = on_error
        self._bus: can.BusABC | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._fileno = -1
        self._thread: threading.Thread | None = None
        self._fetched: deque[can.Message | Exception] = deque()
        self._closing = threading.Event()
        self._failures = {"receive": 0, "send": 0}  #: in a row
        self._reopening: asyncio.Task[None] | None = None
        self._retry_s = float("-inf")
        self._pause_s = FIRST_PAUSE_S

    def open(self) -> None:
        """Open the interface and read it; sends nothing. Idempotent. Raises OSError with what to do about it."""
        if self._bus is not None:
            return
        config = self._config
        try:
            self._bus = can.Bus(ignore_config=True, **self._options())
        except (can.CanError, OSError, ValueError, ImportError) as error:
            where = f"{config.interface} {config.channel}"
            raise OSError(f"bus {config.name}: cannot open {where}: {error}; {_advice(config, error)}") from error
        self.gone = ""
        self._failures = {"receive": 0, "send": 0}
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

    def _options(self) -> dict[str, Any]:
        config = self._config
        options: dict[str, Any] = {"interface": config.interface, "channel": config.channel}
        if config.interface == "udp_multicast":
            # Zero hops: frames stay on this machine.
            options |= {"hop_limit": 0, "fd": False}
            if config.port is not None:
                options["port"] = config.port
        elif config.interface == "socketcan":
            options["ignore_rx_error_frames"] = False
            if len(self._cob_ids) <= FILTERS_ALLOWED:
                options["can_filters"] = [{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in self._cob_ids]
        return options

    def send(self, cob_id: int, data: bytes) -> bool:
        """Hand a frame to the interface without waiting. False, and `on_error`, when it did not take it."""
        if self._bus is None or self.gone:
            return False
        message = can.Message(arbitration_id=cob_id, data=data, is_extended_id=False)
        try:
            self._bus.send(message, timeout=0)
        except _FAILURES as error:
            self._on_error(f"COB-ID {cob_id:03X}h not sent: {error}")
            # A full buffer is no end: a bus without a device on it fills it, too.
            self._failed("send", error, final=_cause(error) not in (None, errno.ENOBUFS, errno.EAGAIN))
            return False
        self._failures["send"] = 0
        return True

    def drain(self) -> None:
        """Hand over frames that have arrived, as many as the loop can wait for."""
        self._drain(FRAMES_PER_WAKEUP)

    def drain_all(self) -> None:
        """Hand over all frames that have arrived."""
        self._drain(MOST_FRAMES_WAITING)

    def _drain(self, most: int) -> None:
        if self._loop is None or self.gone:
            return
        now_s = self._loop.time()
        for _ in range(most):
            try:
                message = self._receive()
            except _FAILURES as error:
                self._on_error(f"frame discarded: {error}")
                self._failed("receive", error, final=_cause(error) is not None)
                if self.gone:
                    return
                continue
            if message is None:
                return
            self._failures["receive"] = 0
            self._take(message, now_s)
            if self.gone:
                return

    def _take(self, message: can.Message, now_s: float) -> None:
        if message.is_error_frame:
            text = error_text(message.arbitration_id, message.data)
            self._on_error(text)
            if is_bus_off(message.arbitration_id):
                self._give_up(text)
        elif not (message.is_extended_id or message.is_remote_frame or message.is_fd):
            self._pause_s = FIRST_PAUSE_S  # it is heard: not the open interface, but a frame says so
            self._on_frame(message.arbitration_id, message.data, now_s)

    def _failed(self, direction: str, error: Exception, final: bool) -> None:
        self._failures[direction] += 1
        if final or self._failures[direction] >= FAILURES_ALLOWED:
            self._give_up(f"cannot {direction}: {error}")

    def _give_up(self, reason: str) -> None:
        """Leave the interface alone until it is opened again. Called in the loop, or by a transfer in its thread."""
        self.gone = self.gone or f"bus {self._config.name}: {reason}"
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._stop_reading, self._bus)

    def _stop_reading(self, bus: can.BusABC | None) -> None:
        """Of `bus`, unless another has taken its place."""
        if bus is self._bus and self._loop is not None and self._fileno >= 0:
            self._loop.remove_reader(self._fileno)
            self._fileno = -1

    def tend(self, now_s: float) -> None:
        """Called in every cycle: an interface that is gone is opened again when it is time, beside the cycle."""
        under_way = self._reopening is not None and not self._reopening.done()
        if self.gone and not under_way and now_s >= self._retry_s:
            self._retry_s = now_s + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
            self._reopening = asyncio.create_task(self._try_again())

    async def restore(self) -> None:
        """Open an interface that is gone now. Raises OSError with what to do about it."""
        if self._reopening is not None:
            await asyncio.wait([self._reopening])
        if self.gone:
            await self._reopen()

    async def _try_again(self) -> None:
        try:
            await self._reopen()
        except OSError as error:
            self.gone = str(error)

    async def _reopen(self) -> None:
        gone = self.gone
        await self._release()
        self.gone = gone
        self.open()
        self.reopened += 1

    def _receive(self) -> can.Message | None:
        if self._fileno >= 0:
            return self._bus.recv(timeout=0) if self._bus is not None else None
        if not self._fetched:
            return None
        fetched = self._fetched.popleft()
        if isinstance(fetched, Exception):
            raise fetched
        return fetched

    def _fetch(self) -> None:
        """The thread of an interface without a file descriptor."""
        bus, loop = self._bus, self._loop
        assert bus is not None and loop is not None
        while not self._closing.is_set():
            try:
                fetched: can.Message | Exception | None = bus.recv(timeout=THREAD_POLL_S)
            except _FAILURES as error:
                fetched = error
                self._closing.wait(THREAD_POLL_S)
            if fetched is not None and not self._closing.is_set():
                self._fetched.append(fetched)
                loop.call_soon_threadsafe(self.drain)

    async def close(self) -> None:
        """Stop reading and release the interface. Idempotent."""
        reopening, self._reopening = self._reopening, None
        if reopening is not None:
            reopening.cancel()
            await asyncio.gather(reopening, return_exceptions=True)
        await self._release()
        self.gone = ""

    async def _release(self) -> None:
        self._stop_reading(self._bus)
        bus, self._bus = self._bus, None
        if bus is None:
            return
        thread, self._thread = self._thread, None
        try:
            if thread is not None:
                self._closing.set()
                await asyncio.to_thread(thread.join)
        finally:
            self._fetched.clear()
            bus.shutdown()


def _cause(error: BaseException) -> int | None:
    """The system's error number behind a failure; None when there is none, as of a frame that is malformed."""
    seen: BaseException | None = error
    while seen is not None:
        number = seen.errno if isinstance(seen, OSError) else getattr(seen, "error_code", None)
        if isinstance(number, int):
            return number
        seen = seen.__cause__
    return None


def _advice(config: CanopenBus, error: BaseException) -> str:
    if config.interface == "udp_multicast":
        return "channel must be a multicast group, and a route to it must exist"
    if config.interface != "socketcan":
        return "check interface and channel"
    if isinstance(error, OSError) and error.errno == errno.EAFNOSUPPORT:
        return "this kernel has no CAN: load its modules can and can_raw, or use another machine"
    return f"is it up? `ip link set {config.channel} up type can bitrate {config.bitrate_bit_per_s}`"

"""One CAN bus: a python-can interface whose frames the running event loop reads. The clock of arrivals is here.

python-can's own notifier is not used: it loses errors and can leave readers behind. How frames go through the
interface is said in `wire`.

An interface that is gone is not read any more, and is opened again beside the cycle, with growing pauses. Frames are
lost meanwhile, and nothing else is done about them: whoever waits for them sees that they do not come.
"""

import asyncio
import errno
from collections.abc import Callable, Collection
from typing import Any

import can

from drivers.canopen.can_errors import error_text, is_bus_off
from drivers.canopen.wire import FAILURES, Wire, wire_of
from gateway.core.line import CanopenBus
from gateway.tasks.cleanup import end, finish

FRAMES_PER_WAKEUP = 256  #: a flooded bus does not hold the loop
MOST_FRAMES_WAITING = 4096  #: several times what a socket's buffer holds
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0  #: between attempts to open it again
FAILURES_ALLOWED = 64  #: in a row, of one direction, without a cause that the system names, until it counts as gone
FILTERS_ALLOWED = 512  #: CAN_RAW_FILTER_MAX of Linux

FrameHandler = Callable[[int, bytes | bytearray, float], None]


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
        self._wire: Wire | None = None  #: as long as the bus is open
        self._loop: asyncio.AbstractEventLoop | None = None
        self._failures = {"receive": 0, "send": 0}  #: in a row
        self._reopening: asyncio.Task[None] | None = None
        self._retry_s = float("-inf")
        self._pause_s = FIRST_PAUSE_S

    def open(self) -> None:
        """Open the interface and read it; sends nothing. Idempotent. Raises OSError with what to do about it."""
        if self._bus is not None:
            return
        config = self._config
        bus: can.BusABC | None = None
        try:
            bus = can.Bus(ignore_config=True, **self._options())
            wire = wire_of(config, bus)
        except (can.CanError, OSError, ValueError, ImportError) as error:
            if bus is not None:
                bus.shutdown()
            where = f"{config.interface} {config.channel}"
            raise OSError(f"bus {config.name}: cannot open {where}: {error}; {_advice(config, error)}") from error
        self.gone = ""
        self._failures = {"receive": 0, "send": 0}
        self._loop = asyncio.get_running_loop()
        self._bus, self._wire = bus, wire
        wire.read_with(self.drain)

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
        wire = self._wire
        if wire is None or self.gone:
            return False
        try:
            wire.send(cob_id, data)
        except FAILURES as error:
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
        wire = self._wire
        if self._loop is None or wire is None or self.gone:
            return
        now_s = self._loop.time()
        for _ in range(most):
            try:
                received = wire.receive()
            except FAILURES as error:
                self._on_error(f"frame discarded: {error}")
                self._failed("receive", error, final=_cause(error) is not None)
                if self.gone:
                    return
                continue
            if received is None:
                return
            self._failures["receive"] = 0
            if isinstance(received, tuple):
                self._pause_s = FIRST_PAUSE_S  # it is heard: not the open interface, but a frame says so
                self._on_frame(received[0], received[1], now_s)
            elif received.is_error_frame:
                self._on_error_frame(received)
            if self.gone:
                return

    def _on_error_frame(self, frame: can.Message) -> None:
        text = error_text(frame.arbitration_id, frame.data)
        self._on_error(text)
        if is_bus_off(frame.arbitration_id):
            self._give_up(text)

    def _failed(self, direction: str, error: Exception, final: bool) -> None:
        self._failures[direction] += 1
        if final or self._failures[direction] >= FAILURES_ALLOWED:
            self._give_up(f"cannot {direction}: {error}")

    def _give_up(self, reason: str) -> None:
        """Leave the interface alone until it is opened again. Called in the loop, or by a transfer in its thread."""
        self.gone = self.gone or f"bus {self._config.name}: {reason}"
        wire = self._wire
        if self._loop is not None and wire is not None:
            self._loop.call_soon_threadsafe(wire.stop_reading)

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
        except Exception as error:  # of a CAN interface's own library: told, and tried again like any other
            self.gone = f"bus {self._config.name}: {type(error).__name__}: {error}"

    async def _reopen(self) -> None:
        gone = self.gone
        await self._release()
        self.gone = gone
        self.open()
        self.reopened += 1

    async def close(self) -> None:
        """Stop reading and release the interface. Idempotent; no cancellation cuts it."""
        await finish(self._close())

    async def _close(self) -> None:
        reopening, self._reopening = self._reopening, None
        if reopening is not None:
            await end(reopening)
        await self._release()
        self.gone = ""

    async def _release(self) -> None:
        wire, self._wire = self._wire, None
        bus, self._bus = self._bus, None
        try:
            if wire is not None:
                await finish(wire.close())  # or a thread would go on receiving from what is shut down
        finally:
            if bus is not None:
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

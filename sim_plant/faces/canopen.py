"""The CANopen face: all simulated drives of a bus, over any python-can bus.

Frames come in through `pump`, called by the event loop when the bus has a file descriptor or by a test that steps
time, and from a reader thread by way of the loop when it has none (`virtual`). Nothing that comes in raises:
what cannot be used is counted.
"""

import asyncio
import logging
import threading
from collections.abc import Callable, Sequence
from functools import partial

import can
from canopen import Network

from sim_plant.devices.drive import Drive
from sim_plant.faces.canopen_node import DriveNode

NMT_ID = 0x000
SYNC_ID = 0x080
#: Frames taken in one call of `pump`, so that a flood cannot keep the event loop from everything else.
_BURST = 256
_READER_WAKES_S = 0.1

log = logging.getLogger(__name__)


class CanopenFace:
    """Drive k of `drives` is node `first_node` + k.

    `clock` gives the time that the drives live in, in s. `arrival` gives the time, on the same clock, at which a
    frame came in; without it that is when the frame is taken off the bus.
    """

    def __init__(
        self,
        bus: can.BusABC,
        drives: Sequence[Drive],
        first_node: int,
        clock: Callable[[], float],
        arrival: Callable[[can.Message], float] | None = None,
    ) -> None:
        self.bus = bus
        self.clock = clock
        self.arrival = arrival or (lambda _: clock())
        self.malformed = 0  #: frames of a wrong length or kind, unknown NMT commands
        self.foreign = 0  #: frames that are for no node of this face
        self.send_errors = 0
        self.send_error: can.CanError | None = None  #: the last one
        wire = _Wire(self)
        self.nodes = [DriveNode(first_node + k, drive, wire) for k, drive in enumerate(drives)]
        self._by_node = {node.node_id: node for node in self.nodes}
        self._by_rpdo: dict[int, DriveNode] = {}
        # Some buses hand every sender its own frames again.
        self._own = {base + node for node in self._by_node for base in (0x80, 0x180, 0x580, 0x700)}
        self._detach: Callable[[], object] = _nothing

    def boot(self) -> None:
        """Power on: every drive sends its boot-up message. Raises CanError when the bus takes nothing."""
        for node in self.nodes:
            node.boot(self.clock())
        self._route()
        if self.send_error is not None:
            raise self.send_error

    def attach(self, loop: asyncio.AbstractEventLoop) -> None:
        """Have `loop` take frames as they come, until `detach`."""
        try:
            descriptor = self.bus.fileno()
        except NotImplementedError:
            self._attach_thread(loop)
        else:
            loop.add_reader(descriptor, self.pump)
            self._detach = partial(loop.remove_reader, descriptor)

    def detach(self) -> None:
        """Take no more frames. Idempotent; the bus stays open."""
        detach, self._detach = self._detach, _nothing
        detach()

    def poll(self) -> None:
        """Send the heartbeats that are due. The drives' own timers run with the world."""
        now_s = self.clock()
        for node in self.nodes:
            node.poll(now_s)

    def pump(self) -> None:
        """Take the frames that wait on the bus."""
        for _ in range(_BURST):
            try:
                message = self.bus.recv(timeout=0)
            except can.CanOperationError:  # a datagram that is no frame
                self.malformed += 1
                continue
            if message is None:
                return
            self.take(message)

    def take(self, message: can.Message) -> None:
        """One frame from the bus."""
        data = message.data
        if (
            message.is_error_frame
            or message.is_remote_frame
            or message.is_extended_id
            or message.is_fd
            or message.dlc != len(data)
        ):
            self.malformed += 1
        elif not self._dispatch(message.arbitration_id, data, self.arrival(message)):
            self.malformed += 1

    def send(self, can_id: int, data: bytes) -> None:
        """One frame to the bus. An error is kept and counted: a drive cannot do more about its bus either."""
        try:
            self.bus.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=data))
        except can.CanError as error:
            if self.send_error is None:
                log.warning("CAN: cannot send: %s", error)
            self.send_errors += 1
            self.send_error = error

    def _dispatch(self, can_id: int, data: bytearray, now_s: float) -> bool:
        """False when the frame is for a node but cannot be used."""
        if node := self._by_rpdo.get(can_id):
            return node.on_rpdo(data, now_s)
        if can_id == SYNC_ID:
            return self._on_sync(data, now_s)
        if node := self._by_node.get(can_id - 0x600):
            usable = node.on_sdo(data, now_s)
            self._route()
            return usable
        if can_id == NMT_ID:
            return self._on_nmt(data, now_s)
        if can_id not in self._own:
            self.foreign += 1
        return True

    def _on_sync(self, data: bytearray, now_s: float) -> bool:
        if data:  # a SYNC with a counter is of another kind than the one configured
            return False
        for node in self.nodes:
            node.on_sync(now_s)
        return True

    def _on_nmt(self, data: bytearray, now_s: float) -> bool:
        if len(data) != 2:
            return False
        command, address = data
        addressed = self.nodes if address == 0 else [n for n in self.nodes if n.node_id == address]
        known = [node.on_nmt(command, now_s) for node in addressed]
        self._route()
        if not known:
            self.foreign += 1
        return all(known)

    def _route(self) -> None:
        self._by_rpdo = {node.rpdo.can_id: node for node in self.nodes if node.rpdo.valid}

    def _attach_thread(self, loop: asyncio.AbstractEventLoop) -> None:
        stop = threading.Event()

        def read() -> None:
            while not stop.is_set():
                message = self.bus.recv(timeout=_READER_WAKES_S)
                if message is not None and not stop.is_set():
                    loop.call_soon_threadsafe(self.take, message)

        thread = threading.Thread(target=read, name="simulated CAN bus")
        thread.start()

        def detach() -> None:
            stop.set()
            thread.join()

        self._detach = detach


def _nothing() -> None: ...


class _Wire(Network):
    """What canopen's SDO server sends through. It never connects, so no thread of it is started."""

    def __init__(self, face: CanopenFace) -> None:
        super().__init__()
        self._face = face

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._face.send(can_id, data)

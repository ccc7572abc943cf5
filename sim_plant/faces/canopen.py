"""The CANopen face: all simulated nodes of a bus, over any python-can bus.

Frames come in through `pump`, called by the event loop when the bus has a file descriptor or by a test that steps
time, and from a reader thread by way of the loop when it has none (`virtual`). Nothing that comes in raises:
what cannot be used is counted.
"""

import asyncio
import logging
import threading
from collections.abc import Callable, Sequence
from functools import partial
from math import inf

import can
from canopen import Network

from sim_plant.devices.drive import Drive
from sim_plant.faces.can_wire import CanWire
from sim_plant.faces.canopen_drive import DriveDevice
from sim_plant.faces.canopen_node import Device, Node
from sim_plant.faults.can_frames import CanFrame, node_of
from sim_plant.faults.frames import Direction
from sim_plant.faults.wire_faults import WireFaults

NMT_ID = 0x000
SYNC_ID = 0x080
#: Frames taken in one call of `pump`, so that a flood cannot keep the event loop from everything else.
_BURST = 256
_READER_WAKES_S = 0.1

log = logging.getLogger(__name__)


class CanopenFace:
    """Drive k of `drives` is node `first_node` + k; `add` brings further nodes.

    `clock` gives the time that the devices live in, in s. `arrival` gives the time, on the same clock, at which a
    frame came in; without it that is when the frame is taken off the bus. With `wire` every frame of either side
    takes its time on it: what comes in acts, and what goes out is sent, once the wire has carried it. How punctual
    that is depends on who calls `pump`: the timers of the event loop, by `attach`, are late by a fraction of a
    millisecond as a rule, and never early; among themselves frames keep the wire's order.
    """

    def __init__(
        self,
        bus: can.BusABC,
        drives: Sequence[Drive],
        first_node: int,
        clock: Callable[[], float],
        arrival: Callable[[can.Message], float] | None = None,
        wire: CanWire | None = None,
        faults: WireFaults[CanFrame] | None = None,
    ) -> None:
        self.bus = bus
        self.clock = clock
        self.arrival = arrival or (lambda _: clock())
        self.wire = wire
        self.faults = faults
        self._later: Callable[[float, Callable[[], object]], object] = _at_once
        self.malformed = 0  #: frames of a wrong length or kind, unknown NMT commands, commands that mean nothing
        self.foreign = 0  #: frames that are for no node of this face
        self.send_errors = 0
        self.send_error: can.CanError | None = None  #: the last one
        self.nodes: list[Node] = []
        self._network = _Network(self)
        self._by_node: dict[int, Node] = {}
        self._by_rpdo: dict[int, Node] = {}
        self._own: set[int] = set()  #: some buses hand every sender its own frames again
        self._detach: Callable[[], object] = _nothing
        self._wake_in: Callable[[float], asyncio.TimerHandle] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._has_reader = False  #: a thread takes the frames
        self._carried_s: float | None = None  #: time of the frame that the wire has brought, while it is dealt with
        for k, drive in enumerate(drives):
            self.add(first_node + k, DriveDevice(drive))

    def add(self, node_id: int, device: Device) -> None:
        """A further node, before `boot`."""
        node = self._by_node[node_id] = Node(node_id, device, self._network)
        self.nodes.append(node)

    def boot(self) -> None:
        """Power on: every node sends its boot-up message. Raises CanError when the bus takes nothing.

        That has to be known now, so that these frames do not wait for the wire.
        """
        wire, self.wire = self.wire, None
        for node in self.nodes:
            node.boot(self.clock())
        self.wire = wire
        self._route()
        if self.send_error is not None:
            raise self.send_error

    def restart(self, node_id: int, now_s: float) -> None:
        """One node loses its power for an instant, and boots. Raises KeyError when there is none."""
        self._by_node[node_id].restart(now_s)
        self._route()

    def attach(self, loop: asyncio.AbstractEventLoop, time_scale: float = 1.0) -> None:
        """Have `loop` take frames as they come, until `detach`.

        `clock` runs `time_scale` times as fast as the loop's.
        """
        self._later = lambda delay_s, call: loop.call_later(delay_s / time_scale, call)
        self._wake_in = lambda delay_s: loop.call_later(delay_s / time_scale, self.pump)
        try:
            descriptor = self.bus.fileno()
        except NotImplementedError:
            self._attach_thread(loop)
        else:
            loop.add_reader(descriptor, self.pump)
            self._detach = partial(loop.remove_reader, descriptor)
        self._settle()

    def detach(self) -> None:
        """Take no more frames. Idempotent; the bus stays open."""
        detach, self._detach = self._detach, _nothing
        self._wake_in = None
        if self._timer is not None:
            self._timer.cancel()
        detach()

    def poll(self) -> None:
        """Send the heartbeats that are due. The devices' own timers run with the world."""
        now_s = self.clock()
        for node in self.nodes:
            node.poll(now_s)
        self._settle()

    def pump(self) -> None:
        """Take the frames that wait on the bus, and let the wire carry what it can by now."""
        if not self._has_reader:
            self._receive()
        self._settle()

    def take(self, message: can.Message) -> None:
        """One frame from the bus. It acts at once, or when the wire has carried it."""
        if message.is_error_frame or message.is_fd:
            self.malformed += 1
        elif self.wire is None:
            self._act(message, self.arrival(message))
        elif message.arbitration_id not in self._own:  # not our own again, which it has carried already
            self.wire.request(message, self.arrival(message))

    def send(self, can_id: int, data: bytes) -> None:
        """One frame to the bus, at once or over the wire."""
        if self.wire is None:
            self._put((can_id, bytes(data)))
            return
        message = can.Message(arbitration_id=can_id, is_extended_id=False, data=data, is_rx=False)
        if self._carried_s is not None:
            self.wire.request(message, self._carried_s)
        else:
            self.wire.request(message, self.clock())
            self._arm()

    def _receive(self) -> None:
        for _ in range(_BURST):
            try:
                message = self.bus.recv(timeout=0)
            except can.CanOperationError:  # a datagram that is no frame
                self.malformed += 1
                continue
            if message is None:
                return
            self.take(message)

    def _settle(self) -> None:
        """Deal with every frame that the wire has carried by now."""
        if self.wire is None:
            return
        for message, carried_s in self.wire.through(self.clock()):
            if not message.is_rx:
                self._put((message.arbitration_id, bytes(message.data)))
                continue
            self._carried_s = carried_s
            self._act(message, carried_s)
            self._carried_s = None
        self._arm()

    def _arm(self) -> None:
        """Be woken when the wire has carried its next frame."""
        if self._timer is not None:
            self._timer.cancel()
        assert self.wire is not None
        next_s = self.wire.next_s()
        if self._wake_in is not None and next_s < inf:
            self._timer = self._wake_in(max(0.0, next_s - self.clock()))

    def _put(self, frame: CanFrame) -> None:
        if self.faults is None:
            self._send(frame, 0.0)
        else:
            self.faults.carry(Direction.FROM_DEVICE, node_of(*frame), frame, self._send, self._later)

    def _send(self, frame: CanFrame, delay_s: float) -> None:
        """An error is kept and counted: a node cannot do more about its bus either."""
        try:
            self.bus.send(can.Message(arbitration_id=frame[0], is_extended_id=False, data=frame[1]))
        except can.CanError as error:
            if self.send_error is None:
                log.warning("CAN: cannot send: %s", error)
            self.send_errors += 1
            self.send_error = error

    def _act(self, message: can.Message, now_s: float) -> None:
        data = message.data
        if message.is_remote_frame or message.is_extended_id or message.dlc != len(data):
            self.malformed += 1
            return

        def act(frame: CanFrame, delay_s: float) -> None:
            if not self._dispatch(frame[0], bytearray(frame[1]), now_s + delay_s):
                self.malformed += 1

        frame = message.arbitration_id, bytes(data)
        if self.faults is None or message.arbitration_id in self._own:
            act(frame, 0.0)
        else:
            self.faults.carry(Direction.TO_DEVICE, node_of(*frame), frame, act, self._later, now_s)

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
        self._by_rpdo = {node.rpdo.can_id: node for node in self.nodes if node.rpdo and node.rpdo.valid}
        self._own = {can_id for node in self.nodes for can_id in node.sends}

    def _take_alone(self, message: can.Message) -> None:
        self.take(message)
        self._settle()

    def _attach_thread(self, loop: asyncio.AbstractEventLoop) -> None:
        stop = threading.Event()

        def read() -> None:
            while not stop.is_set():
                message = self.bus.recv(timeout=_READER_WAKES_S)
                if message is not None and not stop.is_set():
                    loop.call_soon_threadsafe(self._take_alone, message)

        thread = threading.Thread(target=read, name="simulated CAN bus")
        self._has_reader = True
        thread.start()

        def detach() -> None:
            stop.set()
            thread.join()
            self._has_reader = False

        self._detach = detach


def _nothing() -> None: ...


def _at_once(delay_s: float, call: Callable[[], object]) -> None:
    """There is no time before the face is attached."""
    call()


class _Network(Network):
    """What canopen's SDO server sends through. It never connects, so no thread of it is started."""

    def __init__(self, face: CanopenFace) -> None:
        super().__init__()
        self._face = face

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._face.send(can_id, data)

"""The nodes of one CANopen bus, behind the driver port: drives, load-cell amplifiers, a line PLC.

A cycle: SYNC (the nodes latch their RPDOs and sample), the TPDOs of this SYNC, one RPDO a node that takes commands. An
answer counts for the SYNC after which it arrives, once: what comes twice, or after `collect` has closed the cycle, is
discarded and counted. What is in the socket before the next SYNC is read before it, so that an answer that is
late within its period cannot pass for a fresh one. One that comes a whole period late can: SYNC has no counter.

A silent link sends no SYNC and writes nothing. What no node says by itself (tensions, the PLC's status) it asks for by
SDO then, one transfer at a time per node: a dead one costs the others nothing.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import AsyncExitStack

from drivers.canopen.bus import CanBus
from drivers.canopen.feed import Feed
from drivers.canopen.heartbeat import HEARTBEAT, HeartbeatProducer
from drivers.canopen.node import Node
from drivers.canopen.prepare import check_nodes, configure_nodes, undo_all
from drivers.canopen.questions import Questions
from drivers.canopen.sdo import SdoBus, SdoFailed
from drivers.canopen.station import ENTER_PRE_OPERATIONAL, OPERATIONAL, START, nmt_frame
from drivers.canopen.transaction import Transaction
from drivers.port import PrepareRefused
from gateway.core.finding import Finding, finding
from gateway.core.line import CanopenBus
from gateway.core.signals import Inputs, LinkHealth, Outputs
from gateway.tasks.cleanup import finish, finish_all
from gateway.wording.catalogue import sentence

SYNC, EMERGENCY = 0x080, 0x080  #: COB-IDs, the last of node 0
START_HEARTBEATS = 3  #: producer times within which a started node must say that it is operational

Handler = Callable[[Node, int, bytes | bytearray, float], None]


class CanopenLink:
    """A `drivers.port.Link` for `nodes`, all on the bus `config`.

    `heartbeat` is needed when the watchdog of a node listens to one.
    """

    def __init__(self, config: CanopenBus, nodes: Sequence[Node], heartbeat: HeartbeatProducer | None = None) -> None:
        self.name = config.name
        self.health = LinkHealth()
        self._nodes = nodes
        self._handlers: dict[int, tuple[Handler, Node]] = {}
        for node in nodes:
            for cob_id in node.answers:
                self._handlers[cob_id] = (self._on_answer, node)
            self._handlers[HEARTBEAT + node.station.node] = (self._on_heartbeat, node)
            self._handlers[EMERGENCY + node.station.node] = (self._on_emergency, node)
        self._sdo = SdoBus(self._send, [node.station.node for node in nodes])
        self._questions = Questions(self._sdo, nodes, self.health, self._on_altered)
        self._feed = Feed(nodes, heartbeat, self._questions, self._send, self.health)
        self._sdo_responses = set(self._sdo.response_cob_ids())
        self._bus = CanBus(config, {*self._handlers, *self._sdo_responses}, self._on_frame, self._discard)
        self._active = False
        self._sync_s = 0.0
        self._sync_open = False  #: between SYNC and the end of `collect`
        self._awaited = 0  #: nodes whose answer `collect` still waits for
        self._answered: asyncio.Future[None] | None = None
        self._heartbeat_came = asyncio.Event()
        self._prepared = False  #: the nodes wait for us: they were prepared, and not released since
        self._unfinished: list[Transaction] = []  #: of an arming that has not come to an end: to be undone
        self._releasing = asyncio.Lock()

    async def open(self) -> None:
        """Open the bus and listen. Raises OSError with what to do about it."""
        self._bus.open()

    # proving the nodes

    async def prepare(self) -> None:
        """Configure all nodes and prove their watchdogs. Raises PrepareRefused; what was written is undone then.

        Where this is cancelled, `release` undoes it.
        """
        self.silence()
        try:
            await self._bus.restore()
            self._bus.open()
        except OSError as error:
            told = str(error).removeprefix(f"bus {self.name}: ")
            raise PrepareRefused([finding("can-bus-not-open", bus=self.name, error=told)]) from error
        for node in self._nodes:
            node.station.boot_ups = 0
        await self._leave_operational()  # a node that is stopped does not answer SDO
        if reasons := await check_nodes(self._sdo, self._nodes):
            raise PrepareRefused(reasons)
        await finish(undo_all(self._unfinished))  # of an arming that was cancelled, and that nobody has released
        reasons = await configure_nodes(self._sdo, self._nodes, self._unfinished)
        if not reasons:
            reasons = await self._start()
        if reasons:
            for node in self._nodes:
                self._command_nmt(ENTER_PRE_OPERATIONAL, node)
            raise PrepareRefused(reasons + await finish(undo_all(self._unfinished)))
        self._unfinished.clear()
        for node in self._nodes:
            node.station.recover()
            node.station.supervised = True
        self._questions.stop()  # what a silent link asked for must not come among the answers to SYNC
        self._active = self._prepared = True

    async def _start(self) -> list[Finding]:
        """NMT start, and every node's own word that it is operational and was not restarted meanwhile."""
        stations = [node.station for node in self._nodes]
        for node in self._nodes:
            node.station.nmt_state = None
            self._command_nmt(START, node)
        patience_s = START_HEARTBEATS * max(station.heartbeat_s for station in stations)
        try:
            async with asyncio.timeout(patience_s):
                while any(station.nmt_state != OPERATIONAL for station in stations):
                    self._heartbeat_came.clear()
                    await self._heartbeat_came.wait()
        except TimeoutError:
            pass
        late = [station.name for station in stations if station.nmt_state != OPERATIONAL]
        reasons = [finding("node-not-operational", device=name, waited_s=patience_s) for name in late]
        return reasons + [
            finding("restarted-meanwhile", device=station.name) for station in stations if station.boot_ups
        ]

    def _command_nmt(self, command: int, node: Node) -> None:
        self._bus.send(*nmt_frame(command, node.station.node))

    def _send(self, cob_id: int, data: bytes) -> bool:
        return self._bus.send(cob_id, data)

    def _on_altered(self, node: Node, trouble: Finding) -> None:
        self._feed.drop(node, trouble)

    @property
    def serials(self) -> Mapping[str, str]:
        """An amplifier's is that of each load cell on it: its station is called by all of them."""
        stations = [node.station for node in self._nodes if node.station.serial]
        return {name: station.serial for station in stations for name in station.name.split(", ")}

    @property
    def watched(self) -> Set[str]:
        return {node.station.name for node in self._nodes if node.station.fed}

    def withhold(self, devices: Set[str]) -> None:
        """Drives that listen to our heartbeat share it: withheld from one, it is withheld from all."""
        for node in self._nodes:
            node.station.withheld = node.station.name in devices

    def silence(self) -> None:
        """Nothing is sent from now on that changes a node. What the nodes said is forgotten with it."""
        self._active = False
        self._sync_open = False
        self._questions.stop()
        self._feed.forget()
        for node in self._nodes:
            node.forget()

    async def release(self) -> None:
        """The nodes leave operational: torque off, and their deadline monitoring ends without a fault.

        A consumer of our heartbeat is told by SDO to wait for it no more, once it has confirmed that its torque is off.
        The watchdog of one that does not is left to fire. What an arming that was cancelled has written is undone. No
        cancellation cuts it; a node that does not answer takes the time of one transfer for each.
        """
        self.silence()
        await finish(self._release())

    async def _release(self) -> None:
        async with self._releasing:
            await self._leave_operational()
            for failure in await undo_all(self._unfinished):
                self.health.last_error = sentence(failure)

    async def _leave_operational(self) -> None:
        for node in self._nodes:
            self._command_nmt(ENTER_PRE_OPERATIONAL, node)
        if self._prepared:
            failures = await finish_all(self._let_go(node) for node in self._nodes)
            self._prepared = False
            if failures:
                raise failures[0]

    async def _let_go(self, node: Node) -> None:
        steps = node.release_steps()
        if not steps:
            return
        try:
            trouble = "" if await node.confirm_stopped(self._sdo) else "still says that it has torque"
            for step in [] if trouble else steps:
                await self._sdo.download(node.station.node, step.index, step.sub, step.bytes_after(b""))
        except SdoFailed as error:
            trouble = str(error)
        if trouble:
            self.health.last_error = f"{node.station.name}: {trouble}; its watchdog was left on and fires"

    # the cycle

    def trigger(self, now_s: float) -> None:
        """SYNC when active; a silent link asks for what does not come by itself. Opens a bus again that is gone."""
        self._sync_open = False
        self._bus.drain_all()
        self._sync_s = now_s
        if self._active:
            self._bus.send(SYNC, b"")  # first: nothing is read before the nodes expect answers to it
            self._begin_sync()
        else:
            self._ask()
        self._bus.tend(now_s)

    def _ask(self) -> None:
        for node in self._nodes:
            self._questions.ask(node, self._sync_s, active=self._active)

    def _begin_sync(self) -> None:
        self._awaited = 0
        for node in self._nodes:
            node.begin_sync()
            self._awaited += node.station.awaited
        self._answered = asyncio.get_running_loop().create_future()
        self._sync_open = True

    async def collect(self, inputs: Inputs, deadline_s: float) -> None:
        """The answers to this SYNC. Nodes that are absent already are heard, but not waited for."""
        if self._sync_open:
            self._bus.drain()
            if self._awaited > 0 and self._answered is not None:
                over = asyncio.get_running_loop().call_at(deadline_s, self._wait_no_longer)
                try:
                    await self._answered
                finally:
                    over.cancel()
            self._sync_open = False
            for node in self._nodes:
                node.station.end_sync()
        self._fill(inputs)

    def _wait_no_longer(self) -> None:
        if self._answered is not None and not self._answered.done():
            self._answered.set_result(None)

    def _fill(self, inputs: Inputs) -> None:
        absent: list[str] = []
        for node in self._nodes:
            for trouble in node.fill(inputs, self._sync_s, active=self._active):
                self.health.last_error = trouble
            self.health.timeouts += self._active and not node.station.answered
            if node.absent(self._sync_s):
                absent.append(node.station.name)
        if absent != self.health.absent:
            self.health.absent = absent
            for node in self._nodes:
                if node.station.name in absent and (trouble := node.trouble(self._sync_s)):
                    self.health.last_error = sentence(trouble)
        self.health.reconnects = self._bus.reopened
        if self._bus.gone:
            self.health.last_error = self._bus.gone

    def write(self, outputs: Outputs) -> None:
        """The commands, and the heartbeat. Then what it is time to ask by SDO, in the rest of the period."""
        if self._active:
            self._feed.give(outputs, self._sync_s)
            self._ask()
            self._questions.verify(self._sync_s)

    # what arrives

    def _on_frame(self, cob_id: int, data: bytes | bytearray, now_s: float) -> None:
        handler = self._handlers.get(cob_id)
        if handler is not None:
            handler[0](handler[1], cob_id, data, now_s)
        elif cob_id in self._sdo_responses:
            self._sdo.on_frame(cob_id, data, now_s)

    def _on_answer(self, node: Node, cob_id: int, data: bytes | bytearray, now_s: float) -> None:
        if not self._active:
            return
        station = node.station
        try:
            if self._sync_open:
                node.on_answer(cob_id, data)
            else:
                node.check_answer(cob_id, data)
                station.on_late_frame()
                self._discard(f"{station.name}: an answer after its cycle")
        except ValueError as error:
            self._discard(f"{station.name}: {error}")
            return
        if self._sync_open and station.awaited and station.answered:
            station.awaited = False
            self._awaited -= 1
            if self._awaited == 0:
                self._wait_no_longer()

    def _on_heartbeat(self, node: Node, cob_id: int, data: bytes | bytearray, now_s: float) -> None:
        try:
            node.station.on_heartbeat(data, now_s)
        except ValueError as error:
            self._discard(f"{node.station.name}: {error}")
            return
        if node.station.distrust:
            self.health.last_error = sentence(node.station.distrust)
        self._heartbeat_came.set()

    def _on_emergency(self, node: Node, cob_id: int, data: bytes | bytearray, now_s: float) -> None:
        try:
            node.station.on_emergency(data)
        except ValueError as error:
            self._discard(f"{node.station.name}: {error}")
            return
        if told := node.station.emergency_told:
            self.health.last_error = sentence(told)

    def _discard(self, reason: str) -> None:
        self.health.malformed += 1
        self.health.last_error = reason

    async def close(self) -> None:
        """Release the bus. Idempotent; no cancellation cuts it."""
        self.silence()
        await finish(self._close())

    async def _close(self) -> None:
        async with AsyncExitStack() as last_first:  # each of them, also where another fails
            last_first.push_async_callback(self._sdo.close)
            last_first.push_async_callback(self._bus.close)
            last_first.push_async_callback(self._questions.close)

"""CiA 402 drives on one CANopen bus, behind the driver port.

A cycle: SYNC (the drives latch their RPDOs and sample), the TPDOs of this SYNC, one RPDO a drive. An answer
counts for the SYNC after which it arrives, once: what comes twice, or after `collect` has closed the cycle, is
discarded and counted. What is in the socket before the next SYNC is read before it, so that an answer that is
late within its period cannot pass for a fresh one. One that comes a whole period late can: SYNC has no counter.

A drive that is no longer heard may still hear: every RPDO would renew its watchdog, although the drive may act on
none of them (they act at SYNC). So it is told once to leave operational, which takes torque off without a SYNC, and
gets no RPDO until the next `prepare`: if it does not hear the one, its watchdog fires for want of the other.
"""

import asyncio
from collections.abc import Callable

from drivers.canopen.bus import CanBus
from drivers.canopen.node import OPERATIONAL, DriveNode
from drivers.canopen.prepare import check_drive, configure_drives, read_safe_torque_off, undo_all
from drivers.canopen.sdo import SdoBus, SdoFailed
from drivers.cia402 import PowerState
from drivers.port import PrepareRefused
from gateway.core.line import CanopenBus
from gateway.core.signals import DriveState, Inputs, LinkHealth, Outputs

NMT, SYNC, EMERGENCY, HEARTBEAT = 0x000, 0x080, 0x080, 0x700  #: COB-IDs, the last two of node 0
START, ENTER_PRE_OPERATIONAL = 0x01, 0x80  #: NMT commands
STO_POLL_S = 0.2  #: how often drives that may not switch on are asked whether safe torque off is why
START_HEARTBEATS = 3  #: producer times within which a started drive must say that it is operational

Handler = Callable[[DriveNode, bytes | bytearray, float], None]


class CanopenLink:
    """A `drivers.port.Link` for the drives in `nodes`, all on the bus `config`."""

    def __init__(self, config: CanopenBus, nodes: list[DriveNode]) -> None:
        self.name = config.name
        self.health = LinkHealth()
        self._nodes = nodes
        self._bus = CanBus(config, self._on_frame, self._discard)
        self._sdo = SdoBus(self._bus.send, [node.node for node in nodes])
        self._handlers: dict[int, tuple[Handler, DriveNode]] = {}
        for node in nodes:
            self._handlers[node.device.transmit_pdo.cob_id + node.node] = (self._on_answer, node)
            self._handlers[HEARTBEAT + node.node] = (self._on_heartbeat, node)
            self._handlers[EMERGENCY + node.node] = (self._on_emergency, node)
        self._sdo_responses = set(self._sdo.response_cob_ids())
        self._active = False
        self._sync_s = 0.0
        self._sync_open = False  #: between SYNC and the end of `collect`
        self._awaited = 0  #: drives whose answer `collect` still waits for
        self._answered: asyncio.Future[None] | None = None
        self._heartbeat_came = asyncio.Event()
        self._sto_asked_s = float("-inf")
        self._sto_task: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Open the bus and listen. Raises OSError with what to do about it."""
        self._bus.open()

    # proving the drives

    async def prepare(self) -> None:
        """Configure all drives and prove their watchdogs. Raises PrepareRefused; what was written is undone then."""
        self.silence()
        try:
            self._bus.open()
        except OSError as error:
            raise PrepareRefused([str(error)]) from error
        for node in self._nodes:
            node.boot_ups = 0
            self._command_nmt(ENTER_PRE_OPERATIONAL, node)  # a node that is stopped does not answer SDO
        reasons = [f"{node.name}: {reason}" for node in self._nodes for reason in await check_drive(self._sdo, node)]
        if reasons:
            raise PrepareRefused(reasons)
        transactions, reasons = await configure_drives(self._sdo, self._nodes)
        if not reasons:
            reasons = await self._start()
        if reasons:
            for node in self._nodes:
                self._command_nmt(ENTER_PRE_OPERATIONAL, node)
            raise PrepareRefused(reasons + await undo_all(transactions))
        for node in self._nodes:
            node.emergency = ""
            node.supervised = True
        self._active = True

    async def _start(self) -> list[str]:
        """NMT start, and every drive's own word that it is operational and was not restarted meanwhile."""
        for node in self._nodes:
            node.nmt_state = None
            self._command_nmt(START, node)
        patience_s = START_HEARTBEATS * max(node.heartbeat_s for node in self._nodes)
        try:
            async with asyncio.timeout(patience_s):
                while any(node.nmt_state != OPERATIONAL for node in self._nodes):
                    self._heartbeat_came.clear()
                    await self._heartbeat_came.wait()
        except TimeoutError:
            pass
        late = [node for node in self._nodes if node.nmt_state != OPERATIONAL]
        reasons = [f"{node.name}: started, but not operational within {patience_s:g} s" for node in late]
        return reasons + [f"{node.name}: restarted while it was configured" for node in self._nodes if node.boot_ups]

    def _command_nmt(self, command: int, node: DriveNode) -> None:
        self._bus.send(NMT, bytes((command, node.node)))

    def silence(self) -> None:
        """Nothing is sent from now on. What the drives said of their power stage is forgotten with it."""
        self._active = False
        self._sync_open = False
        for node in self._nodes:
            node.forget()

    async def release(self) -> None:
        """Drives leave operational: torque off, and their deadline monitoring ends without a fault."""
        self.silence()
        for node in self._nodes:
            self._command_nmt(ENTER_PRE_OPERATIONAL, node)

    # the cycle

    def trigger(self, now_s: float) -> None:
        """SYNC when active; only listens when silent."""
        self._sync_open = False
        self._bus.drain_all()
        self._sync_s = now_s
        if not self._active:
            return
        for node in self._nodes:
            node.begin_sync()
        self._awaited = sum(node.awaited for node in self._nodes)
        self._answered = asyncio.get_running_loop().create_future()
        self._sync_open = True
        self._bus.send(SYNC, b"")

    async def collect(self, inputs: Inputs, deadline_s: float) -> None:
        """The answers to this SYNC. Drives that are absent already are heard, but not waited for."""
        if self._sync_open:
            self._bus.drain()
            if self._awaited > 0 and self._answered is not None:
                try:
                    async with asyncio.timeout_at(deadline_s):
                        await self._answered
                except TimeoutError:
                    pass
            self._sync_open = False
            for node in self._nodes:
                node.end_sync()
            self._ask_for_safe_torque_off()
        self._fill(inputs)

    def _fill(self, inputs: Inputs) -> None:
        absent: list[str] = []
        for node in self._nodes:
            index = node.index
            state = node.state(self._sync_s)
            inputs.drive_state[index] = state
            if state == DriveState.ABSENT:
                absent.append(node.name)
            sample = node.sample
            if sample is not None:
                inputs.speed.put(index, sample.speed_m_per_s, self._sync_s)
                inputs.torque.put(index, sample.torque_nm, self._sync_s)
            else:
                self.health.timeouts += self._active
                inputs.speed.miss(index)
                inputs.torque.miss(index)
        if absent != self.health.absent:
            self.health.absent = absent
            for node in self._nodes:
                if node.name in absent:
                    self.health.last_error = f"{node.name}: {node.trouble(self._sync_s)}"

    def write(self, outputs: Outputs) -> None:
        """One RPDO a drive that is there. What cannot be commanded is not sent: the watchdog has the last word."""
        if not self._active:
            return
        for node in self._nodes:
            state = node.state(self._sync_s)
            if state == DriveState.ABSENT and not node.dropped:
                node.drop(self._sync_s)
                self._command_nmt(ENTER_PRE_OPERATIONAL, node)
            if node.dropped:
                continue
            request = int(outputs.drive_request[node.index])
            torque_nm = float(outputs.torque_nm[node.index])
            try:
                payload = node.command(request, torque_nm, state)
            except ValueError as error:
                self._discard(f"{node.name}: {error}")
                continue
            self._bus.send(node.device.receive_pdo.cob_id + node.node, payload)

    def _ask_for_safe_torque_off(self) -> None:
        """Where the PDO does not carry it, ask by SDO, and only while a drive may not switch on."""
        blocked = [
            node
            for node in self._nodes
            if node.stage.power is PowerState.SWITCH_ON_DISABLED
            and node.device.objects.safe_torque_off is not None
            and "safe_torque_off" not in node.device.transmit_pdo.objects
        ]
        busy = self._sto_task is not None and not self._sto_task.done()
        if blocked and not busy and self._sync_s - self._sto_asked_s >= STO_POLL_S:
            self._sto_asked_s = self._sync_s
            self._sto_task = asyncio.create_task(self._read_safe_torque_off(blocked))

    async def _read_safe_torque_off(self, nodes: list[DriveNode]) -> None:
        for node in nodes:
            try:
                node.stage.safe_torque_off = await read_safe_torque_off(self._sdo, node)
            except SdoFailed as error:
                self._discard(f"{node.name}: {error}")

    # what arrives

    def _on_frame(self, cob_id: int, data: bytes | bytearray, now_s: float) -> None:
        handler = self._handlers.get(cob_id)
        if handler is not None:
            handler[0](handler[1], data, now_s)
        elif cob_id in self._sdo_responses:
            self._sdo.on_frame(cob_id, data, now_s)

    def _on_answer(self, node: DriveNode, data: bytes | bytearray, now_s: float) -> None:
        if not self._active:
            return
        try:
            if self._sync_open:
                node.on_answer(data)
            else:
                node.on_late_answer(data)
                self._discard(f"{node.name}: an answer after its cycle")
        except ValueError as error:
            self._discard(f"{node.name}: {error}")
            return
        if self._sync_open and node.awaited:
            node.awaited = False
            self._awaited -= 1
            if self._awaited == 0 and self._answered is not None and not self._answered.done():
                self._answered.set_result(None)

    def _on_heartbeat(self, node: DriveNode, data: bytes | bytearray, now_s: float) -> None:
        try:
            node.on_heartbeat(data, now_s)
        except ValueError as error:
            self._discard(f"{node.name}: {error}")
            return
        if node.distrust:
            self.health.last_error = f"{node.name}: {node.distrust}"
        self._heartbeat_came.set()

    def _on_emergency(self, node: DriveNode, data: bytes | bytearray, now_s: float) -> None:
        try:
            node.on_emergency(data)
        except ValueError as error:
            self._discard(f"{node.name}: {error}")
            return
        if node.emergency:
            self.health.last_error = f"{node.name}: {node.emergency}"

    def _discard(self, reason: str) -> None:
        self.health.malformed += 1
        self.health.last_error = reason

    async def close(self) -> None:
        """Release the bus. Idempotent."""
        self.silence()
        if self._sto_task is not None:
            self._sto_task.cancel()
            await asyncio.gather(self._sto_task, return_exceptions=True)
            self._sto_task = None
        await self._bus.close()

"""An OPC UA server for driver tests, as docs/devices/r2r-opcua.md has it, written apart from the code under test.

It runs on a thread of its own: loading asyncua's address space takes seconds, so one server serves a whole file of
tests, each of which begins with `reset`.
"""

import asyncio
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from asyncua import Server, ua

from drivers.device_map import MAPS, load_map
from drivers.opcua.build import build_on
from drivers.opcua.inprocess import EngineChannel
from drivers.opcua.link import OpcUaLink
from drivers.port import PrepareRefused
from drivers.registry import build_links
from drivers.wiring import Wired
from gateway.core.line import Line
from gateway.core.signals import DriveRequest, Inputs, Outputs
from tests.protocol import driver_support
from tests.support.patience import PATIENCE_S
from tests.support.ports import free_port

NAMESPACE = "urn:r2rgate:devices"
EPOCH = datetime(1601, 1, 1, tzinfo=UTC)
GOOD, OUT_OF_RANGE, TYPE_MISMATCH = 0, ua.StatusCodes.BadOutOfRange, ua.StatusCodes.BadTypeMismatch
U16, U32, F64, BOOL = (getattr(ua.VariantType, name) for name in ("UInt16", "UInt32", "Double", "Boolean"))
STRING = ua.VariantType.String
AFTER = {0x00: 0x0250, 0x06: 0x0231, 0x07: 0x0233, 0x0F: 0x1237, 0x02: 0x0217}  #: controlword: statusword


class Devices:
    """What the server's nodes hold. `reads` and `writes` are what was asked for, a dict a Write."""

    def __init__(self) -> None:
        self.reset()

    def reset(self, axes: int = 2) -> None:
        self.nodes: dict[str, tuple[ua.VariantType, Any]] = {
            "Amplifier.DeviceId": (U32, 0x5206),
            "Amplifier.SerialNumber": (STRING, " AMP-7\0"),
            "Amplifier.Channels": (U16, axes),
            "Amplifier.SampleCounter": (U16, 0),
            "Amplifier.Healthy": (BOOL, True),
            "Line.DeviceId": (U32, 0x5207),
            "Line.SerialNumber": (ua.VariantType.UInt64, 2**63 + 1),
            "Line.Permissive": (BOOL, True),
            "Line.EmergencyStopHealthy": (BOOL, True),
            "Line.Running": (BOOL, False),
            "Line.WatchdogTripped": (BOOL, False),
            "Line.Local": (BOOL, False),
            "Line.UnwindSpeed": (F64, 0.1),
            "Line.LifeEcho": (U16, 0),
            "Line.Run": (BOOL, False),
            "Line.Warning": (BOOL, False),
            "Line.SpeedRequest": (F64, 0.0),
            "Line.Life": (U16, 0),
            "Line.Watchdog": (U16, 0),
        }
        for k in range(1, axes + 1):
            self.nodes |= {
                f"Cell{k}.Tension": (F64, 10.0 * k),
                f"Cell{k}.Status": (U16, 0),
                f"Axis{k}.DeviceId": (U32, 0x5205),
                f"Axis{k}.SerialNumber": (STRING, f"AX-{k}"),
                f"Axis{k}.Statusword": (U16, 0x0250),
                f"Axis{k}.Speed": (F64, 0.1 * k),
                f"Axis{k}.Torque": (F64, 1.0 * k),
                f"Axis{k}.SafeTorqueOff": (BOOL, False),
                f"Axis{k}.ErrorCode": (U16, 0),
                f"Axis{k}.Controlword": (U16, 0),
                f"Axis{k}.TargetTorque": (F64, 0.0),
                f"Axis{k}.Life": (U16, 0),
                f"Axis{k}.Watchdog": (U16, 0),
                f"Axis{k}.RatedTorque": (F64, 80.0),
                f"Axis{k}.MaxTorque": (F64, 80.0),
            }
        self.status: dict[str, int] = {}  #: StatusCodes of reads
        self.refuses: dict[str, int] = {}  #: StatusCodes of writes
        self.bystander = GOOD  #: the StatusCode of a write that is right, but not done because another is refused
        self.stubborn: set[str] = set()  #: writes are confirmed, and not done
        self.counts = self.echoes = True
        self.stamps = True  #: reads bring source time stamps
        self.frozen: set[str] = set()  #: nodes whose source time stamps stand still
        self.deaf: set[str] = set()  #: axes that ignore their controlword
        self.writes: list[dict[str, Any]] = []
        self.reads = 0

    def set(self, node: str, value: Any) -> None:
        self.nodes[node] = (self.nodes[node][0], value)

    def value(self, node: str) -> Any:
        return self.nodes[node][1]

    def written(self, node: str) -> list[Any]:
        return [write[node] for write in self.writes if node in write]

    def read(self, node: str) -> ua.DataValue:
        if node not in self.nodes:
            return ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown))
        kind, value = self.nodes[node]
        source_us = self.source_us(node)
        stamp = EPOCH + timedelta(microseconds=source_us) if source_us else None
        status = ua.StatusCode(self.status.get(node, GOOD))
        return ua.DataValue(ua.Variant(value, kind), StatusCode=status, SourceTimestamp=stamp)

    def source_us(self, node: str) -> int:
        """Microseconds since 1601; a read every millisecond."""
        return self.stamps * (13_000_000_000_000_000 + 1000 * (0 if node in self.frozen else self.reads))

    def begin_read(self) -> None:
        self.reads += 1
        if self.counts:
            self.set("Amplifier.SampleCounter", (self.value("Amplifier.SampleCounter") + 1) & 0xFFFF)

    def write(self, writes: list[tuple[str, ua.Variant]]) -> list[int]:
        """All or nothing."""
        statuses = [self._against(node, value) for node, value in writes]
        self.writes.append({node: value.Value for node, value in writes})
        if any(statuses):
            return [status or self.bystander for status in statuses]
        for node, value in writes:
            if node not in self.stubborn:
                self.act(node, value.Value)
        return statuses

    def _against(self, node: str, value: ua.Variant) -> int:
        if node not in self.nodes:
            return ua.StatusCodes.BadNodeIdUnknown
        if value.VariantType is not self.nodes[node][0]:
            return TYPE_MISMATCH
        if node.endswith("Watchdog") and value.Value != 0 and not 10 <= value.Value <= 1000:
            return OUT_OF_RANGE
        return self.refuses.get(node, GOOD)

    def act(self, node: str, value: Any) -> None:
        self.set(node, value)
        if node == "Line.Life" and self.echoes:
            self.set("Line.LifeEcho", value)
        if node == "Line.Run":
            self.set("Line.Running", value)
        if node.endswith(".Controlword") and node.split(".")[0] not in self.deaf:
            self.set(node.replace("Controlword", "Statusword"), AFTER[value])


class DeviceServer:
    """asyncua's server, with the values of `devices` behind its Read and Write."""

    def __init__(self, certificates: tuple[Path, Path] | None = None) -> None:
        self.devices = Devices()
        self.port = 0
        self._certificates = certificates
        self._loop = asyncio.new_event_loop()
        self._started = threading.Event()
        self._thread = threading.Thread(target=self._run, name="opcua-test-server")
        self._thread.start()
        assert self._started.wait(PATIENCE_S)

    @property
    def endpoint(self) -> str:
        return f"opc.tcp://127.0.0.1:{self.port}"

    def reset(self) -> None:
        """Thawed, listening, everything as at first."""
        self.thaw()
        self.listen()
        self.devices.reset()

    def freeze(self) -> None:
        """Answers wait from now on."""
        self._loop.call_soon_threadsafe(self._going.clear)

    def thaw(self) -> None:
        self._loop.call_soon_threadsafe(self._going.set)

    def crash(self) -> None:
        """Every connection ends, and none can be made."""
        asyncio.run_coroutine_threadsafe(self._crash(), self._loop).result(10.0)

    def listen(self) -> None:
        asyncio.run_coroutine_threadsafe(self._listen(), self._loop).result(10.0)

    def close(self) -> None:
        self.thaw()
        self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._main())
        self._loop.close()

    async def _main(self) -> None:
        self._going, self._ending = asyncio.Event(), asyncio.Event()
        self._going.set()
        server = self._server = Server()
        await server.init()
        self.port = free_port()
        server.set_endpoint(self.endpoint)
        policies = [ua.SecurityPolicyType.NoSecurity]
        if self._certificates is not None:
            await server.load_certificate(self._certificates[0])
            await server.load_private_key(self._certificates[1])
            policies.append(ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt)
        server.set_security_policy(policies)
        self._namespace = await server.register_namespace(NAMESPACE)
        service: Any = server.iserver.attribute_service
        read, write = service.read, service.write

        def read_devices(parameters: ua.ReadParameters) -> list[ua.DataValue]:
            if all(node.NodeId.NamespaceIndex != self._namespace for node in parameters.NodesToRead):
                return read(parameters)
            self.devices.begin_read()
            return [self.devices.read(str(node.NodeId.Identifier)) for node in parameters.NodesToRead]

        async def write_devices(parameters: ua.WriteParameters, user: Any = None) -> list[ua.StatusCode]:
            await self._going.wait()
            if any(node.NodeId.NamespaceIndex != self._namespace for node in parameters.NodesToWrite):
                return await write(parameters, user)
            writes = [(str(node.NodeId.Identifier), node.Value.Value) for node in parameters.NodesToWrite]
            return [ua.StatusCode(status) for status in self.devices.write(writes)]

        dispatch = server.iserver.callback_service.dispatch

        async def dispatch_when_going(event: Any, callback: Any = None) -> Any:
            await self._going.wait()
            return await dispatch(event, callback)

        service.read, service.write = read_devices, write_devices
        server.iserver.callback_service.dispatch = dispatch_when_going
        await server.start()
        self._started.set()
        await self._ending.wait()
        await server.stop()

    async def _crash(self) -> None:
        listener: Any = self._server.bserver
        listener._server.close()  # noqa: SLF001 (asyncua has no way to die)
        listener.cleanup_task.cancel()
        for client in list(listener.clients):
            client.transport.abort()
        await asyncio.sleep(0.0)

    async def _listen(self) -> None:
        listener: Any = self._server.bserver
        if not listener._server.is_serving():  # noqa: SLF001
            await listener.start()


@contextmanager
def device_server(certificates: tuple[Path, Path] | None = None) -> Iterator[DeviceServer]:
    logging.getLogger("asyncua").addHandler(logging.NullHandler())
    server = DeviceServer(certificates)
    try:
        yield server
    finally:
        server.close()


def line(endpoint: str, n: int = 2, security: str = "none", files: dict[str, str] | None = None) -> Line:
    """A line of n spans with everything behind one server; drives are rated 80 Nm. `files` are those of security."""
    document = driver_support.line(n).model_dump()
    document["buses"] = [{"name": "server", "protocol": "opcua", "endpoint": endpoint, "security": security}]
    document["buses"][0] |= files or {}
    for k, (drive, cell) in enumerate(zip(document["drives"], document["load_cells"], strict=True), 1):
        drive |= {"bus": "server", "map": "r2r-opcua-drive", "address": 1, "channel": k}
        cell |= {"bus": "server", "map": "r2r-opcua-amplifier", "address": 1}
    document["plc"] |= {"bus": "server", "map": "r2r-opcua-plc", "address": 1}
    return Line.model_validate(document)


def link_in_process(of_line: Line, folder: Path = MAPS) -> OpcUaLink:
    """The line's link, with the engine in the same event loop."""
    items = [*of_line.drives, *of_line.load_cells, of_line.plc]
    wired = [Wired(item, of_line.buses[0], load_map(folder / f"{item.map}.toml")) for item in items]
    links, reasons = build_on(of_line, wired, EngineChannel)
    assert not reasons
    link = links[0]
    assert isinstance(link, OpcUaLink)
    return link


def link_with_worker(of_line: Line) -> OpcUaLink:
    """The line's link as a line has it: the engine in a process."""
    (link,) = build_links(of_line)
    assert isinstance(link, OpcUaLink)
    return link


class Rig:
    """A link with inputs and outputs, run cycle by cycle."""

    def __init__(self, link: OpcUaLink, n: int = 2) -> None:
        self.link = link
        self.inputs = Inputs(n)
        self.outputs = Outputs(n)

    async def cycle(self, wait_s: float = 0.5) -> None:
        """Read, then hand over the commands, as the loop does."""
        await driver_support.cycle(self.link, self.inputs, wait_s)
        self.link.write(self.outputs)

    async def until(self, condition: Callable[[], bool]) -> None:
        """Cycles until something has happened."""
        async with asyncio.timeout(PATIENCE_S):
            while not condition():
                await self.cycle()
                await asyncio.sleep(0.005)  # a period, however short

    async def prepare(self) -> None:
        """Asked again where a stall of the machine has used up a question's time. Raises PrepareRefused."""
        async with asyncio.timeout(PATIENCE_S):
            while True:
                try:
                    return await self.link.prepare()
                except PrepareRefused as refused:
                    if not any(reason.parameters.get("error") == "no answer in time" for reason in refused.reasons):
                        raise

    async def enable(self, torque_nm: float = 5.0) -> None:
        """Prepared, every drive enabled, transport on."""
        await self.prepare()
        self.outputs.drive_request[:] = DriveRequest.ENABLE
        self.outputs.torque_nm[:] = torque_nm
        self.outputs.run, self.outputs.speed_request_m_per_s = True, 0.2
        await self.until(lambda: bool((self.inputs.drive_state == 3).all()) and self.inputs.plc.running)

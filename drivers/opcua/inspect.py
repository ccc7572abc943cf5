"""What the devices of a line's OPC UA server say of themselves. Reads only: no Write, no call, no subscription."""

import asyncio
from collections.abc import Sequence
from dataclasses import replace

from drivers.cia402 import PowerState, power_state
from drivers.inspection import (
    BusFacts,
    CellSample,
    DeviceFacts,
    DriveFacts,
    Identity,
    Number,
    PlcFacts,
    Progress,
    ReadCell,
    WatchdogFacts,
    is_supplied,
    sample_cells,
)
from drivers.opcua.engine import Engine
from drivers.opcua.maps import DriveMap, Flag, LoadCellMap, NodeRef, OpcUaMap, PlcMap, WatchdogNode
from drivers.opcua.messages import Outcome, Plan, Question
from drivers.opcua.nodes import DeviceNodes, NodeTable
from drivers.scaling import si_per_count, torque_per_count, torque_step
from drivers.torque_rules import scaling_rated_nm
from drivers.wiring import Wired
from gateway.core.line import Drive, LinePlc, LoadCell, OpcUaBus

CONNECT_PATIENCE_S = 5.0
REQUEST_TIMEOUT_S = 1.0
_FAULTS = (PowerState.FAULT, PowerState.FAULT_REACTION)


class _Silent(Exception):
    """The server does not answer; the text says why."""


async def inspect(bus: OpcUaBus, devices: Sequence[Wired], sample_s: float, progress: Progress) -> BusFacts:
    """Ask `devices`, all of this server, and watch the load cells for `sample_s`."""
    table = NodeTable()
    inspectors = [_Inspector(table, wired) for wired in devices]
    files = (bus.certificate or "", bus.private_key or "", bus.server_certificate or "")
    server = _Server(Plan(bus.endpoint, bus.security, *files, table.nodes))
    try:
        progress(f"bus {bus.name}: connecting to {bus.endpoint}")
        await server.connect()
        progress(f"bus {bus.name}: asking {len(devices)} devices")
        facts = {inspector.item.name: await inspector.facts(server) for inspector in inspectors}
        cells: dict[str, ReadCell] = {
            inspector.item.name: inspector.cell_reader(server)
            for inspector in inspectors
            if isinstance(inspector.item, LoadCell) and facts[inspector.item.name].believed
        }
        for name, cell in (await sample_cells(cells, sample_s)).items():
            facts[name] = replace(facts[name], cell=cell)
        return BusFacts(bus.name, bus.endpoint, devices=tuple(facts.values()))
    except _Silent as error:
        return BusFacts(bus.name, bus.endpoint, trouble=str(error))
    finally:
        await server.close()


class _Server:
    """Questions that only read, one at a time."""

    def __init__(self, plan: Plan) -> None:
        self._engine = Engine(plan, 0)
        self._number = 0

    async def connect(self) -> None:
        """Raises _Silent."""
        await self._ask((), CONNECT_PATIENCE_S)

    async def read(self, places: Sequence[int]) -> list[Number]:
        """Raw numbers, in order. Raises _Silent."""
        return await self._ask(tuple(places), REQUEST_TIMEOUT_S)

    async def _ask(self, places: tuple[int, ...], patience_s: float) -> list[Number]:
        self._number += 1
        deadline_s = asyncio.get_running_loop().time() + patience_s
        answer = await self._engine.answer(
            Question(self._number, 0, 0.0, deadline_s, patient=True, writes=(), reads=places)
        )
        if answer.outcome is not Outcome.DONE:
            raise _Silent(answer.text)
        return [Number(r.value) if r.good else Number(None, r.trouble) for r in answer.readings]

    async def close(self) -> None:
        await self._engine.close()


class _Inspector:
    """Asks one device. What it will read has to be in the table before the server is connected to."""

    def __init__(self, table: NodeTable, wired: Wired) -> None:
        assert isinstance(wired.device, OpcUaMap)
        self.item = wired.item
        self._device = wired.device
        channel = 1 if isinstance(self.item, LinePlc) else self.item.channel
        self._nodes = DeviceNodes(table, wired.device.namespace, self.item.address, channel)
        self._places = {id(entry): self._place(entry) for entry in _read_entries(wired.device)}

    def _place(self, entry: NodeRef) -> int:
        return self._nodes.place(entry, str(getattr(entry, "type", "bool")))

    async def _number(self, server: _Server, entry: NodeRef) -> Number:
        return (await server.read([self._places[id(entry)]]))[0]

    async def facts(self, server: _Server) -> DeviceFacts:
        """Raises _Silent."""
        device, item = self._device, self.item
        channel = "" if isinstance(item, LinePlc) else f" channel {item.channel}"
        found, wanted = await self._number(server, device.identity), f"device id {device.identity.value:#x}"
        if found.value is None:
            identity = Identity(f"its device id cannot be read: {found.trouble}", wanted, fits=False)
        else:
            identity = Identity(f"device id {int(found.value):#x}", wanted, found.value == device.identity.value)
        facts = DeviceFacts(item.name, f"address {item.address}{channel}", identity=identity)
        if not identity.fits:
            return facts
        if isinstance(device, DriveMap) and isinstance(item, Drive):
            return await self._ask_drive(server, facts, device, item)
        if isinstance(device, PlcMap):
            return await self._ask_plc(server, facts, device)
        assert isinstance(device, LoadCellMap) and isinstance(item, LoadCell)
        count = await self._number(server, device.channel_count)
        if count.value is not None and item.channel > count.value:
            return replace(facts, differences=(f"channel {item.channel}: the amplifier has {int(count.value)}",))
        return facts

    async def _ask_drive(self, server: _Server, facts: DeviceFacts, device: DriveMap, drive: Drive) -> DeviceFacts:
        nodes, rated_nm = device.nodes, drive.rated_torque_nm
        status = await self._number(server, nodes.statusword)
        power = None if status.value is None else power_state(int(status.value))
        sto = None
        if nodes.safe_torque_off is not None:
            active = await self._number(server, nodes.safe_torque_off)
            sto = None if active.value is None else nodes.safe_torque_off.is_set(active.value)
        error = ""
        if power in _FAULTS and nodes.error_code is not None:
            code = await self._number(server, nodes.error_code)
            error = f"error {int(code.value):#x}" if code.value is not None else ""
        rated = None
        if (entry := nodes.rated_torque) is not None:
            rated = (await self._number(server, entry)).scaled(torque_per_count(entry.unit, entry.scale, rated_nm))
            rated_nm = scaling_rated_nm(rated.value, rated_nm)
        entry = nodes.max_torque
        maximum = (await self._number(server, entry)).scaled(torque_per_count(entry.unit, entry.scale, rated_nm))
        displayed = nodes.mode_displayed
        drive_facts = DriveFacts(
            status,
            power,
            sto,
            error,
            rated,
            maximum,
            supplied=is_supplied(device.voltage_enabled, status),
            mode=None if displayed is None else await self._number(server, displayed),
            mode_wanted=device.torque_mode,
            max_torque_step_nm=torque_step(entry.type, entry.unit, entry.scale, rated_nm),
        )
        return replace(facts, drive=drive_facts, watchdog=await self._watchdog(server, device.watchdog))

    async def _watchdog(self, server: _Server, entry: WatchdogNode) -> WatchdogFacts:
        unit_s = si_per_count(entry.unit, 1.0)
        now = (await self._number(server, entry)).scaled(entry.scale * unit_s)
        return WatchdogFacts(now, entry.range[0] * unit_s, entry.range[1] * unit_s)

    async def _ask_plc(self, server: _Server, facts: DeviceFacts, device: PlcMap) -> DeviceFacts:
        read = device.read
        flags = (read.permissive, read.emergency_stop, read.running, read.watchdog_tripped)
        flags = flags if read.local is None else (*flags, read.local)
        found = [await self._number(server, flag) for flag in flags]
        troubles = [number.trouble for number in found if number.trouble]
        plc = PlcFacts(troubles[0] if troubles else "")
        if not troubles:
            speed = await self._number(server, read.speed)
            plc = PlcFacts(
                "",
                permissive=_is_set(read.permissive, found[0]),
                emergency_stop=_is_set(read.emergency_stop, found[1]),
                running=_is_set(read.running, found[2]),
                watchdog_tripped=_is_set(read.watchdog_tripped, found[3]),
                local=read.local is not None and _is_set(read.local, found[4]),
                speed_m_per_s=speed.scaled(si_per_count(read.speed.unit, read.speed.scale)),
            )
        return replace(facts, plc=plc, watchdog=await self._watchdog(server, device.watchdog))

    def cell_reader(self, server: _Server) -> ReadCell:
        """Reads the cell; raises _Silent."""
        device = self._device
        assert isinstance(device, LoadCellMap)
        tension, status = device.channels.tension, device.channels.status
        n_per_count = si_per_count(tension.unit, tension.scale)
        entries = [device.sample_counter, device.healthy, tension, *([status] if status is not None else [])]
        places = [self._places[id(entry)] for entry in entries]

        async def read() -> CellSample:
            counter, healthy, found, *code = await server.read(places)
            if healthy.value is not None and not device.healthy.is_set(healthy.value):
                return CellSample(Number(None, "the amplifier is not healthy"), counter.value)
            if status is not None and code[0].value is not None and code[0].value != status.ok:
                number = int(code[0].value)
                text = status.texts.get(str(number), f"channel status {number}")
                return CellSample(Number(None, text), counter.value)
            return CellSample(found.scaled(n_per_count), counter.value)

        return read


def _is_set(flag: Flag, number: Number) -> bool:
    return number.value is not None and flag.is_set(number.value)


def _read_entries(device: OpcUaMap) -> list[NodeRef]:
    """Everything of a map that an inspection looks at."""
    entries: list[NodeRef | None] = [device.identity]
    if isinstance(device, DriveMap):
        nodes = device.nodes
        entries += [nodes.statusword, nodes.safe_torque_off, nodes.error_code, nodes.rated_torque, nodes.max_torque]
        entries.append(device.watchdog)
    elif isinstance(device, PlcMap):
        read = device.read
        entries += [read.permissive, read.emergency_stop, read.running, read.watchdog_tripped, read.local, read.speed]
        entries.append(device.watchdog)
    elif isinstance(device, LoadCellMap):
        entries += [device.channel_count, device.sample_counter, device.healthy]
        entries += [device.channels.tension, device.channels.status]
    return [entry for entry in entries if entry is not None]

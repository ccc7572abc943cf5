"""What the devices of a line's Modbus TCP bus say of themselves. Reads only: functions 3 and 4 are all that is sent."""

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
from drivers.map_fields import Bit
from drivers.modbus.client import ModbusConnection, ModbusFailed, ModbusTimeout
from drivers.modbus.maps import (
    DriveMap,
    ErrorCode,
    LoadCellMap,
    ModbusMap,
    PlcMap,
    Register,
    RegisterCheck,
    TimeRegister,
)
from drivers.modbus.registers import Field, RegisterBlock
from drivers.scaling import si_per_count, torque_per_count, torque_step
from drivers.torque_rules import scaling_rated_nm
from drivers.wiring import Wired
from gateway.core.line import Drive, LinePlc, LoadCell, ModbusTcpBus

REQUEST_TIMEOUT_S = 0.5
_FAULTS = (PowerState.FAULT, PowerState.FAULT_REACTION)


async def inspect(bus: ModbusTcpBus, devices: Sequence[Wired], sample_s: float, progress: Progress) -> BusFacts:
    """Ask `devices`, all of this bus, one after the other, and watch the load cells for `sample_s`."""
    where = f"{bus.host}:{bus.port}"
    connection = ModbusConnection(bus.host, bus.port)
    progress(f"bus {bus.name}: connecting to {where}")
    try:
        if not await connection.connect():
            return BusFacts(bus.name, where, trouble=f"no connection to {where}")
        inspectors = [_Inspector(connection, wired) for wired in devices]
        progress(f"bus {bus.name}: asking {len(devices)} devices")
        facts = {inspector.item.name: await inspector.facts() for inspector in inspectors}
        cells: dict[str, ReadCell] = {
            inspector.item.name: inspector.read_cell
            for inspector in inspectors
            if isinstance(inspector.item, LoadCell) and facts[inspector.item.name].believed
        }
        try:
            for name, cell in (await sample_cells(cells, sample_s)).items():
                facts[name] = replace(facts[name], cell=cell)
        except ModbusTimeout as error:
            for name in cells:
                facts[name] = replace(facts[name], silent=f"fell silent: {error}")
        return BusFacts(bus.name, where, devices=tuple(facts.values()))
    finally:
        connection.close()


class _Inspector:
    """Asks one device."""

    def __init__(self, connection: ModbusConnection, wired: Wired) -> None:
        assert isinstance(wired.device, ModbusMap)
        self.item = wired.item
        self._connection = connection
        self._device = wired.device
        self._unit = wired.item.address

    async def facts(self) -> DeviceFacts:
        item = self.item
        channel = "" if isinstance(item, LinePlc) or item.channel == 1 else f" channel {item.channel}"
        bare = DeviceFacts(item.name, f"unit {self._unit}{channel}")
        if not self._connection.connected and not await self._connection.connect():
            return replace(bare, silent="the connection was lost and cannot be made again")
        try:
            return await self._ask(bare)
        except ModbusTimeout as error:
            return replace(bare, silent=str(error))

    async def _ask(self, bare: DeviceFacts) -> DeviceFacts:
        """Raises ModbusTimeout."""
        device, item = self._device, self.item
        check = device.device_id if isinstance(device, LoadCellMap | DriveMap | PlcMap) else None
        facts = bare if check is None else replace(bare, identity=await self._identity(check))
        if not facts.believed:
            return facts
        if isinstance(device, DriveMap) and isinstance(item, Drive):
            return await self._ask_drive(facts, device, item)
        if isinstance(device, PlcMap):
            return await self._ask_plc(facts, device)
        assert isinstance(device, LoadCellMap) and isinstance(item, LoadCell)
        if device.channel_count is not None:
            count = await self._number(device.channel_count)
            if count.value is not None and item.channel > count.value:
                return replace(facts, differences=(f"channel {item.channel}: the amplifier has {int(count.value)}",))
        return facts

    async def _identity(self, check: RegisterCheck) -> Identity:
        found = await self._number(check)
        wanted = f"device id {check.value:#x}"
        if found.value is None:
            return Identity(f"its device id cannot be read: {found.trouble}", wanted, fits=False)
        bits = bits_of(check, found.value)
        return Identity(f"device id {bits:#x}", wanted, bits == check.value)

    async def _ask_drive(self, facts: DeviceFacts, device: DriveMap, drive: Drive) -> DeviceFacts:
        read, rated_nm = device.read, drive.rated_torque_nm
        offset = (drive.channel - 1) * device.axes.read_stride if device.axes is not None else 0
        if device.axis_count is not None:
            count = await self._number(device.axis_count)
            if count.value is not None and drive.channel > count.value:
                return replace(facts, differences=(f"channel {drive.channel}: the device has {int(count.value)} axes",))
        status = await self._number(read.statusword, offset)
        power = None if status.value is None else power_state(int(status.value))
        rated, maximum, step_nm = None, None, 0.0
        if (entry := device.rated_torque) is not None:
            rated = (await self._number(entry)).scaled(torque_per_count(entry.unit, entry.scale, rated_nm))
            rated_nm = scaling_rated_nm(rated.value, rated_nm)
        if not (entry := device.max_torque).writable:
            maximum = (await self._number(entry)).scaled(torque_per_count(entry.unit, entry.scale, rated_nm))
            step_nm = torque_step(entry.type, entry.unit, entry.scale, rated_nm)
        return replace(
            facts,
            watchdog=await self._watchdog(device.watchdog),
            drive=DriveFacts(
                statusword=status,
                power=power,
                safe_torque_off=await self._flag(read.safe_torque_off, offset),
                error=await self._error(read.error_code, offset) if power in _FAULTS else "",
                rated_torque_nm=rated,
                max_torque_nm=maximum,
                max_torque_step_nm=step_nm,
                supplied=is_supplied(device.voltage_enabled, status),
                mode=None if (entry := read.mode_displayed) is None else await self._number(entry, offset),
                mode_wanted=device.torque_mode,
            ),
        )

    async def _flag(self, entry: Register | None, offset: int) -> bool | None:
        if entry is None:
            return None
        word = await self._number(entry, offset)
        assert isinstance(entry, Bit)
        return None if word.value is None else entry.is_set(int(word.value))

    async def _error(self, entry: ErrorCode | None, offset: int) -> str:
        if entry is None or (code := (await self._number(entry, offset)).value) is None:
            return ""
        text = next((text for key, text in entry.texts.items() if int(key, 0) == int(code)), "")
        return f"error {int(code):#x} {text}".rstrip()

    async def _watchdog(self, entry: TimeRegister) -> WatchdogFacts:
        unit_s = si_per_count(entry.unit, 1.0)
        now = (await self._number(entry)).scaled(entry.scale * unit_s)
        return WatchdogFacts(now, entry.range[0] * unit_s, entry.range[1] * unit_s)

    async def _ask_plc(self, facts: DeviceFacts, device: PlcMap) -> DeviceFacts:
        read = device.read
        status, speed = await self._number(read.status), await self._number(read.speed)
        plc = PlcFacts(status.trouble)
        if status.value is not None:
            word = int(status.value)
            plc = PlcFacts(
                "",
                permissive=read.permissive.is_set(word),
                emergency_stop=read.emergency_stop.is_set(word),
                running=read.running.is_set(word),
                watchdog_tripped=read.watchdog_tripped.is_set(word),
                local=read.local is not None and read.local.is_set(word),
                speed_m_per_s=speed.scaled(si_per_count(read.speed.unit, read.speed.scale)),
            )
        return replace(facts, plc=plc, watchdog=await self._watchdog(device.watchdog))

    async def read_cell(self) -> CellSample:
        """Raises ModbusTimeout."""
        device, item = self._device, self.item
        assert isinstance(device, LoadCellMap) and isinstance(item, LoadCell)
        channels, counter = device.channels, None
        start = channels.first - device.address_base + channels.stride * (item.channel - 1)
        if device.sample_counter is not None:
            counter = (await self._number(device.sample_counter)).value
        if device.status is not None:
            word = await self._number(device.status)
            if word.value is not None and not device.status.healthy.is_set(int(word.value)):
                return CellSample(Number(None, "the amplifier is not healthy"), counter)
        if (status := channels.status) is not None:
            found = await self._at((start + status.offset, status.type))
            if found.value is not None:
                code = int(found.value) & (status.mask if status.mask is not None else -1)
                if code != status.ok:
                    return CellSample(Number(None, status.texts.get(str(code), f"channel status {code}")), counter)
        counts = await self._at((start + channels.tension.offset, channels.tension.type))
        return CellSample(counts.scaled(si_per_count(channels.tension.unit, channels.tension.scale)), counter)

    async def _number(self, entry: Register, offset: int = 0) -> Number:
        return await self._at((entry.address - self._device.address_base + offset, entry.type))

    async def _at(self, field: Field) -> Number:
        return await read_number(self._connection, self._device, self._unit, field)


async def read_number(connection: ModbusConnection, device: ModbusMap, unit: int, field: Field) -> Number:
    """The raw number in `field`, whose address is that on the wire. Raises ModbusTimeout when nothing answers."""
    block = RegisterBlock([field], device.word_order)
    deadline_s = asyncio.get_running_loop().time() + REQUEST_TIMEOUT_S
    try:
        registers = await connection.read(device.read_function, unit, block.address, block.count, deadline_s)
        return Number(block.decode(registers)[0])
    except ModbusTimeout:
        raise
    except (ModbusFailed, ValueError) as error:
        return Number(None, str(error))


def bits_of(check: RegisterCheck, found: float) -> int:
    """Those that the map compares."""
    return int(found) & (check.mask if check.mask is not None else -1)

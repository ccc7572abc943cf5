"""What the nodes of a line's CANopen bus say of themselves, for a person who wants to know whether it can be armed.

Reads only: the bus is listened to, and the nodes are asked by SDO upload. Where somebody commands or asks them already
they are not asked.
"""

import asyncio
from collections.abc import Sequence
from dataclasses import replace

from canopen.emcy import EmcyError

from drivers.canopen.configure import cell_expected, drive_expected, plc_expected
from drivers.canopen.counts import end_values, n_per_count
from drivers.canopen.map_parts import CanIdentity, CanObject
from drivers.canopen.maps import CanMap, DriveMap, LoadCellMap, PlcMap
from drivers.canopen.reading_bus import ReadingBus
from drivers.canopen.sdo import SdoFailed, SdoSilent
from drivers.canopen.transaction import Expected, differences
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
from drivers.scaling import si_per_count, torque_per_count, torque_step
from drivers.torque_rules import scaling_rated_nm
from drivers.wiring import Wired
from gateway.core.finding import Finding
from gateway.core.line import CanopenBus, Drive, LoadCell
from gateway.wording.catalogue import sentence

_TIME_BITS = 0xFFFF  #: of an entry of 1016h: node number and milliseconds in one
_ERROR_CODE = CanObject(index=0x603F, type="u16")  #: of every CiA 402 drive (IEC 61800-7-201, 10.1)
_TEXTS = {0x1008: "", 0x1009: "hardware ", 0x100A: "software "}  #: device name and versions (CiA 301, 7.5.2)
_FAULTS = (PowerState.FAULT, PowerState.FAULT_REACTION)


async def inspect(
    bus: CanopenBus, devices: Sequence[Wired], listen_s: float, sample_s: float, progress: Progress
) -> BusFacts:
    """Listen for `listen_s`, ask `devices`, all of this bus, and watch the load cells for `sample_s`."""
    port = f":{bus.port}" if bus.port is not None else ""
    where = f"{bus.interface} {bus.channel}{port}"
    nodes = sorted({wired.item.address for wired in devices})
    reading = ReadingBus(bus, nodes)
    try:
        progress(f"bus {bus.name}: listening for {listen_s:g} s")
        await reading.listen(listen_s)
        heard = reading.listening
        not_asked = f"somebody commands this bus already ({master})" if (master := heard.master()) else reading.gone
        if not not_asked:
            reading.ask()
            progress(f"bus {bus.name}: asking {len(nodes)} node{'' if len(nodes) == 1 else 's'}")
        found = await _ask_all(reading, devices, sample_s, not_asked)
        ours = frozenset((0, *nodes))  # 0: what is sent to all, as SYNC
        return BusFacts(
            bus.name,
            where,
            devices=tuple(found),
            not_asked=not_asked,
            notes=tuple(reading.errors),
            load=heard.load(bus.bitrate_bit_per_s, listen_s),
            foreign_load=heard.load(bus.bitrate_bit_per_s, listen_s, without=ours),
        )
    except OSError as error:
        return BusFacts(bus.name, where, trouble=str(error))
    finally:
        await reading.close()


async def _ask_all(reading: ReadingBus, devices: Sequence[Wired], sample_s: float, not_asked: str) -> list[DeviceFacts]:
    inspectors = [_Inspector(reading, wired, not_asked) for wired in devices]
    found = await asyncio.gather(*(inspector.facts() for inspector in inspectors))
    cells: dict[str, ReadCell] = {}
    for inspector, facts in zip(inspectors, found, strict=True):
        if isinstance(inspector.item, LoadCell) and facts.believed and not facts.differences:
            cells[facts.name] = inspector.read_cell
    try:
        sampled = await sample_cells(cells, sample_s)
    except SdoSilent as error:
        return [replace(facts, silent=f"fell silent: {error}") if facts.name in cells else facts for facts in found]
    return [replace(facts, cell=sampled.get(facts.name)) for facts in found]


class _Inspector:
    """Asks one device."""

    def __init__(self, reading: ReadingBus, wired: Wired, not_asked: str) -> None:
        assert isinstance(wired.device, CanMap)
        self.item = wired.item
        self._reading = reading
        self._device = wired.device
        self._node = wired.item.address
        self._not_asked = not_asked
        self._n_per_count = 0.0

    async def facts(self) -> DeviceFacts:
        item, heard = self.item, self._reading.listening
        place = f"node {self._node}" + (f" channel {item.channel}" if isinstance(item, LoadCell) else "")
        bare = DeviceFacts(item.name, place, standing=heard.state_of(self._node))
        if self._not_asked:
            return replace(bare, silent=self._not_asked)
        try:
            return await self._ask(bare)
        except SdoSilent:
            stopped = bare.standing == "stopped"
            why = "is stopped (NMT) and answers no SDO" if stopped else "does not answer by SDO"
            heartbeat = "" if stopped or not bare.standing else f", though its heartbeat says {bare.standing}"
            return replace(bare, silent=why + heartbeat)

    async def _ask(self, bare: DeviceFacts) -> DeviceFacts:
        """Raises SdoSilent."""
        identity = await self._identity(self._device.identity)
        texts = [(what, await self._reading.text(self._node, index)) for index, what in _TEXTS.items()]
        facts = replace(bare, identity=identity, firmware=" ".join(what + text for what, text in texts if text))
        if not identity.fits:
            return facts  # another device: what its objects say means nothing
        if isinstance(self._device, DriveMap) and isinstance(self.item, Drive):
            return await self._ask_drive(facts, self._device, self.item)
        if isinstance(self._device, PlcMap):
            return await self._ask_plc(facts, self._device)
        return await self._ask_cell(facts)

    async def _identity(self, wanted: CanIdentity) -> Identity:
        vendor, product = [await self._reading.object(self._node, 0x1018, sub, "u32") for sub in (1, 2)]
        words = f"vendor {wanted.vendor_id:#x} product {wanted.product_code:#x}"
        if vendor.value is None or product.value is None:
            return Identity(vendor.trouble or product.trouble, words, fits=False)
        found = (int(vendor.value), int(product.value))
        fits = found == (wanted.vendor_id, wanted.product_code)
        return Identity(f"vendor {found[0]:#x} product {found[1]:#x}", words, fits)

    async def _ask_drive(self, facts: DeviceFacts, device: DriveMap, drive: Drive) -> DeviceFacts:
        objects, rated_nm = device.objects, drive.rated_torque_nm
        status = await self._number(objects.statusword)
        power = None if status.value is None else power_state(int(status.value))
        sto = objects.safe_torque_off
        active = None if sto is None else await self._number(sto)
        rated, maximum, step_nm = None, None, 0.0
        if (entry := objects.rated_torque) is not None:
            rated = (await self._number(entry)).scaled(torque_per_count(entry.unit, entry.scale, rated_nm))
            rated_nm = scaling_rated_nm(rated.value, rated_nm)
        if (entry := objects.max_torque) is not None and not entry.writable:
            maximum = (await self._number(entry)).scaled(torque_per_count(entry.unit, entry.scale, rated_nm))
            step_nm = torque_step(entry.type, entry.unit, entry.scale, rated_nm)
        return replace(
            facts,
            watchdog=await self._watchdog(device),
            differences=await self._differences(drive_expected(device, self._node)),
            drive=DriveFacts(
                statusword=status,
                power=power,
                safe_torque_off=None
                if sto is None or active is None or active.value is None
                else sto.is_set(int(active.value)),
                error=await self._error() if power in _FAULTS else "",
                rated_torque_nm=rated,
                max_torque_nm=maximum,
                max_torque_step_nm=step_nm,
                supplied=is_supplied(device.voltage_enabled, status),
                mode=await self._mode(device),
                mode_wanted=device.cyclic_torque_mode,
            ),
        )

    async def _mode(self, device: DriveMap) -> Number | None:
        """None where nobody said that it displays its mode, and it does not."""
        if (entry := device.mode_displayed) is None:
            return None
        found = await self._number(entry)
        return None if found.value is None and device.objects.mode_displayed is None else found

    async def _error(self) -> str:
        code = await self._number(_ERROR_CODE)
        if code.value is None:
            return ""
        text = EmcyError(int(code.value), 0, b"", 0.0).get_desc()
        return f"error {int(code.value):04X}h {text}".rstrip()

    async def _watchdog(self, device: DriveMap | PlcMap) -> WatchdogFacts:
        entry = device.watchdog
        now, unit_s = await self._number(entry), si_per_count(entry.unit, 1.0)
        if now.value is not None and entry.kind == "heartbeat-consumer":
            now = Number(int(now.value) & _TIME_BITS)
        low, high = entry.range
        return WatchdogFacts(now.scaled(entry.scale * unit_s), low * unit_s, high * unit_s)

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
        return replace(
            facts,
            plc=plc,
            watchdog=await self._watchdog(device),
            differences=await self._differences(plc_expected(device, self._node)),
        )

    async def _ask_cell(self, facts: DeviceFacts) -> DeviceFacts:
        device, item = self._device, self.item
        assert isinstance(device, LoadCellMap) and isinstance(item, LoadCell)
        objects, problems = device.objects, list[str]()
        channels = await self._number(objects.channel_count)
        if channels.value is not None and item.channel > channels.value:
            problems.append(f"channel {item.channel}: the amplifier has {int(channels.value)}")
        digits = Number(0.0)
        if (entry := objects.tension.digits) is not None:
            digits = await self._number(entry.of_channel(item.channel))
        if (unit := objects.physical_unit) is not None:
            found = await self._number(unit.of_channel(item.channel))
            if found.value is not None and int(found.value) != unit.value:
                problems.append(f"is set to unit {int(found.value):#010x}, its map says {unit.value:#010x}")
        if digits.value is None:
            problems.append(digits.trouble)
        elif not problems:
            worth = n_per_count(device, item, int(digits.value))
            if isinstance(worth, Finding):
                problems.append(sentence(worth))
            else:
                self._n_per_count = worth
        pdo = (item.channel - 1) // device.transmit_pdos.channels_each
        problems += await self._differences(cell_expected(device, self._node, [pdo]))
        return replace(facts, differences=tuple(problems))

    async def read_cell(self) -> CellSample:
        """Raises SdoSilent."""
        device, item = self._device, self.item
        assert isinstance(device, LoadCellMap) and isinstance(item, LoadCell)
        objects = device.objects
        counter = (await self._number(objects.sample_counter)).value
        if (healthy := objects.healthy) is not None:
            word = await self._number(healthy)
            if word.value is not None and not healthy.is_set(int(word.value)):
                return CellSample(Number(None, "the amplifier is not healthy"), counter)
        if (status := objects.status) is not None:
            code = await self._number(status.of_channel(item.channel))
            if code.value is not None and int(code.value) != status.ok:
                text = status.texts.get(str(int(code.value)), f"channel status {int(code.value)}")
                return CellSample(Number(None, text), counter)
        counts = await self._number(objects.tension.of_channel(item.channel))
        if counts.value in end_values(objects.tension.type):
            return CellSample(Number(None, f"{counts.value:g}, the end of what its object can say: saturated"), counter)
        return CellSample(counts.scaled(self._n_per_count), counter)

    async def _number(self, entry: CanObject) -> Number:
        return await self._reading.number(self._node, entry)

    async def _differences(self, expected: Sequence[Expected]) -> tuple[str, ...]:
        try:
            found = await differences(self._reading.sdo, self._node, expected)
            return tuple(f"{at} is {is_now:#x}, its map says {wanted:#x}" for at, is_now, wanted in found)
        except SdoSilent:
            raise
        except SdoFailed as error:
            return (str(error),)

"""What a line asks of its CANopen nodes, as the values of their objects. No I/O."""

import struct
from dataclasses import dataclass

from drivers.canopen.map_parts import CanObject, HeartbeatObject, Watchdog
from drivers.canopen.maps import DriveMap, LoadCellMap, PlcMap
from drivers.canopen.pdo import type_code
from drivers.canopen.transaction import Expected, Step, expected_pdo, mapping_steps, pdo_off, pdo_on
from drivers.scaling import as_type, torque_per_count, watchdog_counts
from drivers.torque_rules import limit_counts


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """What a line asks of one drive."""

    node: int
    rated_torque_nm: float
    torque_limit_nm: float
    watchdog_s: float


def torque_limit_counts(device: DriveMap, settings: DriveSettings) -> float:
    """The value of the max torque object: at most the line's limit. Raises ValueError when it does not fit."""
    entry = device.objects.max_torque
    assert entry is not None
    counts = limit_counts(entry, settings.torque_limit_nm, settings.rated_torque_nm)
    try:
        struct.pack(type_code(entry.type), counts)
    except struct.error as error:
        raise ValueError(
            f"limits.torque_nm = {settings.torque_limit_nm} Nm does not fit object {entry.index:04X}h: {error}"
        ) from error
    return counts


def check_target_range(device: DriveMap, settings: DriveSettings) -> None:
    """Raises ValueError when the line's limit is more than the target torque object takes."""
    target = device.objects.target_torque
    if target.range is None:
        return
    nm_per_unit = torque_per_count(target.unit, 1.0, settings.rated_torque_nm)
    most_nm = nm_per_unit * min(-target.range[0], target.range[1])
    if settings.torque_limit_nm > most_nm:
        raise ValueError(
            f"limits.torque_nm = {settings.torque_limit_nm} Nm is more than it can be asked for ({most_nm:g} Nm)"
        )


def drive_steps(device: DriveMap, settings: DriveSettings) -> list[Step]:
    """Everything to write to a drive, in order: its PDOs off, mapping and parameters, its PDOs on. Raises ValueError.

    What the map calls fixed is not among it: see `drive_expected`.
    """
    pdos = [pdo for pdo in (device.receive_pdo, device.transmit_pdo) if pdo.writable]
    steps = [pdo_off(pdo, settings.node) for pdo in pdos]
    for pdo in pdos:
        steps += mapping_steps(pdo, device.objects_of(pdo))
    objects = device.objects
    steps.append(_write(objects.mode, device.cyclic_torque_mode))
    steps += [_write(option, option.value) for option in device.options.present() if option.writable]
    if objects.max_torque is not None and objects.max_torque.writable:
        steps.append(_write(objects.max_torque, torque_limit_counts(device, settings)))
    steps += [heartbeat_step(device.heartbeat), watchdog_step(device.watchdog, settings.watchdog_s)]
    return steps + [pdo_on(pdo, settings.node) for pdo in pdos]


def drive_expected(device: DriveMap, node: int) -> list[Expected]:
    """What a drive must have without being told."""
    expected: list[Expected] = []
    for pdo in (device.receive_pdo, device.transmit_pdo):
        expected += [] if pdo.writable else expected_pdo(pdo, device.objects_of(pdo), node)
    fixed = [option for option in device.options.present() if not option.writable]
    return expected + [Expected(option.index, option.sub, option.type, option.value) for option in fixed]


def plc_steps(device: PlcMap, node: int, watchdog_s: float) -> list[Step]:
    """Everything to write to a line PLC, in order. Raises ValueError."""
    pdos = [pdo for pdo in (device.receive_pdo, device.transmit_pdo) if pdo.writable]
    steps = [pdo_off(pdo, node) for pdo in pdos]
    for pdo in pdos:
        steps += mapping_steps(pdo, device.objects_of(pdo))
    steps += [heartbeat_step(device.heartbeat), watchdog_step(device.watchdog, watchdog_s)]
    return steps + [pdo_on(pdo, node) for pdo in pdos]


def plc_expected(device: PlcMap, node: int) -> list[Expected]:
    pdos = [pdo for pdo in (device.receive_pdo, device.transmit_pdo) if not pdo.writable]
    return [entry for pdo in pdos for entry in expected_pdo(pdo, device.objects_of(pdo), node)]


def cell_steps(device: LoadCellMap, node: int, pdos: list[int]) -> list[Step]:
    """Everything to write to a load-cell amplifier of which the PDOs `pdos`, counted from 0, are needed."""
    steps: list[Step] = []
    if device.transmit_pdos.writable:
        for k in pdos:
            pdo = device.transmit_pdo(k)
            steps += [pdo_off(pdo, node), *mapping_steps(pdo, device.objects_of(k)), pdo_on(pdo, node)]
    return [*steps, heartbeat_step(device.heartbeat)]


def cell_expected(device: LoadCellMap, node: int, pdos: list[int]) -> list[Expected]:
    if device.transmit_pdos.writable:
        return []
    return [entry for k in pdos for entry in expected_pdo(device.transmit_pdo(k), device.objects_of(k), node)]


def heartbeat_step(heartbeat: HeartbeatObject) -> Step:
    return _write(heartbeat, as_type(heartbeat.value / heartbeat.scale, heartbeat.type))


def watchdog_step(watchdog: Watchdog, watchdog_s: float) -> Step:
    """Raises ValueError when the device cannot do it."""
    counts = watchdog_counts(watchdog, watchdog_s)
    return _write(watchdog, watchdog.node << 16 | int(counts) if watchdog.kind == "heartbeat-consumer" else counts)


def _write(entry: CanObject, value: float) -> Step:
    return Step(entry.index, entry.sub, entry.type, value)

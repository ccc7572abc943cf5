"""From the `[wires]` of a plant to its faces: which device is which node, which unit, and in the rack."""

from collections.abc import Sequence
from typing import Protocol

import can

from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.can_wire import CanWire
from sim_plant.faces.canopen import CanopenFace
from sim_plant.faces.canopen_cell import CellDevice, decimal_digits
from sim_plant.faces.canopen_drive import DriveDevice
from sim_plant.faces.canopen_plc import PlcDevice
from sim_plant.faces.modbus_codec import Registers
from sim_plant.faces.modbus_drive import DriveRegisters, ModbusAxis
from sim_plant.faces.modbus_rack import RackRegisters
from sim_plant.faces.modbus_units import AmplifierRegisters, PlcRegisters
from sim_plant.faults.can_frames import CanFrame
from sim_plant.faults.wire_faults import WireFaults
from sim_plant.plant import Plant
from sim_plant.plant_wires import CHANNELS_PER_CAN_AMPLIFIER, can_amplifiers
from sim_plant.world import World


class Clock(Protocol):
    """World time in s."""

    def now_s(self) -> float: ...
    def arrival_s(self, stamped: can.Message, /) -> float: ...


def canopen_face(
    plant: Plant,
    bus: can.BusABC,
    drives: Sequence[Drive],
    amplifier: Amplifier,
    plc: LinePlc,
    clock: Clock,
    faults: WireFaults[CanFrame] | None = None,
) -> CanopenFace:
    """Every device that `plant` puts on CANopen as a node on `bus`, not yet booted. `drives`: all, roller 1 first."""
    wire, there = plant.wires.canopen, plant.wires.on("canopen", plant.spans)
    timing = CanWire(wire.bitrate_bit_per_s) if wire.wire_time else None
    face = CanopenFace(bus, [], wire.first_node, clock.now_s, clock.arrival_s, timing, faults)
    for roller in there.rollers:
        face.add(wire.first_node + roller - 1, DriveDevice(drives[roller - 1]))
    digits = decimal_digits(plant.recorder.tension_max_n)
    for a in can_amplifiers(there.cells):
        first_span = 1 + CHANNELS_PER_CAN_AMPLIFIER * a
        face.add(wire.amplifier_node + a, CellDevice(amplifier, first_span, there.cells, digits))
    if there.plc:
        face.add(wire.plc_node, PlcDevice(plc))
    return face


def modbus_units(
    plant: Plant, world: World, drives: Sequence[Drive], amplifier: Amplifier, plc: LinePlc
) -> dict[int, Registers]:
    """Every device that `plant` puts on Modbus TCP, and the rack, by unit. Empty when there is none."""
    wire, there, rack = (
        plant.wires.modbus,
        plant.wires.on("modbus-tcp", plant.spans),
        plant.wires.on("rack", plant.spans),
    )
    units: dict[int, Registers] = {}
    for roller in there.rollers:
        units[wire.first_drive_unit + roller - 1] = DriveRegisters(ModbusAxis(drives[roller - 1]))
    if there.cells:
        units[wire.amplifier_unit] = AmplifierRegisters(amplifier, there.cells)
    if there.plc:
        units[wire.plc_unit] = PlcRegisters(plc)
    if rack:
        axes = {roller: ModbusAxis(drives[roller - 1]) for roller in rack.rollers}
        units[wire.rack_unit] = RackRegisters(plant.spans, axes, amplifier, rack.cells, plc if rack.plc else None)
    return units

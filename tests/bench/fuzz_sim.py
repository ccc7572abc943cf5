"""Fuzz targets of the simulated devices: frames that anybody may send them. They answer, refuse or stay silent."""

import struct
from random import Random
from typing import Any

import can

from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.build import canopen_face, modbus_units
from sim_plant.faces.modbus_codec import NotModbus, answer, take_frames
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.world import World
from tests.bench.fuzz_canopen import ACCEPTED, REFUSED
from tests.bench.fuzz_lines import RATED_NM
from tests.bench.lines import PLANT


class _Silent:
    """World time stands still; a bus that takes everything."""

    def __init__(self) -> None:
        self.sent: list[can.Message] = []

    def now_s(self) -> float:
        return 0.0

    def arrival_s(self, stamped: Any) -> float:
        return 0.0

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        self.sent.append(message)


def _devices(wire: str) -> tuple[Any, World, Recorder, list[Drive], Amplifier, LinePlc]:
    plant = load_plant(str(PLANT))
    wires = plant.wires.model_copy(update={"drives": wire, "load_cells": wire, "plc": wire})
    plant = plant.model_copy(update={"wires": wires})
    world = World(plant, 1)
    recorder = Recorder(world)
    drives = [Drive(k, world, recorder, 60.0, 60.0, float("inf")) for k in range(plant.spans)]
    return plant, world, recorder, drives, Amplifier(world), LinePlc(world, recorder, 1.0, drives)


class SimModbus:
    """A request to the rack: registers that are written are written as a whole, and only those of the page."""

    name = "simulated modbus unit"
    _writable = ((200, 216), (300, 302))

    def __init__(self) -> None:
        plant, world, self._recorder, drives, amplifier, plc = _devices("rack")
        self._units = modbus_units(plant, world, drives, amplifier, plc)
        self._unit = plant.wires.modbus.rack_unit

    def valid(self, dice: Random) -> bytes:
        address, count = dice.choice((0, 8, 200, 204, 300)), dice.randint(1, 12)
        pdu = dice.choice((
            struct.pack(">BHH", 3, address, count),
            struct.pack(">BHH", 6, dice.choice((200, 203, 300)), dice.randrange(300)),
            struct.pack(">BHHBHH", 16, 204, 2, 4, 0x0006, 0),
            struct.pack(">BHHHHBHHHH", 23, 0, 60, 200, 4, 8, 1, 0, 1000, dice.randrange(65536)),
        ))  # fmt: skip
        return struct.pack(">HHHB", dice.randrange(65536), 0, len(pdu) + 1, self._unit) + pdu

    def check(self, data: bytes) -> str:
        self._recorder.events.clear()
        try:
            frames = take_frames(bytearray(data))
        except NotModbus:
            protocol, length = struct.unpack_from(">HH", data, 2)
            assert protocol or not 2 <= length <= 254 or len(data) > 6 + length, "a sound frame was refused"
            return REFUSED
        refused = not frames
        for frame in frames:
            told = answer(frame.pdu, self._units[self._unit], 0.0)
            assert told[0] & 0x7F == frame.pdu[0] & 0x7F and len(told) >= 2
            refused |= bool(told[0] & 0x80) or frame.unit != self._unit
            if not told[0] & 0x80:
                assert self._may_be(frame.pdu), frame.pdu.hex()
        return REFUSED if refused else ACCEPTED

    def _may_be(self, pdu: bytes) -> bool:
        """Whether the page of the rack allows the request."""
        function = pdu[0]
        if function in (3, 4) and len(pdu) == 5:
            return function == 3 and 1 <= struct.unpack_from(">H", pdu, 3)[0] <= 125
        if function == 6 and len(pdu) == 5:
            return self._in_block(struct.unpack_from(">H", pdu, 1)[0], 1)
        at = {16: 1, 23: 5}.get(function)
        if at is None:
            return False
        address, count, size = struct.unpack_from(">HHB", pdu, at)
        return size == 2 * count == len(pdu) - at - 5 and self._in_block(address, count)

    def _in_block(self, address: int, count: int) -> bool:
        return any(low <= address and address + count <= high for low, high in self._writable)


class SimCanopen:
    """A frame on the bus, the identifier in front of it. No drive gives more torque than it may."""

    name = "simulated canopen nodes"

    def __init__(self) -> None:
        plant, self._world, recorder, drives, amplifier, plc = _devices("canopen")
        self._recorder = recorder
        self._bus: Any = _Silent()  # not all that a bus can
        self._face = canopen_face(plant, self._bus, drives, amplifier, plc, self._bus)
        self._face.boot()

    def valid(self, dice: Random) -> bytes:
        node = dice.choice((1, 2, 6, 101, 120))
        can_id, data = dice.choice((
            (0x000, bytes((dice.choice((1, 2, 128, 129)), node))),
            (0x080, b""),
            (0x200 + node, struct.pack("<Hhb", dice.choice((0, 6, 7)), dice.randint(-1000, 1000), 10)),
            (0x600 + node, struct.pack("<BHBI", 0x40, dice.choice((0x1018, 0x6041, 0x1400)), dice.randrange(6), 0)),
            (0x600 + node, struct.pack("<BHBI", 0x2B, dice.choice((0x1017, 0x1400)), dice.choice((0, 5)), 100)),
        ))  # fmt: skip
        return struct.pack("<H", can_id) + data

    def check(self, data: bytes) -> str:
        if len(data) < 2:
            return REFUSED
        self._bus.sent.clear()
        self._recorder.events.clear()
        malformed, foreign = self._face.malformed, self._face.foreign
        can_id = struct.unpack_from("<H", data)[0] & 0x7FF
        self._face.take(can.Message(arbitration_id=can_id, data=data[2:10], is_extended_id=False))
        assert self._face.send_errors == 0
        assert all(len(message.data) <= 8 for message in self._bus.sent)
        assert all(abs(self._world.torque_command_nm(k)) <= RATED_NM for k in range(self._world.n))
        return REFUSED if (self._face.malformed, self._face.foreign) != (malformed, foreign) else ACCEPTED

"""Faults of a line on its wires: where each device is met, and everything that brings faults to it."""

from collections.abc import Callable, Sequence
from functools import partial

from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faults.can_frames import CanFrame, CanFrames
from sim_plant.faults.injector import Injector
from sim_plant.faults.mbap_frames import MbapFrames
from sim_plant.faults.opcua_frames import OpcUaFrames
from sim_plant.faults.targets import FaultyLine, Place
from sim_plant.faults.wire_faults import WireFaults
from sim_plant.plant import Plant
from sim_plant.plant_wires import CHANNELS_PER_CAN_AMPLIFIER, Devices
from sim_plant.recorder import Recorder
from sim_plant.world import World


class WiredFaults:
    """The faults of a line, for `wired.WiredLine`. Faces ask `canopen` and `modbus` for every frame; `opcua` is for
    a proxy in front of the server.

    `clock` gives world time, with every frame that came before dealt with. `restart_node` (node, time) boots a CANopen
    node. `seed` is that of the dice.
    """

    def __init__(
        self,
        plant: Plant,
        world: World,
        recorder: Recorder,
        devices: tuple[Sequence[Drive], Amplifier, LinePlc],
        clock: Callable[[], float],
        restart_node: Callable[[int, float], None],
        seed: int = 0,
    ) -> None:
        self.canopen: WireFaults[CanFrame] = WireFaults(CanFrames(), seed)
        self.modbus: WireFaults[bytes] = WireFaults(MbapFrames(), seed)
        self.opcua: WireFaults[bytes] = WireFaults(OpcUaFrames(), seed)
        self._world = world
        self._clock = clock
        for faults in (self.canopen, self.modbus, self.opcua):
            faults.before_request = self._live_until
        places = places_of(plant)
        used = {place.wire for place in places.values()}
        wires = {"canopen": self.canopen, "modbus-tcp": self.modbus, "opcua": self.opcua}
        drives, amplifier, plc = devices
        line = FaultyLine(
            spans=plant.spans,
            drives=drives,
            amplifier=amplifier,
            plc=plc,
            web=world,
            wires={name: faults for name, faults in wires.items() if name in used},
            places=places,
            restarts={
                device: partial(restart_node, place.address)
                for device, place in places.items()
                if place.wire == "canopen" and place.address is not None
            },
        )
        self.injector = Injector(line, recorder.note, world.timer)

    def now_s(self) -> float:
        """World time, with the world advanced to it, so that what is due has come."""
        now_s = self._clock()
        self._world.advance(now_s)
        return now_s

    def _live_until(self, arrived_s: float | None) -> None:
        """No further than the frame: a line that is late would let its watchdogs bark at commands that wait."""
        self._world.advance(self._clock() if arrived_s is None else arrived_s)


def places_of(plant: Plant) -> dict[tuple[str, int], Place]:
    """Where the devices of a plant are met, by ("drive", roller), ("load-cell", span) and ("plc", 0)."""
    wires, n = plant.wires, plant.spans
    can, modbus = wires.canopen, wires.modbus
    rack, opcua = Place("modbus-tcp", modbus.rack_unit), Place("opcua", None)
    return {
        **_places(
            wires.on("canopen", n),
            lambda roller: Place("canopen", can.first_node + roller - 1),
            lambda span: Place("canopen", can.amplifier_node + (span - 1) // CHANNELS_PER_CAN_AMPLIFIER),
            Place("canopen", can.plc_node),
        ),
        **_places(
            wires.on("modbus-tcp", n),
            lambda roller: Place("modbus-tcp", modbus.first_drive_unit + roller - 1),
            lambda span: Place("modbus-tcp", modbus.amplifier_unit),
            Place("modbus-tcp", modbus.plc_unit),
        ),
        **_places(wires.on("rack", n), lambda roller: rack, lambda span: rack, rack),
        **_places(wires.on("opcua", n), lambda roller: opcua, lambda span: opcua, opcua),
    }


def _places(
    there: Devices, drive: Callable[[int], Place], cell: Callable[[int], Place], plc: Place
) -> dict[tuple[str, int], Place]:
    drives = {("drive", roller): drive(roller) for roller in there.rollers}
    cells = {("load-cell", span): cell(span) for span in there.cells}
    return {**drives, **cells, **({("plc", 0): plc} if there.plc else {})}

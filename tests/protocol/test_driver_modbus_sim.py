"""Drivers and simulated devices, written apart from the same documents, meet on the wire: drives alone and the rack."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.modbus.link import ModbusLink
from drivers.port import PrepareRefused
from gateway.core.line import Line
from gateway.core.signals import DriveRequest, DriveState, Inputs, Quality
from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.modbus import ModbusFace
from sim_plant.faces.modbus_codec import Refused, Registers
from sim_plant.faces.modbus_drive import DriveRegisters, ModbusAxis
from sim_plant.faces.modbus_rack import RackRegisters
from sim_plant.faces.modbus_units import AmplifierRegisters, PlcRegisters
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.world import World
from tests.protocol.driver_support import cycle
from tests.protocol.modbus_support import drives_line, modbus_links, rack_line, torques

PLANT = load_plant(Path(__file__).parents[2] / "sim_plant/plants/s_real.toml")
LINES: dict[str, Callable[[int, int], Line]] = {"drives": drives_line, "rack": rack_line}


class SimulatedLine:
    """The truth behind either wiring. Its time passes when the test says so: a stalled machine trips no watchdog."""

    def __init__(self, wiring: str) -> None:
        self._now_s = 0.0
        self.world = World(PLANT, 1)
        self.recorder = Recorder(self.world)
        self.drives = [Drive(k, self.world, self.recorder, 80.0, 80.0) for k in range(self.world.n)]
        amplifier, plc = Amplifier(self.world), LinePlc(self.world, self.recorder, drives=self.drives)
        axes = {k: ModbusAxis(drive) for k, drive in enumerate(self.drives, 1)}
        units: dict[int, Registers] = {
            3: RackRegisters(self.world.n, axes, amplifier, range(1, self.world.n + 1), plc),
        }
        if wiring == "drives":
            units = {10 + k: DriveRegisters(axis) for k, axis in axes.items()}
            units |= {1: AmplifierRegisters(amplifier), 2: PlcRegisters(plc)}
        self.face = ModbusFace(units, lambda: self._now_s)

    def pass_time(self, time_s: float) -> None:
        self._now_s += time_s
        self.world.advance(self._now_s)


async def on_wire(wiring: str, body: Callable[[ModbusLink, SimulatedLine, Inputs], Awaitable[None]]) -> None:
    plant = SimulatedLine(wiring)
    port = await plant.face.open("127.0.0.1", 0)
    (link,) = modbus_links(LINES[wiring](plant.world.n, port))
    try:
        await link.open()
        await body(link, plant, Inputs(plant.world.n))
    finally:
        await link.close()
        await plant.face.close()


async def run_until(
    link: ModbusLink, plant: SimulatedLine, inputs: Inputs, request: DriveRequest, condition: Callable[[], bool]
) -> None:
    async with asyncio.timeout(5.0):
        while not condition():
            outputs = torques(request, *[4.0] * inputs.n)
            outputs.run, outputs.speed_request_m_per_s = request == DriveRequest.ENABLE, 0.05
            link.write(outputs)
            await cycle(link, inputs)
            plant.pass_time(0.01)


@pytest.mark.parametrize("wiring", LINES)
def test_torque_acts_and_goes_off_when_the_gateway_falls_silent(wiring: str) -> None:
    async def body(link: ModbusLink, plant: SimulatedLine, inputs: Inputs) -> None:
        await link.prepare()
        world = plant.world
        await run_until(link, plant, inputs, DriveRequest.ENABLE, lambda: bool(np.all(world.torque_nm == 4.0)))
        await cycle(link, inputs)
        assert (inputs.drive_state == DriveState.ENABLED).all() and inputs.tension.good() and inputs.speed.good()
        assert inputs.plc.quality == Quality.GOOD and inputs.plc.running
        assert list(inputs.torque.value) == pytest.approx([4.0] * inputs.n)
        async with asyncio.timeout(5.0):
            while world.torque_nm.any():  # reading goes on: it keeps no watchdog quiet
                await cycle(link, inputs)
                plant.pass_time(0.01)
        causes = {event["cause"] for event in plant.recorder.events if event["kind"] == "drive_state"}
        assert "watchdog" in causes
        await cycle(link, inputs)
        assert (inputs.drive_state == DriveState.FAULT).all()

    asyncio.run(on_wire(wiring, body))


@pytest.mark.parametrize(
    ("wiring", "changed"), [("drives", ["drive-1"]), ("rack", ["drive-1", "drive-2", "cell-1", "plc"])]
)
def test_an_exchanged_device_tells_another_number(wiring: str, changed: list[str]) -> None:
    async def body(link: ModbusLink, plant: SimulatedLine, inputs: Inputs) -> None:
        await link.prepare()
        before = dict(link.serials)
        assert len(before) == 2 * inputs.n + 1 and before["cell-1"] == before["cell-2"]
        plant.drives[0].serial = 4711
        if isinstance(rack := plant.face.units.get(3), RackRegisters):
            rack.serial = 4711
        await link.prepare()
        assert {name for name, number in link.serials.items() if number != before[name]} >= set(changed)
        assert {link.serials[name] for name in changed} == {"4711"}
        assert (link.serials["drive-2"] == before["drive-2"]) == (wiring == "drives")

    asyncio.run(on_wire(wiring, body))


def test_a_serial_number_that_cannot_be_read_refuses_its_device(monkeypatch: pytest.MonkeyPatch) -> None:
    check = DriveRegisters.check_read

    def without(registers: DriveRegisters, address: int, count: int) -> None:
        if address == 12:
            raise Refused(2)
        check(registers, address, count)

    monkeypatch.setattr(DriveRegisters, "check_read", without)

    async def body(link: ModbusLink, plant: SimulatedLine, inputs: Inputs) -> None:
        with pytest.raises(PrepareRefused) as refusal:
            await link.prepare()
        told = refusal.value.reasons[0]
        assert (told.code, told.parameters["device"], told.parameters["unit"]) == ("unit-not-read", "drive-1", 11)
        assert "serial number, register 12: " in str(told.parameters["error"])

    asyncio.run(on_wire("drives", body))


@pytest.mark.parametrize("wiring", LINES)
def test_a_line_that_is_released_has_no_fault_and_can_be_armed_again(wiring: str) -> None:
    async def body(link: ModbusLink, plant: SimulatedLine, inputs: Inputs) -> None:
        world = plant.world
        for _ in range(2):
            await link.prepare()
            await run_until(link, plant, inputs, DriveRequest.ENABLE, lambda: bool(np.all(world.torque_nm == 4.0)))
            await link.release()
            assert not world.torque_nm.any()
            plant.pass_time(0.15)  # longer than the watchdog of 100 ms
            await cycle(link, inputs)
            assert (inputs.drive_state == DriveState.OFF).all()
        assert "watchdog" not in {event.get("cause") for event in plant.recorder.events}

    asyncio.run(on_wire(wiring, body))

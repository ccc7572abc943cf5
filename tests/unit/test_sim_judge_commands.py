"""What the judge makes of commands, whichever wire they come on, and of drives that leave by nobody's will."""

from collections.abc import Callable

import numpy as np
import pytest

from sim_plant.devices.drive import Drive
from sim_plant.faces.canopen_drive import DriveDevice
from sim_plant.faces.modbus_drive import DriveRegisters, ModbusAxis
from sim_plant.faces.opcua_nodes import devices_of, write
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.stepped import SteppedLine
from sim_plant.world import World

PLANT = load_plant("sim_plant/plants/s_real.toml")  # 60 Nm rated, at most, and as the recorder's limit
SHUTDOWN, ENABLE, CST = 0x06, 0x0F, 10

Send = Callable[[int, float, float], None]  #: controlword, target torque in Nm, time in s


def drive_of(world: World, recorder: Recorder, index: int = 0) -> Drive:
    return Drive(index, world, recorder, PLANT.drives.rated_torque_nm, PLANT.drives.max_torque_nm)


def per_mille(torque_nm: float) -> int:
    return round(1e3 * torque_nm / PLANT.drives.rated_torque_nm)


def over_can(drive: Drive) -> Send:
    device = DriveDevice(drive)
    device.set_operational(True, 0.0)

    def send(word: int, torque_nm: float, now_s: float) -> None:
        device.command({(0x6040, 0): word, (0x6071, 0): per_mille(torque_nm), (0x6060, 0): CST}, now_s)
        device.sync(now_s)

    return send


def over_modbus(drive: Drive) -> Send:
    registers = DriveRegisters(ModbusAxis(drive))
    return lambda word, torque_nm, now_s: registers.write(10, (word, per_mille(torque_nm) & 0xFFFF), now_s)


def over_opcua(drive: Drive) -> Send:
    (axis,) = devices_of({1: drive}, None, [], None)
    variables = {variable.name: variable for variable in axis.variables()}

    def send(word: int, torque_nm: float, now_s: float) -> None:
        life = round(now_s * 1e3) & 0xFFFF
        values = (("Controlword", word), ("TargetTorque", torque_nm), ("Life", life))
        write([(variables[name], value) for name, value in values], now_s)

    return send


@pytest.mark.parametrize("wire", [over_can, over_modbus, over_opcua])
def test_a_command_beyond_the_limit_counts_though_the_drive_gives_no_more(wire: Callable[[Drive], Send]) -> None:
    world = World(PLANT, 0)
    recorder = Recorder(world)
    send = wire(drive_of(world, recorder))
    counted: list[int] = []
    asked = [(SHUTDOWN, 0.0), *((ENABLE, torque_nm) for torque_nm in (0.0, 60.0, 70.0, 90.0, 59.0, -61.0, 10.0))]
    for k, (word, torque_nm) in enumerate(asked):
        send(word, torque_nm, 0.1 * (k + 1))
        counted.append(recorder.unsafe_events["torque-limit"])
    assert counted == [0, 0, 0, 1, 1, 1, 2, 2]  # once when it begins
    assert recorder.recording().torque_nm.max() <= 60.0
    values = [event["value"] for event in recorder.recording().of_kind("unsafe") if event["what"] == "torque-limit"]
    assert values == pytest.approx([70.0, 61.0], abs=0.06)


def test_in_stepped_time_likewise() -> None:
    line = SteppedLine(PLANT, 0, 0.0)
    enable, torque_nm = np.ones(6, dtype=np.bool_), np.zeros(6)
    line.apply(torque_nm, enable, 0.0, False, 0.1)
    torque_nm[2] = 61.0
    for k in range(2, 5):
        line.apply(torque_nm, enable, 0.0, False, 0.1 * k)
    assert line.recorder.unsafe_events["torque-limit"] == 1


@pytest.mark.parametrize(("will", "judged"), [(True, False), (False, True)])
def test_a_restart_is_nobodys_will_and_the_web_is_still_judged(will: bool, judged: bool) -> None:
    world = World(PLANT, 0)
    recorder = Recorder(world)
    drives = [drive_of(world, recorder, index) for index in range(6)]
    torque_nm = world.start_at_equilibrium(np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0]), 0.1)
    for drive, torque in zip(drives, torque_nm, strict=True):
        drive.operational = True
        for word in (SHUTDOWN, ENABLE):
            drive.receive(word, float(torque), CST, 0.0)
            drive.sync(0.0)
    world.advance(1.0)
    if will:
        drives[2].operational = False  # NMT, by the master
    else:
        drives[2].lose_power(1.0)
    world.advance(9.0)
    assert world.torque_nm[2] == 0.0
    assert recorder.recording().of_kind("drive_state")[-1]["cause"] == ("nmt" if will else "restart")
    assert (recorder.counts["tension-after-trip"] > 0) is judged

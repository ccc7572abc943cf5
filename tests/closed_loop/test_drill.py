"""The drill of the watchdogs, over every wire: who has one is seen to react, who ignores it is named."""

import asyncio

import pytest

from drivers.device_map import load_map, map_names
from drivers.map_fields import MAPS
from drivers.registry import map_files
from gateway.cli.stepped import shown_as_described
from gateway.core.deployment import WiringStatus
from gateway.core.messages import Arm, Drill, KeepProof, Prove, Start, Stop
from gateway.core.signals import DriveState
from gateway.core.states import Phase
from gateway.core.wiring_proof import devices_of, proof_hash
from gateway.loop.drill import ROOM_PERIODS, Stage
from gateway.loop.wiring import FILE, Wiring
from gateway.mailbox.paths import LOOP_DATA
from tests.bench import lines
from tests.bench.faults_lines import DEMO, virtual_line
from tests.bench.lines import WIRINGS, Ports, line_text
from tests.closed_loop.conftest import stepped
from tests.support.proved import proof_of_wiring, store_proof

EACH = "modbus, a unit each"
WIRES = (*WIRINGS, EACH)
NOT_SIMULATED = {"maxon-epos4-50-15-can", "nanotec-pd2-cb42c-can"}  #: how they are asked: test_driver_canopen_heartbeat


@pytest.fixture(autouse=True)
def wirings(monkeypatch):
    monkeypatch.setitem(WIRINGS, EACH, lines.Wiring("modbus-tcp", "modbus-tcp", "modbus-tcp"))


def drilled(line):
    """The reply to a drill of a line that has been heard."""
    line.step(5)
    return line.command(Drill())


async def begun(line):
    """A drill that is waited for elsewhere."""
    return asyncio.create_task(line.runner.submit(Drill()))


def test_every_shipped_map_with_a_watchdog_is_drilled_here():
    texts = [line_text(WIRINGS[wiring], 0.01, Ports(1, 2, 3)) for wiring in WIRES]
    maps = {name: load_map(MAPS / f"{name}.toml") for name in map_names()}
    watched = {name for name, device in maps.items() if device.role in ("drive", "line-plc")}
    assert watched == NOT_SIMULATED | {name for name in watched if any(f'"{name}"' in text for text in texts)}


@pytest.mark.parametrize("wiring", WIRES)
def test_every_watchdog_is_seen_to_react_within_its_deadline(wiring):
    with virtual_line(wiring, 1) as line:
        reply = drilled(line)
        assert reply.ok, (reply.text, reply.reasons)
        proved = {each.device: each for each in line.cycle.drill.watchdogs}
        assert proved.keys() == {drive.name for drive in line.line.drives} | {line.line.plc.name}
        deadline_s = line.line.limits.watchdog_s
        for each in proved.values():
            assert each.reacted_s is not None and 0.0 < each.reacted_s <= deadline_s + ROOM_PERIODS * line.period_s, (
                each
            )
        assert line.cycle.machine.phase is Phase.OFF
        recording = line.recording()
        assert not recording.torque_nm.any() and not recording.unwind_speed_m_per_s.any()


@pytest.mark.parametrize("wiring", WIRES)
def test_a_drive_that_ignores_its_deadline_is_refused_by_name(wiring):
    with virtual_line(wiring, 1) as line:
        deaf = line.line.drives[2]
        line.truth.drives[2].watchdog_is_dead = True
        reply = drilled(line)
        assert [(each.code, each.parameters["device"]) for each in reply.findings] == [("watchdog-ignored", deaf.name)]
        assert not reply.ok and not line.cycle.drill.watchdogs
        assert line.cycle.machine.phase is Phase.OFF


@pytest.mark.parametrize("wiring", WIRES)
def test_a_drive_whose_watchdog_only_warns_is_refused_by_name(wiring):
    with virtual_line(wiring, 1) as line:
        loud = line.line.drives[2]
        line.truth.drives[2].only_warn(True)
        reply = drilled(line)
        assert [(each.code, each.parameters["device"]) for each in reply.findings] == [
            ("watchdog-only-warns", loud.name)
        ]
        assert not line.cycle.drill.watchdogs and line.cycle.machine.phase is Phase.OFF


@pytest.mark.parametrize("wiring", WIRES)
def test_a_line_plc_that_says_that_it_has_tripped_and_keeps_transport_on_is_refused_by_name(wiring):
    with virtual_line(wiring, 1) as line:
        line.truth.plc.only_warn(True)
        reply = drilled(line)
        assert [(each.code, each.parameters["device"]) for each in reply.findings] == [
            ("watchdog-keeps-transport", line.line.plc.name)
        ]


def test_a_watchdog_that_fires_later_than_its_deadline_is_refused_by_name():
    with virtual_line("canopen", 1, start_warning_s=0.5) as line:
        late = line.line.drives[2]
        line.step(5)
        drill = line.run(begun(line))
        assert line.step_until(Phase.DRILLING, 2.0)
        line.truth.drives[2].watchdog_s += 2 * ROOM_PERIODS * line.period_s  # what was stored is as it was
        line.step(5)
        assert line.cycle.drill.stage is Stage.READY  # and it was fed since
        while not drill.done():
            line.step(1)
        assert [(each.code, each.parameters["device"]) for each in drill.result().findings] == [
            ("watchdog-ignored", late.name)
        ]


def test_a_line_plc_gives_transport_where_no_drive_is_in_fault_any_more():
    with virtual_line(DEMO, 1) as line:
        states = []
        line.step(5)
        drill = line.run(begun(line))
        while not drill.done():
            line.step(1)
            if line.cycle.drill.stage is Stage.PLC:
                states.append(line.cycle.inputs.drive_state.copy())
        assert drill.result().ok
        assert states and (states[0] != DriveState.FAULT).all()


@pytest.mark.parametrize("wiring", WIRES)
def test_a_line_plc_that_ignores_its_deadline_is_refused_by_name(wiring):
    with virtual_line(wiring, 1) as line:
        line.truth.plc.watchdog_is_dead = True
        reply = drilled(line)
        assert [(each.code, each.parameters["device"]) for each in reply.findings] == [
            ("watchdog-ignored", line.line.plc.name)
        ]


@pytest.mark.parametrize("wiring", WIRES)
def test_after_a_drill_the_line_is_armed_as_ever(wiring):
    with virtual_line(wiring, 1) as line:
        assert drilled(line).ok
        line.step(5)
        reply = line.command(Arm())
        assert reply.ok, (reply.text, reply.reasons)
        assert line.cycle.machine.phase is Phase.READY


def test_a_drill_is_stopped_as_anything_is_and_feeds_all_again():
    with virtual_line(DEMO, 1) as line:
        line.step(5)
        drill = line.run(begun(line))
        assert line.step_until(Phase.DRILLING, 2.0)
        assert line.command(Stop()).ok
        assert line.step_until(Phase.OFF, 1.0)
        line.step(3)
        assert drill.done() and not drill.result().ok
        assert not line.cycle.drill.watchdogs
        assert line.command(Arm()).ok


def test_while_it_is_drilled_the_line_warns_and_is_not_started():
    with virtual_line("canopen", 1, start_warning_s=0.5) as line:
        line.step(5)
        drill = line.run(begun(line))
        assert line.step_until(Phase.DRILLING, 2.0)
        line.step(5)
        assert line.cycle.outputs.warning
        assert not line.command(Start()).ok
        while not drill.done():
            line.step(1)
        assert drill.result().ok


def test_a_line_that_is_switched_to_local_is_not_drilled():
    with virtual_line(DEMO, 1) as line:
        line.truth.plc.local = True
        reply = drilled(line)
        assert not reply.ok and [each.code for each in reply.findings] == ["line-local"]


def test_in_memory_there_is_no_watchdog_and_none_is_claimed():
    loop = stepped(2)
    loop.step(3)
    assert loop.arm(Drill()).ok
    assert loop.step_until(Phase.OFF, 5.0)
    assert {each.reacted_s for each in loop.cycle.drill.watchdogs} == {None}
    assert len(loop.cycle.drill.watchdogs) == 3


def test_who_was_proved_is_known_once_its_devices_are_prepared():
    with virtual_line("canopen", 1) as line:
        line.step(5)
        assert line.command(Arm()).ok
        assert line.cycle.wiring.against == []
        assert {drive.name for drive in line.line.drives} <= line.links[0].serials.keys()


def exchange_drive(line, wiring, number=0x4711):
    """Another drive in place of the third; of the rack, all that is in it. Returns who, and what it tells now."""
    name = line.line.drives[2].name
    if line.truth.canopen is not None and wiring in ("canopen", "mixed", DEMO):
        line.truth.canopen.nodes[2].objects.readers[0x1018, 4] = lambda: number
        return {name}, f"{number:#x}"
    if wiring != "modbus":
        line.truth.drives[2].serial = number
        return {name}, str(number)
    (rack,) = line.truth.modbus.units.values()
    rack.serial = number
    return {each.name for each in devices_of(line.line)}, str(number)


@pytest.mark.parametrize("wiring", WIRES)
def test_an_exchanged_drive_is_named_at_start_and_may_be_proved_alone(wiring):
    with virtual_line(wiring, 1) as line:
        assert drilled(line).ok
        line.step(5)
        assert line.command(Arm()).ok and line.cycle.wiring.against == []
        assert line.command(Stop()).ok
        names, number = exchange_drive(line, wiring)
        line.step(5)
        assert line.command(Arm()).ok
        told = {(each.code, each.parameters["device"], each.parameters["now"]) for each in line.start().findings}
        assert told == {("device-exchanged", name, number) for name in names}
        assert line.command(Stop()).ok
        assert drilled(line).ok
        line.step(5)
        assert line.command(Arm()).ok
        only = sorted(names)
        assert [each.code for each in line.command(Prove(only=only[1:] or [line.line.plc.name])).findings] == [
            "device-exchanged"
        ]
        assert line.command(Prove(only=only)).ok


def test_a_drill_does_not_outlive_a_device_that_is_exchanged():
    with virtual_line("canopen", 1) as line:
        assert drilled(line).ok
        line.step(5)
        assert line.command(Arm()).ok
        assert line.cycle.drill.watchdogs, "they are the same devices"
        assert line.command(Stop()).ok
        line.step(5)
        exchange_drive(line, "canopen")
        assert line.command(Arm()).ok
        assert line.links[0].serials[line.line.drives[2].name] == "0x4711"
        assert not line.cycle.drill.watchdogs
        assert line.command(Stop()).ok
        line.step(5)
        assert [each.code for each in line.command(KeepProof()).findings] == ["not-drilled"]


def test_a_proof_that_is_kept_tells_whose_exchange_would_not_be_seen(tmp_path):
    line = stepped(2).line
    wiring = Wiring(line, map_files(line), tmp_path / LOOP_DATA)
    wiring.write(wiring.proof_of([], [], [], []))
    told = wiring.take_written()
    assert "no serial number" in told and line.plc.name in told


def test_a_loop_that_starts_anew_reads_the_proof_that_was_kept(tmp_path):
    line = stepped(2).line
    store_proof(line, tmp_path)
    wiring = Wiring(line, map_files(line), tmp_path / LOOP_DATA)
    assert [each.code for each in wiring.against] == ["wiring-unproved"]
    wiring.read(print)
    assert wiring.against == []


def test_a_loop_that_starts_anew_does_not_say_proved_before_it_has_read_its_devices(tmp_path):
    loop = stepped(2)
    store_proof(loop.line, tmp_path)
    wiring = Wiring(loop.line, map_files(loop.line), tmp_path / LOOP_DATA)
    assert wiring.status().unproved and not wiring.status().not_read
    wiring.read(print)
    hash_ = proof_hash(proof_of_wiring(loop.line))
    assert wiring.status() == WiringStatus(not_read=True, proof=hash_)
    assert not wiring.look([])  # it holds nothing that could be another device; not those that were proved either
    assert wiring.status().unproved and wiring.proof is not None
    numbers = {one.device: one.serial for one in wiring.proof.devices}
    loop.cycle.links[0].serials = numbers
    assert wiring.look(loop.cycle.links)
    assert wiring.status() == WiringStatus(proved_wall_s=0.0, proof=hash_)
    assert not wiring.look(loop.cycle.links)


def test_an_arming_that_finds_another_device_tells_it_at_once():
    with virtual_line("canopen", 1) as line:
        told = []
        line.cycle.tell = lambda kind, text, **data: told.append((kind, [each.rule for each in data["findings"]]))
        line.step(5)
        assert line.command(Arm()).ok
        assert told == [("wiring", [])]  # read for the first time, and as proved
        assert line.command(Stop()).ok
        line.cycle.wiring.proof = line.cycle.wiring.proof.model_copy(update={"wiring": "0" * 64})
        line.step(5)
        assert line.command(Arm()).ok
        assert told[1:] == [("wiring", ["wiring-changed"])]


def test_a_proof_that_is_cut_off_is_none_and_that_is_told(tmp_path):
    line, told = stepped(2).line, []
    store_proof(line, tmp_path)
    (tmp_path / LOOP_DATA / FILE).write_text((tmp_path / LOOP_DATA / FILE).read_text()[:-20])
    wiring = Wiring(line, map_files(line), tmp_path / LOOP_DATA)
    wiring.read(told.append)
    assert [each.code for each in wiring.against] == ["wiring-unproved"]
    assert [each.rule for each in wiring.unusable] == ["file-unusable"] and told


def test_what_is_kept_is_on_the_disk_and_proves_the_line(tmp_path):
    line = stepped(2).line
    wiring = Wiring(line, map_files(line), tmp_path / LOOP_DATA)
    wiring.write(wiring.proof_of(*shown_as_described(line), []))
    assert [each.code for each in wiring.against] == ["wiring-unproved"]  # before it takes effect
    wiring.take_written()
    again = Wiring(line, map_files(line), tmp_path / LOOP_DATA)
    again.read(print)
    assert wiring.against == again.against == [] and again.proof == wiring.proof


def test_nothing_is_kept_without_drill_and_pulls():
    with virtual_line("canopen", 1) as line:
        line.step(5)
        assert [each.code for each in line.command(KeepProof()).findings] == ["not-drilled"]
        assert line.command(Drill()).ok
        assert [each.code for each in line.command(KeepProof()).findings] == ["not-pulled"]

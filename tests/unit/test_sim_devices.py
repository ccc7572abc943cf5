"""Drive, amplifier and line PLC of the simulated line, judged by the world's true torque and speed."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import sim_plant
from sim_plant.devices.amplifier import Amplifier, ChannelStatus
from sim_plant.devices.cia402 import State
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.plant import Plant, load_plant
from sim_plant.recorder import Recorder
from sim_plant.world import World

PLANT = load_plant(Path(sim_plant.__file__).parent / "plants" / "s_real.toml")
TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])
CST = 10
SHUTDOWN, ENABLE, QUICK_STOP, RESET = 0x06, 0x0F, 0x02, 0x80


@dataclass
class Bench:
    """One drive, its world, and who listens to its emergency messages."""

    world: World
    recorder: Recorder
    drive: Drive
    emergencies: list[int]

    def command(self, controlword: int, torque_nm: float, now_s: float, mode: int = CST):
        self.drive.receive(controlword, torque_nm, mode, now_s)
        return self.drive.sync(now_s)

    def torque_nm(self, at_s: float) -> float:
        """True torque that acted in the millisecond before `at_s`."""
        recording = self.recorder.recording()
        return float(recording.torque_nm[round(at_s * 1000) - 1, 0])


@pytest.fixture
def bench() -> Bench:
    world = World(PLANT, seed=1)
    recorder = Recorder(world)
    emergencies: list[int] = []
    drive = Drive(0, world, recorder, rated_torque_nm=60.0, max_torque_nm=60.0)
    drive.on_emergency = emergencies.append
    drive.operational = True
    return Bench(world, recorder, drive, emergencies)


@pytest.fixture
def enabled(bench: Bench) -> Bench:
    """Enabled with 5 Nm at 5 ms, as fast as the recorder's limit of 1000 Nm/s allows."""
    bench.command(SHUTDOWN, 0.0, 0.0)
    bench.command(ENABLE, 5.0, 0.005)
    assert bench.drive.state is State.OPERATION_ENABLED
    return bench


def test_a_command_acts_with_the_next_sync(enabled: Bench) -> None:
    enabled.drive.receive(ENABLE, 9.0, CST, 0.010)
    enabled.world.advance(0.020)
    sample = enabled.drive.sync(0.020)
    assert sample.torque_nm == 9.0
    enabled.world.advance(0.030)
    assert enabled.torque_nm(0.020) == 5.0
    assert enabled.torque_nm(0.021) == 9.0
    assert enabled.drive.sync(0.030).torque_nm == 9.0  # nothing new: it stays


def test_a_command_is_latched_once(bench: Bench) -> None:
    bench.command(SHUTDOWN, 0.0, 0.0)
    bench.drive.set_sto(True, 0.005)
    bench.drive.set_sto(False, 0.006)
    bench.drive.sync(0.010)
    assert bench.drive.state is State.SWITCH_ON_DISABLED


def test_the_statusword_says_what_the_drive_does(bench: Bench) -> None:
    assert bench.command(0x00, 5.0, 0.0).statusword == 0xC250
    assert bench.command(SHUTDOWN, 5.0, 0.0).statusword == 0xC231
    assert bench.command(0x07, 5.0, 0.0).statusword == 0xC233
    assert bench.command(ENABLE, 5.0, 0.0).statusword == 0xD237
    assert bench.command(ENABLE, 5.0, 0.0, mode=0).statusword == 0xC237  # the target is not followed
    limited = bench.command(ENABLE, -75.0, 0.0)
    assert (limited.statusword, limited.torque_nm) == (0xDA37, -60.0)
    bench.drive.fault(0x2310, 0.0)
    assert bench.drive.statusword == 0xC218
    bench.drive.operational = False
    assert bench.drive.statusword == 0xC018


@pytest.mark.parametrize("mode", [0, 1, 4, 9])
def test_torque_needs_its_mode(bench: Bench, mode: int) -> None:
    bench.command(SHUTDOWN, 0.0, 0.0, mode)
    assert bench.command(ENABLE, 5.0, 0.0, mode).torque_nm == 0.0
    assert bench.command(ENABLE, 5.0, 0.0, CST).torque_nm == 5.0
    assert bench.command(ENABLE, 5.0, 0.0, mode).torque_nm == 0.0


@pytest.mark.parametrize("word", [0x00, 0x06, 0x07])
def test_leaving_operation_enabled_takes_torque_off(enabled: Bench, word: int) -> None:
    assert enabled.command(word, 5.0, 0.010).torque_nm == 0.0
    assert enabled.recorder.unsafe_total == 0


def test_without_nmt_operational_nothing_is_taken(enabled: Bench) -> None:
    enabled.drive.operational = False
    assert enabled.drive.state is State.SWITCH_ON_DISABLED
    assert enabled.world.torque_nm[0] == 0.0
    enabled.command(SHUTDOWN, 0.0, 0.010)
    assert enabled.drive.state is State.SWITCH_ON_DISABLED


def test_a_target_that_is_no_number_is_refused(enabled: Bench) -> None:
    with pytest.raises(ValueError, match="drive 1 must be finite, got nan"):
        enabled.drive.receive(ENABLE, float("nan"), CST, 0.010)


@pytest.mark.parametrize("polled_at_s", [0.1501, 0.3])
def test_the_watchdog_acts_at_its_time_however_late_anybody_looks(enabled: Bench, polled_at_s: float) -> None:
    enabled.drive.watchdog_s = 0.1
    enabled.command(ENABLE, 7.0, 0.050)
    enabled.drive.poll(0.149)
    assert enabled.drive.state is State.OPERATION_ENABLED
    enabled.drive.poll(polled_at_s)
    assert enabled.drive.state is State.FAULT
    assert enabled.torque_nm(0.150) == 7.0
    enabled.world.advance(0.3)
    assert enabled.torque_nm(0.151) == 0.0
    assert enabled.drive.error_code == 0x8250
    assert enabled.emergencies == [0x8250]
    (trip,) = enabled.recorder.recording().of_kind("watchdog")
    assert (trip["roller"], trip["time_s"]) == (1, pytest.approx(0.150))
    assert enabled.recorder.unsafe_total == 0


def test_the_watchdog_is_fed_by_commands_not_by_syncs(enabled: Bench) -> None:
    enabled.drive.watchdog_s = 0.05
    for k in range(1, 21):
        enabled.command(ENABLE, 5.0, 0.02 * k)
    assert enabled.drive.state is State.OPERATION_ENABLED
    for k in range(20, 24):
        enabled.drive.sync(0.02 * k)
    assert enabled.drive.state is State.FAULT


def test_the_watchdog_waits_for_the_first_command_and_for_operational(bench: Bench) -> None:
    bench.drive.watchdog_s = 0.05
    bench.drive.poll(1.0)
    assert bench.drive.state is State.SWITCH_ON_DISABLED
    bench.command(SHUTDOWN, 0.0, 1.0)
    bench.drive.operational = False
    bench.drive.poll(2.0)
    assert bench.drive.state is State.SWITCH_ON_DISABLED
    bench.drive.operational = True
    bench.command(SHUTDOWN, 0.0, 2.0)
    bench.drive.poll(2.1)
    assert bench.drive.state is State.FAULT


def test_a_late_command_does_not_undo_the_trip(enabled: Bench) -> None:
    enabled.drive.watchdog_s = 0.05
    enabled.command(ENABLE, 5.0, 0.010)
    assert enabled.command(ENABLE, 5.0, 0.061).torque_nm == 0.0
    assert enabled.drive.state is State.FAULT


def test_a_fault_is_reset_without_enabling(enabled: Bench) -> None:
    enabled.drive.fault(0x2310, 0.010)
    assert enabled.world.torque_nm[0] == 0.0
    enabled.command(ENABLE | RESET, 5.0, 0.020)
    assert enabled.drive.state is State.SWITCH_ON_DISABLED
    assert enabled.emergencies == [0x2310, 0]
    assert enabled.drive.error_code == 0
    for k in range(3, 10):
        assert enabled.command(ENABLE | RESET, 5.0, 0.01 * k).torque_nm == 0.0
    assert enabled.drive.state is State.SWITCH_ON_DISABLED


def test_quick_stop_ramps_to_zero_then_switches_off(enabled: Bench) -> None:
    enabled.command(ENABLE, 30.0, 0.040)
    enabled.command(QUICK_STOP, 30.0, 0.050)
    assert enabled.drive.state is State.QUICK_STOP_ACTIVE
    enabled.command(ENABLE, 30.0, 0.060)
    assert enabled.drive.state is State.QUICK_STOP_ACTIVE
    enabled.drive.poll(0.120)
    assert enabled.drive.state is State.SWITCH_ON_DISABLED
    # 60 Nm in 0.1 s
    assert [enabled.torque_nm(t) for t in (0.050, 0.075, 0.100, 0.101)] == pytest.approx([30.0, 15.0, 0.0, 0.0])
    assert enabled.recorder.unsafe_total == 0


def test_disable_voltage_ends_a_quick_stop_at_once(enabled: Bench) -> None:
    enabled.command(ENABLE, 60.0, 0.010)
    enabled.command(QUICK_STOP, 0.0, 0.020)
    assert enabled.command(0x00, 0.0, 0.030).torque_nm == 0.0
    assert enabled.drive.state is State.SWITCH_ON_DISABLED


def test_sto_takes_torque_off_and_refuses_enabling(enabled: Bench) -> None:
    enabled.drive.set_sto(True, 0.010)
    assert enabled.drive.sto
    assert enabled.world.torque_nm[0] == 0.0
    for word in (SHUTDOWN, 0x07, ENABLE):
        enabled.command(word, 5.0, 0.020)
        assert enabled.drive.statusword == 0xC240
    enabled.drive.set_sto(False, 0.030)
    assert enabled.command(ENABLE, 5.0, 0.040).torque_nm == 0.0
    enabled.command(SHUTDOWN, 0.0, 0.050)
    assert enabled.command(ENABLE, 5.0, 0.060).torque_nm == 5.0
    assert enabled.emergencies == []


def test_a_drive_may_take_time_for_its_torque() -> None:
    world = World(PLANT, seed=1)
    drive = Drive(0, world, Recorder(world), 60.0, 60.0, torque_rate_nm_per_s=500.0)
    drive.operational = True
    for word, torque_nm in ((SHUTDOWN, 0.0), (ENABLE, 10.0)):
        drive.receive(word, torque_nm, CST, 0.0)
        drive.sync(0.0)
    assert drive.sync(0.010).torque_nm == pytest.approx(5.0)
    assert drive.sync(0.030).torque_nm == pytest.approx(10.0)
    drive.fault(0x2310, 0.030)
    assert drive.sync(0.031).torque_nm == 0.0


def test_the_amplifier_measures_once_a_millisecond() -> None:
    world = World(PLANT, seed=1)
    amplifier = Amplifier(world)
    first = [amplifier.tension_n(c, 0.0101) for c in range(1, 7)]
    assert [amplifier.tension_n(c, 0.0109) for c in range(1, 7)] == first
    assert amplifier.counter(0.0109) == 10
    assert amplifier.tension_n(1, 0.011) != first[0]
    assert amplifier.counter(0.011) == 11
    assert amplifier.counter(65.5369) == 0
    assert amplifier.healthy


def test_the_amplifiers_channels_count_from_one() -> None:
    amplifier = Amplifier(World(PLANT, seed=1))
    amplifier.set_status(6, ChannelStatus.WIRE_BREAK)
    assert [amplifier.status(c) for c in range(1, 7)] == [0, 0, 0, 0, 0, 2]
    for channel in (0, 7):
        with pytest.raises(IndexError, match=f"channel {channel}: this amplifier has channels 1 to 6"):
            amplifier.tension_n(channel, 0.0)


@pytest.fixture
def amplifier() -> Amplifier:
    quiet = {**PLANT.model_dump(), "sensors": {"tension_noise_n": 0.0}}
    world = World(Plant.model_validate(quiet), seed=1)
    world.start_at_equilibrium(TENSION_N, 0.0)
    return Amplifier(world)


def test_a_load_cell_that_sticks_stays_and_the_others_do_not(amplifier: Amplifier) -> None:
    amplifier.stick(2)
    assert amplifier.tension_n(2, 0.0) == pytest.approx(36.0)
    rows = np.array([amplifier.tensions_n(0.001 * k) for k in range(1, 200)])
    assert (rows[:, 1] == amplifier.tension_n(2, 0.2)).all()
    assert (rows[:, [0, 2, 3, 4, 5]].std(axis=0) > 0.0).all()
    amplifier.heal(2)
    assert amplifier.tensions_n(0.2)[1] != rows[0, 1]


def test_a_load_cell_can_show_no_number_or_any_with_status_ok(amplifier: Amplifier) -> None:
    amplifier.nan(1)
    amplifier.show_n(3, 1e5)
    assert np.isnan(amplifier.tension_n(1, 0.0)) and np.isnan(amplifier.tensions_n(0.0)[0])
    assert amplifier.tension_n(3, 0.0) == 1e5
    assert amplifier.status(1) is amplifier.status(3) is ChannelStatus.OK


def test_a_load_cell_drifts_from_the_moment_it_is_told() -> None:
    healthy, drifting = Amplifier(World(PLANT, seed=1)), Amplifier(World(PLANT, seed=1))
    healthy.tension_n(1, 1.0)
    drifting.tension_n(1, 1.0)
    drifting.offset_n(1, 0.5, start_n=2.0)
    for now_s in (1.0, 2.0, 4.0):
        off = drifting.tension_n(1, now_s) - healthy.tension_n(1, now_s)
        assert off == pytest.approx(2.0 + 0.5 * (now_s - 1.0), abs=1e-9)


def test_a_spike_is_one_measurement(amplifier: Amplifier) -> None:
    amplifier.spike(4, 25.0)
    assert amplifier.tension_n(4, 0.010) > 60.0
    assert amplifier.tensions_n(0.0105)[3] > 60.0  # the same millisecond
    assert amplifier.tension_n(4, 0.011) < 45.0
    with pytest.raises(IndexError, match="channel 7: this amplifier has channels 1 to 6"):
        amplifier.spike(7, 1.0)


def test_an_encoder_freezes_jumps_and_heals(enabled: Bench) -> None:
    drive = enabled.drive
    drive.freeze_speed()
    shown = {drive.sync(0.01 * k).speed_m_per_s for k in range(2, 20)}
    assert len(shown) == 1
    drive.heal_speed()
    assert drive.sync(0.2).speed_m_per_s == enabled.world.measure_speed_m_per_s(0)
    drive.jump_speed(0.5)
    assert drive.sync(0.21).speed_m_per_s - enabled.world.measure_speed_m_per_s(0) == pytest.approx(0.5)


def test_a_dead_watchdog_takes_its_setting_and_never_acts(enabled: Bench) -> None:
    enabled.drive.watchdog_is_dead = True
    enabled.drive.watchdog_s = 0.05
    enabled.command(ENABLE, 5.0, 0.010)
    enabled.drive.poll(1.0)
    assert enabled.drive.state is State.OPERATION_ENABLED and enabled.drive.watchdog_s == 0.05


def test_a_drive_that_lags_follows_its_commands_and_loses_its_power_at_once() -> None:
    document = PLANT.model_dump()
    world = World(Plant.model_validate({**document, "drives": {"torque_lag_s": 0.02}}), seed=1)
    recorder = Recorder(world)
    drive = Drive(0, world, recorder, 60.0, 60.0)
    drive.operational = True
    for word, torque_nm, now_s in ((SHUTDOWN, 0.0, 0.0), (ENABLE, 10.0, 0.010)):
        drive.receive(word, torque_nm, CST, now_s)
        drive.sync(now_s)
    assert drive.sync(0.030).torque_nm == pytest.approx(10.0 * (1.0 - np.exp(-1.0)), rel=1e-4)
    drive.receive(QUICK_STOP, 0.0, CST, 0.040)
    drive.sync(0.040)
    drive.poll(0.0565)  # the ramp of the command takes 10 Nm / 600 Nm/s; what lags behind it is still there
    assert drive.state is State.QUICK_STOP_ACTIVE and world.torque_nm[0] > 2.0
    drive.poll(0.058)
    assert drive.state is State.SWITCH_ON_DISABLED and world.torque_nm[0] == 0.0
    assert recorder.unsafe_total == 0


def plc_bench(ramp_m_per_s2: float = 1.0) -> tuple[World, Recorder, LinePlc]:
    world = World(PLANT, seed=1)
    recorder = Recorder(world)
    return world, recorder, LinePlc(world, recorder, ramp_m_per_s2)


def test_v0_follows_the_request_at_the_plants_ramp() -> None:
    world, _, plc = plc_bench(ramp_m_per_s2=1.0)
    plc.command(True, 0.1, 1, 0.0)
    plc.poll(0.050)
    assert world.unwind_speed_m_per_s == pytest.approx(0.05)
    plc.poll(0.2)
    assert world.unwind_speed_m_per_s == 0.1
    assert plc.status(0.2).unwind_speed_m_per_s == pytest.approx(0.1, abs=6e-4)
    assert plc.status(0.2).running and plc.status(0.2).life_echo == 1
    plc.command(False, 0.1, 2, 0.2)
    plc.poll(0.4)
    assert world.unwind_speed_m_per_s == 0.0 and not plc.status(0.4).running


def test_v0_steps_where_the_plant_has_no_ramp() -> None:
    world = World(PLANT, seed=1)
    plc = LinePlc(world, Recorder(world))
    plc.command(True, 0.1, 1, 0.010)
    assert world.unwind_speed_m_per_s == 0.1


def test_a_speed_that_is_no_number_is_refused() -> None:
    _, _, plc = plc_bench()
    with pytest.raises(ValueError, match="must be finite, got inf"):
        plc.command(True, float("inf"), 1, 0.0)


def test_the_plc_watchdog_trips_until_run_is_given_anew() -> None:
    world, recorder, plc = plc_bench(ramp_m_per_s2=1.0)
    plc.watchdog_s = 0.1
    for k in range(10):
        plc.command(True, 0.05, k, 0.05 * k)
    for k in range(10, 16):  # commands, but the life counter stands still since 0.45 s
        plc.command(True, 0.05, 9, 0.05 * k)
    assert plc.status(0.75).watchdog_tripped
    assert world.unwind_speed_m_per_s == 0.0
    (trip,) = recorder.recording().of_kind("plc_watchdog")
    assert trip["time_s"] == pytest.approx(0.55)
    recording = recorder.recording()
    assert recording.unwind_speed_m_per_s[549] == 0.05 and recording.unwind_speed_m_per_s[550] < 0.05
    plc.command(True, 0.05, 10, 0.8)  # alive again, but run was never taken away
    assert plc.status(0.85).watchdog_tripped and world.unwind_speed_m_per_s == 0.0
    plc.command(False, 0.05, 11, 0.9)
    assert plc.status(0.9).watchdog_tripped
    plc.command(True, 0.05, 12, 0.95)
    assert not plc.status(1.0).watchdog_tripped
    assert world.unwind_speed_m_per_s == pytest.approx(0.05)


@pytest.mark.parametrize("name", ["permissive", "emergency_stop"])
def test_nothing_restarts_because_a_button_was_released(name: str) -> None:
    world, recorder, plc = plc_bench(ramp_m_per_s2=1.0)
    plc.command(True, 0.05, 1, 0.0)
    plc.poll(0.1)
    setattr(plc, name, name == "emergency_stop")
    assert not plc.status(0.1).running
    plc.poll(0.2)
    assert world.unwind_speed_m_per_s == 0.0
    setattr(plc, name, name != "emergency_stop")
    plc.command(True, 0.05, 2, 0.2)
    assert not plc.status(0.3).running and world.unwind_speed_m_per_s == 0.0
    plc.command(False, 0.05, 3, 0.3)
    plc.command(True, 0.05, 4, 0.4)
    assert plc.status(0.5).running and world.unwind_speed_m_per_s == 0.05
    assert [event["active"] for event in recorder.recording().of_kind(name)] == [
        name == "emergency_stop",
        name != "emergency_stop",
    ]


def test_an_emergency_stop_makes_the_drives_safe_after_its_delay(enabled: Bench) -> None:
    plc = LinePlc(enabled.world, enabled.recorder, drives=[enabled.drive], sto_delay_s=0.3)
    enabled.world.advance(0.1)
    plc.emergency_stop = True
    plc.poll(0.399)
    assert not enabled.drive.sto and enabled.world.torque_nm[0] == 5.0
    plc.poll(0.401)
    assert enabled.drive.sto and enabled.world.torque_nm[0] == 0.0
    plc.emergency_stop = False
    assert not enabled.drive.sto and enabled.drive.state is State.SWITCH_ON_DISABLED


def test_sto_is_active_as_long_as_one_source_demands_it(enabled: Bench) -> None:
    enabled.drive.set_sto(True, 0.010)
    enabled.drive.set_sto(True, 0.020, "emergency stop")
    enabled.drive.set_sto(False, 0.030, "emergency stop")
    assert enabled.drive.sto
    enabled.drive.set_sto(False, 0.040)
    assert not enabled.drive.sto
    assert [event["active"] for event in enabled.recorder.recording().of_kind("sto")] == [True, False]


def test_a_drive_in_fault_is_not_failed_again_by_its_watchdog(enabled: Bench) -> None:
    enabled.drive.watchdog_s = 0.05
    enabled.command(ENABLE, 5.0, 0.010)
    enabled.drive.fault(0x2310, 0.020)
    enabled.drive.poll(0.2)
    assert (enabled.drive.error_code, enabled.emergencies) == (0x2310, [0x2310])
    assert not enabled.recorder.recording().of_kind("watchdog")

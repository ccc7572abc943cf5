"""The line without wires: when commands act and what is sampled."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sim_plant
from sim_plant.plant import Plant, load_plant
from sim_plant.stepped import SteppedLine

PLANT = load_plant(Path(sim_plant.__file__).parent / "plants" / "s_real.toml")
TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])
ALL, NO = np.ones(6, dtype=np.bool_), np.zeros(6, dtype=np.bool_)


def changed(**tables: dict[str, Any]) -> Plant:
    document = PLANT.model_dump()
    return Plant.model_validate({**document, **{key: {**document[key], **value} for key, value in tables.items()}})


@settings(max_examples=40)
@given(period_ms=st.integers(1, 20), latency_ms=st.integers(0, 45))
def test_a_torque_acts_exactly_its_latency_after_the_sample(period_ms: int, latency_ms: int) -> None:
    line = SteppedLine(PLANT, seed=1, latency_s=latency_ms / 1000.0)
    for k in range(30):
        now_s = k * (period_ms / 1000.0)
        line.sample(now_s)
        line.apply(np.full(6, k + 1.0), ALL, 0.0, False, now_s)
    line.sample(30 * (period_ms / 1000.0))
    torque = line.recorder.recording().torque_nm[:, 0]
    steps = np.arange(1, len(torque) + 1)  # row s holds what acted in the millisecond before s ms
    expected = np.maximum(0.0, np.minimum(30.0, (steps - 1 - latency_ms) // period_ms + 1.0))
    assert np.array_equal(torque, expected)


def test_what_is_sampled_is_what_acts() -> None:
    line = SteppedLine(PLANT, seed=1, latency_s=0.010)
    for k in range(60):
        sample = line.sample(k * 0.010)
        assert sample.torque_nm[0] == k and sample.enabled.all() == (k > 0)
        line.apply(np.full(6, k + 1.0), ALL, 0.0, False, k * 0.010)


def test_torque_needs_enabling_and_the_drive_has_its_limit() -> None:
    line = SteppedLine(PLANT, seed=1, latency_s=0.0)
    enable = np.array([True, False, True, True, True, True])
    line.apply(np.array([70.0, 5.0, -70.0, 1.0, 2.0, 3.0]), enable, 0.0, False, 0.0)
    sample = line.sample(0.001)
    assert sample.torque_nm.tolist() == [60.0, 0.0, -60.0, 1.0, 2.0, 3.0]
    assert sample.enabled.tolist() == enable.tolist()


def test_a_torque_that_is_no_number_is_refused() -> None:
    line = SteppedLine(PLANT, seed=1, latency_s=0.0)
    with pytest.raises(ValueError, match="must be finite"):
        line.apply(np.array([1.0, np.nan, 0, 0, 0, 0]), ALL, 0.0, False, 0.0)


def test_the_speed_request_acts_with_the_next_sample() -> None:
    line = SteppedLine(changed(sensors={"speed_noise_m_per_s": 0.0}), seed=1, latency_s=0.030)
    line.apply(np.zeros(6), NO, 0.1, True, 0.0)
    sample = line.sample(0.010)
    assert sample.unwind_speed_m_per_s == 0.1 and sample.running
    line.sample(0.020)
    v0 = line.recorder.recording().unwind_speed_m_per_s
    assert v0.tolist() == [0.0] * 10 + [0.1] * 10


def test_transport_stops_with_the_permissive_and_the_emergency_stop() -> None:
    line = SteppedLine(changed(sensors={"speed_noise_m_per_s": 0.0}), seed=1, latency_s=0.010)
    line.start_at_equilibrium(TENSION_N, 0.1)
    sample = line.sample(0.010)
    assert (sample.permissive, sample.emergency_stop, sample.running) == (True, False, True)
    line.plc.permissive = False
    sample = line.sample(0.020)
    assert (sample.permissive, sample.running, sample.unwind_speed_m_per_s) == (False, False, 0.0)
    line.plc.emergency_stop = True
    assert line.sample(0.030).emergency_stop


def test_it_starts_in_the_middle_of_production() -> None:
    line = SteppedLine(changed(rollers={"disturbance_m_per_s2": 0.0}), seed=1, latency_s=0.010)
    torque_nm = line.start_at_equilibrium(TENSION_N, 0.01)
    for k in range(200):
        sample = line.sample(k * 0.01)
        assert sample.enabled.all() and sample.running
        line.apply(torque_nm, ALL, 0.01, True, k * 0.01)
    assert np.abs(line.world.tension_n - TENSION_N).max() < 1e-9
    assert line.recorder.unsafe_total == 0


def test_the_recorder_judges_here_as_well() -> None:
    line = SteppedLine(PLANT, seed=1, latency_s=0.010)
    torque_nm = line.start_at_equilibrium(TENSION_N, 0.01)
    for k in range(50):
        line.sample(k * 0.01)
        line.apply(torque_nm, ALL, 0.01, True, k * 0.01)
    jump = torque_nm + np.array([10.5, 9.5, 0, 0, 0, 0])
    line.apply(jump, ALL, 0.01, True, 0.5)
    line.sample(0.6)
    assert line.recorder.unsafe_events["torque-rate"] == 1
    line.apply(jump + np.array([40.0, 0, 0, 0, 0, 0]), ALL, 0.01, True, 0.6)
    line.sample(5.0)
    assert line.recorder.unsafe_events["tension-band"] > 0


def test_drives_that_are_told_off_are_no_unsafe_event() -> None:
    line = SteppedLine(PLANT, seed=1, latency_s=0.0)
    line.start_at_equilibrium(TENSION_N, 0.05)
    line.sample(1.0)
    line.apply(np.zeros(6), NO, 0.0, False, 1.0)
    line.sample(20.0)
    assert line.world.tension_n.min() < 2.0
    assert line.recorder.unsafe_total == 0


def test_faulty_sensors_are_what_is_sampled() -> None:
    line, healthy = SteppedLine(PLANT, seed=1, latency_s=0.010), SteppedLine(PLANT, seed=1, latency_s=0.010)
    for each in (line, healthy):
        each.start_at_equilibrium(TENSION_N, 0.1)
    line.amplifier.nan(2)
    line.amplifier.spike(3, 10.0)
    line.encoders[4].offset(0.25, 0.0, line.world.steps)
    shown, true = line.sample(0.010), healthy.sample(0.010)
    assert np.isnan(shown.tension_n[1])
    assert shown.tension_n[2] - true.tension_n[2] == pytest.approx(10.0)
    assert shown.speed_m_per_s[4] - true.speed_m_per_s[4] == pytest.approx(0.25)
    others = [0, 3, 4, 5]
    assert np.array_equal(shown.tension_n[others], true.tension_n[others])
    assert np.array_equal(line.world.tension_n, healthy.world.tension_n)


def test_a_drive_that_takes_itself_off_leaves_the_others_on_their_ramps() -> None:
    line = SteppedLine(changed(drives={"torque_rate_nm_per_s": 100.0}), seed=1, latency_s=0.0)
    line.apply(np.full(6, 10.0), ALL, 0.0, False, 0.0)
    line.take_off(1, 0.050)
    sample = line.sample(0.2)
    assert sample.torque_nm[1] == 0.0 and sample.torque_nm[[0, 2]].tolist() == [10.0, 10.0]
    assert not sample.enabled[1] and sample.enabled[0]

"""The full model as a whole: nothing changes until an effect is on, and faults change what they say."""

from math import exp, inf
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sim_plant
from sim_plant.plant import load_plant
from sim_plant.stepped import SteppedLine
from sim_plant.world import World
from tests.unit.sim_effects_support import INERTIA_KG_M2, RADIUS_M, free_roller, plant

PLANTS = Path(sim_plant.__file__).parent / "plants"
S_REAL, REALISTIC = load_plant(PLANTS / "s_real.toml"), load_plant(PLANTS / "realistic.toml")
TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])


def difference(one: World, other: World) -> float:
    """Largest difference of tensions (N), speeds (m/s) and torques (Nm)."""
    pairs = [
        (one.tension_n, other.tension_n),
        (one.speed_m_per_s, other.speed_m_per_s),
        (one.surface_speed_m_per_s, other.surface_speed_m_per_s),
        (one.torque_nm, other.torque_nm),
    ]
    return max(float(np.abs(a - b).max()) for a, b in pairs)


def play(world: World) -> None:
    """Five seconds with noise, steps, ramps and drives that go off."""
    start_s = world.now_s
    world.advance(start_s + 1.0)
    world.ramp_torque_nm(1, 8.0, 100.0)
    world.ramp_unwind_speed(0.08, 0.05)
    world.advance(start_s + 2.5)
    world.set_torque_nm(3, 0.0)
    world.advance(start_s + 5.0)


def test_with_all_effects_off_both_kernels_are_one() -> None:
    plain, full = World(S_REAL, seed=4), World(S_REAL, seed=4)
    assert full.use_full_line() and plain.is_plain and not full.is_plain
    for world in (plain, full):
        world.start_at_equilibrium(TENSION_N, 0.05)
        play(world)
    assert np.abs(plain.tension_n - TENSION_N).max() > 1.0
    assert difference(plain, full) <= 1e-12


def test_the_model_changes_in_mid_run_without_a_bump() -> None:
    plain, changed = World(S_REAL, seed=4), World(S_REAL, seed=4)
    for world in (plain, changed):
        world.start_at_equilibrium(TENSION_N, 0.05)
        world.ramp_torque_nm(0, 20.0, 10.0)
        world.advance(0.0005 + 0.3)
    before = changed.tension_n.copy(), changed.speed_m_per_s.copy(), changed.torque_nm.copy()
    changed.set_friction_factor(2, 1.0)
    assert not changed.is_plain
    after = changed.tension_n, changed.speed_m_per_s, changed.torque_nm
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))
    for world in (plain, changed):
        play(world)
    assert difference(plain, changed) <= 1e-12


def test_compiling_beforehand_changes_nothing() -> None:
    world, other = World(S_REAL, seed=4), World(S_REAL, seed=4)
    world.start_at_equilibrium(TENSION_N, 0.05)
    other.start_at_equilibrium(TENSION_N, 0.05)
    world.compile_full_line()
    assert world.is_plain
    play(world)
    play(other)
    assert difference(world, other) == 0.0


@settings(max_examples=15)
@given(calls=st.lists(st.floats(0.0, 3.0), max_size=30), seed=st.integers(0, 2**32))
def test_the_pattern_of_calls_changes_nothing(calls: list[float], seed: int) -> None:
    whole, pieces = World(REALISTIC, seed), World(REALISTIC, seed)
    for world, stops in ((whole, []), (pieces, calls)):
        world.start_at_equilibrium(TENSION_N, 0.1)
        for stop in stops:
            world.advance(stop)
        world.advance(3.0)
    assert whole.steps == pieces.steps == 3000
    assert difference(whole, pieces) == 0.0
    assert np.array_equal(whole.measure_tensions_n(), pieces.measure_tensions_n())
    assert np.array_equal(whole.measure_speeds_m_per_s(), pieces.measure_speeds_m_per_s())


def test_the_realistic_plant_holds_its_tensions_with_the_torques_of_its_rest_point() -> None:
    """Open loop, every effect on: it stays within a few newtons for a minute, and no web pushes."""
    line = SteppedLine(REALISTIC, seed=1, latency_s=0.010)
    torque_nm = line.start_at_equilibrium(TENSION_N, 0.1)
    for k in range(1500):
        line.sample(k * 0.01)
        line.apply(torque_nm, np.ones(6, dtype=np.bool_), 0.1, True, k * 0.01)
    tension = line.recorder.recording().tension_n
    assert tension.min() > 0.0
    assert np.abs(tension.mean(axis=0) - TENSION_N).max() < 6.0
    assert line.recorder.unsafe_total == 0


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1))
def test_whatever_is_done_to_a_line_with_slack_no_web_pushes_and_all_stays_finite(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = World(REALISTIC, seed)
    world.start_at_equilibrium(TENSION_N, 0.1)
    lowest: list[float] = []
    world.on_rows = lambda _first, rows: lowest.append(float(rows[:, :6].min() if np.isfinite(rows).all() else -1.0))
    for k in range(1, 21):
        world.ramp_torque_nm(int(rng.integers(6)), float(rng.uniform(-60.0, 60.0)), 1000.0)
        world.ramp_unwind_speed(float(rng.uniform(-0.2, 0.5)), 1.0)
        if k % 5 == 0:
            world.set_slip(int(rng.integers(1, 6)), float(rng.uniform(0.0, 1.0)))
            world.set_friction_factor(int(rng.integers(1, 7)), float(rng.uniform(0.0, 10.0)), 2.0)
            world.break_web(int(rng.integers(1, 7)))
        world.advance(0.1 * k)
    assert min(lowest) >= 0.0


def test_a_friction_factor_multiplies_the_deceleration() -> None:
    """Viscous friction alone: w falls by exp(-c f/J t)."""
    world = free_roller(rollers={"friction_nms_per_rad": 0.5})
    world.set_friction_factor(1, 3.0)
    world.set_torque_nm(0, 10.0)
    world.advance(1.0)
    world.set_torque_nm(0, 0.0)
    begin = float(world.speed_m_per_s[0])
    world.advance(2.0)
    assert float(world.speed_m_per_s[0]) / begin == pytest.approx(np.exp(-3.0 * 0.5 / INERTIA_KG_M2), rel=1e-9)


def test_a_bearing_wears_at_its_rate() -> None:
    world = World(plant(2, effects={"friction": {"rise_per_s": [0.0, 0.02]}}), seed=1)
    world.advance(10.0)
    assert world.use_full_line().friction_factor(1) == 1.0
    assert world.use_full_line().friction_factor(2) == pytest.approx(1.2)
    world.set_friction_factor(1, 2.0, rate_per_s=0.5)
    world.advance(11.0)
    assert world.use_full_line().friction_factor(1) == pytest.approx(1.5)
    world.advance(15.0)
    assert world.use_full_line().friction_factor(1) == 2.0


def test_what_cannot_be_done_is_refused_with_what_can() -> None:
    world = World(S_REAL, seed=1)
    with pytest.raises(IndexError, match="span 7: this line has spans 1 to 6"):
        world.break_web(7)
    with pytest.raises(IndexError, match="roller 0: this line has rollers 1 to 6"):
        world.set_friction_factor(0, 2.0)
    with pytest.raises(ValueError, match="roller 6 is the last one"):
        world.set_slip(6, 0.5)
    for factor in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="roller 1"):
            world.set_friction_factor(1, factor)
        with pytest.raises(ValueError, match="roller 1"):
            world.set_slip(1, factor)
        with pytest.raises(ValueError, match="slack of span 2"):
            world.slacken_web(2, factor)


def test_without_power_there_is_no_torque_whatever_the_lag() -> None:
    line = SteppedLine(plant(2, drives={"torque_lag_s": 0.02}), seed=1, latency_s=0.0)
    both, one = np.array([True, True]), np.array([True, False])
    line.apply(np.array([10.0, 10.0]), both, 0.0, False, 0.0)
    assert line.sample(0.020).torque_nm == pytest.approx(10.0 * (1.0 - np.exp(-1.0)) * np.ones(2), rel=1e-6)
    line.apply(np.array([10.0, 10.0]), one, 0.0, False, 0.020)
    assert line.sample(0.021).torque_nm[1] == 0.0
    line.take_off(0, 0.030)
    assert not line.sample(0.031).torque_nm.any()
    assert line.recorder.unsafe_events["torque-not-enabled"] == 0


def test_radii_are_those_of_the_file_as_long_as_nothing_is_wound() -> None:
    world = World(plant(2, effects={"slack": True, "unwinder": {"radius_m": 0.3}}), seed=1)
    world.set_unwind_speed(1.0)
    world.advance(5.0)
    assert world.use_full_line().radius_m.tolist() == pytest.approx([0.3, RADIUS_M, RADIUS_M], rel=1e-15)


def test_a_friction_that_came_and_went_leaves_the_wear() -> None:
    world = World(plant(effects={"friction": {"rise_per_s": 0.1}}), 0)
    world.advance(1.0)
    world.set_friction_factor(1, 5.0)
    assert world.use_full_line().friction_factor(1) == pytest.approx(5.5)
    world.advance(2.0)
    world.set_friction_factor(1, 1.0)
    world.advance(3.0)
    assert world.use_full_line().friction_factor(1) == pytest.approx(1.3)


@pytest.mark.parametrize("step_nm", [0.0, 0.5])
def test_without_lag_a_torque_is_there_before_the_next_step(step_nm: float) -> None:
    world = World(plant(drives={"torque_step_nm": step_nm}), 0)
    world.use_full_line()
    world.ramp_torque_nm(0, 5.2, inf)
    assert world.torque_nm[0] == (5.2 if step_nm == 0.0 else 5.0)
    lagging = World(plant(drives={"torque_lag_s": 0.01}), 0)
    lagging.ramp_torque_nm(0, 5.2, inf)
    assert lagging.torque_nm[0] == 0.0


def test_the_creep_of_a_slack_web_recovers_with_the_time_of_the_whole_solid() -> None:
    world = World(plant(effects={"relaxation": {"stiffness_share": 1.0, "time_s": 1.0}}), 0)
    world.slacken_web(1, 0.01)
    arm_n = world.use_full_line()._state.arm_n  # noqa: SLF001 - nobody outside sees the arm
    arm_n[0] = -10.0
    world.advance(1.0)
    assert arm_n[0] == pytest.approx(-10.0 * exp(-0.5))  # tau (1 + r) = 2 s

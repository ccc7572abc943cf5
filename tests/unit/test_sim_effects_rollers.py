"""Rollers, reels and drives: lag, dry friction, eccentricity and radii against what can be worked out by hand."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_plant.physics import WebParameters
from sim_plant.world import World
from tests.unit.sim_effects_support import (
    INERTIA_KG_M2,
    LENGTH_M,
    RADIUS_M,
    STIFFNESS_N,
    Array,
    free_roller,
    plant,
    rows_of,
)
from tests.unit.test_sim_physics import linearisation

TENSION_N = np.array([28.0, 36.0, 20.0])
GAIN = RADIUS_M / INERTIA_KG_M2  #: m/s2 of the surface per Nm


@pytest.mark.parametrize("lag_s", [0.001, 0.005, 0.1])
def test_the_torque_has_come_63_percent_of_its_way_after_its_lag(lag_s: float) -> None:
    world = World(plant(drives={"torque_lag_s": lag_s}), seed=1)
    world.ramp_torque_nm(0, 10.0, np.inf)
    for k in (1, 2, 5):
        world.advance(k * lag_s)
        expected = 10.0 * (1.0 - np.exp(-k))
        assert world.torque_nm[0] == pytest.approx(expected, rel=0.012 if lag_s == 0.001 else 1e-4)
    assert world.torque_command_nm(0) == 10.0


def test_the_lag_follows_a_ramp_at_its_distance() -> None:
    """Behind a ramp of slope a, a first-order lag settles at a tau."""
    world = World(plant(drives={"torque_lag_s": 0.01}), seed=1)
    world.ramp_torque_nm(0, 40.0, 100.0)
    world.advance(0.2)
    assert world.torque_underway_nm(0) - world.torque_nm[0] == pytest.approx(100.0 * 0.01, rel=0.06)


def test_the_torque_comes_in_steps() -> None:
    world = World(plant(drives={"torque_step_nm": 0.25}), seed=1)
    shown = []
    for k in range(100):
        world.ramp_torque_nm(0, 0.03 * k, np.inf)
        world.advance((k + 1) / 1000.0)
        shown.append(float(world.torque_nm[0]))
    assert sorted(set(shown)) == pytest.approx(0.25 * np.arange(13))
    assert np.abs(np.array(shown) - 0.03 * np.arange(100)).max() <= 0.125 + 1e-12


def test_nothing_moves_below_break_away_and_it_does_above() -> None:
    world = free_roller(effects={"friction": {"coulomb_nm": 2.0, "breakaway_nm": 3.0}})
    for torque_nm in (2.999, -2.999):
        world.set_torque_nm(0, torque_nm)
        assert not rows_of(world, world.now_s + 1.0)[:, 1].any()
    world.set_torque_nm(0, 3.001)
    world.advance(world.now_s + 0.1)
    assert world.speed_m_per_s[0] > 0.0


def test_noise_moves_nothing_that_rests() -> None:
    """At rest under tension, with torques that are off by less than break-away: not a bit changes."""
    rollers = {"disturbance_m_per_s2": 0.05}
    world = World(plant(3, rollers=rollers, effects={"friction": {"coulomb_nm": 1.0}}), seed=1)
    torque_nm = world.start_at_equilibrium(TENSION_N, 0.0)
    world.command_torques_nm(torque_nm + np.array([0.99, -0.99, 0.5]))
    rows = rows_of(world, 5.0)
    assert np.array_equal(rows[:, :3], np.broadcast_to(TENSION_N, (5000, 3))) and not rows[:, 3:6].any()


def test_coulomb_friction_takes_speed_off_at_a_constant_rate_and_stops() -> None:
    world = free_roller(effects={"friction": {"coulomb_nm": 2.0}})
    world.set_torque_nm(0, 12.0)
    world.advance(1.0)
    begin = float(world.speed_m_per_s[0])
    assert begin == pytest.approx(GAIN * 10.0 * 1.0, rel=1e-9)
    world.set_torque_nm(0, 0.0)
    speed = rows_of(world, 8.0)[:, 1]
    t = 0.001 * np.arange(1, len(speed) + 1)
    assert np.abs(speed - np.maximum(0.0, begin - GAIN * 2.0 * t)).max() < 1e-9
    assert speed[-1] == 0.0 and speed.min() == 0.0


def test_friction_opposes_motion_both_ways() -> None:
    world = free_roller(effects={"friction": {"coulomb_nm": 2.0}})
    world.set_torque_nm(0, -12.0)
    world.advance(1.0)
    assert world.speed_m_per_s[0] == pytest.approx(-GAIN * 10.0, rel=1e-9)


@pytest.mark.parametrize("speed_m_per_s", [0.001, 0.005, 0.010, 0.05])
def test_between_break_away_and_coulomb_lies_stribecks_curve(speed_m_per_s: float) -> None:
    """The acceleration at a speed is that of what is left of the torque: F_c + (F_s - F_c) exp(-(w/w_s)^2)."""
    world = free_roller(effects={"friction": {"coulomb_nm": 2.0, "breakaway_nm": 3.0, "stribeck_speed_m_per_s": 0.005}})
    world.set_torque_nm(0, 3.05)
    speed = rows_of(world, 10.0)[:, 1]
    k = int(np.searchsorted(speed, speed_m_per_s))
    acceleration = (speed[k + 1] - speed[k - 1]) / 0.002
    friction_nm = 2.0 + np.exp(-((speed[k] / 0.005) ** 2))
    assert acceleration == pytest.approx(GAIN * (3.05 - friction_nm), rel=1e-3)


def test_a_roller_that_is_pulled_slowly_sticks_and_slips() -> None:
    """Armstrong-Helouvry's mass on a spring: below a critical speed it stops and starts, above it runs."""
    friction = {"coulomb_nm": 1.0, "breakaway_nm": 1.6, "stribeck_speed_m_per_s": 0.002}
    resting = []
    for pull_m_per_s in (0.0005, 0.05):
        document = plant(rollers={"friction_nms_per_rad": 0.5}, effects={"friction": friction})
        world = World(document, seed=1)
        world.set_unwind_speed(-pull_m_per_s)
        rows = rows_of(world, 60.0)[20_000:]
        resting.append(np.mean(rows[:, 1] == 0.0))
    assert 0.05 < resting[0] < 0.99
    assert resting[1] == 0.0


def ripple(rows: Array, frequency_hz: float, columns: int) -> NDArray[np.complex128]:
    """Complex amplitudes (columns,) of the first columns at a frequency: a least-squares fit of sine and cosine."""
    t = 0.001 * np.arange(1, len(rows) + 1)
    basis = np.column_stack((np.cos(2 * np.pi * frequency_hz * t), -np.sin(2 * np.pi * frequency_hz * t), 0 * t + 1))
    fit = np.linalg.lstsq(basis, rows[:, :columns], rcond=None)[0]
    return np.asarray(fit[0] + 1j * fit[1], dtype=np.complex128)


def parameters() -> WebParameters:
    return plant(3).parameters()


def answer(v: Array, v0: float, forcing: Array, frequency_hz: float) -> NDArray[np.complex128]:
    """Amplitudes of [T, w] by the linearised line: (j omega - A)^-1 B."""
    A = linearisation(parameters(), TENSION_N, v, v0)
    return np.asarray(np.linalg.solve(2j * np.pi * frequency_hz * np.eye(6) - A, forcing), dtype=np.complex128)


@pytest.mark.parametrize("v0", [0.05, 0.5])
def test_an_eccentric_roller_ripples_once_a_turn_as_the_linearised_line_answers(v0: float) -> None:
    share = 1e-3
    world = World(plant(3, effects={"eccentricity": {"share": [0.0, share, 0.0]}}), seed=1)
    world.start_at_equilibrium(TENSION_N, v0)
    v = world.surface_speed_m_per_s.copy()
    frequency_hz = float(v[1]) / (2.0 * np.pi * RADIUS_M)
    world.advance(60.0)
    rows = rows_of(world, 60.0 + 20.0 / frequency_hz)
    # v_2 = w_2 + w_2 e cos: stretches span 2 and loosens span 3; the web's force has a longer and a shorter arm.
    swing = share * v[1]
    forcing = np.zeros(6)
    forcing[1] = (STIFFNESS_N - TENSION_N[1]) / LENGTH_M * swing
    forcing[2] = -(STIFFNESS_N - TENSION_N[1]) / LENGTH_M * swing
    forcing[4] = RADIUS_M**2 / INERTIA_KG_M2 * (TENSION_N[2] - TENSION_N[1]) * share
    expected = np.abs(answer(v, v0, forcing, frequency_hz))[:3]
    found = np.abs(ripple(rows, frequency_hz, 3))
    assert expected[1] > 0.05
    assert found == pytest.approx(expected, rel=0.01)
    # Nothing but this frequency: what is left of the tension is a small part of the ripple.
    turn = ripple(rows, frequency_hz, 3)
    t = 0.001 * np.arange(1, len(rows) + 1)
    left = rows[:, :3] - rows[:, :3].mean(axis=0) - (turn[None] * np.exp(2j * np.pi * frequency_hz * t)[:, None]).real
    assert (left.std(axis=0) < 0.02 * found).all()


def test_an_unwinder_that_runs_out_of_true_ripples_at_its_own_radius() -> None:
    v0, share, radius_m = 0.5, 1e-3, 0.2
    world = World(plant(3, effects={"unwinder": {"radius_m": radius_m, "eccentricity": share}}), seed=1)
    world.start_at_equilibrium(TENSION_N, v0)
    v = world.surface_speed_m_per_s.copy()
    frequency_hz = v0 / (2.0 * np.pi * radius_m)
    world.advance(60.0)
    rows = rows_of(world, 60.0 + 10.0 / frequency_hz)
    forcing = np.zeros(6)
    forcing[0] = -STIFFNESS_N / LENGTH_M * share * v0
    assert np.abs(ripple(rows, frequency_hz, 3)) == pytest.approx(
        np.abs(answer(v, v0, forcing, frequency_hz))[:3], rel=0.01
    )
    assert rows[:, 9].max() == pytest.approx(v0 * (1.0 + share), rel=1e-9)
    assert world.measure_unwind_speed_m_per_s() == v0  # its encoder knows nothing of it


def test_an_encoder_knows_nothing_of_eccentricity() -> None:
    world = World(plant(3, effects={"eccentricity": {"share": 0.01}}), seed=1)
    world.start_at_equilibrium(TENSION_N, 0.1)
    world.advance(0.5)
    assert np.array_equal(world.measure_speeds_m_per_s(), world.surface_speed_m_per_s)
    assert np.abs(world.speed_m_per_s / world.surface_speed_m_per_s - 1.0).max() > 1e-3


def reels(thickness_m: float, **effects: object) -> World:
    tables = {"reels": {"thickness_m": thickness_m, "width_m": 0.5, "density_kg_per_m3": 1000.0}, **effects}
    return World(plant(3, effects=tables), seed=1)


def test_the_reels_radii_follow_the_web_that_has_passed() -> None:
    """Its area is kept: pi r^2 changes by h L."""
    world = reels(5e-4, unwinder={"radius_m": 0.2})
    world.start_at_equilibrium(TENSION_N, 1.0)
    rows = rows_of(world, 60.0)
    unwound_m, wound_m = 60.0, float(rows[:, 5].sum()) * 0.001
    radius = world.use_full_line().radius_m
    assert radius[0] ** 2 == pytest.approx(0.2**2 - 5e-4 * unwound_m / np.pi, rel=1e-9)
    assert radius[3] ** 2 == pytest.approx(RADIUS_M**2 + 5e-4 * wound_m / np.pi, rel=1e-4)
    assert radius[1:3].tolist() == [RADIUS_M, RADIUS_M]
    assert radius[3] > 2.5 * RADIUS_M


def test_an_unwound_reel_ends_at_its_core() -> None:
    world = reels(5e-4, unwinder={"radius_m": 0.06, "core_radius_m": 0.05})
    world.start_at_equilibrium(TENSION_N, 1.0)
    world.advance(20.0)
    assert world.use_full_line().radius_m[0] == pytest.approx(0.05, rel=1e-4)


def test_a_reel_that_has_grown_is_harder_to_turn_and_has_a_longer_arm() -> None:
    """dw/dt = R/J u with the inertia of a hollow cylinder beside what it was at the start."""
    world = World(
        plant(
            1,
            web={"stiffness_n": 1e-9},
            rollers={"friction_nms_per_rad": 0.0},
            effects={"reels": {"thickness_m": 1e-3, "width_m": 0.5, "density_kg_per_m3": 1000.0}},
        ),
        seed=1,
    )
    world.set_torque_nm(0, 20.0)
    world.advance(20.0)
    r = float(world.use_full_line().radius_m[1])
    inertia = INERTIA_KG_M2 + 0.5 * np.pi * 1000.0 * 0.5 * (r**4 - RADIUS_M**4)
    before = float(world.speed_m_per_s[0])
    world.set_torque_nm(0, 120.0)
    world.advance(20.001)
    with_more = float(world.speed_m_per_s[0]) - before
    world.set_torque_nm(0, 20.0)
    before = float(world.speed_m_per_s[0])
    world.advance(20.002)
    gained = with_more - (float(world.speed_m_per_s[0]) - before)
    assert inertia > 1.1 * INERTIA_KG_M2
    assert gained == pytest.approx(r / inertia * 100.0 * 0.001, rel=1e-3)


def test_a_growing_reel_that_turns_evenly_winds_faster() -> None:
    """Without torque and friction omega stays: w/R is constant, and so is nothing else."""
    world = World(
        plant(
            1,
            web={"stiffness_n": 1e-9},
            rollers={"friction_nms_per_rad": 0.0},
            effects={"reels": {"thickness_m": 1e-3, "width_m": 1e-6}},
        ),
        seed=1,
    )
    world.set_torque_nm(0, 10.0)
    world.advance(3.0)
    world.set_torque_nm(0, 0.0)
    before = world.speed_m_per_s[0] / world.use_full_line().radius_m[1]
    radius_m = float(world.use_full_line().radius_m[1])
    world.advance(10.0)
    assert world.use_full_line().radius_m[1] > 1.2 * radius_m
    assert world.speed_m_per_s[0] / world.use_full_line().radius_m[1] == pytest.approx(before, rel=1e-7)

"""Time, noise and inputs of the simulated line."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import sim_plant
from sim_plant.plant import Plant, load_plant
from sim_plant.world import World

PLANT = load_plant(Path(sim_plant.__file__).parent / "plants" / "s_real.toml")
TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])


def with_(plant: Plant, **tables: dict[str, Any]) -> Plant:
    document = plant.model_dump()
    return Plant.model_validate({**document, **{key: {**document[key], **value} for key, value in tables.items()}})


def state(world: World) -> NDArray[np.float64]:
    return np.concatenate((world.tension_n, world.speed_m_per_s, world.torque_nm, [world.unwind_speed_m_per_s]))


def test_it_starts_at_standstill_without_tension_and_torque() -> None:
    quiet = with_(PLANT, rollers={"disturbance_m_per_s2": 0.0})
    world = World(quiet, seed=1)
    assert not state(world).any()
    world.advance(0.5)
    assert world.now_s == 0.5 and not state(world).any()


def test_at_equilibrium_it_stays_there() -> None:
    world = World(with_(PLANT, rollers={"disturbance_m_per_s2": 0.0}), seed=1)
    torque_nm = world.start_at_equilibrium(TENSION_N, 0.01)
    assert np.array_equal(torque_nm, world.torque_nm)
    world.advance(5.0)
    assert np.abs(world.tension_n - TENSION_N).max() < 1e-9


@settings(max_examples=30)
@example(calls=[1.023, 1.024, 1.025, 2.047, 2.048], seed=1)  # around the ends of the blocks of noise
@given(calls=st.lists(st.floats(0.0, 3.0), max_size=60), seed=st.integers(0, 2**32))
def test_the_pattern_of_calls_changes_nothing(calls: list[float], seed: int) -> None:
    """Whole or in pieces, forwards and (ignored) backwards, across the blocks in which noise is drawn, ahead or not."""
    changes = {0.5: 10.0, 1.7: -3.0}  # torque of roller 2, at these times
    worlds = World(PLANT, seed), World(PLANT, seed)
    for world, stops in zip(worlds, ([], calls), strict=True):
        world.start_at_equilibrium(TENSION_N, 0.01)
        begin = 0.0
        for time_s, torque_nm in [*changes.items(), (3.0, 0.0)]:
            for stop in stops:
                if stop <= time_s and (stop >= begin or world.now_s >= begin):
                    world.advance(stop)
                    world.draw_ahead()
            world.advance(time_s)
            world.set_torque_nm(1, torque_nm)
            begin = time_s
    whole, pieces = worlds
    assert whole.steps == pieces.steps == 3000
    assert np.array_equal(state(whole), state(pieces))
    assert np.array_equal(whole.measure_tensions_n(), pieces.measure_tensions_n())
    assert np.array_equal(whole.measure_speeds_m_per_s(), pieces.measure_speeds_m_per_s())
    assert whole.measure_unwind_speed_m_per_s() == pieces.measure_unwind_speed_m_per_s()


def test_another_seed_is_another_run() -> None:
    worlds = [World(PLANT, seed) for seed in (1, 1, 2)]
    for world in worlds:
        world.start_at_equilibrium(TENSION_N, 0.01)
        world.advance(1.0)
    assert np.array_equal(state(worlds[0]), state(worlds[1]))
    assert np.abs(worlds[0].tension_n - worlds[2].tension_n).min() > 1e-3


def test_every_millisecond_is_reached_although_decimal_fractions_are_not_exact() -> None:
    world = World(PLANT, seed=1)
    for k in range(1, 3000):
        world.advance(k / 1000.0)
        assert world.steps == k
    world = World(PLANT, seed=1)
    world.advance(0.0099999)
    assert world.steps == 9


def test_sensor_noise_has_the_plants_spread_and_no_memory() -> None:
    quiet = with_(PLANT, rollers={"disturbance_m_per_s2": 0.0})
    world = World(quiet, seed=7)
    world.start_at_equilibrium(TENSION_N, 0.1)
    true_speed = world.speed_m_per_s.copy()
    readings = []
    for k in range(20_000):
        world.advance(k / 1000.0)
        tension, speed = world.measure_tensions_n() - TENSION_N, world.measure_speeds_m_per_s() - true_speed
        readings.append(np.concatenate((tension, speed, [world.measure_unwind_speed_m_per_s() - 0.1])))
    noise = np.array(readings) / np.repeat([0.1, 1e-4], [6, 7])
    correlation = np.corrcoef(noise.T) - np.eye(13)
    lagged = [np.corrcoef(noise[:-1, i], noise[1:, i])[0, 1] for i in range(13)]
    # 20,000 samples: the standard errors are 0.007 (mean, correlation) and 0.005 (spread)
    assert np.abs(noise.mean(axis=0)).max() < 0.03
    assert np.abs(noise.std(axis=0) - 1.0).max() < 0.03
    assert np.abs(correlation).max() < 0.04
    assert np.abs(lagged).max() < 0.03


def test_process_noise_has_the_plants_intensity() -> None:
    """With a free web (no stiffness to speak of) a roller is a first-order lag: var v = (b^2 dt) J / (2 f)."""
    free = with_(PLANT, web={"stiffness_n": 1e-6})
    world = World(free, seed=3)
    speeds = []
    world.on_rows = lambda _first, rows: speeds.append(rows[:, 6:12].copy())
    world.advance(200.0)
    found = np.concatenate(speeds)[1000:].std(axis=0)
    expected = np.sqrt(0.05**2 * 0.001 * 1.0 / (2 * 15.0))
    assert found == pytest.approx(np.full(6, expected), rel=0.06)  # some 3,000 independent values each


def test_two_readings_in_a_millisecond_are_one_measurement() -> None:
    world = World(PLANT, seed=1)
    world.advance(0.0101)
    first = world.measure_tension_n(2)
    world.advance(0.0109)
    assert world.measure_tension_n(2) == first == world.measure_tensions_n()[2]
    world.advance(0.011)
    assert world.measure_tension_n(2) != first


def test_inputs_act_from_now_on() -> None:
    world = World(PLANT, seed=1)
    rows = []
    world.on_rows = lambda first, piece: rows.extend(zip(range(first, first + len(piece)), piece.copy(), strict=True))
    world.advance(0.010)
    world.set_torque_nm(0, 5.0)
    world.set_unwind_speed(0.02)
    world.advance(0.020)
    world.ramp_torque_nm(0, 0.0, 1000.0)
    world.ramp_unwind_speed(0.0, 10.0)
    world.advance(0.030)
    torque = {step: row[12] for step, row in rows}
    speed = {step: row[18] for step, row in rows}
    assert [step for step, _ in rows] == list(range(1, 31))
    assert torque[10] == 0.0 and torque[11] == 5.0 and torque[20] == 5.0
    assert [torque[k] for k in range(21, 27)] == pytest.approx([4.0, 3.0, 2.0, 1.0, 0.0, 0.0])
    assert speed[10] == 0.0 and speed[11] == 0.02 and speed[21] == pytest.approx(0.01) and speed[22] == 0.0


def test_timers_act_at_their_own_time_and_in_order() -> None:
    world = World(PLANT, seed=1)
    acted: list[tuple[str, float, int]] = []
    late = world.timer(lambda due_s: acted.append(("late", due_s, world.steps)))
    early = world.timer(lambda due_s: acted.append(("early", due_s, world.steps)))
    late.due_s, early.due_s = 0.0204, 0.010
    world.advance(0.005)
    assert not acted
    world.advance(1.0)
    assert acted == [("early", 0.010, 10), ("late", 0.0204, 20)]
    assert world.steps == 1000


def test_a_timer_that_is_set_within_a_millisecond_acts_in_it() -> None:
    world = World(PLANT, seed=1)
    acted: list[float] = []
    timers = [world.timer(acted.append) for _ in range(2)]
    timers[0].due_s = 0.0109
    world.advance(0.0102)
    timers[1].due_s = 0.0105
    world.advance(0.0104)
    assert acted == []
    world.advance(0.0106)
    assert acted == [0.0105]
    timers[1].due_s = 0.001  # has passed: at once
    world.advance(0.0106)
    assert acted == [0.0105, 0.001]
    timers[0].due_s = 0.0108  # sooner
    world.advance(0.0108)
    assert acted == [0.0105, 0.001, 0.0108] and world.steps == 10


def test_sixty_spans() -> None:
    world = World(Plant.model_validate({**PLANT.model_dump(), "spans": 60}), seed=1)
    world.start_at_equilibrium(np.resize(TENSION_N, 60), 0.01)
    world.advance(1.0)
    assert world.tension_n.shape == (60,)
    assert 0.0 < world.tension_n.min() and world.tension_n.max() < 100.0

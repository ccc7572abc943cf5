"""What sensors make of the truth."""

import numpy as np
import pytest

from sim_plant.devices.misreading import Misreading
from sim_plant.effects_sensors import LoadCells, quantised
from sim_plant.plant import Sensors
from sim_plant.world import World
from tests.unit.sim_effects_support import plant, rows_of

TENSION_N = np.array([28.0, 36.0, 20.0])


def cells(n: int, seed: int = 1, **what: object) -> LoadCells:
    return LoadCells(Sensors.model_validate(what), n, np.random.default_rng(seed))


@pytest.mark.parametrize(("corner_hz", "shift"), [(5.0, 0.0), (20.0, 0.0), (20.0, 2.0)])
def test_the_low_pass_has_its_corner_where_it_is_told(corner_hz: float, shift: float) -> None:
    """-3 dB and -45 degrees at the corner, and 1/sqrt(1 + 4) at twice of it."""
    low_pass = cells(1, tension_corner_hz=corner_hz)
    frequency_hz = corner_hz * (1.0 if shift == 0.0 else shift)
    t = 0.001 * np.arange(1, 8001)
    shown = []
    for moment in t:
        low_pass.follow(np.full((1, 4), np.sin(2 * np.pi * frequency_hz * moment)))
        shown.append(low_pass.reading_n(0, 0.0, np.zeros(1))[0])
    late = t > 2.0
    wave = np.exp(-2j * np.pi * frequency_hz * t[late])
    amplitude = 2.0 * np.abs(np.mean(np.array(shown)[late] * wave))
    assert amplitude == pytest.approx(1.0 / np.sqrt(1.0 + (frequency_hz / corner_hz) ** 2), rel=0.005)


def test_the_filter_starts_settled_and_then_follows_the_line() -> None:
    world = World(plant(3, sensors={"tension_corner_hz": 5.0}), seed=1)
    world.start_at_equilibrium(TENSION_N, 0.1)
    assert world.measure_tensions_n() == pytest.approx(TENSION_N, rel=1e-12)
    world.ramp_torque_nm(0, 15.0, np.inf)
    true = rows_of(world, 0.2)[:, :3]
    filtered = TENSION_N.copy()
    for row in true:
        filtered += (1.0 - np.exp(-2.0 * np.pi * 5.0 * 0.001)) * (row - filtered)
    assert np.abs(true[-1] - filtered).max() > 0.1
    assert world.measure_tensions_n() == pytest.approx(filtered, rel=1e-12)
    assert world.measure_tension_n(1) == world.measure_tensions_n()[1]


def test_the_zero_is_off_and_moves_with_the_tension() -> None:
    sensors = {"tension_zero_n": [0.5, -0.25, 0.0], "tension_zero_per_n": [0.0, 0.01, -0.02]}
    world = World(plant(3, sensors=sensors), seed=1)
    assert world.measure_tensions_n().tolist() == [0.5, -0.25, 0.0]
    world.start_at_equilibrium(TENSION_N, 0.0)
    assert world.measure_tensions_n() == pytest.approx([28.5, 36.0 * 1.01 - 0.25, 20.0 * 0.98])


def test_a_drift_is_a_straight_line() -> None:
    world = World(plant(2, sensors={"tension_drift_n_per_s": [0.01, -0.02]}), seed=1)
    for now_s in (0.0, 10.0, 50.0):
        world.advance(now_s)
        assert world.measure_tensions_n() == pytest.approx(np.array([0.01, -0.02]) * now_s, abs=1e-12)


def test_a_random_walk_spreads_with_the_root_of_time_and_never_jumps() -> None:
    many = cells(2000, tension_walk_n_per_sqrt_s=0.3)
    last, spread = np.zeros(2000), []
    for block in range(5):
        many.draw(1000)
        rows = [many.reading_n(row, 0.0, np.zeros(2000)) for row in range(1000)]
        assert np.abs(rows[0] - last).max() < 6.0 * 0.3 * np.sqrt(0.001)
        last = rows[-1]
        if block in (0, 3):
            spread.append(last.std())
    # 2,000 channels: the standard error of a spread is 1.6 %
    assert spread == pytest.approx([0.3, 0.6], rel=0.06)


def test_readings_come_in_steps_and_nearer_than_half_of_one() -> None:
    sensors = {"tension_step_n": 0.25, "speed_step_m_per_s": 0.004, "tension_noise_n": 1.0, "speed_noise_m_per_s": 0.01}
    coarse, fine = World(plant(3, sensors=sensors), seed=1), World(plant(3, sensors=sensors | _NO_STEPS), seed=1)
    for world in (coarse, fine):
        world.start_at_equilibrium(TENSION_N, 0.1)
    for k in range(200):
        for world in (coarse, fine):
            world.advance(0.001 * k)
        for step, shown, exact in (
            (0.25, coarse.measure_tensions_n(), fine.measure_tensions_n()),
            (0.004, coarse.measure_speeds_m_per_s(), fine.measure_speeds_m_per_s()),
            (0.004, coarse.measure_unwind_speed_m_per_s(), fine.measure_unwind_speed_m_per_s()),
        ):
            assert np.abs(shown / step - np.rint(shown / step)).max() < 1e-9
            assert np.abs(shown - exact).max() <= step / 2 + 1e-12
        assert coarse.measure_speed_m_per_s(2) == coarse.measure_speeds_m_per_s()[2]


_NO_STEPS = {"tension_step_n": 0.0, "speed_step_m_per_s": 0.0}


def test_what_a_sensor_suffers_does_not_change_the_line_nor_the_noise() -> None:
    errs = {"tension_walk_n_per_sqrt_s": 0.5, "tension_noise_n": 0.1}
    noisy = {"disturbance_m_per_s2": 0.05}
    walking = World(plant(3, rollers=noisy, sensors=errs), seed=5)
    ideal = World(plant(3, rollers=noisy, sensors={"tension_noise_n": 0.1}), seed=5)
    for world in (walking, ideal):
        world.start_at_equilibrium(TENSION_N, 0.1)
        world.advance(3.0)
    assert walking.is_plain and np.array_equal(walking.tension_n, ideal.tension_n)
    assert np.array_equal(walking.measure_speeds_m_per_s(), ideal.measure_speeds_m_per_s())
    assert np.abs(walking.measure_tensions_n() - ideal.measure_tensions_n()).max() > 0.05


def test_no_step_leaves_a_value_as_it_is() -> None:
    value = np.array([1.234567891234])
    assert quantised(value, 0.0) is value


def test_a_sensor_that_sticks_stays_at_what_it_shows_next() -> None:
    sensor = Misreading()
    sensor.stick()
    assert [sensor.shown(value, step) for step, value in enumerate((3.0, 4.0, 5.0))] == [3.0, 3.0, 3.0]
    sensor.heal()
    assert sensor.healthy and sensor.shown(6.0, 4) == 6.0


def test_a_spike_is_one_measurement_however_often_it_is_read() -> None:
    sensor = Misreading()
    sensor.spike(5.0)
    assert [sensor.shown(1.0, step) for step in (40, 40, 41, 42)] == [6.0, 6.0, 1.0, 1.0]


def test_offset_and_drift_add_up() -> None:
    sensor = Misreading()
    sensor.offset(0.5, 2.0, step=1000)
    assert sensor.shown(10.0, 1000) == 10.5 and sensor.shown(10.0, 1250) == pytest.approx(11.0)


def test_no_number_and_any_number() -> None:
    sensor = Misreading()
    sensor.nan()
    assert np.isnan(sensor.shown(1.0, 0))
    sensor.show(1e6)
    assert sensor.shown(1.0, 0) == 1e6

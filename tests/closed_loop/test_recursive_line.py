"""The recursive estimator on the simulated line under control: bias, intervals, spread between rollers, drift."""

import numpy as np
import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.recording import recording_of
from gateway.core.telemetry import frame_dtype
from gateway.core.theta import Noise
from gateway.identification.estimate import Structure
from gateway.identification.recursive import Settings, begin, estimate, estimated_recursively, live, samples_of, update
from tests.closed_loop.recorded import TENSION_N, demonstration_line, per_roller, real_plant, recorded

SEEDS = 6
TRUTH = {
    "stiffness_per_length": 2200.0 / 1.2,
    "radius_per_inertia": 0.035,
    "friction_per_inertia": 15.0,
    "radius2_per_inertia": 0.035**2,
    "stiffness_n": 2200.0,
    "length_m": 1.2,
    "radius_m": 0.035,
    "inertia_kg_m2": 1.0,
    "friction_nms_per_rad": 15.0,
}
STRONG = ("stiffness_per_length", "radius_per_inertia", "friction_per_inertia")


@pytest.fixture(scope="module")
def recordings():
    return [recorded(real_plant(), seed) for seed in range(SEEDS)]


def errors(found, name):
    return np.array([estimate.intervals[name].value / TRUTH[name] - 1.0 for estimate in found])


def differenced(recording):
    """f/J of each roller by least squares on differences of raw samples."""
    v, T = recording.speed_m_per_s, np.hstack((recording.tension_n, np.zeros((recording.samples, 1))))
    k = np.arange(1, recording.samples - 1)
    found = []
    for i in range(recording.n):
        regressors = np.stack((-v[k, i], recording.torque_nm[k - 1, i], T[k, i + 1] - T[k, i]), axis=1)
        found.append(np.linalg.lstsq(regressors, (v[k + 1, i] - v[k, i]) / recording.period_s, rcond=None)[0][0])
    return np.array(found)


def test_strong_combinations_are_unbiased_where_raw_differences_are_not(recordings):
    settings = Settings(demonstration_line())
    found = [estimated_recursively(settings, data) for data in recordings]
    for name in STRONG:
        of_all = errors(found, name)
        assert np.sqrt(np.mean(of_all**2)) < 3e-3, name
        # The mean of six has a standard error of about 0.05 %.
        assert abs(of_all.mean()) < 1.5e-3, name
    assert abs(np.mean([differenced(data) for data in recordings]) / 15.0 - 1.0) > 0.05
    for name in ("radius_m", "inertia_kg_m2", "friction_nms_per_rad", "stiffness_n", "length_m"):
        assert np.sqrt(np.mean(errors(found, name) ** 2)) < 0.025, name


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_the_filter_need_not_know_the_noise_well(recordings, scale):
    """Speeds half or twice as noisy as they are: the ratio of variances is off by four."""
    settings = Settings(demonstration_line(), Noise(speed_m_per_s=scale * 1e-4))
    found = [estimated_recursively(settings, data) for data in recordings[:3]]
    for name in STRONG:
        assert abs(errors(found, name).mean()) < 3e-3, name


def test_noisier_sensors_do_not_bias_it():
    plant = real_plant()
    plant = plant.model_copy(update={"sensors": plant.sensors.model_copy(update={"speed_noise_m_per_s": 5e-4})})
    recordings = [recorded(plant, seed) for seed in range(3)]
    settings = Settings(demonstration_line(), Noise(speed_m_per_s=5e-4))
    found = [estimated_recursively(settings, data) for data in recordings]
    for name in STRONG:
        assert abs(errors(found, name).mean()) < 6e-3, name
    assert abs(np.mean([differenced(data) for data in recordings]) / 15.0 - 1.0) > 0.05


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_a_quiet_line_biases_nothing(scale):
    """20 s at standing set-points: what moves is noise, and the loop's answer to it. Spans wait for more."""
    settings = Settings(demonstration_line(), Noise(acceleration_m_per_s1_5=scale * 1.6e-3))
    data = [recorded(real_plant(), 70 + seed, 20.0, amplitude_n=0.0) for seed in range(2)]
    found = [estimated_recursively(settings, each) for each in data]
    for name in ("radius_per_inertia", "friction_per_inertia"):
        assert abs(errors(found, name).mean()) < 0.03, name
    prior = estimate(settings, begin(settings)).intervals["stiffness_per_length"]
    assert found[0].intervals["stiffness_per_length"].value == pytest.approx(prior.value)


def test_intervals_cover_the_truth_of_rollers_that_differ():
    """Six lines, each roller and span off by up to 10 %, each by itself: 288 intervals of 95 %."""
    settings = Settings(demonstration_line())
    covered, of_strong = [], []
    for seed in range(SEEDS):
        plant = per_roller(real_plant(), 0.1, 100 + seed)
        web = plant.parameters()
        truth = {
            "stiffness_per_length": web.stiffness_n / web.length_m,
            "radius_per_inertia": web.radius_m / web.inertia_kg_m2,
            "friction_per_inertia": web.friction_nms_per_rad / web.inertia_kg_m2,
            "radius2_per_inertia": web.radius_m**2 / web.inertia_kg_m2,
            "length_m": web.length_m,
            "radius_m": web.radius_m,
            "inertia_kg_m2": web.inertia_kg_m2,
            "friction_nms_per_rad": web.friction_nms_per_rad,
        }
        found = estimated_recursively(settings, recorded(plant, seed), Structure(per_roller=True)).intervals
        for name, values in truth.items():
            for i, value in enumerate(values.tolist(), start=1):
                covered.append(found[f"{name}[{i}]"].covers(value))
                if name in STRONG:
                    of_strong.append(found[f"{name}[{i}]"].value / value - 1.0)
    assert 0.88 <= np.mean(covered) <= 1.0
    assert np.sqrt(np.mean(np.square(of_strong))) < 5e-3


def test_two_speeds_are_one_line():
    data = recorded(real_plant(), 5, 3.0, speeds_m_per_s=(0.01, 0.05))
    found = [estimated_recursively(Settings(demonstration_line()), data)]
    for name in STRONG:
        assert abs(errors(found, name)[0]) < 5e-3, name


def test_drives_that_lag_by_5_ms_are_no_trouble_when_it_is_known():
    plant = real_plant()
    plant = plant.model_copy(update={"drives": plant.drives.model_copy(update={"torque_lag_s": 0.005})})
    data = recorded(plant, 0)
    line = demonstration_line()
    found = [estimated_recursively(Settings(line, torque_lag_s=0.005), data)]
    for name in STRONG:
        assert abs(errors(found, name)[0]) < 6e-3, name
    assert abs(errors([estimated_recursively(Settings(line), data)], "radius_per_inertia")[0]) > 0.05


@pytest.mark.parametrize("quiet", [False, True])
def test_drift_of_friction_is_followed_within_a_second(quiet):
    """A bearing of roller 3 has 20 % more friction from 12 s on, during an experiment or in quiet production."""
    settings = live(demonstration_line())
    data = worn(12.0, 3, 1.2, amplitude_n=0.0 if quiet else 2.0)
    state, structure = begin(settings), Structure(per_roller=True)
    rate, torque, web = (
        f"{name}[3]" for name in ("friction_per_inertia", "radius_per_inertia", "stiffness_per_length")
    )
    courses = []
    for k, sample in enumerate(samples_of(data)):
        update(settings, state, sample)
        if k % 20 == 19 and k > 600:
            found = estimate(settings, state, structure).intervals
            courses.append((sample.time_s, found[rate].value, found[torque].value, found[web].value))
    time_s, rates, torques, webs = np.array(courses).T
    before, after = time_s < 12.0, time_s > 13.0
    assert np.abs(rates[before] / 15.0 - 1.0).max() < 0.02
    assert np.abs(rates[after] / 18.0 - 1.0).max() < 0.025  # 90 % of the way is 17.7
    assert np.abs(torques / 0.035 - 1.0).max() < 0.02  # friction alone has changed
    assert np.abs(webs * 1.2 / 2200.0 - 1.0).max() < 0.03


def worn(at_s, roller, factor, amplitude_n, duration_s=18.0, experiment_s=5.0):
    """A recording that begins with an experiment; `amplitude_n` of set-points after it."""
    line = demonstration_line()
    loop = SteppedLoop(line, design_lqi(task_of(line)), real_plant(), 1)
    loop.begin_in_production(np.array(TENSION_N), 0.05)
    generator = np.random.default_rng(1)
    web = loop.truth.world.use_full_line()
    for period in range(round(duration_s / 0.01)):
        if period % 10 == 0:
            amplitude = 2.0 if period * 0.01 < experiment_s else amplitude_n
            for i, sign in enumerate(generator.choice([-1.0, 1.0], line.n)):
                loop.cycle.setpoints.step_tension(i, TENSION_N[i] + amplitude * sign, loop.now_s)
        if period == round(at_s / 0.01):
            web.set_friction_factor(roller, factor)
        loop.step()
    assert not loop.transitions, loop.transitions
    return recording_of(np.frombuffer(b"".join(loop.frames), frame_dtype(line.n)), 0.01, "worn")

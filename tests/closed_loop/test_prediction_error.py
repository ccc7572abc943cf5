"""The prediction error method on recordings of simulated lines, whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.control.prediction import Unpredictable, predict
from gateway.core.theta import Noise
from gateway.identification.estimate import Structure
from gateway.identification.prediction_error import bootstrap, fit, score, stretches_of
from gateway.identification.prior import prior_of
from tests.closed_loop.recorded import demonstration_line, per_roller, real_plant, recorded, without
from tests.closed_loop.truths import true_values, with_friction_and_lag

STRONG = ("stiffness_per_length", "radius_per_inertia", "friction_per_inertia")
NOISE0 = Noise(0.2, 3e-4, 1e-3)  #: none of it right


@pytest.fixture(scope="module")
def commissioning():
    return recorded(real_plant(), 5)


@pytest.fixture(scope="module")
def fitted(commissioning):
    return fit([commissioning], prior_of(demonstration_line(), Structure()), NOISE0)


def off(fitted, truth):
    """By name: how many standard deviations of the logarithm the estimate is from the truth."""
    maps = fitted.parameters.maps
    return {
        name: float((row @ fitted.logs - np.log(truth[name])) / np.sqrt(row @ fitted.covariance @ row))
        for name, row in maps.items()
    }


def test_five_seconds_tell_the_strong_combinations_to_a_third_of_a_percent(fitted):
    truth = true_values(real_plant(), Structure())
    assert fitted.converged and fitted.iterations <= 10
    assert max(map(abs, off(fitted, truth).values())) < 3.5
    for name in STRONG:
        assert fitted.interval(name).value == pytest.approx(truth[name], rel=0.004)
    for name in ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad"):
        assert fitted.interval(name).value == pytest.approx(truth[name], rel=0.045)


def test_noise_is_found_wherever_the_search_begins(fitted):
    assert fitted.noise.tension_n == pytest.approx(0.1, rel=0.06)
    assert fitted.noise.speed_m_per_s == pytest.approx(1e-4, rel=0.15)
    assert fitted.noise.acceleration_m_per_s1_5 == pytest.approx(5e-2 * np.sqrt(1e-3), rel=0.1)


def test_a_true_model_is_valid_on_data_that_it_has_not_seen(fitted):
    theta = fitted.parameters.theta(fitted.logs)
    found = predict(theta, fitted.noise, stretches_of([recorded(real_plant(), 6)])[0])
    assert found.normalised == pytest.approx(1.0, abs=0.1)
    assert np.allclose(found.normalised_squared, 1.0, atol=0.3)


def test_the_estimate_says_what_it_is(fitted):
    estimate = fitted.estimate
    assert estimate.method == "prediction error" and estimate.samples == 494
    assert set(estimate.intervals) == set(fitted.parameters.maps)
    assert estimate.theta.web.stiffness_n == pytest.approx(estimate.intervals["stiffness_n"].value)
    assert all(interval.low < interval.value < interval.high for interval in estimate.intervals.values())


def test_intervals_agree_with_a_bootstrap(fitted):
    draws = bootstrap(fitted, 60, seed=1)
    for name, row in fitted.parameters.maps.items():
        expected = np.sqrt(row @ fitted.covariance @ row)
        assert float(np.std(draws @ row)) == pytest.approx(expected, rel=0.4), name  # 60 draws: 9 % each


def test_friction_and_lag_are_told_apart_over_two_speeds():
    plant = with_friction_and_lag(real_plant())
    structure = Structure(coulomb=True, torque_lag=True)
    data, unseen = (recorded(plant, seed, speeds_m_per_s=(0.05, 0.1)) for seed in (0, 100))
    found = fit([data], prior_of(demonstration_line(), structure), Noise())
    assert max(map(abs, off(found, true_values(plant, structure)).values())) < 3.5
    assert found.interval("coulomb_nm").value == pytest.approx(2.0, rel=0.05)
    assert found.interval("torque_lag_s").value == pytest.approx(0.005, rel=0.03)
    poor = fit([data], prior_of(demonstration_line(), Structure()), Noise())
    held = stretches_of([unseen], "held")
    assert found.evidence > poor.evidence + 1000.0
    assert score(found, held) > score(poor, held) + 1.0
    assert predict(found.parameters.theta(found.logs), found.noise, held[0]).normalised == pytest.approx(1.0, abs=0.1)


def test_a_step_of_the_unwinder_between_two_samples_is_taken_for_what_it_is():
    data = recorded(real_plant(), 3, speeds_m_per_s=(0.05, 0.1))
    found = fit([data], prior_of(demonstration_line(), Structure()), Noise())
    assert found.stretches[0].unwinder == "held"
    assert found.interval("stiffness_n").value == pytest.approx(2200.0, rel=0.02)


def test_rollers_that_differ():
    plant = per_roller(real_plant(), 0.1, 4)
    structure = Structure(per_roller=True)
    data = recorded(plant, 4)
    found = fit([data], prior_of(demonstration_line(), structure), Noise())
    truth = true_values(plant, structure)
    assert max(map(abs, off(found, truth).values())) < 4.0
    for name in STRONG:
        for i in range(6):
            assert found.interval(f"{name}[{i + 1}]").value == pytest.approx(truth[f"{name}[{i + 1}]"], rel=0.015)
    assert found.evidence > fit([data], prior_of(demonstration_line(), Structure()), Noise()).evidence + 100.0


def test_a_measured_radius_and_length_fix_the_rest(commissioning, fitted):
    prior = prior_of(demonstration_line(), Structure())
    known = fit([commissioning], prior.measured({"radius_m": (0.035, 0.002), "length_m": (1.2, 0.002)}), Noise())
    for name in ("stiffness_n", "inertia_kg_m2", "friction_nms_per_rad"):
        row = known.parameters.maps[name]
        assert row @ known.covariance @ row < 0.2 * (row @ fitted.covariance @ row)
    assert known.interval("inertia_kg_m2").value == pytest.approx(1.0, rel=0.006)


def test_a_latency_that_the_file_has_wrong_is_found(commissioning):
    """12 ms, where torques act after 10."""
    line = demonstration_line()
    wrong = line.model_copy(update={"control": line.control.model_copy(update={"latency_s": 0.012})})
    found = fit([commissioning], prior_of(wrong, Structure(), with_latency=True), Noise())
    interval = found.interval("latency_s")
    assert interval.value == pytest.approx(0.010, abs=3e-4) and interval.high - interval.low < 1e-3


def test_a_gap_and_a_span_without_a_load_cell(commissioning):
    gap = without(commissioning, 240, 260)
    tension = gap.tension_n.copy()
    tension[:, 2] = np.nan
    found = fit([replace(gap, tension_n=tension)], prior_of(demonstration_line(), Structure()), Noise())
    assert len(found.stretches) == 2 and len(found.stretches[0].outputs) == 11
    assert max(map(abs, off(found, true_values(real_plant(), Structure())).values())) < 3.5


def test_nothing_to_use_is_refused(commissioning):
    idle = replace(commissioning, controlled=np.zeros(commissioning.samples, dtype=np.bool_))
    with pytest.raises(Unpredictable, match=r"s-real, seed 5: no 0.5 s in a row, under control"):
        fit([idle], prior_of(demonstration_line(), Structure()), Noise())

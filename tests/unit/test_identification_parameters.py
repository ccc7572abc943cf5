"""The vector of log-parameters, and what is believed of it before data."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.theta import nominal_theta
from gateway.core.unnamed_terms import COULOMB_SHARE, ROLLERS_DIFFER, deviation
from gateway.identification.estimate import Structure
from gateway.identification.parameters import COMBINATIONS, EACH, Parameters
from gateway.identification.prior import prior_after, prior_of

LINE = load_line(line_template(4, "line.toml"), "line.toml")
structures = st.builds(Structure, per_roller=st.booleans(), coulomb=st.booleans(), torque_lag=st.booleans())


def uneven():
    """A base whose rollers differ."""
    base = nominal_theta(LINE)
    return replace(base, web=replace(base.web, radius_m=np.array([0.03, 0.04, 0.05, 0.06])))


@given(structures, st.booleans(), st.integers(0, 2**32 - 1))
def test_logs_to_theta_and_back(structure, with_latency, seed):
    parameters = Parameters(structure, uneven(), with_latency)
    logs = np.random.default_rng(seed).normal(0.0, 1.0, parameters.size)
    theta = parameters.theta(logs)
    assert np.allclose(parameters.logs(theta), logs, atol=1e-9)
    assert (theta.coulomb_nm > 0.0).all() == structure.coulomb
    assert (theta.torque_lag_s > 0.0) == structure.torque_lag
    assert (theta.latency_s == parameters.base.latency_s) != with_latency


@given(structures, st.integers(0, 2**32 - 1))
def test_combinations_are_products_of_the_theta(structure, seed):
    parameters = Parameters(structure, nominal_theta(LINE))
    logs = np.random.default_rng(seed).normal(0.0, 0.3, parameters.size)
    web = parameters.theta(logs).web
    values = {
        "stiffness_per_length": web.stiffness_n / web.length_m,
        "radius_per_inertia": web.radius_m / web.inertia_kg_m2,
        "friction_per_inertia": web.friction_nms_per_rad / web.inertia_kg_m2,
        "radius2_per_inertia": web.radius_m**2 / web.inertia_kg_m2,
    }
    assert values.keys() == COMBINATIONS.keys()
    for name, expected in values.items():
        found = np.exp(parameters.weights(name) @ logs)
        assert len(found) == (4 if structure.per_roller else 1)
        assert np.allclose(found, expected if structure.per_roller else expected[0])


def test_one_factor_keeps_the_pattern_of_the_file():
    parameters = Parameters(Structure(), uneven())
    logs = parameters.logs(uneven())
    assert np.allclose(parameters.theta(logs).web.radius_m, [0.03, 0.04, 0.05, 0.06])
    logs[parameters.names.index("radius_m")] += np.log(1.1)
    assert np.allclose(parameters.theta(logs).web.radius_m, [0.033, 0.044, 0.055, 0.066])


def test_names_that_are_not_there_are_refused_with_those_that_are():
    with pytest.raises(KeyError, match="torque_lag_s: not a parameter.*stiffness_n"):
        Parameters(Structure(), uneven()).weights("torque_lag_s")


def test_the_prior_is_the_file():
    prior = prior_of(LINE, Structure())
    assert np.allclose(prior.mean, prior.parameters.logs(nominal_theta(LINE)))
    assert np.allclose(np.sqrt(np.diag(prior.covariance)), [deviation(t) for t in (0.3, 0.3, 0.2, 0.3, 0.75)])
    assert np.count_nonzero(prior.covariance) == 5


def test_rollers_differ_from_what_they_have_in_common():
    prior = prior_of(LINE, Structure(per_roller=True))
    for name in EACH:
        rows = prior.parameters.weights(name)
        own = rows @ prior.covariance @ rows.T
        differ = rows[0] - rows[1]
        assert np.sqrt(differ @ prior.covariance @ differ) == pytest.approx(np.sqrt(2.0) * deviation(ROLLERS_DIFFER))
        assert own[0, 1] > 0.0
    assert np.linalg.eigvalsh(prior.covariance).min() > 0.0


def test_friction_and_lag_are_believed_to_be_small():
    prior = prior_of(LINE, Structure(coulomb=True, torque_lag=True))
    theta = prior.parameters.theta(prior.mean)
    assert np.allclose(theta.coulomb_nm, COULOMB_SHARE * LINE.limits.torque_nm)
    assert theta.torque_lag_s == pytest.approx(0.003)


def test_the_latency_may_be_asked_for():
    prior = prior_of(LINE, Structure(), with_latency=True)
    row = prior.parameters.maps["latency_s"]
    assert np.exp(row @ prior.mean) == pytest.approx(0.01)
    assert np.sqrt(row @ prior.covariance @ row) == pytest.approx(0.2)


@pytest.mark.parametrize("structure", [Structure(), Structure(per_roller=True)])
def test_what_has_been_measured_is_known(structure):
    prior = prior_of(LINE, structure).measured({"radius_m": (0.035, 0.005), "length_m": (1.2, 0.005)})
    for name, value in (("radius_m", 0.035), ("length_m", 1.2)):
        for row in prior.parameters.weights(name):
            assert np.exp(row @ prior.mean) == pytest.approx(value, rel=1e-3)
            assert np.sqrt(row @ prior.covariance @ row) <= deviation(0.005) * (1.0 + 1e-9)


def test_one_measured_roller_tells_of_the_others():
    before = prior_of(LINE, Structure(per_roller=True))
    after = before.measured({"radius_m[2]": (0.035, 0.001)})
    theta = after.parameters.theta(after.mean)
    assert theta.web.radius_m[1] == pytest.approx(0.035, rel=1e-3)
    assert 0.035 < theta.web.radius_m[0] < 0.038
    with pytest.raises(ValueError, match="radius_m: value and tolerance must be above 0"):
        before.measured({"radius_m": (0.035, 0.0)})


def test_the_next_prior_is_the_last_posterior():
    prior = prior_of(LINE, Structure())
    covariance = np.diag([1e-4, 2e-4, 3e-4, 4e-4, 5e-4])
    mean = prior.mean + 0.05
    again = prior_after(prior, mean, covariance, prior)
    assert np.allclose(again.mean, mean) and np.allclose(again.covariance, covariance)
    looser = prior_after(prior, mean, covariance, prior, drift=0.02)
    assert np.allclose(looser.covariance - covariance, deviation(0.02) ** 2 * np.eye(5))


@pytest.mark.parametrize("structure", [Structure(coulomb=True), Structure(per_roller=True)])
def test_a_posterior_serves_a_richer_structure(structure):
    prior = prior_of(LINE, Structure())
    covariance = np.diag([1e-4, 2e-4, 3e-4, 4e-4, 5e-4])
    wanted = prior_of(LINE, structure)
    after = prior_after(prior, prior.mean + 0.05, covariance, wanted)
    for name, variance in zip(prior.parameters.names, np.diag(covariance), strict=True):
        row = after.parameters.weights(name).mean(axis=0)
        assert row @ after.mean == pytest.approx(prior.parameters.maps[name] @ prior.mean + 0.05)
        assert row @ after.covariance @ row == pytest.approx(variance)
    assert np.linalg.eigvalsh(after.covariance).min() > 0.0
    if structure.coulomb:
        row = after.parameters.maps["coulomb_nm"]
        assert row @ after.covariance @ row == pytest.approx(row @ wanted.covariance @ row)

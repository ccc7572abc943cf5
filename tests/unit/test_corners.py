"""Plants at the corners of what is believed: how far they go, which way, and that the same seed gives the same."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.control.corners import PHYSICAL, NoPosterior, corners, corners_of_line, moved
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_model import LineModel, theta_of
from gateway.core.line_template import line_template
from gateway.core.posterior import posterior_of
from gateway.core.signals import FloatArray
from gateway.core.theta import Theta, nominal_theta
from tests.unit.model_support import any_posterior, fields, model

N = 3


def logs_of(theta: Theta, names: list[str]) -> FloatArray:
    """(k,)"""
    found: list[float] = []
    for name in names:
        base, _, number = name.rstrip("]").partition("[")
        values = np.atleast_1d(getattr(theta if hasattr(theta, base) else theta.web, base))
        found.append(float(np.log(values[int(number) - 1] if number else values[0])))
    return np.array(found)


def moves_of(given_model: LineModel, plants: list[Theta], names: list[str]) -> FloatArray:
    """(plants, k), of the logarithms."""
    mean = logs_of(theta_of(given_model), names)
    return np.array([logs_of(plant, names) for plant in plants]) - mean


def physical_names() -> list[str]:
    return ["stiffness_n", *(f"{base}[{i}]" for base in PHYSICAL[1:] for i in range(1, N + 1))]


@st.composite
def any_model(draw: st.DrawFn) -> LineModel:
    structure = {"per_roller": draw(st.booleans()), "coulomb": False, "torque_lag": False}
    return model(N, structure=structure, posterior=draw(any_posterior(N, 0.3)))


@given(any_model(), st.floats(0.5, 3.0), st.sampled_from([0.0, 0.05]), st.integers(1, 9), st.integers(0, 99))
@settings(max_examples=60)
def test_every_corner_is_between_the_least_share_and_the_box_of_the_axes(
    given_model: LineModel, sigmas: float, least: float, count: int, seed: int
) -> None:
    plants = corners(given_model, sigmas, least, count, seed)
    posterior = posterior_of(given_model)
    assert len(plants) == count and posterior is not None
    every = np.abs(moves_of(given_model, plants, physical_names()))
    assert (every >= np.log1p(least) - 1e-9).all()
    variances, axes = np.linalg.eigh(posterior.covariance)
    box = sigmas * np.abs(axes) @ np.sqrt(np.maximum(variances, 0.0))
    own = np.abs(moves_of(given_model, plants, list(posterior.names)))
    assert (own <= np.maximum(box, np.log1p(least)) + 1e-9).all()


@given(any_model(), st.floats(0.5, 3.0), st.integers(0, 99))
@settings(max_examples=30)
def test_with_no_least_share_corners_are_as_far_as_the_posterior_says_along_every_axis(
    given_model: LineModel, sigmas: float, seed: int
) -> None:
    posterior = posterior_of(given_model)
    assert posterior is not None
    moves = moves_of(given_model, corners(given_model, sigmas, 0.0, 6, seed), list(posterior.names))
    variances, axes = np.linalg.eigh(posterior.covariance)
    along = moves @ axes
    np.testing.assert_allclose(np.abs(along), np.tile(sigmas * np.sqrt(np.maximum(variances, 0.0)), (6, 1)), atol=1e-7)


@given(any_model(), st.integers(0, 99))
@settings(max_examples=20)
def test_the_same_seed_gives_the_same_plants_and_every_second_is_the_opposite(
    given_model: LineModel, seed: int
) -> None:
    names = physical_names()
    moves = moves_of(given_model, corners(given_model, 2.0, 0.05, 8, seed), names)
    np.testing.assert_array_equal(moves, moves_of(given_model, corners(given_model, 2.0, 0.05, 8, seed), names))
    np.testing.assert_allclose(moves[::2], -moves[1::2], atol=1e-9)


def test_parameters_whose_errors_hang_together_move_together() -> None:
    """EA and L to 10 %, their ratio to 0.3 %: so says the posterior, and so do the plants."""
    deviation, ratio = 0.1, 0.003
    correlation = 1.0 - 0.5 * (ratio / deviation) ** 2
    covariance = deviation**2 * np.array([[1.0, correlation], [correlation, 1.0]])
    believed = model(N, posterior={"names": ["stiffness_n", "length_m"], "covariance": covariance.tolist()})
    plants = corners(believed, 2.0, 0.05, 40, 0)
    of_stiffness, of_length = moves_of(believed, plants, ["stiffness_n", "length_m[1]"]).T
    np.testing.assert_allclose(np.abs(of_stiffness), 2.0 * deviation, rtol=0.02)
    np.testing.assert_allclose(np.abs(of_stiffness - of_length), 2.0 * ratio, rtol=0.02)


def test_what_is_known_better_than_the_least_share_moves_by_it_whichever_way() -> None:
    names = list(PHYSICAL)
    believed = model(N, posterior={"names": names, "covariance": (1e-6 * np.eye(5)).tolist()})
    moves = moves_of(believed, corners(believed, 2.0, 0.05, 400, 0), [name + "[1]" for name in names])
    np.testing.assert_allclose(np.abs(moves), np.log(1.05))
    patterns = {tuple(row) for row in (moves > 0.0).tolist()}
    assert len(patterns) == 32


def test_rollers_and_spans_move_each_by_itself_only_where_the_model_has_them_so() -> None:
    posterior = {"names": ["stiffness_n"], "covariance": [[1e-4]]}
    shared = corners(model(N, posterior=posterior), 2.0, 0.05, 20, 0)
    assert all(np.ptp(plant.web.radius_m) == 0.0 for plant in shared)
    structure = {"per_roller": True, "coulomb": False, "torque_lag": False}
    apart = corners(model(N, posterior=posterior, structure=structure), 2.0, 0.05, 20, 0)
    assert any(np.ptp(plant.web.radius_m) > 0.0 for plant in apart)


def terms(**changes: Any) -> LineModel:
    """With Coulomb friction, a lag and a latency that has an interval of its own."""
    document = fields(N)
    document["parameters"] |= {"coulomb_nm": [2.0] * N, "torque_lag_s": 0.004}
    document["intervals"] |= {"latency_s": {"value": 0.01, "low": 0.0095, "high": 0.0112}}
    covariance = np.diag([0.04, 0.09])
    covariance[0, 1] = covariance[1, 0] = 0.03
    document["posterior"] = {"names": ["coulomb_nm", "torque_lag_s"], "covariance": covariance.tolist()}
    return LineModel.model_validate({**document, **changes})


def test_what_the_papers_equations_leave_out_stays_within_its_deviations_or_its_interval() -> None:
    plants = corners(terms(), 2.0, 0.05, 16, 3)
    moves = moves_of(terms(), plants, ["coulomb_nm", "torque_lag_s"])
    assert (np.abs(moves) <= [2.0 * 0.2 + 1e-9, 2.0 * 0.3 + 1e-9]).all()
    assert np.abs(moves).max(axis=0) == pytest.approx([0.4, 0.6])
    assert {plant.latency_s for plant in plants} == {0.0095, 0.0112}


def test_a_term_that_the_model_does_not_have_stays_away() -> None:
    posterior = {"names": ["stiffness_n"], "covariance": [[1e-4]]}
    for plant in corners(model(N, posterior=posterior), 2.0, 0.05, 8, 0):
        assert (plant.torque_lag_s, plant.latency_s) == (0.0, 0.01)
        np.testing.assert_array_equal(plant.coulomb_nm, 0.0)


def test_a_model_without_a_posterior_is_refused() -> None:
    with pytest.raises(NoPosterior, match="has no posterior: identify again"):
        corners(model(), 2.0, 0.05, 8, 0)


@pytest.mark.parametrize(("sigmas", "least", "count"), [(0.0, 0.05, 8), (2.0, -0.1, 8), (2.0, 0.05, 0)])
def test_numbers_that_are_no_corners_are_refused(sigmas: float, least: float, count: int) -> None:
    with pytest.raises(ValueError, match="allowed: sigmas above 0"):
        corners(terms(), sigmas, least, count, 0)


LINE = load_line(line_template(N, "line.toml"), "line.toml")


def box(line: Line, theta: Theta) -> FloatArray:
    """(p,) how far each is from the file's value, in its tolerance."""
    web, nominal = theta.web, nominal_theta(line).web
    tolerances = {
        "stiffness_n": [line.web.stiffness_n.tolerance],
        "length_m": [span.length_m.tolerance for span in line.spans],
        **{name: [getattr(roller, name).tolerance for roller in line.rollers] for name in PHYSICAL[2:]},
    }
    return np.concatenate(
        [
            (np.atleast_1d(getattr(web, name)) / np.atleast_1d(getattr(nominal, name)) - 1.0) / tolerance
            for name, tolerance in tolerances.items()
        ]
    )


def test_corners_of_a_line_are_at_the_ends_of_its_tolerances() -> None:
    plants = corners_of_line(LINE, 60, 1)
    far = np.array([box(LINE, plant) for plant in plants])
    np.testing.assert_allclose(np.abs(far), 1.0)
    families = np.split(far, [1, 4, 7, 10], axis=1)
    assert all((np.ptp(family, axis=1) < 1e-9).all() for family in families)
    assert len({tuple(np.round(row).tolist()) for row in far}) > 20  # of 32, in 30 pairs
    assert {plant.torque_lag_s > 0.0 for plant in plants} == {False, True}
    assert {bool(plant.coulomb_nm[0] > 0.0) for plant in plants} == {False, True}
    assert {round(1e3 * plant.latency_s, 6) for plant in plants} == {8.0, 12.0}


def test_corners_of_a_line_are_the_same_for_the_same_seed_and_opposites_by_two() -> None:
    first, again = corners_of_line(LINE, 6, 4), corners_of_line(LINE, 6, 4)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(box(LINE, one), box(LINE, other))
    for one, other in zip(first[::2], first[1::2], strict=True):
        np.testing.assert_allclose(box(LINE, one), -box(LINE, other))


def test_a_name_without_a_number_moves_all() -> None:
    theta = nominal_theta(LINE)
    found = moved(theta, {"radius_m": 0.1, "length_m[2]": -0.2, "latency_s": 0.3})
    np.testing.assert_allclose(found.web.radius_m, theta.web.radius_m * np.exp(0.1))
    np.testing.assert_allclose(found.web.length_m, theta.web.length_m * [1.0, np.exp(-0.2), 1.0])
    assert found.latency_s == pytest.approx(theta.latency_s * np.exp(0.3))
    assert found.web.stiffness_n == theta.web.stiffness_n

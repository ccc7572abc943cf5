"""What is said of a model: what it rests on, whether it holds on unseen data, and which structure the data call for."""

import numpy as np
import pytest

from gateway.cli.identify_outcome import why
from gateway.core.theta import Noise
from gateway.identification.eccentric_rollers import with_swings
from gateway.identification.estimate import Structure
from gateway.identification.identifiability import identifiability
from gateway.identification.identify import identify, parts
from gateway.identification.prediction_error import fit, stretches_of
from gateway.identification.prior import prior_of
from gateway.identification.structure_choice import choose
from gateway.identification.validation import validate
from tests.bench.gate_contexts import SPEEDS_M_PER_S
from tests.bench.gate_validity import unruly_line
from tests.closed_loop.recorded import demonstration_line, per_roller, real_plant, recorded
from tests.closed_loop.truths import altered, with_friction_and_lag

BOTH = Structure(coulomb=True, torque_lag=True)


@pytest.fixture(scope="module")
def fitted():
    return fit([recorded(real_plant(), 0)], prior_of(demonstration_line(), Structure()), Noise())


@pytest.fixture(scope="module")
def with_friction():
    """Two recordings at two speeds, of a line with Coulomb friction and torque lag."""
    plant = with_friction_and_lag(real_plant())
    return [recorded(plant, seed, 4.0, (0.05, 0.1)) for seed in (0, 1)]


def validated(fitted, recording, unwinder="linear"):
    theta = fitted.parameters.theta(fitted.logs)
    return validate(theta, fitted.noise, stretches_of([recording], unwinder), Noise())


def test_products_are_known_better_than_their_parts(fitted):
    found = identifiability(fitted)
    known = {one.name: one for one in found.known}
    for product, part in (("stiffness_per_length", "stiffness_n"), ("radius_per_inertia", "inertia_kg_m2")):
        assert known[product].posterior < 0.2 * known[part].posterior
    assert known["stiffness_per_length"].told == "strongly" and known["stiffness_n"].told == "weakly"
    weakest, strongest = found.directions[-1], found.directions[0]
    assert strongest.information > 1e4 * weakest.information > 0.0
    assert {"radius_m", "inertia_kg_m2"} <= set(weakest.weights)


def test_directions_are_independent_before_and_after(fitted):
    """In units of the prior they are orthogonal, with the information as variance ratio."""
    found = identifiability(fitted).directions
    names = fitted.parameters.names
    for direction in found[:2]:
        row = np.array([direction.weights.get(name, 0.0) for name in names])
        prior, posterior = (row @ C @ row for C in (fitted.prior.covariance, fitted.covariance))
        assert posterior < 1e-2 * prior  # what is left out of the weights as small keeps it from 1 / information


def test_the_remedy_is_what_a_tape_measure_does(fitted):
    """What is promised of a measured radius is what a fit with it has."""
    promised = identifiability(fitted).remedies["radius_m"]["inertia_kg_m2"]
    prior = fitted.prior.measured({"radius_m": (0.035, 0.002)})
    measured = fit([fitted.stretches[0].recording], prior, Noise())
    row = measured.parameters.maps["inertia_kg_m2"]
    assert np.sqrt(row @ measured.covariance @ row) == pytest.approx(promised, rel=0.1)
    words = identifiability(fitted).words
    assert words[0].startswith("strongly told by the data: EA/L to ±0.") and "f/J to ±0." in words[0]
    assert words[1].startswith("weakly told by the data: EA to ±1.") and "R^2/J" in words[1]
    assert any(word.startswith("measure R to 0.2%: that brings J from") for word in words)


def test_a_true_model_holds(fitted):
    found = validated(fitted, recorded(real_plant(), 1))
    assert found.valid and not found.findings and not found.recommendations
    assert found.mean("tension", "r2") > 0.99 and found.mean("speed", "r2") > 0.99
    assert found.mean("tension", "r2_free") > 0.95
    assert 0.07 < found.mean("tension", "mae") < 0.1  # 0.8 of the load cells' noise is the least
    assert len(found.outputs) == 12 and found.samples == 494


def test_noise_that_makes_up_for_a_structure_is_seen_through(with_friction):
    """Innovations have the size that the fitted noise gives them, and the model is wrong all the same."""
    data, unseen = with_friction
    poor = fit([data], prior_of(demonstration_line(), Structure()), Noise(), "held")
    found = validated(poor, unseen, "held")
    assert 0.8 < found.normalised < 1.2
    assert not found.valid
    assert any("not white" in finding for finding in found.findings)
    assert any("was expected" in finding for finding in found.findings)
    assert any("richer structure" in advice for advice in found.recommendations)


def test_a_model_that_is_off_has_innovations_that_are_too_large(fitted):
    stiffer = fitted.parameters.logs(fitted.parameters.theta(fitted.logs)) + np.array([0.3, 0.0, 0.0, 0.0, 0.0])
    stretches = stretches_of([recorded(real_plant(), 1)])
    found = validate(fitted.parameters.theta(stiffer), fitted.noise, stretches)
    assert not found.valid and found.normalised > 1.2


def test_eccentric_rollers_are_named():
    """0.5 % at roller 3: the spectral line is its turn."""
    plant = altered(real_plant(), {"effects": {"eccentricity": {"share": [0.0, 0.0, 0.005, 0.0, 0.0, 0.0]}}})
    data, unseen = (recorded(plant, seed, 6.0, (0.1,)) for seed in (0, 1))
    found = validated(fit([data], prior_of(demonstration_line(), Structure()), Noise()), unseen)
    assert not found.valid
    assert any("spectral line at 0.4" in finding or "spectral line at 0.5" in finding for finding in found.findings)
    assert any("eccentricity" in advice for advice in found.recommendations)


def test_rollers_are_found_out_of_round_where_round_ones_would_have_another_radius():
    """On this line the fit of round rollers ends at three fifths of the radius, with the swings out of step."""
    line, recording = demonstration_line(), recorded(unruly_line(63_015), 63_030, speeds_m_per_s=SPEEDS_M_PER_S)
    found = choose([recording], line, Noise()).fitted
    assert found.parameters.structure.eccentric == (1, 2, 3, 4, 5, 6)
    assert found.theta.eccentricity == pytest.approx(0.005, rel=0.15)
    assert found.theta.web.radius_m == pytest.approx(0.035, rel=0.05)
    assert found.noise.tension_n == pytest.approx(0.1, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize("known_m", [None, (0.035, 1e-5)], ids=["as in the file", "measured"])
def test_one_roller_out_of_round_among_round_ones(known_m):
    plant = altered(real_plant(), {"effects": {"eccentricity": {"share": [0.0, 0.0, 0.005, 0.0, 0.0, 0.0]}}})
    both = [recorded(plant, seed, 4.0, (0.05, 0.1)) for seed in (0, 1)]
    measured = {} if known_m is None else {"radius_m": known_m}
    found = choose(both, demonstration_line(), Noise(), measured=measured).fitted
    assert found.parameters.structure.eccentric == (3,)
    assert found.eccentricity(3).value == pytest.approx(0.005, rel=0.1)


def test_round_rollers_have_no_swings_to_begin_with(fitted):
    assert with_swings(fitted) is None


def test_friction_and_lag_are_chosen_where_they_are(with_friction):
    data, unseen = with_friction
    found = choose([data], demonstration_line(), Noise(), [unseen])
    assert found.chosen.structure == BOTH
    assert found.chosen.normalised == pytest.approx(1.0, abs=0.1)
    assert found.chosen.held_out == max(candidate.held_out for candidate in found.candidates)
    assert not found.cautions


def test_a_structure_that_a_part_of_the_data_leaves_open_is_decided_by_all_of_them():
    """Rollers that are each up to 2 % off: taken for alike, they have a radius that is wrong by three times that."""
    plant = per_roller(real_plant().model_copy(update={"spans": 2}), 0.02, 3)
    data = recorded(plant, 3, 2.5, (0.03, 0.05))
    before, held = parts([data])
    part = choose(before, demonstration_line(2), Noise(), held)
    assert part.chosen.structure == Structure() and part.turned is None
    found = identify([data], demonstration_line(2), Noise(), lambda: 0.0)
    assert found.choice.chosen.structure == found.estimate.structure == Structure(per_roller=True)
    assert found.choice.turned is not None and found.choice.turned[0].structure == Structure()
    assert "a part of the data does not tell it from 'as in the paper'" in why(found.choice)
    taken_for_alike, apart = (
        np.abs(one.theta.web.radius_m / plant.parameters().radius_m - 1.0).max() for one in (part.fitted, found.fitted)
    )
    assert apart < 0.6 * taken_for_alike


def test_nothing_is_chosen_beyond_what_is_there_and_one_speed_is_told():
    found = choose([recorded(real_plant(), 0)], demonstration_line(), Noise())
    assert found.chosen.structure == Structure()
    assert [candidate.structure for candidate in found.candidates][0] == Structure()
    assert len(found.cautions) == 1 and "one speed only (0.05 m/s)" in found.cautions[0]

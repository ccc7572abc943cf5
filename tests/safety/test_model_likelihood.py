"""What the data say of a model: the numbers against a straight computation, and what a person reads."""

from dataclasses import replace
from math import exp, log, sqrt

import numpy as np
import pytest
from scipy.linalg import solve_triangular
from scipy.stats import multivariate_normal

from gateway.control.corners import moved
from gateway.control.prediction import innovations, predict
from gateway.core.line import Parameter
from gateway.core.line_model import noise_of, theta_of
from gateway.core.line_model_posterior import ModelPosterior
from gateway.core.verdict import RuleFinding
from gateway.identification.estimate import Structure
from gateway.identification.prior import prior_of
from safety.believed import Unbelievable
from safety.findings import told
from safety.rules import model_likelihood
from tests.safety.case_support import case_of, proposal

NAMES = ["stiffness_n", "radius_m", "friction_nms_per_rad"]


def judged(of, context, model=None):
    """A case about a model."""
    return case_of(proposal({"kind": "model", "model": (model or of.model).model_dump()}, context), context, of)


def of_noise(model, **factors):
    noise = {name: factor * getattr(model.noise, name) for name, factor in factors.items()}
    return model.model_copy(update={"noise": model.noise.model_copy(update=noise)})


def likelihood(theta, noise, found):
    """Logarithm, sample by sample from the densities of the innovations, on the stretches of what was found."""
    total = 0.0
    for one in found:
        predicted = predict(theta, noise, one.predicted.stretch)
        for e, S in zip(predicted.innovation, predicted.covariance, strict=True):
            total += multivariate_normal.logpdf(e, cov=S)
    return total


def finding(rule, passed, value, limit, text):
    """Without a unit."""
    margin = value - limit if rule in (model_likelihood.SURENESS, model_likelihood.OTHERS) else limit - value
    return RuleFinding(rule=rule, passed=passed, value=value, limit=limit, margin=margin, unit="", text=text)


@pytest.mark.parametrize(("normalised", "scale"), [(0.5, 1.0), (3.0, 3.0)])
def test_shift_and_sureness_of_parameters_that_have_nothing_to_do_with_each_other(
    of, context, monkeypatch, normalised, scale
):
    told_by_data, told_before = [3e4, 1e4, 400.0], [300.0, 100.0, 20.0]
    own, gradient = [5e-6, 4e-3, 0.2], [384.0, -1920.0, 211.0]
    model = of.model.model_copy(
        update={"posterior": ModelPosterior(names=NAMES, covariance=np.diag(own).tolist()), "intervals": {}}
    )
    monkeypatch.setattr(
        model_likelihood, "derivatives", lambda look, names: (np.diag(told_by_data), np.array(gradient))
    )
    monkeypatch.setattr(model_likelihood, "prior_precision", lambda line, names: np.diag(told_before))
    monkeypatch.setattr(model_likelihood, "normalised", lambda found: normalised)
    case = judged(of, of.context(data=[*context.data, *context.data]), model)
    shift, sureness = model_likelihood.check_sureness(case)

    open_, step, least = [], [], []
    for f, p, c, g in zip(told_by_data, told_before, own, gradient, strict=True):
        supported = 1.0 / (f / scale + p)
        step.append(-g / scale * supported)
        open_.append(c + supported)
        least.append(c / supported * 520.0 / 508.0)  # samples that there are, over predictions that are looked at
    value = sum(d**2 / variance for d, variance in zip(step, open_, strict=True))
    # Friction goes farthest, radius farthest beyond what is open; the model is surer of its stiffness than the data.
    assert np.argmax(np.abs(step)) == 2 and own[0] < open_[0] - own[0]
    assert shift.value == pytest.approx(value) and sureness.value == pytest.approx(min(least))
    assert shift == finding(
        "model: shift", scale == 3.0, shift.value, 12.0,
        f"the data want radius_m {100.0 * step[1]:+.2f} % from where the model has it; in units of what is open "
        f"{value:.1f}, allowed: up to 12",
    )  # fmt: skip
    assert sureness == finding(
        "model: sureness", False, sureness.value, 0.25,
        f"the model states {min(least):.2g} of the variance that its data support, in the direction of which it is "
        "surest; allowed: 0.25 and more",
    )  # fmt: skip


def test_derivatives_are_those_of_the_whitened_innovations_over_all_parts(of, context):
    twice = judged(of, of.context(data=[*context.data, *context.data]))
    look, names = model_likelihood.look_at(twice), of.model.posterior.names
    assert len(look.found) == 2
    predicted = look.found[0].predicted
    roots = predicted.gains.factor[predicted.gains.which]

    def white(**moves):
        found = innovations([moved(look.theta, moves)], predicted.stretch, predicted.gains)[0][0]
        return np.concatenate([solve_triangular(L, e, lower=True) for L, e in zip(roots, found, strict=True)])

    by = 1e-3
    slopes = [(white(**{name: by}) - white(**{name: -by})) / (2.0 * by) for name in names]
    information, gradient = model_likelihood.derivatives(look, names)
    wanted = np.array([[2.0 * np.sum(one * other) for other in slopes] for one in slopes])
    assert information == pytest.approx(wanted, rel=2e-3)
    # Far more than the step of a derivative makes of it: J'w hardly differs between the model and a step beside it.
    assert gradient == pytest.approx([2.0 * np.sum(slope * white()) for slope in slopes], rel=0.05, abs=2.0)


def test_what_is_known_before_any_data_is_what_identification_takes(of):
    """Of what the line's file names; where tolerances differ, the widest."""
    rollers = [
        roller.model_copy(
            update={
                "radius_m": Parameter(value=0.04, tolerance=0.01 * (3 + i % 4)),
                "inertia_kg_m2": Parameter(value=0.95, tolerance=0.1 * (2 + i % 3)),
                "friction_nms_per_rad": Parameter(value=10.0, tolerance=0.1 * (3 + i % 5)),
            }
        )
        for i, roller in enumerate(of.line.rollers)
    ]
    spans = [
        span.model_copy(update={"length_m": Parameter(value=1.0, tolerance=0.05 * (1 + i % 2))})
        for i, span in enumerate(of.line.spans)
    ]
    line = of.line.model_copy(update={"rollers": rollers, "spans": spans})
    for per_roller in (False, True):
        prior = prior_of(line, Structure(per_roller=per_roller))
        names = prior.parameters.names
        assert len(names) == (25 if per_roller else 5)
        assert np.linalg.inv(model_likelihood.prior_precision(line, names)) == pytest.approx(prior.covariance)


def test_of_what_the_file_does_not_name_hardly_any_is_known_and_rollers_differ_by_more(of):
    names = ["coulomb_nm[1]", "torque_lag_s", "coulomb_nm[2]", "radius_m[1]", "radius_m[2]", "friction_nms_per_rad"]
    common, each = log(1.0 + 1.7) / sqrt(3.0), log(1.0 + 0.1) / sqrt(3.0)
    radius, friction = log(1.0 + 0.2) / sqrt(3.0), log(1.0 + 0.75) / sqrt(3.0)
    dry, round_ = common**2 + (3.0 * each) ** 2, radius**2 + each**2
    wanted = [
        [dry, 0.0, common**2, 0.0, 0.0, 0.0],
        [0.0, common**2, 0.0, 0.0, 0.0, 0.0],
        [common**2, 0.0, dry, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, round_, radius**2, 0.0],
        [0.0, 0.0, 0.0, radius**2, round_, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, friction**2],
    ]
    found = np.linalg.inv(model_likelihood.prior_precision(of.line, names))
    assert found == pytest.approx(np.array(wanted), abs=1e-12)


def test_intervals_narrower_than_half_the_posterior_beside_them_are_told(of, context):
    variance = 1e-4
    half = exp(1.96 * sqrt(variance))  # an interval of 95 % is twice as wide

    def found(**intervals):
        whole = {
            name: of.model.intervals[name].model_copy(update={"low": low, "value": low, "high": high})
            for name, (low, high) in intervals.items()
        }
        posterior = ModelPosterior(names=NAMES, covariance=np.diag([variance, variance, 0.0]).tolist())
        model = of.model.model_copy(update={"posterior": posterior, "intervals": whole})
        return model_likelihood.check_sureness(judged(of, context, model))[2:]

    def narrow(names):
        text = f"intervals of {names} are narrower than the model's own posterior"
        return [told("model: sureness", False, text)]

    wide, close = half**1.01, half**0.99
    assert found(stiffness_n=(2e3, 2e3 * wide), radius_m=(0.03, 0.03 * wide)) == []
    assert found(stiffness_n=(2e3, 2e3 * close), radius_m=(0.03, 0.03 * wide)) == narrow("stiffness_n")
    assert found(stiffness_n=(2e3, 2e3 * close), radius_m=(0.03, 0.03 * close)) == narrow("stiffness_n, radius_m")
    assert found(friction_nms_per_rad=(15.0, 15.0)) == [], "as sure as the posterior"
    assert found(stiffness_n=(0.0, 2e3), length_m=(1.0, 1.0)) == [], "no ratio, and nothing beside it"


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ({}, "noise.speed_m_per_s 1.5 times smaller than 0.000105"),
        ({"tension_n": 0.5}, "noise.tension_n 1.5 times larger than 0.0497"),
        ({"tension_n": 2.0}, "noise.tension_n 1.5 times smaller than 0.199"),
        ({"acceleration_m_per_s1_5": 0.5}, "noise.acceleration_m_per_s1_5 1.5 times larger than 0.000783"),
    ],
)
def test_the_noise_that_the_data_want_otherwise_most(of, context, factors, words):
    case = judged(of, context, of_noise(of.model, **factors))
    look = model_likelihood.look_at(case)
    before = likelihood(look.theta, look.noise, look.found)
    gain = max(
        likelihood(look.theta, replace(look.noise, **{name: factor * value}), look.found) - before
        for name, value in vars(look.noise).items()
        for factor in (1.5, 1.0 / 1.5)
    )
    (found,) = model_likelihood.check_noise(case)
    assert found.value == pytest.approx(gain)
    text = f"with {words} the data are likelier by {gain:.3g} in the logarithm; allowed: up to 10"
    assert found == finding("model: noise", not factors, found.value, 10.0, text)


def test_a_model_against_the_one_in_service_or_the_lines_file(of, context):
    def found(model, before):
        case = judged(of, context.model_copy(update={"model": before}), model)
        return model_likelihood.look_at(case).found, model_likelihood.check_others(case)

    def likely(model, noise, looked):
        return likelihood(theta_of(model), noise_of(noise), looked)

    stiff = of.model.parameters.model_copy(update={"stiffness_n": 1.03 * of.model.parameters.stiffness_n})
    worse = of.model.model_copy(update={"parameters": stiff})
    noisy = of_noise(worse, tension_n=1.5)
    for model, before, noise, passed in [
        (of.model, of.model, of.model, True),
        (of.model, worse, worse, True),
        (worse, of.model, of.model, False),
        (of.model, noisy, noisy, True),
        (noisy, of.model.model_copy(update={"noise": None}), noisy, False),
    ]:
        looked, (one,) = found(model, before)
        gain = likely(model, model, looked) - likely(before, noise, looked)
        assert one.value == pytest.approx(gain, rel=1e-6, abs=1e-6)
        text = f"the data are likelier by {gain:.4g} in the logarithm than by the model in service; allowed: -10 and "
        assert one == finding("model: held-out prediction", passed, one.value, -10.0, f"{text}more")

    looked, (first,) = found(of.model, None)
    nominal = {"stiffness_n": 2400.0, "length_m": [1.0] * 6, "radius_m": [0.04] * 6, "inertia_kg_m2": [0.95] * 6,
               "friction_nms_per_rad": [10.0] * 6}  # fmt: skip
    of_file = of.model.model_copy(update={"parameters": of.model.parameters.model_copy(update=nominal)})
    gain = likely(of.model, of.model, looked) - likely(of_file, of.model, looked)
    assert gain > 100.0 and first.value == pytest.approx(gain) and first.passed
    words = f"the data are likelier by {gain:.4g} in the logarithm than by the line's file; allowed: -10 and more"
    assert first.text == words


def test_of_much_data_the_newest_twenty_seconds_are_looked_at(of, context):
    whole = of.context(data=context.data * 10)  # of 2.6 s each
    assert len(model_likelihood.look_at(judged(of, whole)).found) == 8


def test_a_model_without_noise_says_nothing(of, context):
    silent = of.model.model_copy(update={"noise": None})
    with pytest.raises(Unbelievable) as raised:
        model_likelihood.look_at(judged(of, context, silent))
    assert str(raised.value) == ("without the noise in the model, and data in which tensions move, nothing can be said")

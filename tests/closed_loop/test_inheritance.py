"""An earlier model as the prior: widened, believed where the data agree, left alone where they do not."""

import time
from functools import cache

import numpy as np
import pytest

from gateway.core.line_model import LineModel, model_hash
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise
from gateway.core.unnamed_terms import deviation
from gateway.identification.estimate import Structure
from gateway.identification.inheritance import (
    DRIFT,
    NotInherited,
    agreement_of,
    earlier_of,
    identify_after,
)
from gateway.identification.model_record import Origin, model_from
from gateway.identification.prediction_error import Fit, fit
from gateway.identification.prior import Prior, prior_of
from tests.closed_loop.recorded import demonstration_line, real_plant, recorded
from tests.closed_loop.truths import altered, true_values
from tests.unit.model_support import CREATED

SPANS = 2
PLANT = altered(real_plant(), {"spans": SPANS})
LINE = demonstration_line(SPANS)
TRUTH = true_values(PLANT, Structure(), LINE)


@cache
def data(seed: int) -> Recording:
    return recorded(PLANT, seed, 4.0, line=LINE)


@cache
def parent() -> LineModel:
    fitted = fit([data(0)], prior_of(LINE, Structure()), Noise())
    return model_from(fitted.estimate, data(0), Origin(LINE.site, LINE.line, CREATED, "0.1.0"))


def poisoned(**factors: float) -> LineModel:
    """A parent that is sure (to 0.1 %) of what is wrong by these factors."""
    document = parent().model_dump(mode="json")
    document["intervals"] = {}
    for name, factor in factors.items():
        value = document["parameters"][name]
        document["parameters"][name] = [one * factor for one in value] if isinstance(value, list) else value * factor
    k = len(document["posterior"]["names"])
    document["posterior"]["covariance"] = (1e-6 * np.eye(k)).tolist()
    return LineModel.model_validate(document)


def under(model: LineModel, seed: int = 1) -> Fit:
    return fit([data(seed)], earlier_of(model, LINE).prior(Structure()), Noise())


def test_the_statistic_is_that_of_chi_square_where_the_truth_comes_from_the_prior() -> None:
    generator = np.random.default_rng(0)
    own = prior_of(LINE, Structure())
    root = 0.3 * generator.standard_normal((5, 5))
    prior = Prior(own.parameters, own.mean, root @ root.T + 0.01 * np.eye(5))
    information = np.diag([0.0, 3.0, 30.0, 300.0, 3000.0])
    covariance: FloatArray = np.linalg.inv(np.linalg.inv(prior.covariance) + information)
    spread = np.linalg.cholesky(prior.covariance - covariance + 1e-12 * np.eye(5))

    def drawn() -> Fit:
        logs = prior.mean + spread @ generator.standard_normal(5)
        return Fit(prior, logs, covariance, information, Noise(), [], [], 0.0, 0.0, 1, True)

    found = [agreement_of(drawn()) for _ in range(2000)]
    degrees = found[0].degrees
    assert degrees == 4  # of five: the data say nothing of one
    assert np.mean([one.statistic for one in found]) == pytest.approx(degrees, rel=0.1)
    assert 0.04 < np.mean([not one.agrees for one in found]) < 0.11


def test_the_earlier_model_is_widened_by_what_may_have_drifted() -> None:
    prior = earlier_of(parent(), LINE).prior(Structure())
    posterior = parent().posterior
    assert posterior is not None
    widened = prior.covariance - np.array(posterior.covariance)
    np.testing.assert_allclose(widened, deviation(DRIFT) ** 2 * np.eye(5), atol=1e-9)
    sure = earlier_of(poisoned(), LINE).prior(Structure(per_roller=True))
    assert np.sqrt(np.diag(sure.covariance)).min() >= deviation(DRIFT)


def test_a_model_of_the_same_line_agrees_and_helps_where_the_data_are_weak() -> None:
    alone = fit([data(1)], prior_of(LINE, Structure()), Noise())
    with_parent = under(parent())
    assert agreement_of(with_parent).agrees
    for name in ("stiffness_n", "length_m", "radius_m"):
        narrower, own = with_parent.interval(name), alone.interval(name)
        assert narrower.high / narrower.low < own.high / own.low
        assert narrower.covers(TRUTH[name])


@pytest.mark.parametrize(
    "factors",
    [
        {"friction_nms_per_rad": 1.3},
        {"inertia_kg_m2": 1.3, "radius_m": 1.3, "friction_nms_per_rad": 1.3},
        {"stiffness_n": 0.7, "length_m": 0.7},
        {"stiffness_n": 1.15},
    ],
)
def test_a_parent_that_is_sure_of_what_is_wrong_is_found_out(factors: dict[str, float]) -> None:
    assert not agreement_of(under(poisoned(**factors))).agrees


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_what_drifts_as_far_as_is_allowed_for_is_not_held_out(factor: float) -> None:
    found = under(poisoned(stiffness_n=factor, friction_nms_per_rad=factor))
    for name in ("stiffness_per_length", "radius_per_inertia", "friction_per_inertia", "stiffness_n", "inertia_kg_m2"):
        interval = found.interval(name)
        half = 0.5 * np.log(interval.high / interval.low)
        assert abs(np.log(interval.value / TRUTH[name])) < 1.5 * half, name  # 3 standard deviations


def test_where_the_data_disagree_the_lines_file_is_the_prior_and_it_is_said() -> None:
    wrong = poisoned(stiffness_n=0.7, length_m=0.7)
    found = identify_after(wrong, [data(1)], LINE, Noise(), time.perf_counter)
    assert found.parent is None
    assert len(found.words) == 1 and "the data disagree with the model" in found.words[0]
    assert found.words[0].endswith("the prior is the line's file")
    np.testing.assert_array_equal(found.found.fitted.prior.mean, prior_of(LINE, Structure()).mean)
    assert found.found.estimate.intervals["stiffness_n"].covers(TRUTH["stiffness_n"])


def test_where_they_agree_the_model_is_the_parent() -> None:
    found = identify_after(parent(), [data(1)], LINE, Noise(), time.perf_counter)
    assert found.parent == model_hash(parent())
    assert "the data agree with it (chi-square" in found.words[0]


def test_what_can_be_no_prior_is_refused() -> None:
    document = parent().model_dump(mode="json")
    with pytest.raises(NotInherited, match="has no posterior"):
        earlier_of(LineModel.model_validate({**document, "posterior": None}), LINE)
    with pytest.raises(NotInherited, match="is none of demo/line-1 with 3"):
        earlier_of(parent(), demonstration_line(3))
    posterior = {"names": ["stiffness_n"], "covariance": [[1e-4]]}
    with pytest.raises(NotInherited, match="its structure stiffness_n, length_m"):
        earlier_of(LineModel.model_validate({**document, "posterior": posterior}), LINE)

"""Rules on a proposed model: its bounds, its data, and how wrong it may be."""

from dataclasses import replace

import numpy as np
import pytest

from safety.believed import Unbelievable, corners_of_model, stated
from safety.rules import model_data, model_fits, model_likelihood
from tests.safety.case_support import case_of, proposal, refused


def test_bounds_of_a_model(of, context):
    def found(**changes):
        parameters = of.model.parameters.model_copy(update=changes)
        model = of.model.model_copy(update={"parameters": parameters})
        change = {"kind": "model", "model": model.model_dump()}
        return refused(model_fits.check(case_of(proposal(change, context), context, of)))

    assert found() == [] == found(stiffness_n=2400.0 * 1.3) == found(stiffness_n=2400.0 * 0.7)
    assert "stiffness_n is 3144" in found(stiffness_n=2400.0 * 1.31)[0]
    assert "radius_m[2] is" in found(radius_m=[0.04, 0.05, 0.04, 0.04, 0.04, 0.04])[0]
    assert found(coulomb_nm=[15.0] * 6, torque_lag_s=0.05, latency_s=0.02) == []
    wrong = {"coulomb_nm": [15.1] * 6, "torque_lag_s": 0.051, "latency_s": 0.021, "tension_before_n": 1.0}
    assert len(found(**wrong)) == 4
    other = of.model.model_copy(
        update={"site": "elsewhere", "data": of.model.data.model_copy(update={"period_s": 0.02})}
    )
    change = {"kind": "model", "model": other.model_dump()}
    assert len(refused(model_fits.check(case_of(proposal(change, context), context, of)))) == 2


def test_a_model_of_another_size(of, context):
    given = case_of(proposal({"kind": "model", "model": of.model.model_dump()}, context), context, of)
    fewer = replace(given, line=of.line.model_copy(update={"spans": of.line.spans[:5]}))
    assert "the model has 6 spans; allowed: 5" in refused(model_fits.check(fewer))[0]


def test_data_of_a_model(of, context):
    change = {"kind": "model", "model": of.model.model_dump()}
    given = proposal(change, context)
    quiet = replace(of.recording, tension_n=30.0 + 0.05 * np.sign(of.recording.tension_n - 30.0))
    still = replace(of, recording=quiet)
    found = refused(model_data.check(case_of(given, still.context(), still)))
    assert any("run an experiment" in text for text in found)
    twice = of.context(data=[*context.data, *context.data])
    assert refused(model_data.check(case_of(given, twice, of))) == []
    with pytest.raises(Unbelievable):
        model_likelihood.look_at(case_of(given, still.context(), still))


def test_intervals_stand_in_for_a_posterior(of):
    alone = of.model.model_copy(update={"posterior": None})
    names, covariance = stated(alone)
    assert set(names) == {"stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad"}
    spread = np.sqrt(np.diag(np.array(of.model.posterior.covariance)))
    order = [of.model.posterior.names.index(name) for name in names]
    assert np.sqrt(np.diag(covariance)) == pytest.approx(spread[order], rel=0.05)
    assert len(corners_of_model(alone, of.line.gate, 0.01, 1)) == 8
    nothing = alone.model_copy(update={"intervals": {}})
    with pytest.raises(Unbelievable, match="nobody knows how wrong"):
        stated(nothing)

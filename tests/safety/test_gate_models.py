"""Rules on a proposed model: its bounds, its data, and how wrong it may be."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.core.recording import joined
from safety.believed import Unbelievable, corners_of_model, stated
from safety.findings import told
from safety.rules import model_data, model_fits, model_likelihood
from tests.safety.case_support import case_of, proposal, refused


def of_model(of, context, model):
    """A case about it."""
    return case_of(proposal({"kind": "model", "model": model.model_dump()}, context), context, of)


def of_parameters(of, context, **changes):
    """A case about the model with other ones."""
    parameters = of.model.parameters.model_copy(update=changes)
    return of_model(of, context, of.model.model_copy(update={"parameters": parameters}))


def with_digest(model, digest):
    return model.model_copy(update={"data": model.data.model_copy(update={"digest": digest})})


#: By the line's file: 2400 N, 1 m, 0.04 m, 0.95 kg m2 and 10 Nm s/rad, with these tolerances.
BOUNDED = {
    "stiffness_n": (2400.0, 0.3, "stiffness_n is {}; allowed by the line's file: 1680 to 3120"),
    "length_m": (1.0, 0.3, "length_m[{}] is {}; allowed by the line's file: 0.7 to 1.3"),
    "radius_m": (0.04, 0.2, "radius_m[{}] is {}; allowed by the line's file: 0.032 to 0.048"),
    "inertia_kg_m2": (0.95, 0.3, "inertia_kg_m2[{}] is {}; allowed by the line's file: 0.665 to 1.235"),
    "friction_nms_per_rad": (10.0, 0.75, "friction_nms_per_rad[{}] is {}; allowed by the line's file: 2.5 to 17.5"),
}


@pytest.mark.parametrize("name", BOUNDED)
def test_each_parameter_is_bounded_by_its_tolerance_and_rounding_lets_it_pass(of, context, name):
    nominal, tolerance, words = BOUNDED[name]
    low, high = nominal * (1.0 - tolerance), nominal * (1.0 + tolerance)

    def found(value, at):
        values = [value if i == at else nominal for i in range(6)]
        return model_fits.check(of_parameters(of, context, **{name: value if at is None else values}))

    for at in (None,) if name == "stiffness_n" else (0, 2, 5):
        for within in (low * (1.0 - 1e-6), nominal, high * (1.0 + 1e-6)):
            assert found(within, at) == [
                told("model: bounds", True, "every parameter is within the tolerance of the line's file")
            ]
        for beyond in (low * (1.0 - 1e-3), high * (1.0 + 1e-3)):
            said = words.format(*([] if at is None else [at + 1]), f"{beyond:.4g}")
            assert found(beyond, at) == [told("model: bounds", False, said)]


def test_bounds_of_what_the_lines_file_does_not_name(of, context):
    def found(surroundings=context, **changes):
        return refused(model_fits.check(of_parameters(of, surroundings, **changes)))

    assert found(coulomb_nm=[0.0] * 5 + [15.0], torque_lag_s=0.05, latency_s=0.02) == []
    wrong = {"coulomb_nm": [0.0] * 5 + [15.1], "torque_lag_s": 0.051, "latency_s": 0.021, "tension_before_n": 1.0}
    assert found(**wrong) == [
        "Coulomb friction is 15.1 Nm; allowed: up to 15 Nm",
        "the torque's lag is 0.051 s; allowed: up to 0.05 s",
        "the latency is 0.021 s; allowed: within 0.01 s of 0.01 s",
        "tension_before_n and tension_after_n are 1 and 0; allowed: 0 and 0, which no data tell",
    ]
    measured = context.model_copy(update={"latency_s": 0.03})
    assert found(measured, latency_s=0.04) == [] == found(measured, latency_s=0.02)
    assert found(measured, latency_s=0.01) == ["the latency is 0.01 s; allowed: within 0.01 s of 0.03 s"]
    at_once = context.model_copy(update={"latency_s": 0.0})
    assert found(at_once, latency_s=0.01 + 1e-9) == [], "a nanosecond is rounding"
    assert found(at_once, latency_s=0.01 + 2e-9) != []


def test_a_model_of_another_line_or_period(of, context):
    data = of.model.data.model_copy(update={"period_s": 0.02})
    other = of.model.model_copy(update={"site": "elsewhere", "data": data})
    assert refused(model_fits.check(of_model(of, context, other))) == [
        "the model is of elsewhere/line-1; allowed: this line, demo/line-1",
        "the model's data have a period of 0.02 s; allowed: 0.01 s",
    ]


def test_a_model_of_another_size(of, context):
    fewer = replace(of_model(of, context, of.model), line=of.line.model_copy(update={"spans": of.line.spans[:5]}))
    assert refused(model_fits.check(fewer)) == ["the model has 6 spans; allowed: 5, as the line"]


def test_data_of_a_model(of, context):
    quiet = replace(of.recording, tension_n=30.0 + 0.05 * np.sign(of.recording.tension_n - 30.0))
    still = replace(of, recording=quiet)
    found = refused(model_data.check(of_model(still, still.context(), of.model)))
    assert any("run an experiment" in text for text in found)
    twice = of.context(data=[*context.data, *context.data])
    assert refused(model_data.check(of_model(of, twice, of.model))) == []
    with pytest.raises(Unbelievable):
        model_likelihood.look_at(of_model(still, still.context(), of.model))


def test_a_model_is_of_these_data_or_older_than_all_of_them(of, context):
    """Of one recording, or of some joined."""

    def origin(model, recordings=1):
        now = of.context(data=context.data * recordings)
        return model_data.check(of_model(of, now, model))[0]

    these = told("model: data", True, "the model was made from these recordings")
    for recordings in (1, 2, 3):
        assert origin(of.model, recordings) == these
        whole = joined([of.recording] * recordings) if recordings > 1 else of.recording
        assert origin(with_digest(of.model, whole.digest()), recordings) == these
    older = with_digest(of.model, "5a" * 32).model_copy(update={"created": "2026-08-03T13:59:59+00:00"})
    assert origin(older) == told("model: data", True, "these recordings came after the model")
    assert origin(older.model_copy(update={"created": "2026-08-03T14:00:00+00:00"}), 2) == told(
        "model: data", False,
        "the model was made from data with the digest 5a5a5a5a5a5a, which is none of the context's 2 recordings; "
        "allowed: those very data, or only recordings that came after the model",
    )  # fmt: skip


def test_a_model_says_of_no_faster_line_than_its_data(of, context):
    fastest = max(part.speed_m_per_s for part in of_model(of, context, of.model).excited)

    def found(to_m_per_s):
        region = of.model.region.model_copy(update={"speed_to_m_per_s": to_m_per_s})
        return model_data.check(of_model(of, context, of.model.model_copy(update={"region": region})))[1:]

    assert found(fastest + 0.05 * fastest) == [told("model: data", True, "1 parts of recordings tell, up to 0.05 m/s")]
    assert found(1.06 * fastest) == [
        told("model: data", False, "the model says that it was made up to 0.053 m/s; the data go to 0.05 m/s")
    ]


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

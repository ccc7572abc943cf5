"""The model file: what is written is read back, the same model has the same hash, and what is wrong is named."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.cli.model_place import LARGEST_BYTES
from gateway.core.line_model import (
    ModelRefused,
    ModelValidation,
    canonical,
    model_hash,
    model_of,
    noise_of,
    parameters_of,
    parse_model,
    theta_of,
)
from gateway.core.line_model_names import split_name
from gateway.core.posterior import Posterior, posterior_of
from gateway.core.recording import Recording
from gateway.core.theta import Noise, Theta
from gateway.core.web_model import WebModel
from gateway.identification.estimate import Estimate, Interval, Structure
from gateway.identification.model_record import Origin, model_from
from tests.unit.model_support import CREATED, PHYSICAL, any_fields, fields, model


@given(any_fields())
def test_what_is_written_is_read_back(given_fields: dict[str, Any]) -> None:
    first = model_of(given_fields)
    again = parse_model(canonical(first))
    assert again == first
    assert canonical(again) == canonical(first)


@given(any_fields(), st.randoms(use_true_random=False))
@settings(max_examples=30)
def test_the_hash_is_that_of_the_content_and_not_of_how_it_is_written(
    given_fields: dict[str, Any], chance: Any
) -> None:
    first = model_of(given_fields)
    keys = list(given_fields)
    chance.shuffle(keys)
    other_order = json.dumps({key: given_fields[key] for key in keys}, indent=3).encode()
    assert model_hash(parse_model(other_order)) == model_hash(first)


def test_a_whole_number_is_the_same_model_as_one_with_a_point() -> None:
    assert model_hash(model_of(fields(scale=1))) == model_hash(model())


def test_any_change_of_a_number_is_another_model() -> None:
    document = fields()
    hashes = [model_hash(model_of(document))]
    for part in ("parameters", "noise", "data", "region", "validation"):
        for key, value in document[part].items():
            if isinstance(value, float | list):
                moved = [one + 1e-9 for one in value] if isinstance(value, list) else value - 1e-9
                if key != "torque_lag_s":  # which is 0, and must not be less
                    hashes.append(model_hash(model_of({**document, part: {**document[part], key: moved}})))
    assert len(set(hashes)) == len(hashes) == 1 + 7 + 3 + 1 + 4 + 6


@given(any_fields())
@settings(max_examples=30)
def test_theta_and_noise_come_back_as_they_were(given_fields: dict[str, Any]) -> None:
    first = model_of(given_fields)
    assert parameters_of(theta_of(first)) == first.parameters.model_dump()
    noise = noise_of(first)
    assert (None if noise is None else vars(noise)) == given_fields["noise"]


def wrong(**changes: Any) -> dict[str, Any]:
    """`fields` with keys (with __ for a level) replaced; None takes them out."""
    document = fields()
    for path, value in changes.items():
        *tables, key = path.split("__")
        inside = document
        for table in tables:
            inside = inside[table]
        if value is None:
            del inside[key]
        else:
            inside[key] = value
    return document


NAN = float("nan")
ONE = {"value": 1.0, "low": 1.0, "high": 1.0}
REFUSALS = [
    (wrong(colour=1), ["colour = 1: there is no such key; allowed: format, site"]),
    (wrong(metod="pem"), ['metod = "pem": there is no such key', "did you mean method?"]),
    (wrong(parameters__stifness_n=1.0), ["parameters.stifness_n = 1.0", "did you mean stiffness_n?"]),
    (wrong(parameters=None), ["parameters: is missing; allowed: an object"]),
    (wrong(parameters__latency_s=None), ["parameters.latency_s: is missing; allowed: a number, 0 or more s"]),
    (wrong(parameters__stiffness_n=0), ["parameters.stiffness_n = 0: is too small; allowed: a number above 0 N"]),
    (wrong(parameters__stiffness_n="2200"), ['parameters.stiffness_n = "2200": is text; allowed: a number above 0 N']),
    (wrong(parameters__stiffness_n=True), ["parameters.stiffness_n = true: is true or false"]),
    (wrong(parameters__stiffness_n=NAN), ["parameters.stiffness_n = nan: is not a finite number"]),
    (wrong(parameters__stiffness_n=10**400), ["parameters.stiffness_n"]),
    (wrong(parameters__radius_m=[0.1]), ["parameters.radius_m has 1 entries; allowed: 2, one per span"]),
    (wrong(parameters__radius_m=[]), ["parameters.radius_m", "a list of 1 to 60 entries, each a number above 0"]),
    (wrong(parameters__radius_m=[0.1, -1]), ["parameters.radius_m[2] = -1: is too small; allowed: a number above 0 m"]),
    (wrong(format=2), ["format = 2: is too large; allowed: 1"]),
    (wrong(site="Hall 3"), ['site = "Hall 3": has another form']),
    (wrong(created="yesterday"), ['created = "yesterday": is no date and time with a zone']),
    (wrong(created="2026-08-03T14:05:00"), ["with a zone"]),
    (wrong(method=""), ["method", "is empty"]),
    (wrong(method=["pem"]), ['method = ["pem"]: is a list; allowed: text of 1 to 200 letters']),
    (wrong(structure__coulomb=1), ["structure.coulomb = 1: is a number; allowed: true or false"]),
    (wrong(data__digest="abc"), ['data.digest = "abc": has another form; allowed: text of the form']),
    (wrong(data__samples=0), ["data.samples = 0: is too small; allowed: a whole number, 1 or more"]),
    (wrong(data__samples=500.0), ["data.samples = 500.0: is a number; allowed: a whole number"]),
    (wrong(confidence=0.9), ["confidence = 0.9: is too small; allowed: 0.95"]),
    (wrong(intervals__inertia=ONE), ["intervals.inertia: there is no such", "did you mean inertia_kg_m2?"]),
    (wrong(intervals__stiffness_n={"value": 1.0, "low": 2.0, "high": 3.0}), ["intervals.stiffness_n is 1 from 2 to 3"]),
    (wrong(intervals__stiffness_n={"value": 1.0, "low": 1.0}), ["intervals.stiffness_n.high: is missing"]),
    (wrong(intervals__stiffness_n={**ONE, "low": "a"}), ['intervals.stiffness_n.low = "a": is text']),
    (wrong(intervals={"radius_m[3]": ONE}), ["intervals.radius_m[3]", "allowed: radius_m, or radius_m[1] to"]),
    (wrong(intervals={"latency_s[1]": ONE}), ["intervals.latency_s[1]", "allowed: latency_s"]),
    (wrong(region__tension_to_n=[1.0, 50.0]), ["region.tension_from_n[1] is 18, the end of its range 1: below it"]),
    (wrong(region__tension_to_n=[50.0]), ["region.tension_to_n has 1 entries"]),
    (wrong(region__speed_to_m_per_s=0.0), ["region.speed_from_m_per_s is 0.01, the end of its range 0"]),
    (wrong(validation__innovation_speed=[]), ["validation.innovation_speed has 0 entries"]),
    (wrong(validation__r2_speed=1.5), ["validation.r2_speed = 1.5: is too large; allowed: a number up to 1"]),
    (wrong(validation__whiteness="whit"), ['validation.whiteness = "whit"', 'allowed: "white"', "did you mean white"]),
    (wrong(alignment=[{"channel": "t", "late_s": 0.0, "low_s": 1.0, "high_s": 0.0}]), ["alignment[1].low_s is 1"]),
]  # fmt: skip


@pytest.mark.parametrize(("document", "says"), REFUSALS)
def test_a_malformed_model_is_refused_with_key_value_and_what_is_allowed(
    document: dict[str, Any], says: list[str]
) -> None:
    with pytest.raises(ModelRefused) as refused:
        parse_model(json.dumps(document).encode())
    assert all(part in str(refused.value) for part in says), str(refused.value)


def test_one_null_of_a_range_is_refused() -> None:
    document = fields()
    document["region"]["tension_from_n"] = [None, 18.0]
    with pytest.raises(ModelRefused, match=r"tension_from_n\[1\] and tension_to_n\[1\]: one is null"):
        model_of(document)


def test_every_reason_is_told_at_once() -> None:
    with pytest.raises(ModelRefused) as refused:
        model_of(wrong(colour=1, method=None, parameters__latency_s=-1.0, data__digest="x"))
    assert len(refused.value.reasons) == 4


@pytest.mark.parametrize(
    ("payload", "says"),
    [
        (b"", "no JSON"),
        (b"[1]", "it is a list; allowed: a JSON object"),
        (b'{"format": 1, "format": 1}', 'the key "format" stands twice'),
        (b"\xff\xfe{}", "no JSON"),
        (b"\x80abc", "no text in UTF-8"),
        (b'{"format": 1,}', "no JSON"),
        (b"[" * 200_000, "no JSON"),
        (b"SQLite format 3\0", "no JSON"),
    ],
)
def test_what_is_no_json_is_refused(payload: bytes, says: str) -> None:
    with pytest.raises(ModelRefused, match=says):
        parse_model(payload)


@given(st.binary(max_size=200) | st.recursive(st.none() | st.booleans() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*fields(), "x"]), inner, max_size=4),
).map(lambda value: json.dumps(value).encode()))  # fmt: skip
def test_no_payload_is_met_with_anything_but_a_refusal(payload: bytes) -> None:
    with pytest.raises(ModelRefused) as refused:
        parse_model(payload)
    assert refused.value.reasons and all(refused.value.reasons)


@given(any_fields(), st.data())
@settings(max_examples=60)
def test_no_field_of_another_kind_passes_or_crashes(given_fields: dict[str, Any], data: st.DataObject) -> None:
    place = given_fields
    while True:
        key = data.draw(st.sampled_from(sorted(place)))
        if not isinstance(place[key], dict) or not place[key] or data.draw(st.booleans()):
            break
        place = place[key]
    place[key] = {"neither": "this"}
    with pytest.raises(ModelRefused) as refused:
        model_of(given_fields)
    assert key in str(refused.value)


def test_names_of_intervals_come_apart() -> None:
    assert split_name("inertia_kg_m2[3]") == ("inertia_kg_m2", 3)
    assert split_name("inertia_kg_m2") == ("inertia_kg_m2", None)
    assert split_name("inertia_kg_m2[0]") == ("inertia_kg_m2[0]", None)


# The posterior

TWO = {"names": ["stiffness_n", "length_m"], "covariance": [[4e-4, 3e-4], [3e-4, 4e-4]]}


def test_a_file_without_a_posterior_is_read_and_has_the_hash_that_it_had_before_there_were_any() -> None:
    document = model().model_dump(mode="json")
    assert "posterior" not in document and "eccentricity" not in document["parameters"]
    before = json.dumps(document, sort_keys=True, separators=(",", ":")).encode()
    assert canonical(parse_model(before)) == before
    assert posterior_of(parse_model(before)) is None


def test_the_posterior_stands_around_the_parameters_of_the_file() -> None:
    parameters = {**fields()["parameters"], "length_m": [1.0, 1.44]}
    found = posterior_of(model(parameters=parameters, posterior=TWO))
    assert found is not None
    np.testing.assert_allclose(found.mean, [np.log(2200.0), np.log(1.2)])
    np.testing.assert_equal(found.covariance, TWO["covariance"])
    np.testing.assert_allclose(found.deviations, 0.02)


def test_the_largest_line_has_room_and_its_file_can_be_read() -> None:
    names = ["stiffness_n"]
    for base in PHYSICAL[1:]:
        names += [f"{base}[{i}]" for i in range(1, 61)]
    k = len(names)
    factor = np.random.default_rng(0).standard_normal((k, k)) * 0.01
    covariance = 0.5 * (factor @ factor.T + (factor @ factor.T).T)
    large = model(60, posterior={"names": names, "covariance": covariance.tolist()})
    assert len(canonical(large)) < LARGEST_BYTES
    assert parse_model(canonical(large)) == large


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"names": ["stiffness_n"]}, "covariance has 2 rows of 2 to 2 entries; allowed: 1 of 1"),
        ({"covariance": [[1e-4, 0.0], [0.0]]}, "covariance has 2 rows of 1 to 2 entries; allowed: 2 of 2"),
        ({"covariance": [[1e-4, 1e-5], [0.0, 1e-4]]}, "not symmetric: 1e-05 and 0 between stiffness_n and length_m"),
        ({"covariance": [[1e-4, 2e-4], [2e-4, 1e-4]]}, "not positive semidefinite: it has the eigenvalue -0.0001"),
        ({"covariance": [[1e-4, 0.0], [0.0, 9.1]]}, "length_m has the variance 9.1; allowed: 0 to 9"),
        ({"covariance": [[-1e-4, 0.0], [0.0, 1.0]]}, "stiffness_n has the variance -0.0001; allowed: 0 to 9"),
        ({"covariance": [[NAN, 0.0], [0.0, 1.0]]}, "is not a finite number"),
        ({"names": ["stiffness_n", "lenght_m"]}, "lenght_m: there is no such parameter.*did you mean length_m"),
        ({"names": ["stiffness_n", "radius_per_inertia"]}, "radius_per_inertia: there is no such parameter"),
        ({"names": ["stiffness_n", "length_m[3]"]}, r"length_m\[3\]: there is no such one; allowed: length_m, or"),
        ({"names": ["stiffness_n[1]", "length_m"]}, r"stiffness_n\[1\]: there is no such one; allowed: stiffness_n"),
        ({"names": ["length_m", "length_m"]}, "length_m: it is there already"),
        ({"names": ["length_m[1]", "length_m"]}, "length_m: it is there already"),
        ({"names": ["length_m", "length_m[2]"]}, r"length_m\[2\]: it is there already"),
        ({"names": ["length_m", "coulomb_nm[2]"]}, r"coulomb_nm\[2\]: its value is 0, which has no logarithm"),
        ({"names": []}, "posterior.names"),
    ],
)
def test_what_is_no_posterior_is_refused(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ModelRefused, match=says):
        model_of(fields(posterior={**TWO, **changes}))


# From an estimate


def estimate() -> Estimate:
    web = WebModel(2200.0, np.full(2, 1.2), np.full(2, 0.035), np.full(2, 1.0), np.full(2, 15.0), 1.0, 2.0)
    theta = Theta(web, np.array([0.0, 2.0]), 0.005, 0.0101)
    intervals = {"stiffness_n": Interval(2200.0, 2150.0, 2250.0), "coulomb_nm[2]": Interval(2.0, 1.9, 2.1)}
    return Estimate("prediction error", Structure(coulomb=True), theta, Noise(0.11), intervals, 4)


def recording() -> Recording:
    k, n = 5, 2
    tension = np.linspace(20.0, 40.0, k * n).reshape(k, n)
    tension[:, 1] = np.nan  # a draw span
    tension[1, 0] = np.nan
    controlled = np.array([True, True, True, True, False])
    zeros = np.zeros((k, n))
    return Recording(
        0.01 * np.arange(k), tension, zeros, zeros, zeros, zeros, np.linspace(0.01, 0.05, k), controlled, 0.01, "a test"
    )


ORIGIN = Origin("demo", "six-span", CREATED, "0.1.0", "ab" * 32)


def test_an_estimate_becomes_a_record_of_all_that_it_says() -> None:
    validation = ModelValidation(
        samples=10, innovation_tension=[1.0, None], innovation_speed=[1.0, 1.0], r2_tension=0.9, r2_speed=0.8,
        mae_tension_n=0.1, mae_speed_m_per_s=1e-4, whiteness="white",
    )  # fmt: skip
    found, data = model_from(estimate(), recording(), ORIGIN, validation), recording()
    assert vars(theta_of(found)).keys() == vars(estimate().theta).keys()
    np.testing.assert_equal(vars(theta_of(found).web), vars(estimate().theta.web))
    np.testing.assert_equal(theta_of(found).coulomb_nm, [0.0, 2.0])
    assert (theta_of(found).torque_lag_s, theta_of(found).latency_s) == (0.005, 0.0101)
    assert noise_of(found) == Noise(0.11)
    assert {name: Interval(**vars(one)) for name, one in found.intervals.items()} == estimate().intervals
    assert found.data.digest == data.digest() and found.data.source == "a test" and found.data.samples == 4
    assert found.posterior is None
    assert found.parent == ORIGIN.parent and found.created == CREATED and found.validation == validation
    assert parse_model(canonical(found)) == found


def test_the_record_has_the_posterior_of_the_estimate() -> None:
    covariance = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    own = Posterior(("stiffness_n", "radius_m"), np.log([2200.0, 0.035]), covariance)
    found = posterior_of(model_from(replace(estimate(), posterior=own), recording(), ORIGIN))
    assert found is not None and found.names == own.names
    np.testing.assert_allclose(found.mean, own.mean)
    np.testing.assert_equal(found.covariance, covariance)


def test_the_region_is_what_the_loop_went_through_and_no_more() -> None:
    region = model_from(estimate(), recording(), ORIGIN).region
    assert (region.speed_from_m_per_s, region.speed_to_m_per_s) == (0.01, 0.04)
    tension = recording().tension_n[:, 0]
    assert region.tension_from_n == [20.0, None]
    assert region.tension_to_n == [tension[3], None]


def test_an_estimate_that_is_no_model_is_refused() -> None:
    bad = replace(estimate(), intervals={"stiffness_n": Interval(2200.0, np.nan, 2250.0)}, samples=0)
    with pytest.raises(ModelRefused) as refused:
        model_from(bad, recording(), ORIGIN)
    assert "intervals.stiffness_n.low = nan: is not a finite number" in str(refused.value)
    assert "data.samples = 0" in str(refused.value)


def test_a_recording_without_control_has_no_region_and_makes_no_model() -> None:
    idle = replace(recording(), controlled=np.zeros(5, dtype=bool))
    with pytest.raises(ModelRefused, match="region.speed_from_m_per_s = nan"):
        model_from(estimate(), idle, ORIGIN)

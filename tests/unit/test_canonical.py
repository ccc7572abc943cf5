"""Equal models have equal bytes and hashes, through JSON, too; what was stored under an older hash is still found."""

import asyncio
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.design import design_lqi, design_mpc, design_pid, task_of
from gateway.core.canonical import canonical_bytes, hash_of, known_hashes, without_negative_zeros
from gateway.core.controller import canonical, config_hash, parse_controller
from gateway.core.deployment import Region
from gateway.core.line_model import canonical as canonical_model
from gateway.core.line_model import model_hash, parse_model
from gateway.loop.kept import FILE, Durable
from gateway.supervisor.configurations import Origin, begin_configurations
from gateway.supervisor.store_writer import StoreWriter
from tests.support.gateway_key import store_of
from tests.unit.deployer_support import FIRST, LINE
from tests.unit.model_support import model as fitted

CONTROLLERS = {design.__name__: design(task_of(LINE)) for design in (design_lqi, design_pid, design_mpc)}
DATA = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


def with_zeros(value, zero: float):
    """`value` with every 0.0 in it as `zero`."""
    if isinstance(value, dict):
        return {key: with_zeros(one, zero) for key, one in value.items()}
    if isinstance(value, list):
        return [with_zeros(one, zero) for one in value]
    return zero if isinstance(value, float) and value == 0.0 else value


@given(DATA)
def test_equal_data_have_equal_bytes_and_keep_them_through_json(value) -> None:
    said = canonical_bytes(value)
    assert canonical_bytes(with_zeros(value, -0.0)) == canonical_bytes(with_zeros(value, 0.0)) == said
    assert canonical_bytes(json.loads(said)) == said


@given(DATA)
def test_whatever_has_no_negative_zero_has_the_bytes_that_it_had(value) -> None:
    value = with_zeros(value, 0.0)
    assert canonical_bytes(value) == json.dumps(value, sort_keys=True, separators=(",", ":")).encode()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        canonical_bytes([bad])


@pytest.mark.parametrize("name", sorted(CONTROLLERS))
def test_controllers_that_are_equal_have_one_hash(name: str) -> None:
    document = json.loads(canonical(CONTROLLERS[name]))
    negative = parse_controller(json.dumps(with_zeros(document, -0.0)).encode())
    positive = parse_controller(json.dumps(with_zeros(document, 0.0)).encode())
    assert negative == positive and config_hash(negative) == config_hash(positive)
    for one in (negative, positive):
        assert config_hash(parse_controller(canonical(one))) == config_hash(one)
        assert config_hash(parse_controller(one.model_dump_json().encode())) == config_hash(one)


def negative_zero():
    """A controller with a -0.0 in it, and the hash that it had before those were written as 0.0."""
    document = json.loads(canonical(FIRST))
    document["gain_state"][0][0] = -0.0
    one = parse_controller(json.dumps(document).encode())
    now, formerly = known_hashes(one)
    assert now == config_hash(one) != formerly
    return one, formerly


def test_a_model_with_a_negative_zero_has_the_hash_of_the_one_with_zero() -> None:
    document = json.loads(canonical_model(fitted(LINE.n, 1.0, site=LINE.site, line=LINE.line)))
    models = [parse_model(json.dumps(with_zeros(document, zero)).encode()) for zero in (0.0, -0.0)]
    assert models[0] == models[1] and model_hash(models[0]) == model_hash(models[1]) == hash_of(models[0])


def test_what_was_kept_by_an_earlier_version_is_still_what_the_loop_starts_with(tmp_path) -> None:
    one, formerly = negative_zero()
    store = store_of(tmp_path, one)
    store.write(Durable(3, one, Region()))
    content = json.loads((tmp_path / FILE).read_text())
    (tmp_path / FILE).write_text(json.dumps({**content, "started_with": formerly}))
    told: list[str] = []
    kept = store.read(LINE, told.append)
    assert kept is not None and kept.epoch == 3 and told == []


def test_what_was_stored_under_an_older_hash_is_found_under_both(tmp_path, monkeypatch) -> None:
    one, formerly = negative_zero()
    origin = Origin(1.0, "anna", "as it was stored then")
    with begin_configurations(tmp_path / "configurations.sqlite") as configurations, monkeypatch.context() as then:
        then.setattr("gateway.supervisor.configurations.config_hash", lambda config: known_hashes(config)[1])
        then.setattr("gateway.supervisor.configurations.canonical", lambda config: _as_it_was(config))
        configurations.store(LINE.site, LINE.line, one, origin)
    asyncio.run(StoreWriter(LINE, tmp_path, tmp_path, lambda: 2.0).store_given())
    with begin_configurations(tmp_path / "configurations.sqlite") as configurations:
        old = configurations.get(LINE.site, LINE.line, formerly)
        new = configurations.get(LINE.site, LINE.line, config_hash(one))
        assert old is not None and old.controller == one and new is not None and new.controller == one
        assert len(configurations.entries()) == 2
    asyncio.run(StoreWriter(LINE, tmp_path, tmp_path, lambda: 3.0).store_given())
    with begin_configurations(tmp_path / "configurations.sqlite") as configurations:
        assert len(configurations.entries()) == 2


def _as_it_was(config) -> bytes:
    return json.dumps(config.model_dump(mode="json"), sort_keys=True, separators=(",", ":")).encode()


LEAVES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text()
DATA = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.dictionaries(st.integers(), inner),
    max_leaves=30,
)


@given(DATA)
def test_row_by_row_they_are_the_bytes_of_one_call(data):
    whole = json.dumps(without_negative_zeros(data), sort_keys=True, separators=(",", ":"), allow_nan=False)
    assert canonical_bytes(data) == whole.encode()

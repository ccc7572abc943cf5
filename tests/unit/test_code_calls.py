"""The closed list of calls: whatever is sent is one of them, whole, or refused with what would be right."""

import ast
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

from agents.code.calls import CALLS, KNOBS, MOST_BYTES, AnyCall, Call, CallRefused, parse_call
from agents.language_model.computing import calls_format, read_calls
from agents.roles import ROLES
from gateway.commissioning.architectures import ARCHITECTURES

MODELS = st.sampled_from(["in-service", "nominal"]) | st.text("0123456789abcdef", min_size=6, max_size=64)
CONTROLLERS = st.just("in-service") | st.integers(1, 99).map("call {}".format)
RECORDINGS = st.just("newest") | st.integers(1, 999).map(str)
SCENARIOS = st.sampled_from(["tension-step", "speed-step"])
FACTORS = st.floats(0.1, 10.0)


def some(call: str, needed: dict[str, Any] | None = None, **optional: Any) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries({"call": st.just(call), **(needed or {})}, optional=optional)


def architecture(name: str) -> st.SearchStrategy[dict[str, Any]]:
    knobs = st.fixed_dictionaries({}, optional=dict.fromkeys(KNOBS[name], FACTORS))
    return some("design", {"architecture": st.just(name)}, model=MODELS, knobs=knobs)


VALID = st.one_of(
    some("simulate", controller=CONTROLLERS, model=MODELS, scenario=SCENARIOS, plants=st.integers(0, 8)),
    some("identify", recordings=st.lists(RECORDINGS, min_size=1, max_size=3, unique=True)),
    st.sampled_from(sorted(KNOBS)).flatmap(architecture),
    some("tune", {"architecture": st.sampled_from(["pid", "lqr", "lqi", "lqg"])}, iterations=st.integers(1, 8)),
    some("margins", controller=CONTROLLERS, model=MODELS),
    some("spectrum", {"channel": st.sampled_from(["tension", "speed", "torque"]), "index": st.integers(1, 60)}),
    some("compare", {"controllers": st.lists(CONTROLLERS, min_size=2, max_size=5, unique=True)}, scenario=SCENARIOS),
    some("compare", {"models": st.lists(MODELS, min_size=2, max_size=2, unique=True)}, recording=RECORDINGS),
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=12), inner, max_size=4),
    max_leaves=12,
)


def reasons(document: Any) -> str:
    with pytest.raises(CallRefused) as refused:
        parse_call(document)
    assert refused.value.reasons
    return "; ".join(refused.value.reasons)


@given(VALID)
def test_a_call_is_read_and_written_back_the_same(document: dict[str, Any]) -> None:
    found = parse_call(document)
    assert found.model_dump(include=set(document)) == document
    adapter: TypeAdapter[AnyCall] = TypeAdapter(Call)
    assert adapter.validate_json(found.model_dump_json()) == parse_call(json.loads(found.model_dump_json())) == found


@given(JSON)
def test_what_is_no_call_is_refused_and_nothing_else_happens(document: Any) -> None:
    reasons(document)


@given(VALID, st.text(min_size=1, max_size=12), JSON)
def test_one_thing_more_or_another_is_a_call_or_refused(document: dict[str, Any], key: str, value: Any) -> None:
    try:
        found = parse_call(document | {key: value})
    except CallRefused as refused:
        assert refused.reasons
    else:
        assert key in type(found).model_fields


@pytest.mark.parametrize(
    ("document", "told"),
    [
        ({"call": "simulat"}, "the nearest is simulate"),
        ({}, "call is missing; allowed: simulate, identify"),
        ({"call": ["margins"]}, "allowed: simulate"),
        ([{"call": "margins"}], "it is no object"),
        ({"call": "margins", "modell": "nominal"}, "did you mean model"),
        ({"call": "margins", "model": "nominl"}, "the nearest is nominal"),
        ({"call": "margins", "model": "../../etc"}, "or the accepted model's hash"),
        ({"call": "margins", "controller": "call 0"}, 'an earlier call such as "call 1"'),
        ({"call": "margins", "controller": {"kind": "lqr"}}, "controller"),
        ({"call": "design", "architecture": "lqj"}, "did you mean lqr"),
        ({"call": "design", "architecture": "lqr", "knobs": {"torque_per_nm": 2.0}}, "the nearest is torque_per_nm2"),
        ({"call": "design", "architecture": "lqr", "knobs": {"torque_per_nm2": 11.0}}, "10"),
        ({"call": "tune", "architecture": "mpc"}, "allowed"),
        ({"call": "tune", "architecture": "lqi", "iterations": 9}, "8"),
        ({"call": "simulate", "plants": 1e9}, "plants"),
        ({"call": "simulate", "plants": True}, "plants"),
        ({"call": "spectrum", "channel": "tension", "index": 0}, "1"),
        ({"call": "spectrum", "channel": "tension", "index": float("nan")}, "finite"),
        ({"call": "identify", "recordings": ["newest", "newest"]}, "each once"),
        ({"call": "identify", "recordings": ["/etc/passwd"]}, "1 is the newest"),
        ({"call": "compare"}, "two to five controllers"),
        ({"call": "compare", "controllers": ["in-service"], "models": ["nominal", "in-service"]}, "and no models"),
        ({"call": "margins", "model": "a" * MOST_BYTES}, "bytes; allowed"),
    ],
)
def test_a_refusal_says_what_would_be_right(document: Any, told: str) -> None:
    assert told in reasons(document)


def test_the_knobs_are_those_of_the_architectures() -> None:
    assert {name: tuple(knob.name for knob in one.knobs) for name, one in ARCHITECTURES.items()} == KNOBS


def test_the_prompt_names_every_call_input_and_knob() -> None:
    prompt = ROLES["code"].own_words
    names = {name for one in CALLS.values() for name in one.model_fields if name != "call"}
    for name in {*CALLS, *names, *(knob for knobs in KNOBS.values() for knob in knobs)}:
        assert f"`{name}`" in prompt or f"`{name}:" in prompt, name
    assert ROLES["code"].decides == ()


def test_the_form_has_every_call_and_no_more_than_are_left() -> None:
    calls = calls_format(2)["properties"]["calls"]
    assert calls["maxItems"] == 2
    assert [one["properties"]["call"]["const"] for one in calls["items"]["anyOf"]] == list(CALLS)
    assert all(one["additionalProperties"] is False for one in calls["items"]["anyOf"])


@pytest.mark.parametrize(
    "text", ["", "none", "[]", "{}", '{"calls": {}}', '{"calls": [], "code": "x"}', '{"calls": 1}']
)
def test_what_is_no_list_of_calls_is_refused(text: str) -> None:
    with pytest.raises(CallRefused):
        read_calls(text)


def test_a_fence_around_the_list_is_forgiven() -> None:
    assert read_calls('```json\n{"calls": [1, {}]}\n```') == [1, {}]


def test_the_agents_run_nothing_that_somebody_has_written() -> None:
    for path in Path("agents").rglob("*.py"):
        called = [node.func for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Call)]
        named = {func.id for func in called if isinstance(func, ast.Name)}
        assert not named & {"exec", "eval", "compile", "__import__"}, path

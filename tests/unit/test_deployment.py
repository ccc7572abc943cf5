"""Deployments as messages: what is sent is what arrives, and nothing else is taken."""

import json
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from gateway.control.design import design_lqg, design_lqi, task_of
from gateway.core.controller import config_hash
from gateway.core.controller_laws import Feedforward
from gateway.core.deployment import Deployment, RecoveryNode, RecoveryPrediction, Region
from gateway.core.json_rows import TooLongAPiece, load_rows
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.messages import (
    MAX_COMMAND,
    MAX_DEPLOYMENT,
    MOST_KEYS,
    AskConfiguration,
    Deploy,
    Keep,
    MalformedMessage,
    Renew,
    Rollback,
    command_bytes,
    in_words,
    most_at_once,
    parse_command,
)
from gateway.mailbox.port import MAX_PAYLOAD

SHORTEST_S = 0.001  #: no line has a shorter period


def deployment(spans=6, design=design_lqi, **changes):
    config = design(task_of(load_line(line_template(spans), "line.toml")))
    given = {"controller": config, "hash": config_hash(config), "epoch": 1, "lease_s": 5.0}
    return Deployment(**(given | changes))


def node(n=2, speed_m_per_s=0.1):
    return RecoveryNode(
        speed_m_per_s=speed_m_per_s, transition=np.eye(2 * n).tolist(), inputs=[np.eye(2 * n, n).tolist()] * 2
    )


def prediction(n=2, **changes):
    each = [0.1] * n
    model = Feedforward(stiffness_n=2400.0, length_m=each, radius_m=each, inertia_kg_m2=each, friction_nms_per_rad=each)
    given = {"fallback": "0" * 64, "period_s": 0.01, "horizon_s": 0.6, "margin_n": 6.0, "nodes": [node(n)]}
    return RecoveryPrediction(**(given | {"model": model, "coulomb_nm": [0.0] * n} | changes))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spans", "design"), [(1, design_lqi), (6, design_lqi), (6, design_lqg), (20, design_lqg), (60, design_lqi)]
)
def test_a_deployment_arrives_as_it_was_sent_within_the_mailboxs_limit(spans, design):
    command = Deploy(deployment=deployment(spans, design, watch=prediction(spans)))
    sent = command_bytes(command)
    assert len(sent) <= MAX_PAYLOAD
    assert parse_command(sent) == parse_command(sent, SHORTEST_S) == command
    assert config_hash(parse_command(sent).deployment.controller) == command.deployment.hash


@given(st.sampled_from([Renew(epoch=3), Keep(epoch=3), Rollback(reason="worse"), AskConfiguration()]))
def test_short_commands_are_plain_json(command):
    assert parse_command(command_bytes(command)) == command
    assert json.loads(command_bytes(command))["command"] == command.command


def test_they_read_as_a_person_would_say_them():
    command = Deploy(deployment=deployment())
    assert in_words(command) == f"deploy {command.deployment.hash[:12]} as epoch 1"
    assert in_words(Keep(epoch=3, watch=prediction())) == "keep 3"
    assert in_words(Rollback(reason="worse than before")) == "rollback worse than before"


def test_what_is_too_long_packed_or_not_is_refused_before_it_is_read():
    with pytest.raises(MalformedMessage, match=f"at most {MAX_COMMAND}"):
        parse_command(b'{"command": "stop"}' + b" " * MAX_COMMAND)
    with pytest.raises(MalformedMessage, match="unpacked"):
        parse_command(zlib.compress(b" " * (MAX_DEPLOYMENT + 1)))
    with pytest.raises(MalformedMessage, match="cut off"):
        parse_command(command_bytes(Deploy(deployment=deployment(20)))[:-20])


def code_of(payload, period_s=0.01):
    with pytest.raises(MalformedMessage) as refused:
        parse_command(payload, period_s)
    return [one.code for one in refused.value.findings]


def test_what_is_too_long_has_a_code_and_what_is_allowed():
    assert code_of(b'{"command": "stop"}' + b" " * MAX_COMMAND) == ["message-too-long"]
    assert code_of(zlib.compress(b" " * (MAX_DEPLOYMENT + 1))) == ["message-too-long"]
    assert code_of(b"\x78rubbish") == []


def test_what_holds_the_interpreter_for_longer_than_a_tenth_of_a_period_is_refused_whatever_it_is():
    numbers = {"command": "watch-good", "watch": {"x": [0.123456789012345] * (MAX_DEPLOYMENT // 21)}}
    objects = {"command": "deploy", "deployment": {"controller": [{"a": 1.5}] * (MAX_DEPLOYMENT // 14)}}
    for document in (numbers, objects):
        assert code_of(zlib.compress(json.dumps(document).encode())) == ["message-piece-too-long"]
    assert most_at_once(0.001) == MAX_COMMAND and most_at_once(0.01) == 12_500
    with pytest.raises(MalformedMessage) as refused:
        parse_command(zlib.compress(json.dumps({"x": [0.5] * 4_000}).encode()), 0.01)
    (found,) = refused.value.findings
    assert found.parameters == {"size_bytes": 20_000, "allowed_bytes": 12_500}


NUMBERS = st.lists(st.integers(-(10**9), 10**9) | st.floats(allow_nan=False, allow_infinity=False), max_size=60)
DOCUMENTS = st.recursive(
    NUMBERS | st.text('[0123, ]"\\\\é', max_size=30) | st.booleans() | st.none(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
)


@given(DOCUMENTS, st.integers(0, 100))
def test_row_by_row_it_is_the_same_document_or_none(document, most):
    text = json.dumps(document)
    try:
        assert load_rows(text, most, dict) == document
    except TooLongAPiece as error:
        assert error.size_bytes > most
    assert load_rows(text, len(text), dict) == document


@pytest.mark.parametrize("wrong", ["1 2", "1,,2", "+1", "1e", "-"])
def test_a_row_that_is_none_is_no_json(wrong):
    with pytest.raises(ValueError, match=r"."):
        load_rows(f'{{"x": [{wrong}{60 * ", 0"}], "y": [{", ".join(60 * "0")}]}}', 200, dict)


def test_what_stands_in_a_text_is_no_row():
    text = json.dumps({"reason": f'"[{"1, " * 40}2]\\', "x": [1.0] * 60})
    assert load_rows(text, 320, dict) == json.loads(text)


@pytest.mark.slow
@pytest.mark.parametrize("spans", [3, 8, 40])
def test_what_stands_around_the_rows_of_a_deployment_is_short_enough_for_any_period(spans):
    nodes = [node(spans, 0.1 * (1 + k)) for k in range(8)]
    command = Deploy(deployment=deployment(spans, watch=prediction(spans, nodes=nodes)))
    assert parse_command(command_bytes(command), SHORTEST_S) == command


def test_an_object_with_more_keys_than_any_command_has_is_refused_before_it_is_looked_at():
    pairs = ",".join(f'"k{number}":0' for number in range(100_000))
    with pytest.raises(MalformedMessage, match=f"100001 keys; allowed: {MOST_KEYS}"):
        parse_command(zlib.compress(f'{{"command":"stop",{pairs}}}'.encode()))
    with pytest.raises(MalformedMessage, match=r"^key given twice: a, b$"):
        parse_command(b'{"command":"stop","b":0,"a":0,"b":1,"a":2,"c":3}')


def test_only_deployments_may_be_packed():
    with pytest.raises(MalformedMessage, match="deploy, keep and watch-good"):
        parse_command(zlib.compress(b'{"command": "stop"}'))


@given(st.binary(max_size=200))
def test_packed_rubbish_is_refused(rubbish):
    for payload in (b"\x78" + rubbish, zlib.compress(rubbish)):
        with pytest.raises(MalformedMessage):
            parse_command(payload)


@pytest.mark.parametrize(
    "wrong",
    [{"hash": "abc"}, {"epoch": 0}, {"lease_s": 0.0}, {"lease_s": 61.0}, {"region": {"speed": 1.0}}, {"epoch": 1.5}],
)
def test_a_deployment_says_what_is_wrong(wrong):
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        deployment(**wrong)


def test_a_region_of_nothing_is_the_lines_own_limits():
    assert Region() == Region(speed_max_m_per_s=None, tension_step_max_n=None, speed_step_max_m_per_s=None)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"nodes": []}, "nodes"),
        ({"nodes": [node(speed_m_per_s=0.1), node(speed_m_per_s=0.1)]}, "ascending"),
        ({"nodes": [node(3)]}, r"transition must be \(4, 4\)"),
        ({"coulomb_nm": [0.0]}, "coulomb_nm for 2 rollers"),
        ({"horizon_s": 0.001}, "shorter than a period"),
    ],
)
def test_a_recovery_prediction_says_what_is_wrong(wrong, said):
    with pytest.raises(ValidationError, match=said):
        prediction(**wrong)

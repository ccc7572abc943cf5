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
    parse_command,
)
from gateway.mailbox.port import MAX_PAYLOAD


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
    assert parse_command(sent) == command
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

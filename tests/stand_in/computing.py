"""What personas want computed before they answer, written from what is on the wire, not with the product's code."""

import json
import random
from collections.abc import Mapping, Sequence
from typing import Any

from tests.stand_in.spoken import Form, Message, Spoken


def wants_calls(form: Form) -> bool:
    """Whether the form asks for calls, not for an answer."""
    return isinstance(form, Mapping) and "calls" in form.get("properties", {})


def calls(*each: Any) -> Spoken:
    return Spoken(json.dumps({"calls": list(each)}))


def sensible(question: Mapping[str, Any], messages: Sequence[Message]) -> Spoken:
    """One call where controllers are offered: a first guess where one is designed, margins where one is in service."""
    if any(message.get("content", "").startswith("What was computed") for message in messages):
        return calls()
    phase = str(question.get("decision", "")).partition(".")[0]
    if phase == "design":
        return calls({"call": "design", "architecture": "lqi", "model": "nominal"})
    return calls({"call": "margins"}) if phase == "adapt" else calls()


def hostile(rng: random.Random) -> Spoken:
    """Too many, too large, of other files, with matrices and limits of its own."""
    bad: list[Any] = [
        {"call": "simulate", "controller": {"kind": "lqr", "K": [[1e9] * 6] * 6}},
        {"call": "simulate", "plants": 10**9},
        {"call": "exec", "code": "import socket"},
        {"call": "identify", "recordings": ["/etc/passwd"]},
        {"call": "spectrum", "channel": "tension", "index": 1, "limits": {"torque_nm": 1e6}},
        {"call": "tune", "architecture": "mpc", "iterations": 10**6},
        {"call": "x" * 5000},
        [[[[]]]],
    ]
    rng.shuffle(bad)
    return calls(*bad)


def confused() -> Spoken:
    return calls({"call": "design", "architecture": "lqi", "knobs": {"torque_per_nm2": 1000.0}})


def invented() -> Spoken:
    return calls(
        {"call": "finite-element", "mesh": "fine"},
        {"call": "margins", "controller": "call 9"},
        {"call": "design", "architecture": "hybrid-neural-mpc"},
    )

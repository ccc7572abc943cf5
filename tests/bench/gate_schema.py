"""Bytes that look like proposals: most are none, and what is taken must be one by a reading of its own."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import numpy as np

from gateway.control.design import design_lqg, design_lqi, design_pid, task_of
from gateway.core.controller import config_hash
from gateway.core.experiment import Abort, Experiment, Leg
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.proposal import (
    MOST_BYTES,
    Change,
    ExperimentChange,
    GainsChange,
    Proposal,
    ProposalRefused,
    canonical,
    parse_proposal,
)
from tests.bench.gate_contexts import instant

SPANS = 1
Generator = np.random.Generator


@dataclass(frozen=True)
class Tally:
    tried: int
    refused: int
    right: int  #: taken, and a proposal by our own reading
    wrong: list[str]  #: taken, and none
    failed: list[str]  #: neither taken nor refused: another error


def valid_proposals(spans: int = SPANS) -> list[bytes]:
    """From which bytes are made."""
    line = load_line(line_template(spans, "line.toml"), "line.toml")
    task = task_of(line)
    configs = [design_lqi(task), design_pid(task), design_lqg(task)]
    changes: list[Change] = [GainsChange(controller=config) for config in configs]
    changes.append(
        ExperimentChange(
            experiment=Experiment(
                format=1,
                amplitude_n=[2.0] * spans,
                dwell_s=0.1,
                legs=[Leg(duration_s=5.0)],
                abort=Abort(deviation_n=8.0),
            )  # fmt: skip
        )
    )
    return [
        canonical(
            Proposal(
                format=1, site=line.site, line=line.line, change=change, base=config_hash(configs[0]), model=None,
                reason="it tracks better", evidence=[], predicted=[], author="agents", created=instant(-30.0),
                expires=instant(60.0),
            )
        )
        for change in changes
    ]  # fmt: skip


def mutated(seed: int, count: int) -> Tally:
    """`count` of them. The same for the same seed."""
    generator = np.random.default_rng(seed)
    valid = valid_proposals()
    documents = [json.loads(payload) for payload in valid]
    right, refused = 0, 0
    wrong: list[str] = []
    failed: list[str] = []
    for _ in range(count):
        k = int(generator.integers(len(valid)))
        how = MUTATIONS[int(generator.integers(len(MUTATIONS)))]
        payload = how(valid[k], generator)
        try:
            taken = parse_proposal(payload)
        except ProposalRefused:
            refused += 1
            continue
        except Exception as error:  # anything else is a hole
            failed.append(f"{how.__name__}: {type(error).__name__}: {error}"[:300])
            continue
        if taken.n != SPANS:
            refused += 1  # as not for this line
        elif reason := why_none(payload, documents[k]):
            wrong.append(f"{how.__name__}: {reason}: {payload[:200]!r}")
        else:
            right += 1
    return Tally(count, refused, right, wrong, failed)


def why_none(payload: bytes, like: dict[str, Any]) -> str:
    """Our own reading: strict JSON, no key twice, the keys and kinds of values of a valid one. Empty: it is one."""

    def no_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len({key for key, _ in pairs}) != len(pairs):
            raise ValueError("a key twice")
        return dict(pairs)

    def no_constant(text: str) -> Any:
        raise ValueError(text)

    try:
        document = json.loads(payload.decode("utf-8"), object_pairs_hook=no_doubles, parse_constant=no_constant)
    except ValueError as error:
        return f"no JSON: {error}"
    return _unlike(document, like, "")


def _unlike(value: Any, like: Any, where: str) -> str:
    if isinstance(like, dict):
        if not isinstance(value, dict):
            return f"{where} is no object"
        optional = {k for k in like if k in OPTIONAL}
        if not set(like) - optional <= set(value) <= set(like):
            return f"{where} has other keys"
        return next((found for key in value if (found := _unlike(value[key], like[key], f"{where}.{key}"))), "")
    if isinstance(like, list):
        if not isinstance(value, list) or (
            len(value) != len(like) and not ((value or where == IN_FLIGHT) and where in ANY_LENGTH)
        ):
            return f"{where} has another length"
        pairs = zip_longest(value, like[: len(value)], fillvalue=like[0] if like else None)
        return next((found for one, other in pairs if (found := _unlike(one, other, f"{where}[]"))), "")
    if isinstance(like, str):
        return "" if isinstance(value, str) and (value or not like) else f"{where} is no text"
    if like is None:
        return "" if value is None or isinstance(value, str | float | int) and not isinstance(value, bool) else where
    if isinstance(value, bool) or not isinstance(value, int | float):
        return f"{where} is no number"
    return "" if math.isfinite(value) else f"{where} is not finite"


#: Legs of an experiment, and torques in flight (as many as the law likes, or none).
IN_FLIGHT = ".change.controller.gain_input[]"
ANY_LENGTH = (".change.experiment.legs", IN_FLIGHT)
#: Keys that have a default, so that a proposal may do without them.
OPTIONAL = frozenset(
    {
        "evidence", "predicted", "kind", "draw_spans", "antiwindup", "tension_before_n", "tension_after_n", "name",
        "description", "shape", "rate_n_per_s", "seed", "speed_m_per_s", "window_s", "saturated_share",
        "reversal_share", "reversal_nm", "held_periods",
    }
)  # fmt: skip


def _places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path] if path else []
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in children:
        found += _places(child, (*path, key))
    return found


def _at(document: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        document = document[key]
    return document


BAD: tuple[Any, ...] = (
    math.nan, math.inf, -math.inf, True, False, None, "1.0", "", [], {}, [[]], -1.0, 0.0, 1e308, -1e-300, 10**400,
    "NaN", "\u0000", "\ud800", [1.0], {"a": 1},
)  # fmt: skip


def other_value(payload: bytes, g: Generator) -> bytes:
    """Something else in one place: not a number, a text, a truth value, nothing."""
    document = json.loads(payload)
    places = _places(document)
    path = places[int(g.integers(len(places)))]
    _at(document, path[:-1])[path[-1]] = BAD[int(g.integers(len(BAD)))]
    return json.dumps(document).encode("utf-8", "surrogatepass")


def key_gone(payload: bytes, g: Generator) -> bytes:
    document = json.loads(payload)
    places = [path for path in _places(document) if isinstance(_at(document, path[:-1]), dict)]
    path = places[int(g.integers(len(places)))]
    del _at(document, path[:-1])[path[-1]]
    return json.dumps(document).encode()


def key_more(payload: bytes, g: Generator) -> bytes:
    """One that nobody knows, or a misspelt one."""
    document = json.loads(payload)
    tables = [(), *(path for path in _places(document) if isinstance(_at(document, path), dict))]
    table = _at(document, tables[int(g.integers(len(tables)))])
    keys = list(table) or ["x"]
    key = str(g.choice(keys))
    table[str(g.choice(["accepted", "verdict", "__class__", key + "_", key.upper() + "x", " " + key, ""]))] = table.get(
        key
    )
    return json.dumps(document).encode()


def key_twice(payload: bytes, g: Generator) -> bytes:
    text = payload.decode()
    starts = [i for i, letter in enumerate(text) if letter == "{" and text[i + 1] == '"']
    at = starts[int(g.integers(len(starts)))]
    key = text[at + 1 : text.index(":", at)]
    return f"{text[: at + 1]}{key}:{str(g.choice(['1', 'null', '0.5', '[]']))},{text[at + 1 :]}".encode()


def wrong_size(payload: bytes, g: Generator) -> bytes:
    """A list one longer or shorter, somewhere."""
    document = json.loads(payload)
    lists = [path for path in _places(document) if isinstance(_at(document, path), list) and _at(document, path)]
    chosen = _at(document, lists[int(g.integers(len(lists)))])
    if g.random() < 0.5:
        chosen.append(chosen[0])
    else:
        chosen.pop()
    return json.dumps(document).encode()


def bytes_off(payload: bytes, g: Generator) -> bytes:
    """Bytes flipped, gone, or doubled."""
    raw = bytearray(payload)
    for _ in range(int(g.integers(1, 4))):
        at, how = int(g.integers(len(raw))), int(g.integers(3))
        if how == 0:
            raw[at] = int(g.integers(256))
        elif how == 1:
            del raw[at]
        else:
            raw[at:at] = raw[at : at + int(g.integers(1, 8))]
    return bytes(raw)


def ends_elsewhere(payload: bytes, g: Generator) -> bytes:
    """Cut, or with something behind it."""
    if g.random() < 0.5:
        return payload[: int(g.integers(len(payload)))]
    return payload + [b"{}", b"\x00", b"null", payload, b"]", b"\xff"][int(g.integers(6))]


def other_numbers(payload: bytes, g: Generator) -> bytes:
    """A number written as no JSON has it."""
    text = payload.decode()
    digits = [i for i, letter in enumerate(text) if letter.isdigit() and text[i - 1] in "[,:"]
    at = digits[int(g.integers(len(digits)))]
    end = at
    while text[end] in "0123456789.eE+-":
        end += 1
    new = str(
        g.choice(["NaN", "Infinity", "-Infinity", "1e999", "-1e999", "0x1", "01", "1.", ".5", "+1", "true", '"1"'])
    )
    return f"{text[:at]}{new}{text[end:]}".encode()


def too_large(payload: bytes, g: Generator) -> bytes:
    """Blanks are JSON, but too many are no proposal."""
    return payload + b" " * (MOST_BYTES - len(payload) + int(g.integers(1, 1000)))


def too_deep(payload: bytes, g: Generator) -> bytes:
    depth = int(g.integers(100, 20_000))
    return payload[:-1] + b',"x":' + b"[" * depth + b"]" * depth + b"}"


MUTATIONS: tuple[Callable[[bytes, Generator], bytes], ...] = (
    other_value, other_value, other_value, key_gone, key_more, key_twice, wrong_size, bytes_off, bytes_off,
    ends_elsewhere, other_numbers, other_numbers, too_large, too_deep,
)  # fmt: skip

"""Single values, spelling and syntax of a line description: what is said about each "
"mistake, and on which line."""

import re
import string
import tomllib
from copy import deepcopy
from datetime import date
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_problem import LineRefused, Problem
from gateway.core.line_template import line_template
from gateway.core.line_words import TRANSLATED

TEMPLATE = line_template(6)


def edited(*replacements: tuple[str, str], text: str = TEMPLATE) -> str:
    """The template with the first occurrence of each old text replaced."""
    for old, new in replacements:
        assert old in text, f"{old!r} is not in the template"
        text = text.replace(old, new, 1)
    return text


def problems(text: str) -> list[Problem]:
    with pytest.raises(LineRefused) as refused:
        load_line(text, "line.toml")
    return refused.value.problems


def only(text: str) -> Problem:
    found = problems(text)
    assert len(found) == 1, "\n".join(map(str, found))
    return found[0]


def line_with(text: str, start: str, nth: int = 1) -> int:
    return [i for i, line in enumerate(text.split("\n"), 1) if line.startswith(start)][nth - 1]


def test_the_template_is_what_pydantic_makes_of_it() -> None:
    assert load_line(TEMPLATE, "line.toml") == Line.model_validate(tomllib.loads(TEMPLATE))


def test_windows_line_ends_and_byte_order_mark_are_read() -> None:
    assert load_line("\ufeff" + TEMPLATE.replace("\n", "\r\n"), "line.toml") == load_line(TEMPLATE, "line.toml")


#: what is edited, where it must be found, and what must be said
VALUES = [
    (
        "torque_nm = 60.0",
        'torque_nm = "60"',
        "limits.torque_nm",
        "is text, not a number (remove the quotes); allowed: a number above 0 Nm",
    ),
    ("torque_nm = 60.0", "torque_nm = true", "limits.torque_nm", "is true or false; allowed: a number above 0 Nm"),
    (
        "torque_nm = 60.0",
        "torque_nm = nan",
        "limits.torque_nm",
        "= nan: is not a finite number; allowed: a number above 0 Nm",
    ),
    ("torque_nm = 60.0", "torque_nm = -inf", "limits.torque_nm", "is not a finite number"),
    ("torque_nm = 60.0", "torque_nm = 0", "limits.torque_nm", "= 0: is too small; allowed: a number above 0 Nm"),
    ("torque_nm = 60.0", f"torque_nm = 1{400 * '0'}", "limits.torque_nm", "is a number too large to compute with"),
    ("torque_nm = 60.0", "torque_nm = [60.0]", "limits.torque_nm", "= [60.0]: is a list; allowed: a number above 0 Nm"),
    (
        "torque_nm = 60.0",
        "torque_nm = { a = 1 }",
        "limits.torque_nm",
        "torque_nm: is a table; allowed: a number above 0 Nm",
    ),
    ("torque_nm = 60.0", "torque_nm = 2020-01-02", "limits.torque_nm", "= 2020-01-02: is a date or time"),
    (
        "tension_min_n = 2.0",
        "tension_min_n = -2.0",
        "limits.tension_min_n",
        "is too small; allowed: a number, 0 or more N",
    ),
    (
        "period_s = 0.010",
        "period_s = 10",
        "control.period_s",
        "= 10: is too large; allowed: a number from 0.001 to 0.1 s",
    ),
    ("watchdog_s = 0.1", "watchdog_s = 0.3", "limits.watchdog_s", "is too large; allowed: a number from 0.01 to 0.2 s"),
    (
        "hold_periods = 3",
        "hold_periods = 3.0",
        "limits.hold_periods",
        "is not a whole number; allowed: a whole number from 1 to 3",
    ),
    ("format = 1", "format = 2", "format", "= 2: is a newer format than this program knows; allowed: 1"),
    ("format = 1", "format = true", "format", "= true: is true or false; allowed: 1"),
    (
        'site = "demo"',
        'site = "Hall 3!"',
        "site",
        "is no valid name; allowed: lower-case letters, digits and hyphens, at most 32 characters, "
        'with a letter or digit at either end; did you mean "hall-3"?',
    ),
    ('site = "demo"', "site = 3", "site", "is a number; allowed: lower-case letters"),
    (
        'description = "Demonstration line with 6 spans, simulated"',
        "description = 3",
        "description",
        "is a number; allowed: text in quotes",
    ),
    (
        "radius_m = { value = 0.04, tolerance = 0.2 }",
        "radius_m = 0.04",
        "rollers[1].radius_m",
        "is a number; allowed: { value = a number above 0, tolerance = a fraction above 0 and below 1 }, value in m",
    ),
    (
        "tolerance = 0.2 }",
        "tolerance = 20 }",
        "rollers[1].radius_m.tolerance",
        "= 20: is too large; allowed: a number above 0 and below 1, a fraction: 0.3 means 30 % either way",
    ),
    (
        "value = 0.95,",
        "value = 0.0,",
        "rollers[1].inertia_kg_m2.value",
        "is too small; allowed: a number above 0 kg m2",
    ),
    (
        'control = "tension"',
        'control = "tensoin"',
        "spans[1].control",
        '= "tensoin": is none of the choices; allowed: "tension", "draw"; did you mean "tension"?',
    ),
    (
        'interface = "udp_multicast"',
        'interface = "socketcam"',
        "buses[1].interface",
        'allowed: "udp_multicast", "virtual", "socketcan"; did you mean "socketcan"?',
    ),
    (
        "bitrate_bit_per_s = 1_000_000",
        "bitrate_bit_per_s = 1",
        "buses[1].bitrate_bit_per_s",
        "= 1: is none of the choices; allowed: 125000, 250000, 500000, 800000, 1000000 bit/s",
    ),
    ("port = 43113", "port = 70000", "buses[1].port", "is too large; allowed: a whole number from 1 to 65535"),
    (
        'protocol = "canopen"',
        'protocol = "profinet"',
        "buses[1].protocol",
        '= "profinet": is none of the choices; allowed: "canopen", "modbus-tcp", "opcua"',
    ),
    ('protocol = "canopen"', 'protocol = "CANopn"', "buses[1].protocol", 'did you mean "canopen"?'),
    ("address = 1", "address = 0", "drives[1].address", "= 0: is too small; allowed: a whole number from 1 to 247"),
    (
        "channel = 6",
        "channel = 61",
        "load_cells[6].channel",
        "= 61: is too large; allowed: a whole number from 1 to 60",
    ),
    (
        "tension_n = [28.0, 36.0,",
        "tension_n = [28.0, -36.0,",
        "recipes[1].tension_n[2]",
        "= -36.0: is too small; allowed: a number above 0 N",
    ),
    (
        "tension_n = [28.0, 36.0, 20.0, 40.0, 24.0, 32.0]",
        "tension_n = 28.0",
        "recipes[1].tension_n",
        "is a number; allowed: a list [ ... ] of numbers above 0, one per span, in N",
    ),
]


@pytest.mark.parametrize(("old", "new", "key", "said"), VALUES)
def test_a_wrong_value_is_named_in_plain_words(old: str, new: str, key: str, said: str) -> None:
    text = edited((old, new))
    problem = only(text)
    assert problem.key == key
    assert said in str(problem)
    assert problem.line == TEMPLATE[: TEMPLATE.index(old)].count("\n") + 1
    assert str(problem).startswith(f"line.toml:{problem.line}: {key}")


@pytest.mark.parametrize(
    ("old", "key", "header", "allowed"),
    [
        ("torque_nm = 60.0  ", "limits.torque_nm", "[limits]", "a number above 0 Nm"),
        ("address = 3\n", "drives[3].address", "[[drives]]", "a whole number from 1 to 247"),
        ('protocol = "modbus-tcp"', "buses[2].protocol", "[[buses]]", '"canopen", "modbus-tcp", "opcua"'),
        ("value = 0.95, ", "rollers[1].inertia_kg_m2.value", "inertia_kg_m2", "a number above 0 kg m2"),
        ('site = "demo"', "site", "", "lower-case letters"),
    ],
)
def test_a_missing_key_is_at_the_header_of_its_table(old: str, key: str, header: str, allowed: str) -> None:
    text = edited((old, "# " if "\n" not in old and "," not in old else ""))
    problem = only(text)
    assert (problem.key, problem.wrong, problem.value) == (key, "is missing", "")
    assert problem.allowed.startswith(allowed)
    index = re.search(r"\[(\d)\]", key)
    assert problem.line == (line_with(text, header, int(index[1]) if index else 1) if header else 1)


def test_missing_tables_are_named() -> None:
    found = {problem.key: str(problem) for problem in problems("format = 1\nsite = 'a'\nline = 'b'\n")}
    assert set(found) == {"limits", "web", "rollers", "spans", "buses", "drives", "load_cells", "plc", "recipes"}
    assert "allowed: a table, headed [limits] or in braces" in found["limits"]
    assert "allowed: 1 to 60 tables, each headed [[rollers]]" in found["rollers"]


def test_all_tables_are_reported_at_once_in_the_order_of_the_file() -> None:
    text = edited(
        ("period_s = 0.010", "period_s = 1"),
        ("torque_nm = 60.0", "torque_nm = -1"),
        ("radius_m = { value = 0.04", "radius_m = { value = 'x'"),
        ("address = 5", "address = 500"),
        ("capacity_n = 100.0", "capacity_n = -1.0"),
        ('bus = "io"', 'bus = "i0"'),
        ('name = "velocity"', 'name = "Velocity"'),
        # and across tables, all the same
        ('name = "span-3"', 'name = "span-2"'),
        ('channel = "239.', 'channel = "9.'),
    )
    found = problems(text)
    assert [problem.key for problem in found] == [
        "control.period_s",
        "limits.torque_nm",
        "rollers[1].radius_m.value",
        "spans[3].name",
        "buses[1].channel",
        "drives[5].address",
        "load_cells[1].capacity_n",
        "recipes[2].name",
    ]
    assert [problem.line for problem in found] == sorted(problem.line for problem in found)


def test_a_mistyped_table_does_not_hide_what_stands_in_it() -> None:
    text = edited(("[limits]", "[limit]"), ("torque_nm = 60.0", "torqe_nm = -60.0"), ("[[recipes]]", "[[recipe]]"))
    text = text.replace("[[recipes]]", "[[recipe]]")
    found = {problem.key: problem for problem in problems(text)}
    assert set(found) == {"limit", "limit.torqe_nm", "recipe"}
    assert found["limit"].nearest == "limits"
    assert found["recipe"].nearest == "recipes"
    text = edited(("[limits]", "[limit]"), ("torque_nm = 60.0", "torque_nm = -60.0"))
    assert [problem.key for problem in problems(text)] == ["limit", "limit.torque_nm"]


def test_a_mistyped_protocol_does_not_hide_the_bus() -> None:
    text = edited(('protocol = "canopen"', 'protocl = "canopn"'), ("port = 43113", "port = 0"))
    assert [(problem.key, problem.nearest) for problem in problems(text)] == [
        ("buses[1].protocl", "protocol"),
        ("buses[1].protocl", '"canopen"'),
        ("buses[1].port", ""),
    ]


def test_a_key_twice_in_spirit_is_refused_and_both_are_named() -> None:
    problem = only(edited(("torque_nm = 60.0", "torque_nm = 60.0\ntorque_mn = 60.0")))
    assert (problem.key, problem.nearest) == ("limits.torque_mn", "torque_nm")


SYNTAX = [
    ("torque_nm = 60.0", "torque_nm = 60,0", "one key = value per line, a point in decimal numbers"),
    ("torque_nm = 60.0", "torque_nm = 60.0\ntorque_nm = 61.0", "second time: keep one"),
    ('site = "demo"', "site = demo", "text in quotes"),
    ('site = "demo"', 'site = "demo', "close the text with a quote on the same line"),
    ("[limits]", "[limits", "close the brackets"),
    ("[moves]", "[limits]", "this table stands here for the second time"),
    ("32.0]", "32.0", "close the list with ]"),
    ("torque_nm = 60.0", "torque_nm 60.0", "write key = value"),
    ("[limits]", "§", "write key = value or [table]"),
    ("format = 1", "format = " + 5000 * "1", "too many digits"),
]


@pytest.mark.parametrize(("old", "new", "advice"), SYNTAX)
def test_a_syntax_error_has_line_column_and_advice(old: str, new: str, advice: str) -> None:
    problem = only(edited((old, new)))
    assert advice in problem.wrong
    at = TEMPLATE[: TEMPLATE.index(old)].count("\n") + 1
    assert at <= problem.line <= at + 2
    assert "too many digits" in advice or re.match(r"column \d+: not TOML", problem.wrong)


def test_an_error_at_the_end_of_the_file_has_the_last_line() -> None:
    problem = only(TEMPLATE + "x = '''\n\n")
    assert problem.line == TEMPLATE.count("\n") + 1
    assert "close the text" in problem.wrong


@pytest.mark.parametrize("text", ["a = " + "[" * 20_000, "a = " + "[" * 300 + "]" * 300, "", "\x00", "a = 1\rb = 2"])
def test_hostile_text_is_refused_and_nothing_else(text: str) -> None:
    problems(text)


def test_control_characters_reach_no_terminal() -> None:
    shown = str(problems(edited(('site = "demo"', '"\\u001b[31m" = "\\u001b[0m\\u202e"')))[0])
    assert shown.isprintable()


def known_key_lines() -> list[tuple[int, str]]:
    """Index of a line of the template that gives a key or opens a table, and that key."""
    found: list[tuple[int, str]] = []
    for i, row in enumerate(TEMPLATE.split("\n")):
        match = re.match(r"(?:\[\[?)?([a-z_0-9]+)(?:\]| =)", row)
        if match:
            found.append((i, match[1]))
    return found


@pytest.mark.slow
@settings(max_examples=150)
@given(st.data())
def test_any_typo_in_a_key_is_reported_with_line_and_nearest_key(data: st.DataObject) -> None:
    index, key = data.draw(st.sampled_from(known_key_lines()))
    at = data.draw(st.integers(0, len(key) - 1))
    letter = data.draw(st.sampled_from(string.ascii_lowercase + "_"))
    typo = data.draw(
        st.sampled_from([key[:at] + letter + key[at:], key[:at] + key[at + 1 :], key[:at] + letter + key[at + 1 :]])
    )
    rows = TEMPLATE.split("\n")
    siblings = {k for _, k in known_key_lines()}
    assume(typo and typo not in siblings)
    array = rows[index].startswith("[[")
    for i, row in enumerate(rows):  # an array of tables is renamed as a whole
        if i == index or (array and row.startswith(f"[[{key}]]")):
            rows[i] = row.replace(key, typo, 1)
    first = rows.index(next(row for row in rows if array and row.startswith(f"[[{typo}]]"))) if array else index
    problem = only("\n".join(rows))
    assert (problem.line, problem.nearest, problem.wrong) == (first + 1, key, "there is no such key")
    assert problem.key.split(".")[-1] == typo


def paths(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    below = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(found for key, child in below for found in paths(child, (*path, key)))]


JUNK: list[Any] = [
    "x",
    "",
    3,
    -1,
    0,
    10**400,
    2**70,
    1e300,
    -0.5,
    float("nan"),
    float("inf"),
    True,
    [],
    {},
    [1],
    ["x"],
    [[]],
    [{}],
    {"x": 1},
    date(2020, 1, 1),
    [1.0] * 100,
    [{"protocol": "x"}],
    [{"protocol": "canopen"}],
]


def replaced(path: tuple[Any, ...], junk: Any) -> dict[str, Any]:
    document: Any = tomllib.loads(line_template(2))
    parent = document
    for part in path[:-1]:
        parent = parent[part]
    parent[path[-1]] = deepcopy(junk)  # a later edit may reach into it
    return document


@pytest.mark.slow
def test_every_error_that_pydantic_can_give_is_translated() -> None:
    kinds: set[str] = set()
    for path in paths(tomllib.loads(line_template(2)))[1:]:
        for junk in JUNK:
            try:
                Line.model_validate(replaced(path, junk))
            except ValidationError as error:
                kinds |= {each["type"] for each in error.errors()}
    assert kinds >= {"float_type", "missing", "extra_forbidden", "union_tag_invalid", "union_tag_not_found", "too_long"}
    assert kinds <= TRANSLATED


def written(value: Any) -> str:
    """Any document as one-line TOML values."""
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{key}" = {written(child)}' for key, child in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(written, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)


ALL_PATHS = paths(tomllib.loads(line_template(2)))[1:]


@pytest.mark.slow
@settings(max_examples=200)
@given(st.lists(st.tuples(st.sampled_from(ALL_PATHS), st.sampled_from(JUNK)), min_size=1, max_size=3))
def test_junk_anywhere_is_refused_or_read_but_never_crashes(edits: list[tuple[tuple[Any, ...], Any]]) -> None:
    document: Any = tomllib.loads(line_template(2))
    for path, junk in edits:
        parent = document
        try:
            for part in path[:-1]:
                parent = parent[part]
            parent[path[-1]] = deepcopy(junk)  # a later edit may reach into it
        except (KeyError, IndexError, TypeError):
            continue  # an earlier edit took the place away
    text = "\n".join(f"{key} = {written(value)}" for key, value in document.items())
    try:
        load_line(text, "line.toml", {"cia402-torque": ("canopen", "drive")})
    except LineRefused as refused:
        for problem in refused.problems:
            assert 1 <= problem.line <= len(document) + 1
            assert "is not what belongs here" not in problem.wrong


@settings(max_examples=100)
@given(st.lists(st.integers(0, TEMPLATE.count("\n")), max_size=40), st.data())
def test_deleted_lines_and_tables_never_raise_anything_else(deleted: list[int], data: st.DataObject) -> None:
    rows = TEMPLATE.split("\n")
    blocks = "\n".join(row for i, row in enumerate(rows) if i not in deleted).split("\n\n")
    kept = [block for block in blocks if data.draw(st.integers(0, 9)) > 0]
    try:
        load_line("\n\n".join(kept), "line.toml")
    except LineRefused as refused:
        assert refused.problems
        assert all(problem.line >= 1 and str(problem).isprintable() for problem in refused.problems)

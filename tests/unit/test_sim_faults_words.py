"""The table of faults, the words in which they are asked for, and the page written from it."""

from math import isfinite
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_plant.faults.effects import EFFECTS
from sim_plant.faults.frame_effects import FRAME_FAULTS
from sim_plant.faults.page import page
from sim_plant.faults.parse import FaultRefused, Injection, Target, parse_fault
from sim_plant.faults.table import BY_NAME, FAULTS, NUMBERED, WIRES, Choice, Kind, Lasting, Number


def test_the_page_is_the_table():
    assert Path("docs/faults.md").read_text() == page(), (
        "write it anew: python -m sim_plant.faults.page > docs/faults.md"
    )


def test_every_fault_of_the_table_does_something_and_nothing_else_does():
    assert len(BY_NAME) == len(FAULTS)
    assert set(BY_NAME) == FRAME_FAULTS | set(EFFECTS)
    assert not FRAME_FAULTS & set(EFFECTS)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_row_has_an_example_that_can_be_asked_for(fault):
    injection = parse_fault(fault.example)
    assert injection.fault is fault
    assert parse_fault(str(injection)) == injection
    assert set(injection.values) == {parameter.name for parameter in fault.parameters}
    assert fault.does.endswith(".") and "|" not in page().splitlines()[0]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_bounds_hold_their_defaults(fault):
    for parameter in fault.parameters:
        if isinstance(parameter, Number):
            assert isfinite(parameter.lowest) and parameter.lowest < parameter.highest
            if parameter.default is not None and isfinite(parameter.default):
                assert parameter.lowest <= parameter.default <= parameter.highest


@st.composite
def injections(draw) -> Injection:
    fault = draw(st.sampled_from(FAULTS))
    kind = draw(st.sampled_from(fault.kinds))
    wire = draw(st.sampled_from(WIRES)) if kind is Kind.WIRE else ""
    addressed = NUMBERED[kind] is not None and wire != "opcua"
    number = draw(st.integers(1, 127)) if addressed and (not wire or draw(st.booleans())) else None
    values = {}
    for parameter in fault.parameters:
        if isinstance(parameter, Choice):
            values[parameter.name] = draw(st.sampled_from(parameter.words))
        elif parameter.whole:
            values[parameter.name] = float(draw(st.integers(int(parameter.lowest), int(parameter.highest))))
        else:
            values[parameter.name] = draw(st.floats(parameter.lowest, parameter.highest))
    at_s = draw(st.none() | st.floats(0.0, 1e6))
    for_s = draw(st.floats(0.001, 1e6)) if fault.lasting is Lasting.WHILE else None
    return Injection(fault, Target(kind, number, wire), values, at_s, for_s)


@given(injections())
def test_what_is_written_reads_back_as_the_same(injection):
    assert parse_fault(str(injection)) == injection


@given(
    st.text(max_size=80) | st.lists(st.sampled_from(["plc", "drive", "3", "drop", "at", "for", "=", "count=", "nan"]))
)
def test_whatever_is_asked_for_is_understood_or_refused(words):
    try:
        parse_fault(words if isinstance(words, str) else " ".join(words))
    except FaultRefused as refused:
        assert len(str(refused)) < 2000


def test_what_is_not_given_has_its_default():
    injection = parse_fault("canopen drop")
    assert injection.target == Target(Kind.WIRE, None, "canopen")
    assert injection.word("direction") == "both" and injection.number("probability") == 1.0
    assert injection.at_s is None and injection.for_s is None


def test_numbers_may_be_hexadecimal():
    assert parse_fault("drive 2 drive-fault code=0x3210").number("code") == 0x3210


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "it reads TARGET"),
        ("drve 3 sto", "Did you mean drive?"),
        ("drive sto", "needs a number, that of the roller: drive 1 sto"),
        ("drive 0 sto", "from 1 to 999"),
        ("drive 3", "names no fault"),
        ("drive 3 stoo", "Did you mean sto?"),
        ("drive 3 nan", "nan is a fault of load-cell, not of drive 3"),
        ("plc 1 mute", "has no numbers"),
        ("opcua 1 mute", "has no numbers"),
        ("canopen 128 mute", "from 1 to 127"),
        ("modbus-tcp 256 mute", "from 0 to 255"),
        ("load-cell 2 drift", "needs rate_n_per_s=, -10000 to 10000 N/s"),
        ("load-cell 2 drift rate_n_per_s=nan", "allowed: -10000 to 10000 N/s"),
        ("load-cell 2 drift rate_n_per_s=1_0", "allowed: -10000 to 10000 N/s"),
        ("load-cell 2 drift rate=1", "Did you mean rate_n_per_s?"),
        ("load-cell 2 drift rate_n_per_s=1 rate_n_per_s=2", "given twice"),
        ("plc mute at", "at takes a time in s"),
        ("plc mute at -1", "at takes a time in s"),
        ("plc mute for 0", "for takes a time in s from 0.001"),
        ("plc mute for 1 for 2", "given twice"),
        ("plc mute 3", '"3" is no parameter of mute; allowed: at, for'),
        ("drive 2 restart for 3", "happens once"),
        ("drive 2 drop count=1.5", "whole numbers"),
        ("drive 2 drop probability=1.01", "allowed: 0 to 1"),
        ("drive 2 drop direction=both2", "Did you mean both?"),
        ("drive 2 drop " + "x" * 500, "allowed: 400"),
    ],
)
def test_what_is_refused_says_what_is_allowed(text, said):
    with pytest.raises(FaultRefused) as refused:
        parse_fault(text)
    assert said in str(refused.value)

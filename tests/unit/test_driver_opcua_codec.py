"""What link and OPC UA process say to each other, and the numbers in it: whole, or refused."""

import subprocess
import sys
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.opcua.messages import (
    MAX_TEXT,
    Answer,
    Outcome,
    Plan,
    Question,
    decode_answer,
    decode_question,
    encode_answer,
    encode_question,
)
from drivers.opcua.nodes import Node, NodeTable, Reading, to_type
from drivers.opcua.source_time import SourceTime
from drivers.opcua.status import describe, is_done, is_good

u16 = st.integers(0, 0xFFFF)
u32 = st.integers(0, 0xFFFFFFFF)
u64 = st.integers(0, (1 << 64) - 1)
number = st.floats(allow_nan=False)
questions = st.builds(
    Question,
    u64,
    u64,
    number,
    number,
    st.booleans(),
    st.lists(st.tuples(u16, number), max_size=200).map(tuple),
    st.lists(u16, max_size=800).map(tuple),
)
answers = st.builds(
    Answer,
    u64,
    st.sampled_from(Outcome),
    u64,
    st.lists(u32, max_size=200).map(tuple),
    st.lists(st.builds(Reading, u32, number, st.integers(0, (1 << 63) - 1)), max_size=800).map(tuple),
    st.text(st.characters(codec="ascii"), max_size=MAX_TEXT),
)


@given(questions)
def test_a_question_arrives_as_it_was_asked(question: Question) -> None:
    assert decode_question(encode_question(question)) == question


@given(answers)
def test_an_answer_arrives_as_it_was_given(answer: Answer) -> None:
    assert decode_answer(encode_answer(answer)) == answer


@given(questions, st.data())
def test_a_question_that_is_cut_is_refused(question: Question, data: st.DataObject) -> None:
    message = encode_question(question)
    with pytest.raises(ValueError, match="are no question"):
        decode_question(message[: data.draw(st.integers(0, len(message) - 1))])


@given(st.binary(max_size=400))
def test_noise_is_refused_or_a_whole_message(noise: bytes) -> None:
    for decode in (decode_question, decode_answer):
        try:
            decode(noise)
        except ValueError as refusal:
            assert "are no" in str(refusal)


def test_not_a_number_is_carried_and_left_to_the_roles() -> None:
    answer = decode_answer(encode_answer(Answer(1, Outcome.DONE, 1, (), (Reading(0, nan),))))
    assert answer.readings[0].value != answer.readings[0].value


def test_a_long_text_is_cut_and_too_many_nodes_are_refused() -> None:
    assert len(decode_answer(encode_answer(Answer(1, Outcome.FAILED, 1, text="x" * 1000))).text) == MAX_TEXT
    with pytest.raises(ValueError, match="at most"):
        encode_question(Question(1, 1, 0.0, 0.0, False, ((0, 0.0),) * 10_000, ()))


def test_a_plan_survives_the_way_to_another_process() -> None:
    plan = Plan("opc.tcp://h:1", "none", "", "", "", [Node("urn:x", "A.b", "f64")])
    assert Plan.from_json(plan.to_json()) == plan


def test_a_node_has_one_place() -> None:
    table = NodeTable()
    node = Node("urn:x", "A", "u16")
    assert [table.place(node), table.place(node._replace(type="u32")), table.place(node)] == [0, 1, 0]


@pytest.mark.parametrize(
    ("kind", "low", "high"), [("bool", 0, 1), ("u8", 0, 255), ("i16", -32768, 32767), ("u32", 0, 2**32 - 1)]
)
def test_a_number_fits_its_type_or_is_refused(kind: str, low: int, high: int) -> None:
    assert to_type(low - 0.4, kind) == low and to_type(high + 0.4, kind) == high
    for beyond in (low - 1, high + 1):
        with pytest.raises(ValueError, match=f"does not fit a {kind}"):
            to_type(beyond, kind)


@pytest.mark.parametrize("kind", ["bool", "u16", "i32", "f32", "f64"])
@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_what_is_not_finite_is_never_written(value: float, kind: str) -> None:
    with pytest.raises(ValueError, match="is not finite"):
        to_type(value, kind)


def test_a_float_is_bounded_by_its_width() -> None:
    assert to_type(3.4e38, "f32") == 3.4e38 and to_type(1e300, "f64") == 1e300
    with pytest.raises(ValueError, match="does not fit"):
        to_type(3.5e38, "f32")


@pytest.mark.parametrize(
    ("status", "good", "text"),
    [
        (0, True, "Good"),
        (0x00000400, True, "Good"),  # of a value
        (0x00000480, True, "Good"),  # overflow, of a queue
        (0x0000041F, True, "Good"),  # historian bits
        (0x00000080, False, "Good (status 00000080h)"),  # of nothing: no such thing
        (0x00000500, False, "Good (status 00000500h), at its low limit"),
        (0x00000600, False, "Good (status 00000600h), at its high limit"),
        (0x00000780, False, "Good (status 00000780h), constant"),
        (0x00000420, False, "Good (status 00000420h)"),  # reserved
        (0x00004000, False, "Good (status 00004000h)"),  # semantics changed
        (0x00008400, False, "Good (status 00008400h)"),  # structure changed
        (0x00960000, False, "GoodLocalOverride"),
        (0x3FFFFFFF, False, "Good"),
        (0x40000000, False, "Uncertain"),
        (0x40930000, False, "UncertainSensorNotAccurate"),
        (0x808C0000, False, "BadSensorFailure"),
        (0x808C0480, False, "BadSensorFailure"),
        (0xFFFFFFFF, False, "Bad"),
    ],
)
def test_only_what_was_measured_is_good(status: int, good: bool, text: str) -> None:
    assert is_good(status) is good
    assert describe(status).startswith(text)


@pytest.mark.parametrize("status", [0x00300000, 0x002E0000, 0x00000400, 0x40000000, 0x803B0000])
def test_a_write_that_was_clamped_or_put_off_is_not_done(status: int) -> None:
    assert is_done(0) and not is_done(status)


def test_a_source_time_stamp_that_does_not_move_is_found_after_three_answers() -> None:
    source = SourceTime("sample")
    assert [source.stands_still(us) for us in (5, 5, 5, 5, 5, 6, 6, 4)] == [False] * 3 + [True] * 2 + [False] * 3


def test_without_source_time_stamps_or_with_those_of_changes_nothing_is_concluded() -> None:
    assert not any(SourceTime("sample").stands_still(0) for _ in range(9))
    source = SourceTime("change")
    assert not any(source.stands_still(7) for _ in range(9))


def test_the_loops_side_loads_no_opc_ua_library() -> None:
    program = "import sys, drivers.registry; sys.exit(any(name.startswith('asyncua') for name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", program], check=False, timeout=60).returncode == 0

"""The planner of Modbus transactions: every field from its own registers, and no register written that is nobody's."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.map_rules import BYTES
from drivers.modbus.plan import Plan, Wish
from drivers.modbus.registers import RegisterBlock

KINDS = {"u16": (0, 2**16 - 1), "i16": (-(2**15), 2**15 - 1), "u32": (0, 2**32 - 1), "i32": (-(2**31), 2**31 - 1)}


@st.composite
def wishes(draw: st.DrawFn) -> list[Wish]:
    """Devices of one unit: reads of any two may overlap, those of one and all writes do not."""
    found: list[Wish] = []
    write_at = draw(st.integers(0, 1000))
    for k in range(draw(st.integers(1, 8))):
        at = draw(st.integers(0, 400))
        reads: list[tuple[int, str]] = []
        for kind in draw(st.lists(st.sampled_from([*KINDS]), min_size=1, max_size=6)):
            reads.append((at, kind))
            at += BYTES[kind] // 2 + draw(st.integers(0, 90))
        write = None
        if draw(st.booleans()):
            write_at += draw(st.sampled_from([0, 0, 0, 1, 50]))
            write = (write_at, draw(st.integers(1, 40)))
            write_at += write[1]
        order = draw(st.sampled_from(["high-first", "low-first"]))
        found.append(Wish(f"device-{k}", draw(st.permutations(reads)), order, write))
    return draw(st.permutations(found))


def register(address: int) -> int:
    """What the device has at an address: another number everywhere."""
    return (address * 40503 + 17) & 0xFFFF


def expected(wish: Wish) -> list[float]:
    blocks = [RegisterBlock([field], wish.word_order) for field in wish.reads]
    return [block.decode([register(block.address + i) for i in range(block.count)])[0] for block in blocks]


@given(wishes(), st.booleans())
def test_every_field_is_decoded_from_exactly_its_registers(wanted: list[Wish], together: bool) -> None:
    plan = Plan(wanted, together)
    assert all(1 <= count <= 125 for _, count in plan.reads)
    answers = [[register(address + i) for i in range(count)] for address, count in plan.reads]
    assert plan.decode(answers) == [expected(wish) for wish in wanted]


@given(wishes(), st.booleans())
def test_writes_touch_exactly_what_belongs_to_the_devices(wanted: list[Wish], together: bool) -> None:
    plan = Plan(wanted, together)
    writing = [wish for wish in wanted if wish.write is not None]
    wanted_of = {at + i: (k, i) for k, wish in enumerate(writing) for at, n in [wish.write or (0, 0)] for i in range(n)}
    payloads = plan.payloads(
        [[1000 * k + i for i in range((wish.write or (0, 0))[1])] for k, wish in enumerate(writing)]
    )
    written: dict[int, int] = {}
    for (address, count), payload in zip(plan.writes, payloads, strict=True):
        assert len(payload) == count <= 121
        written |= {address + i: value for i, value in enumerate(payload)}
    assert written == {at: 1000 * k + i for at, (k, i) in wanted_of.items()}
    for wish in writing:  # what one device writes acts together
        at, count = wish.write or (0, 0)
        assert sum(start <= at and at + count <= start + length for start, length in plan.writes) == 1


@given(wishes(), st.booleans())
def test_the_requests_are_as_few_as_the_blocks_and_write_in_their_order(wanted: list[Wish], together: bool) -> None:
    plan = Plan(wanted, together)
    assert [request.read for request in plan.read_write if request.read is not None] == plan.reads
    assert [request.write for request in plan.read_write if request.write is not None] == plan.writes
    assert [request.write for request in plan.read_write[: len(plan.writes)]] == plan.writes, "payload k, request k"
    assert [request.read for request in plan.read_only] == plan.reads
    both = len(plan.reads) + len(plan.writes)
    assert len(plan.read_write) == (max(len(plan.reads), len(plan.writes)) if together else both)


@given(wishes())
def test_reads_are_as_few_as_the_protocol_allows(wanted: list[Wish]) -> None:
    left = {(at, at + BYTES[kind] // 2) for wish in wanted for at, kind in wish.reads}
    fewest = 0
    while left:  # the first register that is left must be read: best with all that reaches on from it
        first = min(left)[0]
        left = {(at, end) for at, end in left if end > first + 125}
        fewest += 1
    assert len(Plan(wanted).reads) == fewest


def test_what_two_devices_would_write_is_refused() -> None:
    one, other = Wish("axis-1", [(0, "u16")], "high-first", (10, 2)), Wish("plc", [(0, "u16")], "high-first", (11, 3))
    with pytest.raises(ValueError, match="plc: register 11 is already written by axis-1"):
        Plan([one, other])


def test_an_answer_of_another_length_is_refused() -> None:
    plan = Plan([Wish("a", [(0, "u16"), (5, "u32")], "high-first")])
    for length in (0, 6, 8):
        with pytest.raises(ValueError, match="asked for 7"):
            plan.decode([[0] * length])


def test_122_registers_side_by_side_are_two_writes() -> None:
    def wish(k: int, count: int) -> Wish:
        return Wish(f"axis-{k}", [(0, "u16")], "high-first", (2 * k, count))

    assert Plan([wish(k, 2) for k in range(61)]).writes == [(0, 120), (120, 2)]

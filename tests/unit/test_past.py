"""The past as the gateway tells it: records in words, quotations as such, tensions without a lost peak."""

import ast
import asyncio
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from gateway.core.audit_record import Who
from gateway.core.line_past import MOST_POINTS, MOST_RECORDS, RecordsAfter, RecordsTold, TensionsBetween, TensionsTold
from gateway.core.messages import Reply
from gateway.core.proposal import canonical, proposal_hash
from gateway.core.signals import Quality
from gateway.core.topics import GATEWAY_PAST
from gateway.mailbox.port import MAX_PAYLOAD
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_begin import begin_anew
from gateway.supervisor.audit_file import FILE_NAME as AUDIT
from gateway.supervisor.historian import FILE_NAME as HISTORY
from gateway.supervisor.lifecycle import OF_NO_PROPOSAL, STEPS
from gateway.supervisor.past import Past
from gateway.supervisor.record_words import LONGEST_QUOTE, SENTENCES, in_a_sentence
from tests.unit.deployer_support import proposal
from tests.unit.supervisor_support import frame_of, line_of, short_folder
from tests.unit.test_historian import WALL_AHEAD_S, writer_of

ANNA = Who(name="anna (operator, page)", uid=1000, pid=7)
LINE = line_of(6)
AA = {"proposal": "a" * 64}


@pytest.fixture
def folder() -> Iterator[Path]:
    with short_folder() as found:
        yield found


def record(folder: Path, *records: tuple[str, Mapping[str, object]], **blobs: bytes) -> None:
    """After record 1, which says that the audit begins."""
    audit = Audit(folder)
    audit.start()
    for kind, what in records:
        audit.append_and_wait(kind, ANNA, what, blobs)
    assert audit.close()


def asked(
    folder: Path, *queries: bytes, between: Callable[[], None] = lambda: None, line: object = LINE
) -> list[bytes]:
    """The answers of a gateway to each, over its socket."""

    async def ask() -> list[bytes]:
        serving, asking = UnixMailbox(), UnixMailbox()
        past = Past(line, serving, folder, lambda: folder / HISTORY)  # type: ignore[arg-type]
        answers = list[bytes]()
        try:
            await serving.listen(folder / "g.sock")
            asking.connect((GATEWAY_PAST,), folder / "g.sock")
            for query in queries:
                answers.append(await asking.request(GATEWAY_PAST, query, 20.0))
                between()
        finally:
            await asking.close()
            await serving.close()
            await past.close()
        return answers

    return asyncio.run(ask())


def records(folder: Path, after: int | None = None, most: int = MOST_RECORDS) -> RecordsTold:
    (answer,) = asked(folder, RecordsAfter(after=after, most=most).model_dump_json().encode())
    return RecordsTold.model_validate_json(answer)


def tensions(folder: Path, from_s: float, to_s: float, points: int = 600) -> TensionsTold:
    query = TensionsBetween(from_wall_s=WALL_AHEAD_S + from_s, to_wall_s=WALL_AHEAD_S + to_s, points=points)
    (answer,) = asked(folder, query.model_dump_json().encode())
    return TensionsTold.model_validate_json(answer)


def refusal(answer: bytes) -> str:
    reply = Reply.model_validate_json(answer)
    assert not reply.ok
    return "; ".join([reply.text, *reply.reasons])


# ---- records


def test_the_newest_without_a_number_and_what_follows_with_one(folder: Path) -> None:
    record(folder, *(("gateway-start", {"version": str(k)}) for k in range(9)))
    newest = records(folder, most=3)
    assert newest.last == 10 and [one.sequence for one in newest.records] == [8, 9, 10]
    assert [one.sequence for one in records(folder, after=2, most=3).records] == [3, 4, 5]
    assert records(folder, after=10).records == [] and records(folder, after=999).last == 10
    first = records(folder, after=0, most=1).records[0]
    assert (first.sequence, first.kind, first.text) == (1, "begun", "the audit has begun")


def test_a_record_is_told_with_who_when_and_what(folder: Path) -> None:
    record(folder, ("operated", {"command": "stop", "done": True, "answer": "the line stops"}))
    one = records(folder).records[-1]
    assert one.text == "anna (operator, page): stop: done: the line stops"
    assert one.who == ANNA.name and one.what["command"] == "stop" and one.wall_s > 1e9


def test_the_reason_of_an_agent_is_a_quotation_shortened_and_harmless(folder: Path) -> None:
    reason = "approve at once\u201d, says the gate.\n\x1b[31m" + "x" * 1000
    one = proposal(1, "0" * 64, 0.0).model_copy(update={"reason": reason, "author": "agents"})
    what = {"proposal": proposal_hash(one), "change": "gains", "author": "agents"}
    record(folder, ("proposed", what), proposal=canonical(one))
    text = records(folder).records[-1].text
    before, quote = text.split("\u201c")
    assert before == f"agents proposes gains {proposal_hash(one)[:12]}: "
    assert quote.startswith("approve at once', says the gate. \\u001b[31mxxx") and quote.endswith("\u2026\u201d")
    assert quote.count("\u201d") == 1 and len(quote) <= LONGEST_QUOTE + 1 and text.isprintable()


def test_a_reason_that_is_lost_leaves_the_rest_to_be_told(folder: Path) -> None:
    record(folder, ("proposed", {"proposal": "ab" * 32, "change": "gains", "author": "rules"}))
    assert records(folder).records[-1].text == "rules proposes gains abababababab"


def test_every_kind_that_the_gateway_records_has_a_sentence() -> None:
    named = {*STEPS, *OF_NO_PROPOSAL}
    for path in Path("gateway/supervisor").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name):
                name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id
                first = node.args[0] if node.args else None
                if name in ("append", "_append", "step", "recorded", "_kept") and isinstance(first, ast.Constant):
                    named |= {str(first.value)} if re.fullmatch(r"[a-z-]+", str(first.value)) else set()
    assert {"operated", "gateway-start", "agents", "refused-person"} <= named
    assert named - set(SENTENCES) == set()


@pytest.mark.parametrize("kind", SENTENCES)
def test_a_record_of_another_version_is_told_all_the_same(kind: str) -> None:
    text = in_a_sentence(kind, "anna", {})
    assert text and text.isprintable() and "None" not in text
    assert in_a_sentence(kind, "anna", {"because": "b\x07" * 50_000, "answer": "a" * 50_000}).isprintable()


def test_a_kind_that_nobody_knows_is_told_as_it_is_called() -> None:
    assert in_a_sentence("turned-inside-out", "anna", {}) == "turned-inside-out, by anna"


@pytest.mark.parametrize(
    ("kind", "what", "said"),
    [
        ("approved", {**AA, "by": "person", "comment": "fine"}, "anna approves proposal aaaaaaaaaaaa: “fine”"),
        (
            "approved",
            {**AA, "by": "verdict", "like": "b" * 64},
            "proposal aaaaaaaaaaaa passes by its verdict alone: it is like bbbbbbbbbbbb",
        ),
        ("experiment-ends", {**AA, "because": ""}, "the experiment of proposal aaaaaaaaaaaa is done"),
        ("experiment-ends", {**AA, "because": "off"}, "the experiment of proposal aaaaaaaaaaaa has ended: off"),
        (
            "found-in-service",
            {"configuration": "c" * 64, "epoch": 3, "because": "start", "explained": False},
            "the loop says that it runs cccccccccccc, epoch 3: start; the records do not explain how it came to that",
        ),
        (
            "shelved",
            {"alarm": "bus", "for_s": 600.0, "because": "mended"},
            "anna shelves alarm bus for 10 min: “mended”",
        ),
        ("refused-person", {"command": "arm", "because": "bert may not"}, "anna was refused arm: bert may not"),
    ],
)
def test_sentences(kind: str, what: dict[str, object], said: str) -> None:
    assert in_a_sentence(kind, "anna", what) == said


def test_answers_fit_a_message_and_nothing_is_left_out_for_good(folder: Path) -> None:
    long = {"command": "x", "done": True, "answer": "ä" * 10_000}  # 60 kB in the record, 20 kB in the answer
    record(folder, *(("operated", long) for _ in range(30)))
    seen, after = list[int](), 0
    while True:
        (answer,) = asked(folder, RecordsAfter(after=after).model_dump_json().encode())
        assert len(answer) <= MAX_PAYLOAD
        told = RecordsTold.model_validate_json(answer)
        seen += [one.sequence for one in told.records]
        if not told.records:
            break
        after = told.records[-1].sequence
    assert seen == list(range(1, 32))
    newest = records(folder).records
    assert newest[-1].sequence == 31 and 5 < len(newest) < 31


def test_a_damaged_record_is_told_as_such_and_hides_no_other(folder: Path) -> None:
    record(folder, ("gateway-start", {"version": "1"}), ("gateway-start", {"version": "2"}))
    content = (folder / AUDIT).read_bytes()
    assert content.count(b'"version":"1"') == 1
    (folder / AUDIT).write_bytes(content.replace(b'"version":"1"', b'"version":"7"'))
    told = records(folder).records
    assert [one.kind for one in told] == ["begun", "damaged", "gateway-start"]
    assert "audit verify" in told[1].text and told[1].what == {}


def test_without_an_audit_and_without_a_history_it_says_so(folder: Path) -> None:
    query = TensionsBetween(from_wall_s=0.0, to_wall_s=10.0).model_dump_json().encode()
    first, second = asked(folder, RecordsAfter().model_dump_json().encode(), query)
    assert "there is no audit at" in refusal(first)
    assert "there is no history at" in refusal(second)


def test_an_audit_that_is_begun_anew_is_read_anew(folder: Path) -> None:
    record(folder, ("gateway-start", {"version": "1"}))
    query = RecordsAfter().model_dump_json().encode()
    before, after = asked(folder, query, query, between=lambda: _anew(folder))
    assert [one.kind for one in RecordsTold.model_validate_json(before).records] == ["begun", "gateway-start"]
    (first,) = RecordsTold.model_validate_json(after).records
    assert first.kind == "begun" and "disk" in json.dumps(first.what)


def _anew(folder: Path) -> None:
    if (folder / AUDIT).stat().st_size and len(list(folder.glob("audit.*"))) and not list(folder.glob("*kept*")):
        begin_anew(folder, "the disk was exchanged", ANNA)


def test_what_is_read_is_left_as_it_was(folder: Path) -> None:
    record(folder, ("gateway-start", {"version": "1"}))
    before = {one.name: one.read_bytes() for one in folder.iterdir()}
    records(folder)
    after = {one.name: one.read_bytes() for one in folder.iterdir() if not one.name.startswith("g.sock")}
    assert after == before


@pytest.mark.parametrize("query", [b"", b"{}", b'{"command": "records", "most": 101}', b'{"command": "forget"}'])
def test_what_is_no_question_is_not_understood(folder: Path, query: bytes) -> None:
    assert "not understood" in refusal(asked(folder, query)[0])


# ---- tensions


def store(folder: Path, time_s: np.ndarray, tension_n: np.ndarray, quality: np.ndarray | None = None) -> None:
    """Frames of six spans, a blob of ten seconds at a time."""
    writer = writer_of(folder / HISTORY)
    for first in range(0, len(time_s), 1000):
        part = range(first, min(first + 1000, len(time_s)))
        trust = np.zeros((len(time_s), 6), np.int8) if quality is None else quality
        frames = [frame_of(k, float(time_s[k]), tension_n=tension_n[k], tension_quality=trust[k]) for k in part]
        writer.store(frames, (), WALL_AHEAD_S)
    writer.disconnect()


def test_no_peak_is_lost_and_least_and_greatest_come_in_their_order(folder: Path) -> None:
    time_s = np.arange(0.0, 60.0, 0.01)
    tension_n = np.tile(np.linspace(20.0, 45.0, 6), (len(time_s), 1))
    tension_n[3333, 2], tension_n[3334, 2] = 60.0, 1.0  # of one sample each, downwards
    tension_n[4440, 5], tension_n[4441, 5] = 2.0, 70.0  # upwards
    store(folder, time_s, tension_n)
    told = tensions(folder, 0.0, 60.0, points=100)
    assert len(told.wall_s) == 100 and told.wall_s == sorted(told.wall_s)
    third, last = told.tension_n[2], told.tension_n[5]
    k = third.index(60.0)
    assert third[k + 1] == 1.0 and abs(told.wall_s[k] - WALL_AHEAD_S - 33.33) < 1.2
    k = last.index(2.0)
    assert last[k + 1] == 70.0 and abs(told.wall_s[k] - WALL_AHEAD_S - 44.4) < 1.2
    assert told.tension_n[0] == [20.0] * 100 and len(told.setpoint_n) == 6 and len(told.speed_m_per_s) == 100


def test_a_gap_is_a_gap_and_what_is_no_number_is_null(folder: Path) -> None:
    time_s = np.concatenate([np.arange(0.0, 10.0, 0.01), np.arange(50.0, 60.0, 0.01)])
    tension_n = np.full((len(time_s), 6), 30.0)
    tension_n[:, 4] = np.nan
    store(folder, time_s, tension_n)
    told = tensions(folder, 0.0, 60.0, points=120)
    assert set(told.tension_n[4]) == {None}
    gaps = [k for k, value in enumerate(told.tension_n[0]) if value is None]
    assert len(gaps) == 1 and abs(told.wall_s[gaps[0]] - WALL_AHEAD_S - 10.5) < 1.0
    assert {value for value in told.tension_n[0] if value is not None} == {30.0}


def test_how_far_each_value_may_be_trusted_is_told_with_it(folder: Path) -> None:
    time_s = np.arange(0.0, 30.0, 0.01)
    tension_n = 30.0 + np.tile(np.sin(time_s)[:, None], (1, 6))
    quality = np.zeros((len(time_s), 6), np.int8)
    quality[1000:2000, 1], quality[1000:2000, 2] = Quality.STALE, Quality.BAD
    tension_n[2000:, 3], quality[2000:, 3] = np.nan, Quality.MISSING
    store(folder, time_s, tension_n, quality)
    told = tensions(folder, 0.0, 30.0, points=60)
    assert {len(column) for column in told.quality} == {len(told.wall_s)}
    between = [10.0 < wall_s - WALL_AHEAD_S < 20.0 for wall_s in told.wall_s]
    for span, then in ((0, Quality.GOOD), (1, Quality.STALE), (2, Quality.BAD)):
        assert told.quality[span] == [then if inside else Quality.GOOD for inside in between]
    for value, trust in zip(told.tension_n[3], told.quality[3], strict=True):
        assert (value is None) == (trust == Quality.MISSING)


def test_an_interval_of_which_nothing_is_kept_has_no_rows(folder: Path) -> None:
    store(folder, np.arange(0.0, 1.0, 0.01), np.full((100, 6), 30.0))
    told = tensions(folder, 100.0, 200.0)
    assert told.wall_s == [] and told.speed_m_per_s == [] and told.quality == []


def test_an_interval_of_some_periods_is_told_whole(folder: Path) -> None:
    store(folder, np.arange(0.0, 1.0, 0.01), np.arange(600.0).reshape(100, 6))
    told = tensions(folder, 0.0, 0.2)
    assert 8 <= len(told.wall_s) <= 12 and None not in told.tension_n[0]


@pytest.mark.parametrize(
    ("from_s", "to_s", "said"), [(10.0, 10.0, "no time"), (10.0, 0.0, "no time"), (0.0, 40_000.0, "allowed: 4.2 h")]
)
def test_what_cannot_be_told_is_refused_with_what_can(folder: Path, from_s: float, to_s: float, said: str) -> None:
    store(folder, np.arange(0.0, 1.0, 0.01), np.full((100, 6), 30.0))
    query = TensionsBetween(from_wall_s=from_s, to_wall_s=to_s).model_dump_json().encode()
    assert said in refusal(asked(folder, query)[0])


@pytest.mark.slow
def test_most_points_of_many_spans_fit_a_message(folder: Path) -> None:
    time_s = np.arange(0.0, 100.0, 0.01)
    writer = writer_of(folder / HISTORY, spans=60)
    rng = np.random.default_rng(1)
    for first in range(0, len(time_s), 1000):
        part = [
            frame_of(k, float(time_s[k]), 60, tension_n=-999.0 * rng.random(60)) for k in range(first, first + 1000)
        ]
        writer.store(part, (), WALL_AHEAD_S)
    writer.disconnect()
    query = TensionsBetween(from_wall_s=WALL_AHEAD_S, to_wall_s=WALL_AHEAD_S + 100.0, points=MOST_POINTS)
    (answer,) = asked(folder, query.model_dump_json().encode(), line=line_of(60))
    assert len(answer) <= MAX_PAYLOAD
    told = TensionsTold.model_validate_json(answer)
    assert len(told.tension_n) == 60 and len(told.wall_s) > 100

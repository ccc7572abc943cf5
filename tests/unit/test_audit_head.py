"""The audit's head leaves the machine's reach: it is told, bounded in rate, and an audit made anew does not have it."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from agents.heads import Heads
from gateway.cli.audit_against import head_in
from gateway.cli.main import app
from gateway.core.audit_head import AuditHead, heads_in, kept_line, parse_head
from gateway.core.audit_record import Who
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.supervisor.audit import Audit, AuditState
from gateway.supervisor.audit_anchor import NOTHING_YET, Anchor
from gateway.supervisor.audit_begin import begin_anew
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.audit_verify import verify
from gateway.supervisor.audit_writer import AuditWriter, Draft
from gateway.supervisor.head_told import HeadTold

WHO = Who(name="anna")
HASH = "0123456789abcdef" * 4


def audit_of(folder: Path, texts: list[str]) -> str:
    """An audit of a record that it begins with and one for each text. Returns its head."""
    writer = AuditWriter(folder)
    for text in texts:
        writer.append([Draft("approved", WHO, {"text": text})])
    writer.close()
    return head_in(folder)


def verified(folder: Path, head: str, *more: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["audit", "verify", "--data-dir", str(folder), "--against", head, *more])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def test_an_audit_contains_its_head_and_every_head_before(tmp_path: Path) -> None:
    first = audit_of(tmp_path, ["one"])
    audit_of(tmp_path, ["two", "three"])
    for head in (first, head_in(tmp_path)):
        code, said = verified(tmp_path, head)
        assert code == 0 and f"it contains {head}" in said
    found = json.loads(verified(tmp_path, first, "--json")[1])
    assert found["contained"] is True and found["against"] == first


def test_chain_and_anchor_that_are_made_anew_together_are_found(tmp_path: Path) -> None:
    head = audit_of(tmp_path, ["gain 3.0", "gain 4.0"])
    for path in tmp_path.iterdir():
        path.unlink()
    other = audit_of(tmp_path, ["gain 3.0", "gain 9.0"])
    assert parse_head(other).sequence == parse_head(head).sequence and verify(tmp_path).sound
    code, said = verified(tmp_path, head)
    assert code == 1 and "NOT SOUND" in said and "made anew" in said
    assert json.loads(verified(tmp_path, head, "--json")[1])["contained"] is False
    assert verified(tmp_path, other)[0] == 0


def test_older_copies_of_both_are_found(tmp_path: Path) -> None:
    audit_of(tmp_path, ["one"])
    copies = {path: path.read_bytes() for path in tmp_path.iterdir()}
    head = audit_of(tmp_path, ["two"])
    for path, content in copies.items():
        path.write_bytes(content)
    assert verify(tmp_path).sound
    code, said = verified(tmp_path, head)
    assert code == 1 and "is not there" in said


@pytest.mark.parametrize("records", [0, 1, 4])
def test_a_gateway_that_runs_writes_upon_no_audit_but_its_own(tmp_path: Path, records: int) -> None:
    writer = AuditWriter(tmp_path / "data")
    known = writer.append([Draft("approved", WHO, {"text": "one"})])[0]
    for path in (tmp_path / "data").iterdir():
        if path.name != "audit.lock":
            path.unlink()
    if records:
        audit_of(tmp_path / "other", ["x"] * records)
        for path in (tmp_path / "other").iterdir():
            if path.name != "audit.lock":
                path.rename(tmp_path / "data" / path.name)
    for _ in range(2):
        with pytest.raises(AuditUnavailable, match=f"has stored record {known.sequence}, {known.head}"):
            writer.append([Draft("approved", WHO, {"text": "two"})])
    writer.close()


def test_an_audit_begun_anew_by_a_person_says_where_the_head_lies(tmp_path: Path) -> None:
    head = audit_of(tmp_path, ["one", "two"])
    kept = begin_anew(tmp_path, "the disk was exchanged", WHO).kept
    code, said = verified(tmp_path, head)
    assert code == 1 and f"--data-dir {kept} --against {head}" in said
    assert verified(kept, head)[0] == 0


def test_an_export_is_held_against_a_head_too(tmp_path: Path) -> None:
    head = audit_of(tmp_path / "data", ["one"])
    out = str(tmp_path / "audit.jsonl")
    assert (
        CliRunner().invoke(app, ["audit", "export", "--data-dir", str(tmp_path / "data"), "--out", out]).exit_code == 0
    )
    sequence = parse_head(head).sequence
    assert verified(tmp_path, head, "--export", out)[0] == 0
    assert verified(tmp_path, f"{sequence}:{HASH}", "--export", out)[0] == 1
    assert verified(tmp_path, f"{sequence + 1}:{HASH}", "--export", out)[0] == 1


@pytest.mark.parametrize(
    "short", ["", "3", "3:", f"3:{HASH[:12]}", f"3:{HASH[:-1]}", f"3:{HASH}0", f"0:{HASH}", f"-3:{HASH}", HASH,
              f"3:{HASH.upper()}", f"3:{'g' * 64}", f"\u0663:{HASH}"],
)  # fmt: skip
def test_short_forms_are_refused(tmp_path: Path, short: str) -> None:
    audit_of(tmp_path, ["one"])
    with pytest.raises(ValueError, match="all 64 digits"):
        parse_head(short)
    code, said = verified(tmp_path, short)
    assert code == 2 and "NUMBER:HASH" in said


def test_a_head_is_read_as_it_was_printed() -> None:
    assert str(parse_head(f" 17:{HASH}\n")) == f"17:{HASH}"


LOG = "Nov 22 r2rgate[7]: audit head: {}\nNov 22 r2rgate[7]: configuration 7:" + HASH + " is odd\n"


@pytest.mark.parametrize(
    "printed",
    [
        "{}", "  {}  \r\nbelow it\n", "#a note\n{}", LOG, '{{"audit_head": "{}", "alarms": []}}',
        '{{\n  "audit_head":"{}"\n}}', "<dt>Head of the audit</dt>\n<dd><code>{}</code></dd>",
        "  1 blobs; last record: {}",
    ],
)  # fmt: skip
def test_a_file_that_has_a_head_stands_for_the_last_one_in_it(tmp_path: Path, printed: str) -> None:
    data = tmp_path / "data"
    audit_of(data, ["one"])
    head = audit_of(data, ["two"])
    file = tmp_path / "noted"
    file.write_text(f"audit head: 1:{HASH}\n" + printed.format(head))
    code, said = verified(data, str(file))
    assert code == 0 and f"it contains {head}" in said, said
    file.write_text(printed.format(head) + f"\naudit head: 1:{HASH}\n")
    assert verified(data, str(file))[0] == 1


@pytest.mark.parametrize("content", ["", "nothing", f"3:{HASH[:-1]}", f"3:{HASH}0", f"record 3:{HASH} is not one"])
def test_a_file_without_a_head_is_refused_with_what_is_allowed(tmp_path: Path, content: str) -> None:
    audit_of(tmp_path, ["one"])
    (tmp_path / "noted").write_text(content)
    code, said = verified(tmp_path, str(tmp_path / "noted"))
    assert code == 2 and "NUMBER:HASH" in said and "all 64 digits" in said


def test_what_is_there_and_no_file_is_refused_and_a_file_goes_before_a_head(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    head = audit_of(tmp_path, ["one"])
    code, said = verified(tmp_path, str(tmp_path))
    assert code == 2 and "cannot be read" in said
    monkeypatch.chdir(tmp_path)
    Path(f"3:{HASH}").write_text(head)
    assert verified(tmp_path, f"3:{HASH}")[0] == 0


class Told:
    """A state that a test sets, a clock, and what was told."""

    def __init__(self) -> None:
        self.state = AuditState(False, "starting", NOTHING_YET)
        self.now_s = 1000.0
        self.said: list[str] = []
        self.heads = HeadTold(lambda: self.state, self.said.append, lambda: self.now_s)

    def record(self, sequence: int, decided: int = 0) -> None:
        self.state = AuditState(True, "recording", Anchor(sequence, HASH), decided)

    def look_for(self, time_s: float) -> None:
        for _ in range(round(4 * time_s)):
            self.now_s += 0.25
            self.heads.look()


def test_it_is_told_when_it_changes_and_once_a_minute_at_most() -> None:
    told = Told()
    told.look_for(10.0)
    assert told.said == [] and told.heads.head == ""
    for number in range(1, 1201):  # five minutes of four records a second
        told.record(number)
        told.look_for(0.25)
    assert told.said[0] == f"audit head: 1:{HASH}" and len(told.said) in (5, 6)
    assert told.heads.head == str(AuditHead(1200, HASH))
    told.look_for(300.0)
    assert told.said[-1] == f"audit head: 1200:{HASH}" and len(told.said) in (6, 7)


def test_a_decision_is_told_within_a_second_or_two() -> None:
    told = Told()
    told.record(1)
    told.look_for(2.0)
    told.record(2, decided=2)
    told.look_for(1.0)
    assert told.said == [f"audit head: 1:{HASH}", f"audit head: 2:{HASH}"]
    for number in range(3, 43):  # ten seconds of decisions
        told.record(number, decided=number)
        told.look_for(0.25)
    assert len(told.said) <= 13


def test_what_comes_often_is_no_decision(tmp_path: Path) -> None:
    audit = Audit(tmp_path)
    audit.start()
    audit.append_and_wait("operated", WHO, {"command": "hold"})
    before = audit.state().decided
    at = audit.append_and_wait("approved", WHO, {"proposal": "x"})
    assert audit.close() and (before, audit.state().decided) == (0, at.sequence)
    assert audit.state().last == at


def test_a_file_of_kept_heads_that_has_grown_keeps_the_newest_and_one_of_each_day_before(tmp_path: Path) -> None:
    told: list[str] = []
    path, day_s = tmp_path / "audit-heads.txt", 86400.0
    lines = [kept_line(AuditHead(k, HASH), "demo/line", k / 1000.0 * day_s) for k in range(1, 5001)]
    path.write_text("".join(lines))
    heads = Heads(InProcessMailbox(Hub()), "monitoring", "demo/line", path, told.append)
    heads.keep(AuditHead(5000, HASH), 5.0 * day_s)
    assert path.read_text() == "".join(lines)  # it has that one
    heads.keep(AuditHead(5001, HASH), 5.001 * day_s)
    found = heads_in(path.read_text())
    assert [one.sequence for one in found] == [999, 1999, 2999, 3999, *range(4001, 5002)]
    assert not told
    heads.keep(AuditHead(17, HASH), 5.002 * day_s)
    assert "was 5001:" in told[0]

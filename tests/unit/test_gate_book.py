"""What a gateway takes its records for: what one calls not done was not."""

import asyncio
import sqlite3
from pathlib import Path

import pytest

from gateway.core.audit_record import Who
from gateway.supervisor import audit_file, lifecycle
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_anchor import Anchor
from gateway.supervisor.audit_file import FILE_NAME, AuditFile
from gateway.supervisor.audit_writer import NOT_DONE, AuditWriter, Draft
from gateway.supervisor.book_file import CannotBegin, book_in, entries_in, newest_in
from gateway.supervisor.lifecycle import Stage

ANNA = Who(name="anna", uid=1000, pid=1)
PROPOSED = {
    "proposal": "1" * 64, "change": "gains", "author": "rules", "base": "2" * 64, "changes": "3" * 64,
    "created": "2026-01-01T00:00:00+00:00", "expires": "2026-01-02T00:00:00+00:00", "expires_s": 1.8e9,
}  # fmt: skip
OFTEN = Draft("operated", ANNA, {"command": "speed 1.25", "done": True, "answer": "line speed to 1.25 m/s"})
FOUND = Draft("found-in-service", ANNA, {"configuration": "2" * 64, "last_known_good": "2" * 64, "epoch": 0})


def named(number: int) -> str:
    return f"{number:08x}" + "0" * 56


def proposed(number: int, *kinds: str) -> list[Draft]:
    made = Draft("proposed", ANNA, {**PROPOSED, "proposal": named(number)})
    return [made, *(Draft(kind, ANNA, {"proposal": named(number), "because": f"{kind} {number}"}) for kind in kinds)]


def written_in(folder: Path, *drafts: Draft) -> list[Anchor]:
    writer = AuditWriter(folder)
    try:
        return writer.append(drafts)
    finally:
        writer.close()


def test_of_what_people_and_agents_write_often_nothing_is_read_when_the_gate_opens(tmp_path, monkeypatch):
    written_in(tmp_path, FOUND, *[OFTEN] * 500, *proposed(1, "accepted"), *[OFTEN] * 500)
    read = list[str]()
    parse = audit_file.parse_record

    def noted(content: bytes):
        read.append((found := parse(content)).kind)
        return found

    monkeypatch.setattr(audit_file, "parse_record", noted)
    assert book_in(tmp_path).entries[named(1)].stage is Stage.WAITING
    assert read == ["begun", "found-in-service", "proposed", "accepted"]


def test_what_is_read_is_found_by_an_index(tmp_path):
    written_in(tmp_path, FOUND, *proposed(1, "accepted"))
    plans = list[str]()
    with AuditFile(tmp_path) as file:

        def look(_: object, statement: str, values: object) -> bool:
            if "CASE WHEN" in statement and not statement.startswith("EXPLAIN"):
                found = file.connection.execute(f"EXPLAIN QUERY PLAN {statement}", values).fetchall()
                plans.append("; ".join(one[3] for one in found))
            return True

        file.connection.exec_trace = look
        assert file.kinds() == ["accepted", "begun", "found-in-service", "proposed"]
        assert len(list(file.rows_of(["proposed"]))) == len(file.newest_of("proposed", [], 9, 0)) == 1
        assert len(file.about(named(1)[:4], 9)) == 2
    assert len(plans) == 5 + 2 + 1 + 1
    assert all("INDEX record_" in plan and "TEMP B-TREE" not in plan for plan in plans[:-1]), plans
    assert "INDEX record_proposal" in plans[-1]


def test_proposals_that_are_done_with_are_told_from_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(lifecycle, "MOST_CLOSED", 8)
    closed = [one for k in range(40) for one in proposed(k, "refused")]
    undone = proposed(99)
    waiting = proposed(50, "accepted")
    stored = written_in(tmp_path, FOUND, *undone, *closed, *waiting)
    changed = Draft("line-changed", ANNA, {"because": "another web"})
    later = [one for k in range(60, 90) for one in proposed(k, "refused")]
    not_done = Draft(NOT_DONE, ANNA, {"sequences": [stored[1].sequence], "because": "nobody waited any more"})
    written_in(tmp_path, not_done, changed, *later)
    book, every = book_in(tmp_path), [named(k) for k in (*range(40), 50, *range(60, 90))]
    assert len(book.entries) <= 8 + 2 and list(book.entries) == every[-len(book.entries) :]
    assert (book.made, book.made - book.forgotten, book.before_change) == (71, len(book.entries), 41)
    pages = [newest_in(tmp_path, 25, skip) for skip in (0, 25, 50)]
    assert [one.proposal for page in pages for one in page] == every[::-1]
    (first,) = entries_in(tmp_path, named(0))
    assert (first.stage, first.why) == (Stage.REFUSED, "refused 0")
    (ended,) = entries_in(tmp_path, named(50)[:8])
    assert (ended.stage, ended.why) == (Stage.SUPERSEDED, "the line has changed: another web")
    assert entries_in(tmp_path, named(99)) == [] and len(entries_in(tmp_path, "0000000")) == 16


def test_a_record_that_is_none_keeps_the_gate_shut_wherever_it_stands(tmp_path):
    written_in(tmp_path, FOUND, OFTEN, *proposed(1))
    connection = sqlite3.connect(tmp_path / FILE_NAME)
    connection.executescript("DROP TRIGGER record_stays; UPDATE record SET content = x'6e6f' WHERE sequence = 3")
    connection.close()
    with pytest.raises(CannotBegin):
        book_in(tmp_path)


def test_an_index_that_has_not_every_record_keeps_the_gate_shut(tmp_path):
    written_in(tmp_path, FOUND, OFTEN, *proposed(1, "accepted"), OFTEN)
    with sqlite3.connect(tmp_path / FILE_NAME) as file:  # all but one are in it, and it says: all
        ((made,),) = file.execute("SELECT sql FROM sqlite_schema WHERE name = 'record_kind'").fetchall()
        file.execute("DROP INDEX record_kind")
        file.execute(f"{made} WHERE sequence <> 5")
        file.execute("PRAGMA writable_schema = ON")
        file.execute("UPDATE sqlite_schema SET sql = ? WHERE name = 'record_kind'", (made,))
    file.close()
    with pytest.raises(CannotBegin, match="the index of records has 5 of 6"):
        book_in(tmp_path)


def test_an_approval_that_came_too_late_to_be_told_is_none_and_may_come_again(tmp_path):
    audit, one = Audit(tmp_path), {"proposal": "1" * 64}
    audit.start()

    async def written() -> None:
        await audit.append(
            "found-in-service", ANNA, {"configuration": "2" * 64, "last_known_good": "2" * 64, "epoch": 0}
        )
        await audit.append("proposed", ANNA, PROPOSED)
        await audit.append("accepted", ANNA, one)
        late = await audit.append("approved", ANNA, one)
        await audit.append(NOT_DONE, ANNA, {"sequences": [late.sequence], "because": "nobody waited any more"})

    asyncio.run(written())
    assert book_in(tmp_path).entries["1" * 64].stage is Stage.WAITING
    asyncio.run(audit.append("approved", ANNA, one))
    audit.close()
    assert book_in(tmp_path).entries["1" * 64].stage is Stage.APPROVED

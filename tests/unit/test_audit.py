"""The audit: on the disk before anybody is told, chained, anchored; and no record where it cannot be trusted."""

import asyncio
import json
import re
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import apsw
import numpy as np
import pytest

from gateway.core.audit_record import BEFORE_FIRST, NotRecordable, Who, head_of
from gateway.storage import sqlite_file
from gateway.supervisor import audit_writer
from gateway.supervisor.audit import Audit
from gateway.supervisor.audit_anchor import FILE_NAME as ANCHOR
from gateway.supervisor.audit_anchor import Anchor, read_anchor, write_anchor
from gateway.supervisor.audit_begin import begin_anew
from gateway.supervisor.audit_file import FILE_NAME, AuditFile, AuditUnavailable
from gateway.supervisor.audit_verify import MOST_BEYOND, verify
from gateway.supervisor.audit_writer import NOT_DONE, AuditWriter, Draft
from tests.unit import audit_damage
from tests.unit.supervisor_support import child, until
from tests.unit.test_models import HOLD_LOCK

ROOT = Path(__file__).parents[2]
ANN = Who(name="ann", uid=1000, pid=7)


@contextmanager
def running(folder: Path, **options: float) -> Iterator[Audit]:
    audit = Audit(folder, **options)
    audit.start()
    try:
        yield audit
    finally:
        assert audit.close()


def kinds(folder: Path) -> list[str]:
    with AuditFile(folder) as file:
        return [row.record().kind for row in file.rows()]


def write(folder: Path, count: int) -> Anchor:
    """Records 1 (begun) to `count` + 1."""
    with running(folder) as audit:
        return [audit.append_and_wait("proposed", ANN, {"k": k}) for k in range(count)][-1]


# Recording


def test_records_are_chained_and_hold_what_was_given(tmp_path: Path) -> None:
    with running(tmp_path) as audit:
        first = audit.append_and_wait("proposed", ANN, {"gain": 0.1}, {"controller": b"phi", "verdict": b"yes"})
        second = audit.append_and_wait("approved", ANN, {"of": first.sequence}, {"controller": b"phi"})
        assert audit.state().available and audit.state().last == second
    assert read_anchor(tmp_path) == second
    with AuditFile(tmp_path) as file:
        begun, proposed, approved = [row.record() for row in file.rows()]
        assert file.blob(proposed.blobs["controller"]) == b"phi" and len(file.blob_ids()) == 2
    assert (begun.kind, begun.previous) == ("begun", BEFORE_FIRST)
    assert (proposed.who, proposed.what, proposed.sequence) == (ANN, {"gain": 0.1}, 2)
    assert approved.previous == first.head and approved.blobs == {"controller": head_of(b"phi")}
    found = verify(tmp_path)
    assert (found.sound, found.records, found.blobs, found.head) == (True, 3, 2, second.head)


def test_the_chain_goes_on_after_a_restart(tmp_path: Path) -> None:
    last = write(tmp_path, 3)
    with running(tmp_path) as audit:
        after = audit.append_and_wait("proposed", ANN, {})
    assert after.sequence == last.sequence + 1
    assert verify(tmp_path).sound and kinds(tmp_path) == ["begun"] + 4 * ["proposed"]


def test_many_at_once_each_wait_for_their_own_and_share_commits(tmp_path: Path) -> None:
    async def all_(audit: Audit) -> list[Anchor]:
        return await asyncio.gather(*(audit.append("proposed", ANN, {"k": k}) for k in range(300)))

    with running(tmp_path) as audit:
        stored = asyncio.run(all_(audit))
    assert [at.sequence for at in stored] == list(range(2, 302))
    with AuditFile(tmp_path) as file:
        rows = {row.sequence: row for row in file.rows()}
    assert [(rows[at.sequence].head, rows[at.sequence].record().what["k"]) for at in stored] == [
        (at.head, k) for k, at in enumerate(stored)
    ]


@pytest.mark.wires
def test_an_event_loop_turns_while_the_disk_does_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def turns(audit: Audit) -> None:
        with blocked(monkeypatch, 2) as asked:
            waiting = asyncio.create_task(audit.append("proposed", ANN, {}))
            await until(asked.is_set)
            for _ in range(100):
                await asyncio.sleep(0)
            assert not waiting.done()
        assert (await waiting).sequence == 2

    with running(tmp_path) as audit:
        asyncio.run(turns(audit))


def test_what_is_no_record_is_refused_at_once(tmp_path: Path) -> None:
    with running(tmp_path) as audit:
        for kind, what in (("No Label", {}), ("proposed", {"x": float("nan")})):
            with pytest.raises(NotRecordable):
                audit.append_and_wait(kind, ANN, what)
        with pytest.raises(NotRecordable, match="the blob verdict has"):
            audit.append_and_wait("proposed", ANN, {}, {"verdict": bytes(17 * 2**20)})
    with pytest.raises(AuditUnavailable, match="closed"):
        audit.append_and_wait("proposed", ANN, {})
    assert kinds(tmp_path) == ["begun"]


def test_stored_rows_can_be_neither_changed_nor_deleted(tmp_path: Path) -> None:
    with running(tmp_path) as audit:
        audit.append_and_wait("proposed", ANN, {}, {"controller": b"phi"})
    connection = sqlite3.connect(tmp_path / FILE_NAME)
    for query in ("UPDATE record SET head = ''", "DELETE FROM record", "UPDATE blob SET id = ''", "DELETE FROM blob"):
        with pytest.raises(sqlite3.IntegrityError, match="a record|a blob"):
            connection.execute(query)
    connection.close()


# Between commit and acknowledgement


@pytest.mark.parametrize("failing", [1, 2])
def test_a_record_that_was_not_anchored_is_refused_and_called_not_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    """Committed, but the anchor could not be written: `failing` times in succession."""
    write(tmp_path, 1)
    real, left = audit_writer.write_anchor, [failing]

    def full(folder: Path, anchor: Anchor) -> None:
        if left[0]:
            left[0] -= 1
            raise OSError(28, "No space left on device")
        real(folder, anchor)

    with running(tmp_path) as audit:
        monkeypatch.setattr(audit_writer, "write_anchor", full)
        for _ in range(failing):
            with pytest.raises(AuditUnavailable, match="audit.anchor cannot be written: No space left"):
                audit.append_and_wait("proposed", ANN, {"k": "lost"})
            assert not audit.state().available and "No space" in audit.state().text
        last = audit.append_and_wait("proposed", ANN, {"k": "kept"})
        assert audit.state().available
    with AuditFile(tmp_path) as file:
        records = [row.record() for row in file.rows()]
    assert [one.kind for one in records] == ["begun", "proposed", "proposed", NOT_DONE, "proposed"]
    assert records[3].what["sequences"] == [3]
    assert verify(tmp_path).sound and read_anchor(tmp_path) == last


@contextmanager
def blocked(monkeypatch: pytest.MonkeyPatch, sequence: int) -> Iterator[threading.Event]:
    """The disk answers for the anchor of a record only at the end; the event tells that it was asked."""
    asked, answers = threading.Event(), threading.Event()
    real = audit_writer.write_anchor

    def slow(folder: Path, anchor: Anchor) -> None:
        if anchor.sequence == sequence:
            asked.set()
            answers.wait()
        real(folder, anchor)

    monkeypatch.setattr(audit_writer, "write_anchor", slow)
    try:
        yield asked
    finally:
        answers.set()


@pytest.mark.wires
def test_a_disk_that_does_not_answer_is_told_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def append(audit: Audit) -> None:
        await audit.append("proposed", ANN, {"k": 1})

    with running(tmp_path, within_s=0.05) as audit, blocked(monkeypatch, 2):
        with pytest.raises(AuditUnavailable, match="did not answer within 0.05 s: nothing may be changed"):
            asyncio.run(append(audit))
        with pytest.raises(AuditUnavailable, match="did not answer within"):
            audit.append_and_wait("proposed", ANN, {"k": 2})
    # Whether it had come to the first or the second by then is a matter of time; neither is left standing.
    assert kinds(tmp_path) in (["begun"], ["begun", "proposed", NOT_DONE])


@pytest.mark.wires
def test_a_record_that_nobody_waits_for_any_more_is_called_not_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def cancelled(audit: Audit, asked: threading.Event) -> None:
        task = asyncio.create_task(audit.append("proposed", ANN, {}))
        await until(asked.is_set)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    with running(tmp_path) as audit, blocked(monkeypatch, 2) as asked:
        asyncio.run(cancelled(audit, asked))
    with AuditFile(tmp_path) as file:
        records = [row.record() for row in file.rows()]
    assert [one.kind for one in records] == ["begun", "proposed", NOT_DONE] and records[2].what["sequences"] == [2]
    assert verify(tmp_path).sound


@pytest.mark.wires
def test_a_record_that_was_stored_before_whoever_waits_for_it_could_hear_it_and_is_cancelled_is_called_not_done(
    tmp_path: Path,
) -> None:
    async def cancelled(audit: Audit) -> None:
        task = asyncio.create_task(audit.append("deploying", ANN, {}))
        await asyncio.sleep(0)  # it has been handed to the writer
        audit.append_and_wait("users", ANN, {})  # which has settled the first, and the event loop has not turned
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    with running(tmp_path) as audit:
        asyncio.run(cancelled(audit))
    with AuditFile(tmp_path) as file:
        records = [row.record() for row in file.rows()]
    assert [one.kind for one in records] == ["begun", "deploying", "users", NOT_DONE]
    assert records[3].what["sequences"] == [2] and verify(tmp_path).sound


# What is not written upon


def take_database(folder: Path) -> None:
    (folder / FILE_NAME).unlink()


def take_anchor(folder: Path) -> None:
    (folder / ANCHOR).unlink()


def older_database(folder: Path) -> None:
    shutil.copy(folder / "older" / FILE_NAME, folder / FILE_NAME)


def older_anchor(folder: Path) -> None:
    shutil.copy(folder / "older" / ANCHOR, folder / ANCHOR)


def changed_content(folder: Path) -> None:
    _tamper(
        folder, """UPDATE record SET content = CAST(replace(content, '"uid"', '"UID"') AS BLOB) WHERE sequence = 90"""
    )


def taken_out(folder: Path) -> None:
    _tamper(folder, "DELETE FROM record WHERE sequence = 90")


def other_tail(folder: Path) -> None:
    """The same number of records, sound in themselves, of another audit."""
    write(folder / "other", MOST_BEYOND + 30)
    shutil.copy(folder / "other" / FILE_NAME, folder / FILE_NAME)


def no_database(folder: Path) -> None:
    (folder / FILE_NAME).write_bytes(b"this is no database, and long enough" * 100)


def empty_database(folder: Path) -> None:
    (folder / FILE_NAME).write_bytes(b"")


def damaged_anchor(folder: Path) -> None:
    (folder / ANCHOR).write_text((folder / ANCHOR).read_text().replace('"sequence":', '"sequence": '))


def _tamper(folder: Path, query: str) -> None:
    connection = sqlite3.connect(folder / FILE_NAME)
    connection.executescript(f"DROP TRIGGER record_stays; DROP TRIGGER record_is_kept; {query}")
    connection.close()


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """More records than an interruption can leave; `older` holds the same audit as it was after the third."""
    folder = tmp_path_factory.mktemp("sound")
    write(folder, 2)
    (folder / "older").mkdir()
    for name in (FILE_NAME, ANCHOR):
        shutil.copy(folder / name, folder / "older" / name)

    async def all_(audit: Audit) -> None:
        await asyncio.gather(*(audit.append("proposed", ANN, {"k": k}) for k in range(MOST_BEYOND + 28)))

    with running(folder) as audit:
        asyncio.run(all_(audit))
    return folder


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (take_database, "is missing|there is no audit"),
        (take_anchor, "audit.anchor is missing"),
        (older_database, "records 4 to 131 are lost"),
        (older_anchor, "audit.anchor is older than the records"),
        (changed_content, "record 90 is damaged"),
        (taken_out, "records 90 to 90 are missing"),
        (other_tail, "record 131 is not the one that audit.anchor says was stored"),
        (no_database, "is no audit"),
        (empty_database, "there is no audit"),
        (damaged_anchor, "audit.anchor is damaged"),
    ],
)
def test_nothing_is_written_upon_what_cannot_be_trusted(sound: Path, tmp_path: Path, harm: object, said: str) -> None:
    folder = tmp_path / "audit"
    shutil.copytree(sound, folder)
    harm(folder)
    before = {path: path.read_bytes() for path in sorted(folder.glob("audit.*")) if path.suffix != ".lock"}
    with running(folder) as audit:
        for _ in range(2):
            with pytest.raises(AuditUnavailable, match=said):
                audit.append_and_wait("proposed", ANN, {})
        assert not audit.state().available
    found = verify(folder)
    assert not found.sound and any(re.search(said, text) for text in found.problems), found.problems
    assert before == {path: path.read_bytes() for path in sorted(folder.glob("audit.*")) if path.suffix != ".lock"}


def test_damage_before_the_tail_is_found_by_verify(sound: Path, tmp_path: Path) -> None:
    folder = tmp_path / "audit"
    shutil.copytree(sound, folder)
    _tamper(folder, """UPDATE record SET content = CAST(replace(content, 'ann', 'bob') AS BLOB) WHERE sequence = 2""")
    assert verify(folder).problems == ["record 2 is damaged: its head is not the hash of its content"]


def test_a_damaged_blob_is_found_and_not_referred_to_again(tmp_path: Path) -> None:
    with running(tmp_path) as audit:
        audit.append_and_wait("proposed", ANN, {}, {"controller": b"phi"})
    connection = sqlite3.connect(tmp_path / FILE_NAME)
    connection.executescript("DROP TRIGGER blob_stays; UPDATE blob SET content = x'00'")
    connection.close()
    assert "the controller of record 2 is missing or damaged" in verify(tmp_path).problems[0]
    with running(tmp_path) as audit, pytest.raises(AuditUnavailable, match="is not what was stored"):
        audit.append_and_wait("proposed", ANN, {}, {"controller": b"phi"})
    assert kinds(tmp_path) == ["begun", "proposed"]


def test_a_database_that_is_moved_away_is_not_begun_again(tmp_path: Path) -> None:
    with running(tmp_path) as audit:
        audit.append_and_wait("proposed", ANN, {})
        (tmp_path / FILE_NAME).rename(tmp_path / "elsewhere")
        with pytest.raises(AuditUnavailable, match="is missing"):
            audit.append_and_wait("proposed", ANN, {})
        (tmp_path / "elsewhere").rename(tmp_path / FILE_NAME)
        audit.append_and_wait("proposed", ANN, {})
    assert verify(tmp_path).sound


def test_only_one_process_writes(tmp_path: Path) -> None:
    with running(tmp_path) as audit:
        audit.append_and_wait("proposed", ANN, {})
        with running(tmp_path) as second, pytest.raises(AuditUnavailable, match="another process writes the audit"):
            second.append_and_wait("proposed", ANN, {})
        with pytest.raises(AuditUnavailable, match="another process writes the audit"):
            begin_anew(tmp_path, "a test", ANN)
        audit.append_and_wait("proposed", ANN, {})


def test_a_lock_that_stays_is_told_and_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, 1)
    monkeypatch.setattr(sqlite_file, "BUSY_MS", 10)
    with running(tmp_path) as audit:
        audit.append_and_wait("proposed", ANN, {})
        with child(HOLD_LOCK, tmp_path / FILE_NAME) as (_, said):
            assert said == "held\n"
            with pytest.raises(AuditUnavailable, match="another program has held"):
                audit.append_and_wait("proposed", ANN, {})
        audit.append_and_wait("proposed", ANN, {})
    assert verify(tmp_path).sound and kinds(tmp_path) == ["begun", *3 * ["proposed"]]


# No room


def test_a_full_disk_is_told_and_nothing_is_lost(tmp_path: Path) -> None:
    last = write(tmp_path, 1)

    def no_page_more(connection: apsw.Connection) -> None:
        connection.execute(f"PRAGMA max_page_count = {(tmp_path / FILE_NAME).stat().st_size // 4096}")

    apsw.connection_hooks.append(no_page_more)
    try:
        with running(tmp_path) as audit, pytest.raises(AuditUnavailable, match="is full: nothing was recorded"):
            audit.append_and_wait("proposed", ANN, {}, {"verdict": bytes(100_000)})
    finally:
        apsw.connection_hooks.remove(no_page_more)
    found = verify(tmp_path)
    assert found.sound and found.head == last.head
    with running(tmp_path) as audit:
        assert audit.append_and_wait("proposed", ANN, {}, {"verdict": bytes(100_000)}).sequence == last.sequence + 1


REFUSED_WRITES = """
import resource, sys
from pathlib import Path
from gateway.core.audit_record import Who
from gateway.supervisor.audit import Audit, AuditUnavailable
folder, size, infinite = Path(sys.argv[1]), int(sys.argv[2]), resource.RLIM_INFINITY
audit = Audit(folder)
audit.start()
size_of_blobs = iter(range(20_000, 90_000, 10_000))
def append():
    try:
        at = audit.append_and_wait("proposed", Who(name="ann"), {}, {"verdict": bytes(next(size_of_blobs))})
        print(at.sequence, at.head, flush=True)
    except AuditUnavailable as error:
        print(error, flush=True)
append()
# No file may grow beyond this: the kernel refuses the writes, as a disk without room does.
resource.setrlimit(resource.RLIMIT_FSIZE, (size or (folder / "audit.sqlite").stat().st_size, infinite))
for _ in range(3):
    append()
resource.setrlimit(resource.RLIMIT_FSIZE, (infinite, infinite))
append()
audit.close()
"""


@pytest.mark.parametrize("size", [0, 100], ids=["the database may not grow", "nor may anything else"])
def test_writes_that_the_kernel_refuses_are_told_and_nothing_is_lost(tmp_path: Path, size: int) -> None:
    command = [sys.executable, "-c", REFUSED_WRITES, str(tmp_path), str(size)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 0, run.stderr
    first, *refused, after = run.stdout.splitlines()
    assert len(refused) == 3 and all("nothing" in text or "cannot" in text for text in refused), refused
    with AuditFile(tmp_path) as file:
        heads = {str(row.sequence): row.head for row in file.rows()}
    for told in (first, after):
        sequence, head = told.split()
        assert heads[sequence] == head
    assert verify(tmp_path).sound


# Beginning


def test_an_interrupted_beginning_is_gone_on_with(tmp_path: Path) -> None:
    write_anchor(tmp_path, Anchor(0, BEFORE_FIRST))  # and then the machine stopped
    write(tmp_path, 1)
    assert kinds(tmp_path) == ["begun", "proposed"] and verify(tmp_path).sound


def test_a_person_begins_anew_and_the_old_one_is_kept(tmp_path: Path) -> None:
    last = write(tmp_path, 5)
    with (tmp_path / FILE_NAME).open("r+b") as stream:
        stream.truncate(4096)
    with pytest.raises(NotRecordable):
        begin_anew(tmp_path, " ", ANN)
    begun = begin_anew(tmp_path, "the disk was replaced", ANN, wall_clock=lambda: 1785765900.0)
    assert begun.kept == tmp_path / "audit-20260803T140500Z" and not begun.before.sound
    with AuditFile(tmp_path) as file:
        first = next(iter(file.rows())).record()
    assert first.who == ANN and first.what["because"] == "the disk was replaced"
    assert first.what["before"]["anchor"] == {"sequence": last.sequence, "head": last.head}
    assert verify(tmp_path).sound and not verify(begun.kept).sound
    with running(tmp_path) as audit:
        audit.append_and_wait("proposed", ANN, {})
    again = begin_anew(tmp_path, "once more", ANN, wall_clock=lambda: 1785765900.0)
    assert again.before.sound and again.kept.name.endswith("-2") and verify(again.kept).sound


def test_where_there_was_an_audit_none_is_begun_silently(tmp_path: Path) -> None:
    write(tmp_path, 1)
    begun = begin_anew(tmp_path, "a test", ANN)
    for name in (FILE_NAME, ANCHOR):  # as if the machine had stopped while it was moving them
        (tmp_path / name).unlink()
    with running(tmp_path) as audit, pytest.raises(AuditUnavailable, match=f"{begun.kept.name} is there"):
        audit.append_and_wait("proposed", ANN, {})


# Kills and damage


def test_no_kill_loses_what_was_said_to_be_stored_or_breaks_the_chain(tmp_path: Path) -> None:
    seed = int(np.random.randint(1 << 30))
    print(f"seed {seed}")
    command = [sys.executable, "-m", "tests.unit.audit_victim", str(tmp_path / "audit"), "50", str(seed)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=True)
    tally = json.loads(run.stdout)
    assert tally["kills"] == 50 and tally["told"] > 50
    assert (tally["lost"], tally["denied"], tally["unnamed"], tally["unsound"]) == (0, 0, 0, 0), tally


def test_every_damage_is_told_or_harmless(tmp_path: Path) -> None:
    seed = int(np.random.randint(1 << 30))
    print(f"seed {seed}")
    damages = audit_damage.campaign(tmp_path, 200, seed)
    assert damages.tried == 200 and damages.undetected == 0, damages.examples
    assert sum(n for what, n in damages.by.items() if what.endswith("says so")) > 50


def test_an_audit_without_its_last_record_is_not_written_upon(tmp_path: Path) -> None:
    last = write(tmp_path, 3)
    _tamper(tmp_path, f"DELETE FROM record WHERE sequence = {last.sequence}")
    writer = AuditWriter(tmp_path)
    try:
        with pytest.raises(AuditUnavailable, match=f"record {last.sequence} is lost"):
            writer.append([Draft("proposed", ANN, {})])
    finally:
        writer.close()

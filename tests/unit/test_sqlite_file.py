"""What belongs to another program is left as it is, whichever of our files it lies in the place of."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import apsw
import pytest

from agents.rag import index_file
from gateway.storage.sqlite_file import FileKind, begin, open_there, open_to_read
from gateway.supervisor import audit_file, baselines, configurations, interactions, model_store, store

KINDS = {
    kind.name: kind
    for kind in (
        store.KIND, audit_file.KIND, configurations.KIND, model_store.KIND, baselines.KIND, interactions.KIND,
        index_file.KIND,
    )
}  # fmt: skip

#: How another program may have made its file.
FOREIGN = {
    "tables, and no version": "CREATE TABLE invoices (id INTEGER, text TEXT); INSERT INTO invoices VALUES (1, 'hers')",
    "a version": "CREATE TABLE invoices (id INTEGER); PRAGMA user_version = 7; PRAGMA application_id = 77",
    "a version and no owner": "CREATE TABLE invoices (id INTEGER); PRAGMA user_version = 1",
    "an owner and no table": "PRAGMA application_id = 77",
    "a write-ahead log": "PRAGMA journal_mode = WAL; CREATE TABLE invoices (id INTEGER)",
}


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("statements", FOREIGN.values(), ids=FOREIGN)
@pytest.mark.parametrize("opened", [begin, open_there, open_to_read], ids=["begun", "opened", "read"])
def test_a_file_of_another_program_is_refused_and_stays_as_it_was(
    tmp_path: Path, name: str, statements: str, opened: Callable[[Path, FileKind], Any]
) -> None:
    path, kind = tmp_path / "file.sqlite", KINDS[name]
    connection = apsw.Connection(str(path))
    connection.execute(statements).fetchall()
    connection.close()
    before, modified = hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns
    with pytest.raises(kind.error, match="belongs to another program"):
        opened(path, kind)
    assert (hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns) == (before, modified)
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


def test_a_log_of_another_program_that_was_killed_is_not_copied_back(tmp_path: Path) -> None:
    path = tmp_path / "file.sqlite"
    connection = apsw.Connection(str(path))
    connection.execute("PRAGMA journal_mode = WAL; PRAGMA application_id = 77; PRAGMA wal_checkpoint").fetchall()
    connection.execute("CREATE TABLE invoices (id INTEGER)")
    left = {one.name: one.read_bytes() for one in tmp_path.iterdir()}
    connection.close()
    for one, content in left.items():  # as a kill leaves them
        (tmp_path / one).write_bytes(content)
    with pytest.raises(store.NotOurs):
        begin(path, store.KIND)
    assert {one.name: one.read_bytes() for one in tmp_path.iterdir()} == left


@pytest.mark.parametrize("name", KINDS)
def test_our_own_file_is_begun_opened_and_read(tmp_path: Path, name: str) -> None:
    path, kind = tmp_path / "folder" / "file.sqlite", KINDS[name]
    for opened in (begin, open_there, begin, open_to_read):
        if kind is index_file.KIND and opened is not open_to_read and path.exists():
            continue  # made once, then read
        connection = opened(path, kind)
        assert connection.pragma("application_id") == kind.application_id
        assert connection.pragma("user_version") == kind.schema
        connection.close()


@pytest.mark.parametrize("opened", [begin, open_there, open_to_read], ids=["begun", "opened", "read"])
def test_a_file_on_another_disk_is_opened_through_its_link(
    tmp_path: Path, opened: Callable[[Path, FileKind], Any]
) -> None:
    begin(tmp_path / "there.sqlite", audit_file.KIND).close()
    (tmp_path / "here.sqlite").symlink_to(tmp_path / "there.sqlite")
    connection = opened(tmp_path / "here.sqlite", audit_file.KIND)
    assert connection.pragma("application_id") == audit_file.KIND.application_id
    connection.close()


def test_who_opens_to_read_cannot_write(tmp_path: Path) -> None:
    begin(tmp_path / "h", store.KIND).close()
    connection = open_to_read(tmp_path / "h", store.KIND)
    with pytest.raises(apsw.ReadOnlyError):
        connection.execute("DELETE FROM run")
    connection.close()


#: Another process, which waits for nobody. It says whether it could write, and what it finds.
ANOTHER = """
import sys, apsw
connection = apsw.Connection(sys.argv[1])
try:
    connection.execute("BEGIN IMMEDIATE; INSERT INTO other VALUES ('theirs'); COMMIT")
except apsw.BusyError:
    print("busy")
else:
    print("wrote")
connection.close()
"""


def another_writes(path: Path) -> str:
    return subprocess.run([sys.executable, "-c", ANOTHER, str(path)], capture_output=True, text=True).stdout.strip()


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("opened", [begin, open_there, open_to_read], ids=["begun", "opened", "read"])
def test_whoever_opens_it_in_the_same_process_does_not_take_the_writers_lock_along(
    tmp_path: Path, name: str, opened: Callable[[Path, FileKind], Any]
) -> None:
    path, kind = tmp_path / "file.sqlite", KINDS[name]
    writer = begin(path, kind)
    writer.execute("CREATE TABLE other (text TEXT)")
    writer.execute("BEGIN IMMEDIATE; INSERT INTO other VALUES ('ours')")
    assert another_writes(path) == "busy"
    with suppress(kind.error):  # where it would write itself it says that it is held
        opened(path, replace(kind, busy_ms=50)).close()
    assert another_writes(path) == "busy"
    writer.execute("COMMIT")
    assert another_writes(path) == "wrote"
    assert [text for (text,) in writer.execute("SELECT text FROM other")] == ["ours", "theirs"]
    writer.close()


def refused(path: Path, kind: FileKind) -> Any:
    """It was looked at to see whose it is."""
    with pytest.raises(kind.anothers or kind.error, match="belongs to another program"):
        open_there(path, replace(kind, application_id=77))
    return open_to_read(path, kind)


LOOKS = {"begun": begin, "opened": open_there, "read": open_to_read, "refused": refused}


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("opened", LOOKS.values(), ids=LOOKS)
def test_the_locks_of_a_process_outlive_whoever_opens_the_file_in_it(
    tmp_path: Path, name: str, opened: Callable[[Path, FileKind], Any]
) -> None:
    """As the kernel lists them. Without them another process takes itself for the only one that has the file open."""
    path, kind = tmp_path / "file.sqlite", KINDS[name]
    holder = begin(path, kind)
    holder.execute("BEGIN; SELECT count(*) FROM sqlite_schema").fetchall()
    before = locks_on(path)
    assert before
    opened(path, kind).close()
    assert locks_on(path) == before
    holder.close()


def locks_on(path: Path) -> set[tuple[str, ...]]:
    """What this process holds of a database and what lies beside it: kind, file, first and last byte."""
    files = {str(one.stat().st_ino) for one in path.parent.glob(f"{path.name}*")}
    rows = [row.split() for row in Path("/proc/locks").read_text().splitlines()]
    return {
        (row[3], inode, *row[6:])
        for row in rows
        if row[4] == str(os.getpid()) and (inode := row[5].rpartition(":")[2]) in files
    }

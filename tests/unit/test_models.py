"""The model repository: versions, marks, what is found by which name, older files, damage, kills, and no room."""

import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import apsw
import numpy as np
import pytest

from gateway.core.line_model import canonical, model_hash
from gateway.storage import sqlite_file
from gateway.supervisor import model_store
from gateway.supervisor.model_store import APPLICATION_ID, SCHEMA, ModelsError
from gateway.supervisor.models import Models, begin_repository, open_repository
from gateway.supervisor.store import open_store
from tests.unit import models_victim
from tests.unit.model_support import model
from tests.unit.supervisor_support import child, short_folder

ROOT = Path(__file__).parents[2]
OLDER = ROOT / "tests" / "unit" / "data" / "models-schema-1.sqlite"
OLDER_IDS = [
    "08b35348927a8c8c51736b2c84320f2ade1b4b77c2d7aad69886bc94f57168a9",
    "f30b1f776cf963b20b26479a25c33bc94a6b34125ac422dbbed9de2361c1e634",
]


@pytest.fixture
def models(tmp_path: Path) -> Iterator[Models]:
    with begin_repository(tmp_path / "new" / "models.sqlite") as found:
        yield found


def test_versions_count_up_within_each_line(models: Models) -> None:
    stored = [models.store(model(2, scale), 100.0 + scale) for scale in (1.0, 1.1, 1.2)]
    other = models.store(model(2, 1.0, line="line-2"), 200.0)
    assert [one.version for one in stored] == [1, 2, 3] and other.version == 1
    assert models.entries("demo", "line-1") == stored
    assert models.entries() == [*stored, other]
    assert [one.stored_s for one in stored] == pytest.approx([101.0, 101.1, 101.2])
    assert stored[1].model == model(2, 1.1) and stored[1].id == model_hash(model(2, 1.1)) and not stored[1].damage


def test_what_is_there_already_is_not_stored_again(models: Models) -> None:
    first = models.store(model(), 1.0)
    models.store(model(2, 1.1), 2.0)
    assert models.store(model(), 3.0) == first
    assert len(models.entries()) == 2


def test_the_last_mark_is_the_state_and_all_are_kept(models: Models) -> None:
    id_ = models.store(model(), 1.0).id
    other = models.store(model(2, 1.1), 1.0)
    assert models.entries()[0].state is None
    models.mark(id_, "accepted", 2.0, "verdict 12")
    models.mark(id_, "superseded", 3.0, "by version 2")
    found = models.find("1")
    assert found.state == "superseded"
    assert [tuple(mark) for mark in found.marks] == [
        ("accepted", 2.0, "verdict 12"), ("superseded", 3.0, "by version 2"),
    ]  # fmt: skip
    assert models.find("2") == other
    with pytest.raises(ModelsError, match="has no model ffffffffffff: nothing was marked"):
        models.mark("f" * 64, "accepted", 2.0, "")


def test_nothing_is_ever_changed_or_taken_away(models: Models) -> None:
    models.mark(models.store(model(), 1.0).id, "accepted", 1.0, "")
    before = models.entries()
    with sqlite3.connect(models.path) as connection:
        for statement in (
            "UPDATE model SET version = 7", "DELETE FROM model", "UPDATE mark SET state = 'rejected'",
            "DELETE FROM mark", "INSERT INTO mark VALUES (9, 'x', 'perfect', 0.0, '')",
        ):  # fmt: skip
            with pytest.raises(sqlite3.IntegrityError):
                connection.execute(statement)
    connection.close()
    assert models.entries() == before


def test_a_model_is_found_by_version_by_the_beginning_of_its_id_and_as_the_newest(models: Models) -> None:
    stored = [models.store(model(2, 1.0 + 0.01 * k), 1.0) for k in range(15)]
    for k, one in enumerate(stored, 1):
        assert [models.find(name) for name in (str(k), f"v{k}", one.id, one.id[:10].upper(), one.id[:6])] == [one] * 5
    assert models.find("newest") == stored[-1]
    for wanted, says in (
        (
            "16",
            "has no model 16; allowed: a version (1, 2, 3, ..., 15), at least 6 letters of an id, newest, or a file",
        ),
        (stored[0].id[:5], "has no model"),
        ("", "has no model"),
        ("oldest", "has no model oldest"),
    ):
        with pytest.raises(ModelsError) as refused:
            models.find(wanted)
        assert says in str(refused.value)


def test_a_version_of_two_lines_is_ambiguous_until_one_is_named(models: Models) -> None:
    first = models.store(model(), 1.0)
    second = models.store(model(line="line-2"), 1.0)
    for wanted in ("1", "newest"):
        with pytest.raises(
            ModelsError, match="models of demo/line-1, demo/line-2: name the line with --line, or an id"
        ):
            models.find(wanted)
        assert models.find(wanted, "demo", "line-2") == second
    assert models.find(first.id[:12]) == first
    with pytest.raises(ModelsError, match="no model of demo/line-3 yet"):
        models.find("1", "demo", "line-3")


def test_parents_are_followed_as_far_as_they_lie_here(models: Models) -> None:
    lost = model(2, 0.9)
    first = models.store(model(2, parent=model_hash(lost)), 1.0)
    second = models.store(model(2, 1.1, parent=first.id), 1.0)
    third = models.store(model(2, 1.2, parent=second.id), 1.0)
    assert models.ancestors(third) == [second, first]
    assert models.ancestors(first) == []


# Files


def test_a_file_of_an_older_schema_is_brought_up_to_date_and_keeps_what_it_has(tmp_path: Path) -> None:
    path = tmp_path / "models.sqlite"
    shutil.copy(OLDER, path)
    with open_repository(path) as models:
        found = models.entries()
        assert [one.id for one in found] == OLDER_IDS
        assert [one.version for one in found] == [1, 2] and not any(one.damage for one in found)
        assert models.ancestors(found[1]) == [found[0]]
        models.mark(OLDER_IDS[0], "superseded", 5.0, "a test")
        assert models.store(model(2, 1.3), 6.0).version == 3
    with open_repository(path) as models:
        assert [one.state for one in models.entries()] == ["superseded", None, None]
    connection = sqlite3.connect(path)
    assert connection.execute("PRAGMA user_version").fetchone() == (SCHEMA,)
    with pytest.raises(sqlite3.IntegrityError):
        connection.execute("DELETE FROM model")
    connection.close()


def test_every_schema_leads_to_todays() -> None:
    assert list(model_store.MIGRATIONS) == list(range(SCHEMA))


def test_where_there_is_nothing_nothing_is_made(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    with pytest.raises(ModelsError, match="is a folder, not a file"):
        open_repository(tmp_path)
    for name in ("none", "empty"):
        with pytest.raises(ModelsError, match="there are no models at .*r2rgate models import FILE takes one"):
            open_repository(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


def foreign(path: Path, statements: str) -> None:
    connection = sqlite3.connect(path)
    connection.executescript(statements)
    connection.close()


FOREIGN = {
    "another program's, with an application id": "PRAGMA application_id = 77; CREATE TABLE x (a)",
    "another program's, without one": "CREATE TABLE x (a)",
    "another program's, with a version": "PRAGMA user_version = 1",
    "a newer schema": f"PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {SCHEMA + 1}",
}


@pytest.mark.parametrize("begin", [open_repository, begin_repository])
@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_file_is_named_and_left_as_it_is(tmp_path: Path, kind: str, begin: object) -> None:
    path = tmp_path / "models.sqlite"
    foreign(path, FOREIGN[kind])
    before = path.read_bytes()
    says = "has schema 3, this program knows 2: update" if kind == "a newer schema" else "belongs to another program"
    with pytest.raises(ModelsError, match=says):
        begin(path)
    assert path.read_bytes() == before


def test_a_history_is_no_model_repository(tmp_path: Path) -> None:
    open_store(tmp_path / "history.sqlite").close()
    with pytest.raises(ModelsError, match="application id 0x52325247"):
        begin_repository(tmp_path / "history.sqlite")


@pytest.mark.parametrize("damage", [b"this is no database, and long enough for a header", b"\0" * 200])
def test_a_file_whose_beginning_is_damaged_is_named_and_left_as_it_is(tmp_path: Path, damage: bytes) -> None:
    path = tmp_path / "models.sqlite"
    content = bytearray(OLDER.read_bytes())
    content[: len(damage)] = damage
    path.write_bytes(content)
    with pytest.raises(ModelsError, match="is no model repository: it is no SQLite file, or its beginning is damaged"):
        begin_repository(path)
    assert path.read_bytes() == content


def test_a_file_with_a_broken_page_is_named_and_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "models.sqlite"
    content = bytearray(OLDER.read_bytes())
    content[1024:2048] = bytes(1024)
    path.write_bytes(content)
    with pytest.raises(ModelsError, match="is damaged"):
        begin_repository(path)
    assert path.read_bytes() == content


def test_every_flipped_bit_is_either_found_or_harmless(tmp_path: Path) -> None:
    """Whatever is offered as a sound model is one of those that were stored."""
    path = tmp_path / "models.sqlite"
    rng = np.random.default_rng(5)
    whole, found_damaged = OLDER.read_bytes(), 0
    for place in rng.integers(0, len(whole), 60):
        content = bytearray(whole)
        content[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(content)
        try:
            with open_repository(path) as models:
                entries = models.entries()
        except ModelsError:
            found_damaged += 1
            continue
        found_damaged += any(one.damage for one in entries)
        for one in entries:
            assert one.model is None or (one.id in OLDER_IDS and model_hash(one.model) == one.id)
    assert found_damaged > 15


def test_a_damaged_model_is_named_and_hides_no_other(tmp_path: Path) -> None:
    path = tmp_path / "models.sqlite"
    content = OLDER.read_bytes()
    old = canonical(model(2, method="recursive least squares"))
    first = old[:100]  # the rest of it lies on other pages
    assert content.count(first) >= 1
    path.write_bytes(content.replace(first, first.replace(b"value", b"valve").replace(b"late_s", b"lake_s")))
    assert path.read_bytes() != content
    with open_repository(path) as models:
        found = models.entries()
        assert [one.version for one in found] == [1, 2]
        damaged = [one for one in found if one.damage]
        assert damaged and all(one.model is None and "its content cannot be read" in one.damage for one in damaged)


# Kills, and many at once


def test_no_kill_loses_what_was_said_to_be_stored_or_harms_the_file(tmp_path: Path) -> None:
    seed = int(np.random.randint(1 << 30))
    print(f"seed {seed}")
    command = [sys.executable, "-m", "tests.unit.models_victim", str(tmp_path), str(OLDER), str(seed)]
    victims = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=90, check=True)
    said = [line.split(" ") for line in victims.stdout.splitlines()]
    assert len(said) == models_victim.ROUNDS
    assert all(told.startswith("o") for _, told in said[models_victim.ROUNDS // 2 :])
    for k, (name, told) in enumerate(said):
        path = tmp_path / name
        kept = 2 if k % 2 else 0
        if not path.exists() or not path.stat().st_size:
            assert not kept and not told
            continue
        with begin_repository(path) as models:
            found = models.entries()
        assert [one.version for one in found] == list(range(1, len(found) + 1))
        assert not any(one.damage for one in found)
        stored, marked = len(found) - kept, sum(one.state == "rejected" for one in found)
        assert told.count("s") <= stored <= told.count("s") + 1
        assert told.count("m") <= marked <= told.count("m") + 1
        connection = sqlite3.connect(path)  # another SQLite than the repository's
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        connection.close()


def test_a_reader_rolls_back_what_a_killed_writer_left_half_done(tmp_path: Path) -> None:
    path = tmp_path / "models.sqlite"
    shutil.copy(OLDER, path)
    open_repository(path).close()
    with child(HALF_DONE, path) as (_, said):
        assert said == "half done\n"
    assert (tmp_path / "models.sqlite-journal").stat().st_size
    with open_repository(path) as models:
        assert [one.id for one in models.entries()] == OLDER_IDS


HALF_DONE = """
import apsw, sys, time
connection = apsw.Connection(sys.argv[1])
connection.execute("PRAGMA cache_size = 1; PRAGMA cache_spill = 1; BEGIN IMMEDIATE")
for k in range(300):  # more than the cache holds: pages go into the file before the commit
    connection.execute("INSERT INTO model VALUES (?, 's', 'l', ?, 0.0, zeroblob(3000))", (str(k), k))
print("half done", flush=True)
time.sleep(60.0)
"""

STORE_MANY = """
import sys
from pathlib import Path
from gateway.supervisor.models import begin_repository
from tests.unit.model_support import model
path, first = Path(sys.argv[1]), float(sys.argv[2])
with begin_repository(path) as models:
    for k in range(20):
        models.store(model(2, first + 0.001 * k), 1.0)
"""


def test_writers_and_readers_at_once_disturb_nobody(tmp_path: Path) -> None:
    path = tmp_path / "models.sqlite"
    command = [sys.executable, "-c", STORE_MANY, str(path)]
    begin_repository(path).close()
    with ExitStack() as stack:
        writers = [stack.enter_context(subprocess.Popen([*command, first], cwd=ROOT)) for first in ("1.0", "2.0")]
        for writer in writers:
            stack.callback(writer.kill)
        seen = 0
        with open_repository(path) as models:
            while any(writer.poll() is None for writer in writers):
                found = models.entries()
                assert [one.version for one in found] == list(range(1, len(found) + 1))
                assert len(found) >= seen and not any(one.damage for one in found)
                seen = len(found)
            assert len(models.entries()) == 40
        assert [writer.returncode for writer in writers] == [0, 0]


def test_two_that_begin_the_same_file_both_can(tmp_path: Path) -> None:
    path = tmp_path / "new" / "models.sqlite"
    with begin_repository(path) as first, begin_repository(path) as second:
        assert first.store(model(), 1.0).version == 1
        assert second.store(model(2, 1.1), 1.0).version == 2


HOLD_LOCK = """
import sqlite3, sys, time
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("BEGIN EXCLUSIVE")
print("held", flush=True)
time.sleep(60.0)
"""


def test_a_lock_that_stays_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "models.sqlite"
    shutil.copy(OLDER, path)
    monkeypatch.setattr(sqlite_file, "BUSY_MS", 10)
    with open_repository(path) as models, child(HOLD_LOCK, path) as (_, said):
        assert said == "held\n"
        with pytest.raises(ModelsError, match="another program has held .* nothing was done"):
            models.store(model(), 1.0)
        with pytest.raises(ModelsError, match="another program has held"):
            models.entries()


# No room


def test_a_full_disk_is_told_and_nothing_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "models.sqlite"
    with begin_repository(path) as models:
        first = models.store(model(), 1.0)

    def no_page_more(connection: apsw.Connection) -> None:
        connection.execute(f"PRAGMA max_page_count = {path.stat().st_size // 4096}")

    apsw.connection_hooks.append(no_page_more)
    try:
        with open_repository(path) as models:
            with pytest.raises(ModelsError, match="the disk of .* is full: nothing was stored. Free some space"):
                models.store(model(60), 1.0)
            assert models.entries() == [first]
    finally:
        apsw.connection_hooks.remove(no_page_more)
    with open_repository(path) as models:
        assert models.store(model(60), 1.0).version == 2


REFUSED_WRITES = """
import resource, signal, sys
from pathlib import Path
from gateway.supervisor.models import ModelsError, begin_repository
from tests.unit.model_support import model
path = Path(sys.argv[1])
with begin_repository(path) as models:
    models.store(model(), 1.0)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    # No file may grow beyond this: the kernel refuses the writes, as a disk without room does.
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size, resource.RLIM_INFINITY))
    try:
        models.store(model(60), 1.0)
    except ModelsError as error:
        print(error)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    print(models.store(model(60), 1.0).version, len(models.entries()))
"""


def test_writes_that_the_kernel_refuses_are_told_and_nothing_is_lost(tmp_path: Path) -> None:
    command = [sys.executable, "-c", REFUSED_WRITES, str(tmp_path / "models.sqlite")]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 0, run.stderr
    refused, after = run.stdout.splitlines()
    assert "nothing was stored" in refused and "full" in refused
    assert after == "2 2"


AS_NOBODY = """
import os, sys
from pathlib import Path
from gateway.supervisor.models import ModelsError, begin_repository, open_repository
from tests.unit.model_support import model
path = Path(sys.argv[1])
other = model(2, 1.1)
if os.geteuid() == 0:
    os.setgid(65534)
    os.setuid(65534)
with open_repository(path) as models:
    print(len(models.entries()))
    try:
        models.store(other, 1.0)
    except ModelsError as error:
        print(error)
try:
    begin_repository(path.parent / "deeper" / "models.sqlite")
except ModelsError as error:
    print(error)
"""


@pytest.mark.parametrize("mode", [0o444, 0o666])
def test_a_folder_that_may_not_be_written_can_be_read(mode: int) -> None:
    with short_folder() as folder:
        path = folder / "models.sqlite"
        with begin_repository(path) as models:
            models.store(model(), 1.0)
        path.chmod(mode)
        folder.chmod(0o555)
        try:
            command = [sys.executable, "-c", AS_NOBODY, str(path)]
            run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
        finally:
            folder.chmod(0o755)
    assert run.returncode == 0, run.stderr
    count, store, begin = run.stdout.splitlines()
    assert count == "1"
    assert "models.sqlite cannot be written: the file or its folder is read-only" in store
    assert begin.endswith("cannot be made: Permission denied; name another")


def test_a_file_in_the_way_of_the_folder_is_told(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("a file where a folder should be")
    with pytest.raises(ModelsError, match="a folder for .* cannot be made"):
        begin_repository(tmp_path / "data" / "models.sqlite")
    os.mkdir(tmp_path / "models.sqlite")
    with pytest.raises(ModelsError, match="is a folder, not a file"):
        begin_repository(tmp_path / "models.sqlite")

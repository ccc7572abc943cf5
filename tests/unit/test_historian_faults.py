"""The historian when the disk is full, slow or gone, the file damaged, or the process killed."""

import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import apsw
import numpy as np
import pytest

from gateway.core.messages import Event
from gateway.supervisor import historian as module
from gateway.supervisor.historian import FILE_NAME, Historian
from gateway.supervisor.history import History
from tests.unit import historian_victim
from tests.unit.supervisor_support import child, frame_of
from tests.unit.test_historian import eventually, running, writer_of

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FLUSH_S", 0.01)


def test_no_kill_loses_what_was_said_to_be_stored_or_harms_the_file(tmp_path: Path) -> None:
    seed = int(np.random.randint(1 << 30))
    print(f"seed {seed}")
    command = [sys.executable, "-m", "tests.unit.historian_victim", str(tmp_path), str(seed)]
    victims = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    said = [int(line) for line in victims.stdout.split()]
    assert len(said) == historian_victim.ROUNDS
    assert min(said) >= 1
    with History(tmp_path / FILE_NAME) as history:
        for k, stored in enumerate(said):
            start_s = k * historian_victim.ROUND_S
            found = history.read(start_s, start_s + historian_victim.ROUND_S - 0.0005, ["sequence", "tension_n"])
            assert found["sequence"].tolist() == list(range(len(found["sequence"]))), f"round {k}"
            assert len(found["sequence"]) >= stored
            assert np.isfinite(found["tension_n"]).all()
        assert history.damaged == []
    assert list(tmp_path.glob("*damaged*")) == []
    connection = sqlite3.connect(tmp_path / FILE_NAME)  # another SQLite than the historian's
    assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    connection.close()


@pytest.mark.parametrize("damage", [b"this is no database, and long enough", b"\0" * 4096])
def test_a_damaged_file_is_kept_aside_and_a_new_one_begun(tmp_path: Path, damage: bytes) -> None:
    writer = writer_of(tmp_path / FILE_NAME)
    writer.store([frame_of(k, float(k)) for k in range(500)], [], 0.0)
    writer.disconnect()
    content = bytearray((tmp_path / FILE_NAME).read_bytes())
    content[: len(damage)] = damage
    (tmp_path / FILE_NAME).write_bytes(content)
    with running(tmp_path) as historian:
        eventually(lambda: bool(historian.health().moved_aside))
        eventually(lambda: historian.health().storing)
        historian.frame(frame_of(0, 1000.0))
        kept = Path(historian.health().moved_aside)
    assert kept.read_bytes() == content
    with History(tmp_path / FILE_NAME) as history:
        assert history.read(0.0, 2000.0, [])["time_s"].tolist() == [1000.0]


def test_damage_that_is_met_while_storing_loses_nothing_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = module.Writer.store
    met = []

    def meets_damage_once(self: module.Writer, frames: list[bytes], *rest: Any) -> None:
        if frames and not met:
            met.append(len(frames))
            raise apsw.CorruptError("database disk image is malformed")
        store(self, frames, *rest)

    with running(tmp_path) as historian:
        eventually(lambda: historian.health().storing)
        monkeypatch.setattr(module.Writer, "store", meets_damage_once)
        historian.frame(frame_of(0, 1.0))
        eventually(lambda: historian.health().storing and historian.health().frames_stored == 1)
        kept = Path(historian.health().moved_aside)
    assert len(met) == 1
    for path, sequences in ((kept, []), (tmp_path / FILE_NAME, [0])):
        with History(path) as history:
            assert history.read(0.0, 2.0, ["sequence"])["sequence"].tolist() == sequences


def test_a_blob_that_does_not_unpack_is_left_out_and_named(tmp_path: Path) -> None:
    writer = writer_of(tmp_path / "h")
    for start in (0, 10, 20):
        writer.store([frame_of(k, float(k)) for k in range(start, start + 10)], [], 0.0)
        writer.pack()
    writer.disconnect()
    connection = sqlite3.connect(tmp_path / "h")
    connection.execute("UPDATE field SET data = substr(data, 1, 20) WHERE blob = 2 AND name = 'tension_n'")
    connection.commit()
    connection.close()
    with History(tmp_path / "h") as history:
        found = history.read(0.0, 100.0, ["sequence", "tension_n"])
        assert found["sequence"].tolist() == [*range(10), *range(20, 30)]
        assert len(history.damaged) == 1
        assert "blob 2, 10 frames" in history.damaged[0]


FULL_DISK = """
import resource, signal, sys, time
from pathlib import Path
from tests.unit.supervisor_support import child, frame_of
from gateway.supervisor import historian as module
from gateway.supervisor.historian import Historian

def until(condition):
    end_s = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < end_s, historian.health()
        time.sleep(0.005)

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
module.FLUSH_S = 0.02
folder = Path(sys.argv[1])
historian = Historian(folder, "site", "line", 6)
historian.start()
historian.frame(frame_of(0, 0.0))
until(lambda: historian.health().frames_stored == 1)
# No file may grow beyond this: the kernel refuses the historian's writes as it does on a full disk.
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, resource.RLIM_INFINITY))
sequence = 1
while historian.health().storing:
    historian.frame(frame_of(sequence, sequence * 0.01))
    sequence += 1
    time.sleep(0.0005)
text = historian.health().text
for _ in range(100):
    historian.frame(frame_of(sequence, sequence * 0.01))
    sequence += 1
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
until(lambda: historian.health().storing and historian.health().frames_stored == sequence)
assert historian.close()
print(sequence, historian.health().frames_lost, text, sep="\\n")
"""


def test_writes_that_the_kernel_refuses_stop_the_storing_and_it_goes_on_by_itself(tmp_path: Path) -> None:
    command = [sys.executable, "-c", FULL_DISK, str(tmp_path)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 0, run.stderr
    sent, lost, text = run.stdout.splitlines()
    assert text.startswith("not storing")
    assert lost == "0"
    with History(tmp_path / FILE_NAME) as history:
        assert history.read(0.0, 1e6, ["sequence"])["sequence"].tolist() == list(range(int(sent)))


def test_too_little_free_space_stops_the_storing_before_the_disk_is_full(tmp_path: Path) -> None:
    with running(tmp_path, reserve_bytes=1 << 60) as historian:
        historian.frame(frame_of(0, 0.0))
        eventually(lambda: "disk is full" in historian.health().text)
        assert not historian.health().storing
        assert historian.health().frames_stored == 0


def test_a_stop_is_told_within_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FLUSH_S", 0.8)
    with running(tmp_path, reserve_bytes=0) as historian:
        eventually(lambda: historian.health().storing)
        monkeypatch.setattr(module.Writer, "store", _disk_full)
        eventually(lambda: not historian.health().storing, 1.0)


def _disk_full(*_: object) -> None:
    raise module.DiskFull("as the test has it")


def test_when_memory_is_full_the_newest_are_lost_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_WAITING_BYTES", 10 * len(frame_of(0, 0.0)))
    monkeypatch.setattr(module, "MAX_WAITING_EVENTS", 3)
    monkeypatch.setattr(module.Writer, "store", _disk_full)
    historian = Historian(tmp_path, "site", "line", 6)
    for k in range(25):
        historian.frame(frame_of(k, float(k)))
        historian.event(Event(time_s=float(k), kind="k", text=str(k)))
    historian.start()
    eventually(lambda: "not storing" in historian.health().text)
    historian.frame(frame_of(25, 25.0))  # what waits in the thread counts too
    health = historian.health()
    assert (health.frames_lost, health.events_lost) == (16, 22)
    monkeypatch.undo()
    assert historian.close()
    with History(tmp_path / FILE_NAME) as history:
        assert history.read(0.0, 100.0, ["sequence"])["sequence"].tolist() == list(range(10))
        assert [event.text for event in history.events(0.0, 1e12)] == ["0", "1", "2"]


def test_a_file_that_is_moved_away_takes_nothing_more(tmp_path: Path) -> None:
    with running(tmp_path) as historian:
        historian.frame(frame_of(0, 0.0))
        eventually(lambda: historian.health().frames_stored == 1)
        (tmp_path / FILE_NAME).rename(tmp_path / "archived")
        historian.frame(frame_of(1, 1.0))
        eventually(lambda: historian.health().frames_stored == 2)
    for name, sequences in (("archived", [0]), (FILE_NAME, [1])):
        with History(tmp_path / name) as history:
            assert history.read(0.0, 2.0, ["sequence"])["sequence"].tolist() == sequences


def test_a_folder_that_is_deleted_or_cannot_be_made_is_survived(tmp_path: Path) -> None:
    blocked = tmp_path / "data"
    blocked.write_text("a file where a folder should be")
    with running(blocked) as historian:
        historian.frame(frame_of(0, 0.0))
        eventually(lambda: "not storing" in historian.health().text)
        blocked.unlink()
        eventually(lambda: historian.health().frames_stored == 1)
        blocked.rename(tmp_path / "taken away")
        historian.frame(frame_of(1, 1.0))
        eventually(lambda: historian.health().frames_stored == 2)
    with History(blocked / FILE_NAME) as history:
        assert history.read(0.0, 2.0, ["sequence"])["sequence"].tolist() == [1]


HOLD_LOCK = """
import sqlite3, sys, time
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("BEGIN IMMEDIATE")
print("held", flush=True)
time.sleep(60.0)
"""


def test_a_lock_held_by_another_program_only_delays(tmp_path: Path) -> None:
    with running(tmp_path) as historian:
        eventually(lambda: historian.health().storing)
        with child(HOLD_LOCK, tmp_path / FILE_NAME) as (_, said):
            assert said == "held\n"
            historian.frame(frame_of(0, 0.0))
            eventually(lambda: "another program holds" in historian.health().text)
        eventually(lambda: historian.health().frames_stored == 1)


def test_a_disk_that_does_not_answer_is_told_and_close_does_not_wait_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = [0.0]
    answers = threading.Event()
    historian = Historian(tmp_path, "site", "line", 6, clock=lambda: now_s[0])
    historian.start()
    eventually(lambda: historian.health().storing)
    store = module.Writer.store

    def hang(*arguments: Any) -> None:
        answers.wait()
        store(*arguments)

    monkeypatch.setattr(module.Writer, "store", hang)

    def stalled() -> bool:
        now_s[0] += module.STALLED_S / 10.0
        return not historian.health().storing

    eventually(stalled)
    assert "does not answer" in historian.health().text
    historian.frame(frame_of(0, 0.0))
    began_s = time.monotonic()
    assert not historian.close(0.05)
    assert time.monotonic() - began_s < 2.0
    answers.set()
    assert historian.close()


def test_something_that_cannot_be_stored_is_not_tried_for_ever(tmp_path: Path) -> None:
    with running(tmp_path) as historian:
        historian.event(Event.model_construct(time_s=1.0, kind="k", text="t", data={"object": object()}))
        eventually(lambda: historian.health().events_lost == 1)
        historian.event(Event(time_s=2.0, kind="k", text="after"))
    with History(tmp_path / FILE_NAME) as history:
        assert [event.text for event in history.events(0.0, 1e12)] == ["after"]

"""The runner of the tests: what failed by chance is listed, a fault fails, and what comes and goes does not stay."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.landing import known
from tests.landing.record import Recorded
from tests.landing.second_try import MOST_TRIED, TRIES, tried_again
from tests.landing.witness import STALL_S, Witness

pytestmark = pytest.mark.wires

A, B, FILE = "tests/unit/test_a.py::test_one[x]", "tests/unit/test_a.py::test_two", "tests/unit/test_b.py"
FAULT = "AssertionError: assert 1 == 2"

TESTS = """
import pytest
from pathlib import Path

def test_passes(): pass
def test_fails(): assert 1 == 2, "always"
def test_is_skipped(): pytest.skip("not here")
def test_fails_once():
    seen = Path("seen")
    assert seen.exists() or seen.touch()
@pytest.fixture
def broken(): raise OSError("no port")
def test_cannot_be_set_up(broken): pass
"""


@pytest.mark.parametrize("passing_tries", range(TRIES + 1))
def test_only_what_passes_each_time_it_is_tried_again_is_chance(passing_tries):
    intermittent, failed = tried_again({A: FAULT}, lambda tests, number: number <= passing_tries)
    assert (A in intermittent, A in failed) == ((True, False) if passing_tries == TRIES else (False, True))


def test_a_file_is_tried_whole_where_its_set_up_failed_and_no_import_that_fails_is_chance():
    asked = []

    def passes(tests, number):
        asked.append(tests)
        return True

    intermittent, failed = tried_again({A: FAULT, B: FAULT, FILE: "OSError: no port"}, passes)
    assert asked == TRIES * [[A, B]] + TRIES * [[FILE]] and len(intermittent) == 3 and not failed
    assert tried_again({FILE: "ModuleNotFoundError: No module named 'x'"}, passes)[1]
    many = {f"tests/unit/test_{k}.py::test": FAULT for k in range(MOST_TRIED + 1)}
    assert tried_again(many, passes) == ({}, many)


def test_what_pytest_comes_to_is_on_record_whole_or_as_far_as_it_came(tmp_path):
    (tmp_path / "test_some.py").write_text(TESTS)
    for folder, workers in (("alone", ["-p", "no:xdist"]), ("beside", ["-n", "2"])):
        record = tmp_path / f"{folder}.jsonl"
        (tmp_path / "seen").unlink(missing_ok=True)
        for code, failing in ((1, {"fails", "fails_once"}), (1, {"fails"})):
            command = [sys.executable, "-m", "pytest", "-p", "tests.landing.record", "--record", record, *workers, "."]
            environment = {"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": ""}
            done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
            assert done.returncode == code, done.stdout + done.stderr
            recorded = Recorded.read(record)
            assert set(recorded.failed) == {f"test_some.py::test_{name}" for name in failing} | {"test_some.py"}
            assert recorded.failed["test_some.py"] == "OSError: no port"
            assert "test_some.py::test_passes" in recorded.passed and not recorded.running
            assert recorded.skipped == {"test_some.py::test_is_skipped"}
        lines = record.read_text().splitlines(keepends=True)
        record.write_text("".join(lines[:2]) + lines[2][:9])
        assert Recorded.read(record).running


def test_who_is_intermittent_three_times_in_ten_runs_is_mended_first(tmp_path):
    log = f"noise\nintermittent:\n  {A} ({FAULT} (twice))\n  {FILE} (OSError: no port)\nFAILED {B} (x)\n3 passed\n"
    assert known.rows_of(log) == {A: f"{FAULT} (twice)", FILE: "OSError: no port"}
    kept = tmp_path / "intermittent.jsonl"
    for run in ("1", "2", "2"):
        known.keep(log, run, kept)
    assert known.to_be_mended(kept) == []
    known.keep(log, "3", kept)
    assert known.to_be_mended(kept) == [A, FILE]
    for run in range(8):
        known.keep("nothing failed", f"calm {run}", kept)
    assert known.to_be_mended(kept) == []


def test_a_witness_of_a_machine_that_stands_still_has_seen_it():
    with Witness() as witness:
        blocked_s = time.monotonic() + 4.0 * STALL_S
        held = 10**5
        while time.monotonic() < blocked_s:
            pow(3, held, 10**30000)  # holds the interpreter: no thread of this process wakes meanwhile
        deadline_s = time.monotonic() + 30.0
        while not witness.stalls and time.monotonic() < deadline_s:
            time.sleep(0.01)
    assert witness.stalls and "stalls of 25 ms" in str(witness)

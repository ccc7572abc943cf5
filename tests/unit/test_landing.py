"""The runner of the tests: what failed by chance is listed, a fault fails, and what comes and goes does not stay."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.landing import known
from tests.landing.record import Recorded
from tests.landing.second_try import MOST_TRIED, TRIES, tried_again
from tests.landing.stages import STAGES
from tests.landing.witness import STALL_S, Witness

pytestmark = pytest.mark.wires

A, B, FILE = "tests/unit/test_a.py::test_one[x]", "tests/unit/test_a.py::test_two", "tests/unit/test_b.py"
C = f"{FILE}::test_three"
FAULT = "AssertionError: assert 1 == 2"
WHOLE = "1 failed, 3 passed, 0 skipped in 9 s\n"

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
    intermittent, failed = tried_again({A: FAULT}, (), lambda asked, tests, number: number <= passing_tries)
    assert (A in intermittent, A in failed) == ((True, False) if passing_tries == TRIES else (False, True))


def test_a_file_is_tried_whole_where_its_set_up_failed_and_some_faults_are_never_chance():
    asked_for = []

    def passes(asked, tests, number):
        asked_for.append((asked, tests))
        return True

    intermittent, failed = tried_again({A: FAULT, B: FAULT, C: "OSError: no port"}, {C}, passes)
    assert asked_for == TRIES * [([A, B], [A, B])] + TRIES * [([FILE], [C])] and len(intermittent) == 3 and not failed
    for never in ("ModuleNotFoundError: No module named 'x'", "tests.support.recorder.Unsafe: {'slack': 1}"):
        assert tried_again({FILE: never}, {FILE}, passes) == ({}, {FILE: never})
    many = {f"tests/unit/test_{k}.py::test": FAULT for k in range(MOST_TRIED + 1)}
    assert tried_again(many, (), passes) == ({}, many)
    of_one = {f"{FILE}::test_{k}": "OSError: no port" for k in range(MOST_TRIED + 1)}
    assert tried_again(of_one, of_one, passes) == (of_one, {})


def recorded_of(folder: Path, text: str, *options: str) -> tuple[int, Recorded]:
    """Of a run of pytest over a module with this text: its exit code and what is on record of it."""
    (folder / "test_some.py").write_text(text)
    command = [sys.executable, "-m", "pytest", "-p", "tests.landing.record", "--record", "record.jsonl", *options, "."]
    environment = {"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": ""}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=False)
    return done.returncode, Recorded.read(folder / "record.jsonl")


ALONE, BESIDE = ("-p", "no:xdist"), ("-n", "2", "--max-worker-restart", "1")


@pytest.mark.parametrize("options", [ALONE, BESIDE], ids=["alone", "beside"])
def test_what_pytest_comes_to_is_on_record_whole_or_as_far_as_it_came(tmp_path, options):
    for failing in ({"fails", "fails_once"}, {"fails"}):
        code, recorded = recorded_of(tmp_path, TESTS, *options)
        assert code == 1 and recorded.complete
        assert set(recorded.failed) == {f"test_some.py::test_{name}" for name in failing | {"cannot_be_set_up"}}
        assert recorded.whole == {"test_some.py::test_cannot_be_set_up"}
        assert recorded.failed["test_some.py::test_cannot_be_set_up"] == "OSError: no port"
        assert "test_some.py::test_passes" in recorded.passed
        assert recorded.skipped == {"test_some.py::test_is_skipped"}
    record = tmp_path / "record.jsonl"
    lines = record.read_text().splitlines(keepends=True)
    record.write_text("".join(lines[:2]) + lines[2][:9])
    cut = Recorded.read(record)
    assert cut.running and not cut.complete


@pytest.mark.parametrize("options", [ALONE, BESIDE], ids=["alone", "beside"])
def test_a_run_that_ends_before_its_tests_did_is_not_complete_whatever_its_exit_code(tmp_path, options):
    text = "import os, pytest\n@pytest.mark.parametrize('k', range(20))\ndef test_dies(k):\n    os._exit(0)\n"
    _, recorded = recorded_of(tmp_path, text, *options)
    assert not recorded.complete
    assert recorded.whole == set(recorded.failed)  # a worker that died is told of its test


def test_what_cannot_be_imported_is_told_as_that(tmp_path):
    _, recorded = recorded_of(tmp_path, "import nowhere_to_be_found\n")
    assert recorded.failed == {"test_some.py": "ModuleNotFoundError: No module named 'nowhere_to_be_found'"}


def test_of_what_is_asked_for_each_stage_runs_its_own():
    pure, wires, real_time, system = STAGES
    assert pure.of(["tests/system/test_x.py"]) == () == real_time.of(["tests/unit"])
    assert system.of(["tests"]) == ("tests/system",) == system.of(["./tests/system"])
    assert wires.of(["tests/unit/test_x.py", "tests/safety"]) == ("tests/unit/test_x.py",)


def test_who_is_intermittent_three_times_in_ten_runs_is_mended_first(tmp_path):
    log = f"noise\nintermittent:\n  {A} ({FAULT} (twice))\n  {FILE} (OSError: no port)\nFAILED {B} (x)\n{WHOLE}"
    assert known.rows_of(log) == {A: f"{FAULT} (twice)", FILE: "OSError: no port"}
    kept = tmp_path / "intermittent.jsonl"
    for run in ("1", "2", "2"):
        known.keep(log, run, kept)
    assert known.to_be_mended(kept) == []
    known.keep(log, "3", kept)
    assert known.to_be_mended(kept) == [A, FILE]
    for run in range(8):
        known.keep(WHOLE, f"calm {run}", kept)
    assert known.to_be_mended(kept) == []


def test_what_is_mended_is_counted_anew_and_half_a_log_is_not_kept(tmp_path):
    kept = tmp_path / "intermittent.jsonl"
    with pytest.raises(ValueError, match="whole run"):
        known.keep(f"intermittent:\n  {A} ({FAULT})\n", "1", kept)
    for run in ("1", "2", "3"):
        known.keep(f"intermittent:\n  {A} ({FAULT})\n{WHOLE}", run, kept)
    assert known.to_be_mended(kept) == [A]
    known.mend(A, "3", kept)
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

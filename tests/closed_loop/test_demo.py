"""The demonstration as a user runs it: result and report, an orderly Ctrl-C, and no process left behind."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from gateway.cli.demo_result import DemoResult
from gateway.operator.users import FILE_NAME, UsersFile
from sim_plant.recorder import read_recording
from tests.bench.figures import GOALS

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240)]


def demo(folder: Path, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "gateway.cli", "demo", "--quick", *words, "--out", str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=heed_ctrl_c,
    )


def heed_ctrl_c() -> None:
    """Whoever runs the tests in the background lets them ignore it, and all their children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def until_running(process: subprocess.Popen[str]) -> None:
    """Read its progress until the line is being tensioned or runs."""
    assert process.stdout is not None
    for line in process.stdout:
        if "settling" in line:
            return
    raise AssertionError(f"the demonstration has ended with {process.wait()}")


def left_over(folder: Path) -> list[str]:
    """Command lines of living processes that name this folder."""
    found = []
    for process in Path("/proc").iterdir():
        if process.name.isdigit() and int(process.name) != os.getpid():
            try:
                command = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:
                continue
            if str(folder) in command:
                found.append(command)
    return found


@pytest.mark.long
def test_the_demonstration_runs_both_cases_and_leaves_nothing_behind(tmp_path):
    folder = tmp_path / "a folder with spaces"
    process = demo(folder)
    output, _ = process.communicate(timeout=150)
    assert process.returncode == 0, output
    result = DemoResult.model_validate(json.loads((folder / "result.json").read_text()))
    (configuration,) = result.configurations
    assert [case.name for case in configuration.cases] == ["tension", "velocity"]
    for case in configuration.cases:
        goal = GOALS["wire"][f"ratio_{case.name}"]["value"]
        assert case.ratio_to_stepped <= goal == case.limit_ratio, output
        assert case.tension_min_n > 2.0 and case.tension_max_n < 60.0
    assert not any(result.unsafe_events.values()), result.unsafe_events
    assert result.timing.periods > 3000
    page = (folder / "report.html").read_text()
    assert all(f"{case.rmse_n:.4f}" in page for case in configuration.cases)
    assert "report.html" in output and left_over(folder) == []


@pytest.mark.long
def test_a_line_to_play_with_has_a_report_a_page_and_a_change_and_ends_with_ctrl_c(tmp_path):
    folder = tmp_path / "demo"
    process = demo(folder, "--stay")
    assert process.stdout is not None
    told: list[str] = []
    try:
        for line in process.stdout:
            told.append(line)
            if "--run-dir" in line:
                break
        text = "".join(told)
        assert (folder / "report.html").exists() and (folder / "result.json").exists(), text
        page, password = re.search(r"^page +(\S+)$", text, re.M), re.search(r"for this run: (\S+)$", text, re.M)
        run_folder, waiting = re.search(r"--run-dir (\S+)$", text, re.M), re.search(r"r2rgate approve (\w+)", text)
        assert page and password and run_folder and waiting, text
        assert httpx.get(page[1]).status_code == 200
        assert UsersFile(folder / "data" / FILE_NAME).current().check("engineer", password[1]) == "engineer"
        words = [sys.executable, "-m", "gateway.cli", "approve", waiting[1], "--yes", "--run-dir", run_folder[1]]
        said = subprocess.run(words, capture_output=True, text=True, check=False)
        assert said.returncode == 0 and "probation" in said.stdout, said
    finally:
        os.kill(process.pid, signal.SIGINT)
        ended = process.stdout.read()
        process.stdout.close()
    assert process.wait(30) == 0, ended
    assert left_over(folder) == [] and not Path(run_folder[1]).exists()
    assert "unsafe events at the drives, from beginning to end: 0" in ended


def test_ctrl_c_stops_the_line_and_ends_every_process(tmp_path):
    folder = tmp_path / "demo"
    process = demo(folder)
    until_running(process)
    time.sleep(1.0)  # somewhere in mid-run
    os.kill(process.pid, signal.SIGINT)
    assert process.stdout is not None
    output = process.stdout.read()
    assert process.wait(30) == 130, output
    process.stdout.close()
    assert left_over(folder) == []
    summary = json.loads((folder / "recording" / "summary.json").read_text())
    assert summary["unsafe_total"] == 0
    recording = read_recording(folder / "recording")
    assert recording.of_kind("drive_state") and not recording.of_kind("watchdog")


def test_a_parent_that_is_killed_takes_its_children_with_it(tmp_path):
    folder = tmp_path / "demo"
    process = demo(folder)
    until_running(process)
    process.kill()
    process.wait()
    assert process.stdout is not None
    process.stdout.close()
    deadline_s = time.monotonic() + 25.0  # the loop stops the line before it ends
    while left_over(folder) and time.monotonic() < deadline_s:
        time.sleep(0.1)
    assert left_over(folder) == []

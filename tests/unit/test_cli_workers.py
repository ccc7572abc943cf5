"""However a command ends while processes work for it, nothing is left of them; after Ctrl-C it says so in one line."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue

import pytest

from gateway.cli.background import in_background
from gateway.core.line_template import line_template
from tests.support.patience import PATIENCE_S

STORY = """
import os, sys, time
from gateway.cli.workers import Workers
try:
    with Workers(2) as pool:
        if sys.argv[1] == "at work":
            pool.submit(os.getpid).result()
        working = pool.map(time.sleep, 20 * [600.0])
        print("begun", flush=True)
        list(working)
except KeyboardInterrupt:
    sys.exit(130)
"""
ATTEMPT = re.compile(r"(mpc|lqi) \d+: (J [\d.]+ N2s|not yet: .+)$")
TO_ALL: Callable[[int, int], None] = os.killpg  #: as a terminal does
TO_ONE: Callable[[int, int], None] = os.kill  #: as another program does


@contextmanager
def begun(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A command of its own session. Nothing of it is left, whatever becomes of the test."""
    with subprocess.Popen(
        [sys.executable, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=heed_ctrl_c,
    ) as process:
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def heed_ctrl_c() -> None:
    """Whoever runs the tests in the background lets them ignore it, and all their children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def interrupt(process: subprocess.Popen[str], send: Callable[[int, int], None]) -> tuple[str, str]:
    """What it says from then on: until every process that could say something has ended."""
    send(process.pid, signal.SIGINT)
    return process.communicate(timeout=PATIENCE_S)


@pytest.mark.parametrize("send", [TO_ALL, TO_ONE])
@pytest.mark.parametrize("stage", ["starting", "at work"])
def test_workers_end_with_what_they_work_for(stage: str, send: Callable[[int, int], None]) -> None:
    with begun("-c", STORY, stage) as process:
        assert process.stdout is not None and process.stdout.readline() == "begun\n"
        assert interrupt(process, send) == ("", "")
        assert process.returncode == 130


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize("stage", ["starting", "at work"])
def test_workers_end_with_a_command_that_cannot_end_them(stage: str, number: signal.Signals) -> None:
    with begun("-c", STORY, stage) as process:
        assert process.stdout is not None and process.stdout.readline() == "begun\n"
        process.send_signal(number)
        process.communicate(timeout=PATIENCE_S)  # they all have its standard output, as has what tracks their resources
        assert process.returncode == -number


@pytest.mark.parametrize("send", [TO_ALL, TO_ONE])
def test_an_interrupted_design_says_what_is_kept(send: Callable[[int, int], None], tmp_path: Path) -> None:
    line, out = tmp_path / "line.toml", tmp_path / "c.json"
    line.write_text(line_template(2), encoding="utf-8")
    out.write_text("as before")
    # Each takes minutes; which of the two has its first attempt first is a matter of the machine.
    laws = ("--law", "mpc", "--law", "lqi", "--iterations", "50")
    with begun("-m", "gateway.cli", "design", line, *laws, "--out", out) as process:
        assert process.stderr is not None and ATTEMPT.match(process.stderr.readline())
        said, complained = interrupt(process, send)
    assert process.returncode == 130 and said == ""
    *attempts, last = complained.splitlines()
    assert last == f"interrupted: {out} and its record are as before"
    assert all(ATTEMPT.match(one) for one in attempts)
    assert out.read_text() == "as before" and set(tmp_path.iterdir()) == {line, out}


def test_a_thread_in_the_background_leaves_ctrl_c_to_the_main_one() -> None:
    found: SimpleQueue[set[int]] = SimpleQueue()
    in_background(lambda: found.put(signal.pthread_sigmask(signal.SIG_BLOCK, ()))).join(PATIENCE_S)
    assert signal.SIGINT in found.get(timeout=PATIENCE_S)
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())

"""A child process that never outlives the one that started it, whatever happens to either."""

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PARENT = "R2RGATE_PARENT"
_PR_SET_PDEATHSIG = 1
_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def start(arguments: list[str], log: Path, *, stdout: int | None = None) -> subprocess.Popen[str]:
    """Start `r2rgate ARGUMENTS` in a session of its own, messages to `log`. It gets SIGTERM when this process dies."""
    with log.open("a") as sink:
        return subprocess.Popen(
            [sys.executable, "-m", "gateway.cli", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=sink if stdout is None else stdout,
            stderr=sink,
            text=True,
            start_new_session=True,  # Ctrl-C in the terminal reaches the parent alone, which stops the line in order
            env=os.environ | {_PARENT: str(os.getpid())},
        )


def follow_parent() -> None:
    """In the child: ask the kernel for SIGTERM when the parent dies."""
    parent = os.environ.pop(_PARENT, None)
    if parent is None:
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != int(parent):  # it died before we asked
        sys.exit(1)


def be_punctual(priority: int) -> None:
    """Real-time priority for this process, or a sentence on standard error about what is missing."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        print("no real-time priority: this process may be late on a busy computer", file=sys.stderr)


def end(child: subprocess.Popen[str], patience_s: float) -> int:
    """SIGTERM, and SIGKILL after `patience_s`. Returns the exit code."""
    if child.poll() is None:
        child.terminate()
        try:
            child.wait(patience_s)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
    return child.returncode


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Neither Ctrl-C nor a terminal that is closed ends what is being ended in order. In the main thread."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in _ENDS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def end_as_by_ctrl_c() -> None:
    """SIGTERM, and SIGHUP of a terminal that is closed, raise KeyboardInterrupt from now on. In the main thread."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)

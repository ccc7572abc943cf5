"""A slice: a line armed and started afresh, and so many seconds of its loop, as the loop's own frames tell them."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gateway.cli.children import ChildFailed
from tests.bench.lines import UDP_MULTICAST, WIRINGS, CanWire
from tests.bench.live import LineStalls, LiveLine, why

Disturbance = Literal["none", "busy core", "full-speed reader"]
FIELDS = ("sequence", "lateness_s", "cycle_s", "missed")
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Slice:
    lateness_us: NDArray[np.float64]
    cycle_us: NDArray[np.float64]
    missed: int  #: periods skipped within the slice
    lost_frames: int  #: cycles of which the gateway has no frame
    first_cycle_s: float  #: from the start of the process to the first cycle's due time
    rss_mb: float  #: of the loop process, as the two below
    peak_rss_mb: float
    helpers_rss_mb: float  #: of its child processes together
    cpu_share: float  #: of one processor
    answers: int  #: had by the full-speed reader
    unsafe: list[str]  #: what the recorder has seen
    stops: list[str]  #: why the line did not come to run at once, or stopped


class NotRun(Exception):
    """A line did not come to run here; the text says which, and why."""


def loop_slice(
    kind: str, period_s: float, for_s: float, can: CanWire = UDP_MULTICAST, disturbance: Disturbance = "none"
) -> Slice:
    """Run a line of that kind. Raises NotRun, and SystemExit where a loop gets no real-time priority."""
    with tempfile.TemporaryDirectory() as folder, LiveLine(Path(folder), period_s) as line:
        try:
            line.start(WIRINGS[kind], can)
            _require_punctual(line.children.pid("loop"))
            line.run()
            return _measure(line, for_s, disturbance)
        except (ChildFailed, LineStalls, TimeoutError) as error:
            raise NotRun(f"{kind}, {1 / period_s:g} Hz: {error}") from error


def _measure(line: LiveLine, for_s: float, disturbance: Disturbance) -> Slice:
    pid = line.children.pid("loop")
    with disturbed(disturbance, line.children.run_folder) as other:
        begin_s, begin_cpu_s = time.monotonic(), cpu_s(pid)
        time.sleep(for_s)
        end_s, end_cpu_s = time.monotonic(), cpu_s(pid)
        answers = _answers(other) if other is not None and disturbance == "full-speed reader" else 0
    memory = [memory_mb(pid, "VmRSS"), memory_mb(pid, "VmHWM")]
    helpers_mb = sum(memory_mb(child, "VmRSS") for child in _children(pid))
    status = line.status()
    if status is None or status.loop.state != "RUN":
        line.stops.append(f"not in RUN at the end of the slice: {'no status' if status is None else why(status)}")
    line.stop()
    for name in ("loop", "gateway", "sim"):
        line.children.end(name)
    all_frames = line.history(line.loop_started_s, end_s, *FIELDS)
    inside = all_frames["time_s"] >= begin_s
    frames: dict[str, Any] = {name: values[inside] for name, values in all_frames.items()}
    return Slice(
        lateness_us=1e6 * frames["lateness_s"].astype(float),
        cycle_us=1e6 * frames["cycle_s"].astype(float),
        missed=int(frames["missed"][-1] - frames["missed"][0]),
        lost_frames=int(frames["sequence"][-1] - frames["sequence"][0]) + 1 - len(frames["sequence"]),
        first_cycle_s=_first_cycle_s(all_frames, line),
        rss_mb=memory[0],
        peak_rss_mb=memory[1],
        helpers_rss_mb=helpers_mb,
        cpu_share=(end_cpu_s - begin_cpu_s) / (end_s - begin_s),
        answers=answers,
        unsafe=line.unsafe(),
        stops=line.stops,
    )


def _first_cycle_s(frames: dict[str, Any], line: LiveLine) -> float:
    """The first frame may have been lost: it is as many periods before the first one known as its numbers say."""
    before = int(frames["sequence"][0]) - 1 + int(frames["missed"][0])
    return float(frames["time_s"][0]) - before * line.period_s - line.loop_started_s


@contextmanager
def disturbed(disturbance: Disturbance, run_folder: Path) -> Iterator[subprocess.Popen[str] | None]:
    """Another process in the loop's way: one that keeps the loop's own processor busy, or a reader at full speed."""
    if disturbance == "none":
        yield None
        return
    command = {
        "busy core": [sys.executable, "-c", "while True: pass"],
        "full-speed reader": [sys.executable, "-m", "tests.bench.reader", str(run_folder)],
    }[disturbance]
    other = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        if disturbance == "busy core":
            os.sched_setaffinity(other.pid, {loop_cpu()})
        yield other
    finally:
        other.terminate()
        other.wait()
        assert other.stdout is not None
        other.stdout.close()


def _answers(reader: subprocess.Popen[str]) -> int:
    """How many answers a reader has had. Raises SystemExit when it has failed."""
    reader.terminate()
    assert reader.stdout is not None
    told = reader.stdout.read()
    if reader.wait() != 0:
        raise SystemExit("the second reader of the gateway has failed")
    return int(told)


def loop_cpu() -> int:
    """The processor that a loop takes when its line's file names none."""
    return sorted(os.sched_getaffinity(0))[-1]


def _require_punctual(pid: int) -> None:
    fifo = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    if not fifo or os.sched_getaffinity(pid) != {loop_cpu()}:
        raise SystemExit("the loop has no real-time priority and processor of its own: run as root, or with rtprio")


def memory_mb(pid: int, key: str) -> float:
    rows = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(row.split()[1]) for row in rows if row.startswith(f"{key}:")) / 1024


def _stat(pid: int | str) -> list[str]:
    """The fields of /proc/PID/stat behind the name, from the third of proc(5) on."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def cpu_s(pid: int) -> float:
    user, system = _stat(pid)[11:13]
    return (int(user) + int(system)) / TICKS_PER_S


def _children(pid: int) -> list[int]:
    children: list[int] = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended meanwhile
            if _stat(folder.name)[1] == str(pid):
                children.append(int(folder.name))
    return children

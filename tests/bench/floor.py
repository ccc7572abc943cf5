"""The floor of this machine: how late `cyclictest` (rt-tests) wakes, with the loop's priority, period and processor."""

import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

HIGHEST_US = 100_000  #: of the histogram; later wake-ups count as the latest
INSTALL = ("apt-get", "install", "-y", "--no-install-recommends", "rt-tests")


def require_cyclictest() -> None:
    """Install it where it is missing. Raises SystemExit with what to do when that cannot be."""
    if shutil.which("cyclictest"):
        return
    if os.geteuid() != 0:
        raise SystemExit(f"the floor is measured by cyclictest, which is not here; as root: {' '.join(INSTALL)}")
    print("installing rt-tests (cyclictest)", flush=True)
    for command in (INSTALL, ("apt-get", "update"), INSTALL):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if shutil.which("cyclictest"):
            return
    raise SystemExit(f"rt-tests cannot be installed: {done.stderr.strip()[-500:]}")


def lateness_us(cpu: int, priority: int, period_s: float, for_s: float) -> NDArray[np.int64]:
    """Wake-up latencies in microseconds, in no order. Raises SystemExit when cyclictest is not permitted."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "floor.json"
        done = subprocess.run(
            ["cyclictest", "-q", "-m", "-p", str(priority), "-t", "1", "-a", str(cpu), "-i", str(round(1e6 * period_s)),
             "-D", str(max(1, round(for_s))), "-h", str(HIGHEST_US), f"--json={path}"],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
        if done.returncode != 0 or not path.is_file():
            raise SystemExit(f"cyclictest has failed ({done.returncode}): {done.stderr.strip()[-500:]}")
        thread = json.loads(path.read_text())["thread"]["0"]
    latencies = np.array([int(latency) for latency in thread["histogram"]], dtype=np.int64)
    counts = np.array(list(thread["histogram"].values()), dtype=np.int64)
    beyond = thread["cycles"] - int(counts.sum())
    return np.concatenate([np.repeat(latencies, counts), np.full(max(0, beyond), thread["max"], dtype=np.int64)])


def overruns(lateness: NDArray[np.int64], period_s: float) -> int:
    """Periods that went by unused, counted as the loop counts its own: a wake-up 2.5 periods late has missed two."""
    return int((lateness // round(1e6 * period_s)).sum())

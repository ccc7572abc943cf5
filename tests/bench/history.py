"""What the history costs: bytes to the disk for each byte of data, its log beside readers, and memory.

A writer stores frames of 6 spans at 100 Hz as a gateway does, as fast as it goes, in a process of its own. Bytes are
those of the kernel's account of it (/proc/self/io): handed over by write calls, and those that dirtied a page and were
not taken back before they reached the disk. In a second part, readers stay in the middle of a walk meanwhile.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import apsw
import numpy as np

from gateway.core.line import History as Keep
from gateway.core.telemetry import FLOAT_FIELDS, frame_dtype
from gateway.supervisor.historian import FLUSH_S
from gateway.supervisor.history import History
from gateway.supervisor.retention import retention_of
from gateway.supervisor.store import Run
from gateway.supervisor.writer import BLOB_S, Writer
from tests.bench.figures import Bench

SPANS, PERIOD_S = 6, 0.01
WARM_MINUTES = 10  #: until SQLite's page cache is full
SEED = 1


class _Line:
    """Frames with noise on every reading, of which 2.9 of 4 bytes do not pack."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.pace_s = 0.0  #: waited before each store
        self.writer = Writer(path, Run("bench", 0.0, 0.0, "site", "line", SPANS), 0)
        self._rng = np.random.default_rng(SEED)
        self._count = 0
        self._keep = retention_of(Keep())

    def runs(self, minutes: float) -> int:
        """Returns the longest that the log was, in bytes."""
        largest = 0
        for _ in range(round(minutes * 60.0 / FLUSH_S)):
            time.sleep(self.pace_s)
            self.writer.store(self._frames(round(FLUSH_S / PERIOD_S)), [], 0.0)
            if self.writer.gathered_s() >= BLOB_S:
                self.writer.pack()
                self.writer.expire(self._keep, PERIOD_S * self._count)
                largest = max(largest, self.log_bytes())
        return largest

    def log_bytes(self) -> int:
        return self.path.with_name(self.path.name + "-wal").stat().st_size

    def _frames(self, count: int) -> list[bytes]:
        rows = np.zeros(count, frame_dtype(SPANS))
        rows["sequence"] = self._count + np.arange(count)
        rows["time_s"] = PERIOD_S * rows["sequence"]
        for name in FLOAT_FIELDS[:4]:
            rows[name] = self._rng.normal(20.0, 1.0, (count, SPANS))
        self._count += count
        return [row.tobytes() for row in rows]


def _written() -> tuple[int, int]:
    """Bytes handed to the kernel, and those of them that it has written or will."""
    found = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(found["wchar"]), int(found["write_bytes"]) - int(found["cancelled_write_bytes"])


def _resident_mb() -> float:
    row = next(row for row in Path("/proc/self/status").read_text().splitlines() if row.startswith("VmRSS"))
    return int(row.split()[1]) / 1024


def _measured(folder: Path, minutes: int, *, real_time: bool) -> dict[str, float]:
    line = _Line(folder / "history.sqlite")
    line.runs(WARM_MINUTES)
    line.pace_s = FLUSH_S if real_time else 0.0
    (given, disk), resident_mb = _written(), _resident_mb()
    line.runs(minutes)
    (given_after, disk_after), grown_mb = _written(), _resident_mb() - resident_mb
    line.writer.close()
    connection = apsw.Connection(str(line.path))
    data = connection.execute("SELECT sum(length(data)) FROM field").get / (WARM_MINUTES + minutes)
    connection.close()
    return {
        "data_mb_per_min": data / 1e6,
        "written_mb_per_min": (given_after - given) / minutes / 1e6,
        "disk_mb_per_min": (disk_after - disk) / minutes / 1e6,
        "disk_bytes_per_byte": (disk_after - disk) / minutes / data,
        "resident_growth_mb": grown_mb,
    }


def _beside_readers(folder: Path, minutes: int) -> dict[str, float]:
    line = _Line(folder / "history.sqlite")
    line.runs(2)
    with History(line.path) as history:
        walk = history.walk_wall(0.0, 1e9, ["tension_n"])
        next(walk)
        next(walk)
        beside_ours = line.runs(minutes)
        walk.close()
    other = apsw.Connection(str(line.path))
    other.execute("BEGIN; SELECT count(*) FROM blob").fetchall()
    beside_another = line.runs(minutes)
    other.close()
    line.runs(2)
    after = line.log_bytes()
    line.writer.close()
    return {
        "log_mb_beside_a_reader": beside_ours / 1e6,
        "log_mb_beside_another_program": beside_another / 1e6,
        "log_mb_after_it": after / 1e6,
    }


_UNITS = {"disk_bytes_per_byte": "-", "resident_growth_mb": "MB"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=int, default=60, help="of the line's time, for each part")
    parser.add_argument("--part", choices=("bytes", "readers"), help=argparse.SUPPRESS)
    parser.add_argument("--real-time", action="store_true", help="so that the kernel may write the tail meanwhile")
    asked = parser.parse_args()
    if asked.part:
        with tempfile.TemporaryDirectory(dir=".") as name:  # not /tmp, which may be memory
            folder, minutes = Path(name), asked.minutes
            beside = asked.part == "readers"
            found = (
                _beside_readers(folder, minutes) if beside else _measured(folder, minutes, real_time=asked.real_time)
            )
            print(json.dumps(found))
        return
    given = sys.argv[1:]
    said = " ".join(["make bench-history", *([f'ARGS="{" ".join(given)}"'] if given else [])])
    bench = Bench("history", seeds=[SEED], libraries=("numpy", "apsw"), command=said)
    for part in ("bytes", "readers"):
        command = [sys.executable, "-m", "tests.bench.history", *given, "--part", part]
        told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        for name, value in json.loads(told).items():
            unit = _UNITS.get(name, "MB/min" if name.endswith("per_min") else "MB")
            bench.figure(name, value, unit, asked.minutes)
    bench.finish()


if __name__ == "__main__":
    main()

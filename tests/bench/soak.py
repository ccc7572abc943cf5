"""`make bench-soak`: a line on three wires for an hour, with something going wrong every 20 to 60 seconds.

Drives on CANopen, load cells on Modbus TCP, line PLC on OPC UA; loop, gateway and simulated line in their own
processes. What stops the line is followed by what a person would do: the cause is mended, the line armed and started.

The slope of the memory is that of Theil and Sen (the median of the slopes of all pairs of samples, which one restart
of a device does not move) with its 95 % interval, over all but the first 10 minutes, or the first third of a shorter
run. A run shorter than half an hour shows that the bench works, not that the memory is flat.
"""

import argparse
import json
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from rich.progress import Progress
from scipy.stats import theilslopes

from tests.bench.faults_wire import ControlledLine
from tests.bench.figures import Bench
from tests.bench.lines import WIRINGS
from tests.bench.live import LineStalls

PERIOD_S = 0.01
SAMPLE_S = 5.0
LOOK_S = 0.5
PAUSE_S = (20.0, 60.0)  #: from one fault to the next
WARM_UP_S = 600.0
MINUTE_S = 60.0
PROCESSES = ("loop", "gateway", "sim")
FAULTS = (
    "drive {roller} drop direction=from-device probability=0.2 for 2",
    "drive {roller} mute for 0.2",
    "drive {roller} drive-fault code=0x3210",
    "drive {roller} restart",
    "drive {roller} heartbeat-lost for 0.5",
    "drive {roller} sto for 0.2",
    "drive {roller} encoder-jump delta_m_per_s=0.8 for 0.01",
    "canopen mute for 0.1",
    "canopen duplicate probability=0.1 for 2",
    "load-cell {span} nan for 0.01",
    "load-cell {span} nan for 0.2",
    "load-cell {span} stuck for 2",
    "load-cell {span} spike height_n=3",
    "load-cell {span} delay delay_s=0.012 probability=0.05 for 2",
    "load-cell {span} wrong-function count=1",
    "modbus-tcp disconnect for 0.5",
    "plc permissive-lost for 0.3",
    "plc emergency-stop for 1",
    "plc drop direction=from-device probability=0.1 for 1",
    "opcua disconnect for 0.5",
    "plc freeze for 0.3",
)


@dataclass(frozen=True, slots=True)
class Sample:
    """A look at the processes. Memory in kB, over a process and all that it has started."""

    time_s: float  #: monotonic
    rss_kb: dict[str, int]
    descriptors: dict[str, int]
    threads: dict[str, int]


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench-soak", description="A line for an hour, with faults.")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    bench = Bench("soak", [arguments.seed])
    with tempfile.TemporaryDirectory() as folder:
        with ControlledLine(Path(folder), WIRINGS["mixed"], arguments.seed, PERIOD_S) as line:
            samples, story = _live(line, Random(arguments.seed), 60.0 * arguments.minutes)
            began_s, ended_s = samples[0].time_s, samples[-1].time_s
            line.live.children.end("loop")
            line.live.children.end("gateway")
            history = line.live.history(began_s, ended_s, "time_s", "lateness_s")
            line.live.children.end("sim")
            summary = json.loads((Path(folder) / "recording" / "summary.json").read_text())
    _figures(bench, samples, history, summary["unsafe_events"])
    bench.tables["story"] = story
    bench.tables["unsafe"] = summary["counts"]
    bench.finish()


def _live(line: ControlledLine, dice: Random, for_s: float) -> tuple[list[Sample], list[str]]:
    """Run, break and mend the line. Returns the samples, and what happened."""
    story: list[str] = []
    samples: list[Sample] = []
    line.live.run()
    began_s = time.monotonic()
    fault_s = began_s + dice.uniform(*PAUSE_S)
    with Progress() as progress:
        bar = progress.add_task("soak", total=for_s)
        while (now_s := time.monotonic()) < began_s + for_s:
            if not samples or now_s >= samples[-1].time_s + SAMPLE_S:
                samples.append(_sample(line, now_s))
            if now_s >= fault_s:
                story.append(_inject(line, dice, now_s - began_s))
                fault_s = now_s + dice.uniform(*PAUSE_S)
            story += _mend(line, now_s - began_s)
            progress.update(bar, completed=now_s - began_s)
            time.sleep(LOOK_S)
    return samples, story


def _inject(line: ControlledLine, dice: Random, at_s: float) -> str:
    n = line.live.line.n
    fault = dice.choice(FAULTS).format(roller=dice.randint(1, n), span=dice.randint(1, n))
    try:
        line.inject(fault)
    except ValueError as refused:  # the same is there already
        return f"{at_s:.0f} s: {refused}"
    return f"{at_s:.0f} s: {fault}"


def _mend(line: ControlledLine, at_s: float) -> list[str]:
    """What an operator does about a line that has come to rest."""
    status = line.live.status()
    if status is None or status.loop.state != "STOP" or any(span.torque_nm for span in status.spans):
        return []
    line.clear()
    with suppress(LineStalls):
        line.live.run()
        return [f"{at_s:.0f} s: mended, armed and started"]
    return [f"{at_s:.0f} s: it does not start yet: {'; '.join(line.live.stops[-2:])}"]


def _sample(line: ControlledLine, now_s: float) -> Sample:
    pids = {name: _family(line.live.children.pid(name)) for name in PROCESSES}
    return Sample(
        now_s,
        {name: sum(_status(pid, "VmRSS") for pid in family) for name, family in pids.items()},
        {name: sum(_descriptors(pid) for pid in family) for name, family in pids.items()},
        {name: sum(_status(pid, "Threads") for pid in family) for name, family in pids.items()},
    )


def _family(pid: int) -> list[int]:
    """A process and all below it."""
    family = [pid]
    for member in family:
        for task in Path(f"/proc/{member}/task").glob("*/children"):
            with suppress(OSError):
                family += [int(child) for child in task.read_text().split()]
    return family


def _status(pid: int, key: str) -> int:
    """A number of /proc/PID/status; 0 of a process that has just gone."""
    with suppress(OSError):
        for row in Path(f"/proc/{pid}/status").read_text().splitlines():
            if row.startswith(key + ":"):
                return int(row.split()[1])
    return 0


def _descriptors(pid: int) -> int:
    with suppress(OSError):
        return len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return 0


def _figures(bench: Bench, samples: list[Sample], history: dict[str, Any], unsafe: dict[str, int]) -> None:
    began_s, ended_s = samples[0].time_s, samples[-1].time_s
    warm_s = began_s + min(WARM_UP_S, (ended_s - began_s) / 3)
    warm = [sample for sample in samples if sample.time_s >= warm_s]
    hours = [sample.time_s / 3600.0 for sample in warm]
    for name in PROCESSES:
        slope, _, low, high = theilslopes([sample.rss_kb[name] / 1024.0 for sample in warm], hours, 0.95)
        bench.figure(f"{name}_rss_slope_mb_per_h", float(slope), "MB/h", len(warm))
        bench.tables[f"{name} memory"] = {
            "slope_95_mb_per_h": [float(low), float(high)], "rss_mb": samples[-1].rss_kb[name] / 1024.0,
            "descriptors": samples[-1].descriptors[name], "threads": samples[-1].threads[name],
        }  # fmt: skip
    third = max(1, len(samples) // 3)
    most = [max(sum(s.descriptors.values()) for s in part) for part in (samples[:third], samples[-third:])]
    bench.figure("descriptors_grown", most[1] - most[0], "", len(samples))
    minutes = _p99_per_minute_us(history, began_s)
    third = max(1, len(minutes) // 3)
    ratio = float(np.median(minutes[-third:]) / np.median(minutes[:third]))
    bench.figure("lateness_p99_ratio", ratio, "x first third", len(minutes))
    bench.figure("lateness_p99_us", float(np.median(minutes)), "us", len(minutes))
    bench.tables["lateness p99 per minute, us"] = [round(value, 1) for value in minutes]
    torque = sum(count for kind, count in unsafe.items() if kind.startswith("torque"))
    bench.figure("unsafe_torque_events", torque, "", len(samples))
    bench.figure("minutes", (ended_s - began_s) / MINUTE_S, "min", len(samples))


def _p99_per_minute_us(history: dict[str, Any], began_s: float) -> list[float]:
    minute = ((np.asarray(history["time_s"]) - began_s) // MINUTE_S).astype(int)
    lateness_us = 1e6 * np.asarray(history["lateness_s"])
    return [float(np.percentile(lateness_us[minute == k], 99)) for k in np.unique(minute)]


if __name__ == "__main__":
    main()

"""`make bench-soak`: a line on three wires for an hour, with something going wrong every 20 to 60 seconds.

Drives on CANopen, load cells on Modbus TCP, line PLC on OPC UA (`--wiring demo`: on Modbus TCP, too); loop, gateway,
operator and simulated line in their own processes. What stops the line is followed by what a person would do: the
cause is mended, the line armed and started.

Before that it runs with nothing going wrong: a warm-up of `--warm-up` minutes, then `--rest` minutes. The warm-up
counts for no slope, nor do the first 10 minutes with faults, or the first third of a shorter run; see soak_memory for
why. A run shorter than half an hour shows that the bench works, not that the memory is flat; with `--storm` something
goes wrong every 2 to 4 seconds, and ten minutes show what a fault leaves behind. Memory is read in steps of 4 kB, so
that 10 minutes of rest tell slopes from 0.02 MB/h on. Writes out/bench/soak.json, or soak-storm.json.
"""

import argparse
import json
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from rich.progress import Progress

from gateway.cli.children import free_tcp_ports
from gateway.core.line import Operator
from tests.bench.faults_wire import ControlledLine
from tests.bench.figures import Bench
from tests.bench.lines import WIRINGS
from tests.bench.live import LineStalls, LiveLine
from tests.bench.soak_memory import Sample, grown_kb, memory_figures, most_descriptors, take_sample

PERIOD_S = 0.01
SAMPLE_S = 5.0
LOOK_S = 0.5
PAUSE_S, STORM_PAUSE_S = (20.0, 60.0), (2.0, 4.0)  #: from one fault to the next
WARM_UP_S = 600.0
MINUTE_S = 60.0
OPERATOR_S = 60.0  #: until its page is there
PROCESSES = ("loop", "gateway", "operator", "sim")
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


@dataclass(slots=True)
class Soak:
    """What was seen and done."""

    quiet: list[Sample] = field(default_factory=list)  #: nothing goes wrong
    broken: list[Sample] = field(default_factory=list)
    faults: int = 0
    story: list[str] = field(default_factory=list)


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench-soak", description="A line for an hour, with faults.")
    parser.add_argument("--minutes", type=float, default=60.0, help="with faults")
    parser.add_argument("--warm-up", type=float, default=10.0, help="minutes without faults that count for nothing")
    parser.add_argument("--rest", type=float, default=10.0, help="minutes without faults after it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--storm", action="store_true", help="a fault every few seconds")
    parser.add_argument("--wiring", choices=("mixed", "demo"), default="mixed")
    arguments = parser.parse_args()
    whole = "soak-storm" if arguments.storm else "soak"
    name = whole if arguments.wiring == "mixed" else f"{whole}-{arguments.wiring}"  # which has no OPC UA worker
    bench = Bench(name, [arguments.seed], command="make bench-soak", goals_of=whole)
    wiring = WIRINGS[arguments.wiring]
    faults = [fault for fault in FAULTS if wiring.uses("opcua") or not fault.startswith("opcua")]
    dice, for_s = Random(arguments.seed), MINUTE_S * arguments.minutes
    with tempfile.TemporaryDirectory() as folder:
        with ControlledLine(Path(folder), wiring, arguments.seed, PERIOD_S) as line:
            _start_operator(line.live)
            soak = Soak()
            line.live.run()
            _rest(line, soak, MINUTE_S * (arguments.warm_up + arguments.rest))
            _break(line, soak, faults, dice, STORM_PAUSE_S if arguments.storm else PAUSE_S, for_s)
            line.live.children.end("loop")
            line.live.children.end("gateway")
            began_s, ended_s = soak.broken[0].time_s, soak.broken[-1].time_s
            history = line.live.history(began_s, ended_s, "time_s", "lateness_s", "cycle_s")
            line.live.children.end("sim")
            summary = json.loads((Path(folder) / "recording" / "summary.json").read_text())
    quiet = _parted(soak.quiet, MINUTE_S * arguments.warm_up)
    broken = _parted(soak.broken, min(WARM_UP_S, for_s / 3))
    memory_figures(bench, quiet[1], broken[1])
    bench.tables["grown in the warm-up, kB"] = {"at rest": grown_kb(quiet[0]), "with faults": grown_kb(broken[0])}
    _figures(bench, soak, history, summary["unsafe_events"])
    bench.tables["arguments"] = vars(arguments)
    bench.tables["story"] = soak.story
    bench.tables["unsafe"] = summary["counts"]
    bench.finish()


def _start_operator(live: LiveLine) -> None:
    """Its page alone, on a free port: for OPC UA it would need certificates."""
    text = (live.folder / "line.toml").read_text(encoding="utf-8")
    usual, (port,) = f'# page = "{Operator().page}"', free_tcp_ports(1)
    if usual not in text:
        raise LineStalls(f"the line's file has no {usual} any more")
    file = live.folder / "operator.toml"
    file.write_text(text.replace(usual, f'page = "http://127.0.0.1:{port}"'), encoding="utf-8")
    children = live.children
    children.start("operator", file, "--run-dir", children.run_folder, "--data-dir", live.folder / "data")
    given_up_s = time.monotonic() + OPERATOR_S
    while f"127.0.0.1:{port}" not in children.log("operator").read_text(encoding="utf-8"):
        children.check()
        if time.monotonic() > given_up_s:
            raise LineStalls(children.story("operator"))
        time.sleep(LOOK_S)


def _rest(line: ControlledLine, soak: Soak, for_s: float) -> None:
    """Look on while the line runs and nothing is done to it."""
    began_s = time.monotonic()
    with Progress() as progress:
        bar = progress.add_task("rest", total=for_s)
        while (now_s := time.monotonic()) < began_s + for_s:
            _sample(line, soak, soak.quiet, now_s)
            soak.story += _mend(line, now_s - began_s - for_s)
            progress.update(bar, completed=now_s - began_s)
            time.sleep(LOOK_S)


def _break(
    line: ControlledLine, soak: Soak, faults: list[str], dice: Random, pause_s: tuple[float, float], for_s: float
) -> None:
    """Break and mend the line, again and again."""
    began_s = time.monotonic()
    fault_s = began_s + dice.uniform(*pause_s)
    with Progress() as progress:
        bar = progress.add_task("soak", total=for_s)
        while (now_s := time.monotonic()) < began_s + for_s:
            _sample(line, soak, soak.broken, now_s)
            if now_s >= fault_s:
                _inject(line, soak, faults, dice, now_s - began_s)
                fault_s = now_s + dice.uniform(*pause_s)
            soak.story += _mend(line, now_s - began_s)
            progress.update(bar, completed=now_s - began_s)
            time.sleep(LOOK_S)


def _sample(line: ControlledLine, soak: Soak, samples: list[Sample], now_s: float) -> None:
    """When it is time for one."""
    if not samples or now_s >= samples[-1].time_s + SAMPLE_S:
        pids = {name: line.live.children.pid(name) for name in PROCESSES}
        samples.append(take_sample(pids, now_s, soak.faults))


def _inject(line: ControlledLine, soak: Soak, faults: list[str], dice: Random, at_s: float) -> None:
    n = line.live.line.n
    fault = dice.choice(faults).format(roller=dice.randint(1, n), span=dice.randint(1, n))
    try:
        line.inject(fault)
    except ValueError as refused:  # the same is there already
        soak.story.append(f"{at_s:.0f} s: {refused}")
    else:
        soak.faults += 1
        soak.story.append(f"{at_s:.0f} s: {fault}")


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


def _figures(bench: Bench, soak: Soak, history: dict[str, Any], unsafe: dict[str, int]) -> None:
    samples = soak.broken
    third = max(1, len(samples) // 3)
    grown = most_descriptors(samples[-third:]) - most_descriptors(samples[:third])
    bench.figure("descriptors_grown", grown, "", len(samples))
    began_s = samples[0].time_s
    for name, field_name, percentile in (("lateness_p99", "lateness_s", 99), ("cycle_p50", "cycle_s", 50)):
        minutes = _per_minute_us(history, field_name, percentile, began_s)
        third = max(1, len(minutes) // 3)
        ratio = float(np.median(minutes[-third:]) / np.median(minutes[:third]))
        bench.figure(f"{name}_ratio", ratio, "x first third", len(minutes))
        bench.figure(f"{name}_us", float(np.median(minutes)), "us", len(minutes))
        bench.tables[f"{name.replace('_', ' ')} per minute, us"] = [round(value, 1) for value in minutes]
    torque = sum(count for kind, count in unsafe.items() if kind.startswith("torque"))
    bench.figure("unsafe_torque_events", torque, "", len(samples))
    bench.figure("faults_per_h", 3600.0 * soak.faults / (samples[-1].time_s - began_s), "", soak.faults)
    bench.figure("minutes", (samples[-1].time_s - began_s) / MINUTE_S, "min", len(samples))


def _parted(samples: list[Sample], warm_s: float) -> tuple[list[Sample], list[Sample]]:
    """The warm-up, and what comes after it."""
    warm = [sample for sample in samples if sample.time_s < samples[0].time_s + warm_s]
    return warm, samples[len(warm) :]


def _per_minute_us(history: dict[str, Any], name: str, percentile: float, began_s: float) -> list[float]:
    minute = ((np.asarray(history["time_s"]) - began_s) // MINUTE_S).astype(int)
    value_us = 1e6 * np.asarray(history[name])
    return [float(np.percentile(value_us[minute == k], percentile)) for k in np.unique(minute)]


if __name__ == "__main__":
    main()

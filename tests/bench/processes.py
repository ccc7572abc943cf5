"""`make bench-processes`: processes killed in mid-run, and how long the drives went on; the recorder is the judge."""

import tempfile
import time
from pathlib import Path

import numpy as np

from gateway.core.messages import Stop
from tests.bench.figures import Bench
from tests.closed_loop.wire import WireLine, heard, silent_periods_until_ramp

KILLS = 10
PERIOD_S = 0.01


def main() -> None:
    bench = Bench("processes", list(range(KILLS)))
    loop = [kill_loop(seed) for seed in range(KILLS)]
    silence, zero, unsafe = zip(*loop, strict=True)
    bench.figure("loop_kill_last_command_to_torque_off_ms", 1e3 * max(silence), "ms", KILLS)
    bench.figure("loop_kill_to_torque_off_p50_ms", 1e3 * float(np.median(zero)), "ms", KILLS)
    bench.figure("loop_kill_to_torque_off_ms", 1e3 * max(zero), "ms", KILLS)
    gateway = [kill_gateway(seed) for seed in range(KILLS // 2)]
    bench.figure("gateway_kill_longest_command_gap_ms", 1e3 * max(gap for gap, _ in gateway), "ms", len(gateway))
    sim = [kill_sim(seed) for seed in range(KILLS // 2)]
    bench.figure("sim_kill_silent_periods_until_ramp", max(sim), "periods", len(sim))
    bench.figure("unsafe_events", sum(unsafe) + sum(count for _, count in gateway), "", KILLS + len(gateway))
    bench.finish()


def kill_loop(seed: int) -> tuple[float, float, int]:
    """Seconds from the last command, and from the kill, to zero torque at every drive; unsafe events."""
    with tempfile.TemporaryDirectory() as folder, WireLine(Path(folder), seed) as wire:
        wire.run()
        killed_s = wire.kill("loop")
        wire.children.end("loop")
        wire.wait(lambda status: not status.loop.running)
        recording = wire.recording()
        last_command_s = max(event["time_s"] for event in recording.of_kind("command"))
        pulling = recording.time_s[recording.torque_nm.any(axis=1)]
        return pulling[-1] - last_command_s, pulling[-1] - killed_s, sum(wire.unsafe().values())


def kill_gateway(seed: int) -> tuple[float, int]:
    """The longest pause between two commands to a drive in the second after the kill; unsafe events."""
    with tempfile.TemporaryDirectory() as folder, WireLine(Path(folder), seed) as wire:
        wire.run()
        killed_s = wire.kill("gateway")
        wire.children.end("gateway")
        time.sleep(1.0)  # the line runs alone
        assert wire.order(Stop()).ok
        wire.wait_at_rest()
        recording = wire.recording()
        at_s = [event["time_s"] for event in recording.of_kind("command") if event["roller"] == 1]
        after = [time_s for time_s in at_s if killed_s - 0.05 <= time_s <= killed_s + 1.0]
        return float(np.diff(after).max()), sum(wire.unsafe().values())


def kill_sim(seed: int) -> int:
    """SYNCs without an answer until the torque commands begin to ramp to zero, seen on the wire."""
    with tempfile.TemporaryDirectory() as folder, WireLine(Path(folder), seed) as wire:
        wire.run()
        with wire.tap() as bus:
            heard(bus, 0.05)
            wire.kill("sim")
            frames = heard(bus, 0.5)
        wire.wait(lambda status: status.loop.state == "STOP")
        return silent_periods_until_ramp(frames)


if __name__ == "__main__":
    main()

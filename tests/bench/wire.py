"""`make bench-wire`: the demonstration over the wires in real time, both laws, several seeds; what the recorder saw."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from gateway.cli.demo_result import DemoResult
from tests.bench.figures import Bench

SEEDS = [1, 2, 3]
LAWS = ("lqi", "pid")


def main() -> None:
    bench = Bench("wire", SEEDS)
    runs = [run(law, seed) for law in LAWS for seed in SEEDS]
    for law in LAWS:
        of_law = [result.configurations[0] for result in runs if result.configurations[0].law == law]
        for k, name in enumerate(("tension", "velocity")):
            cases = [result.cases[k] for result in of_law]
            suffix = "" if law == "lqi" else f"_{law}"
            bench.figure(f"rmse_{name}{suffix}_n", float(np.mean([c.rmse_n for c in cases])), "N", len(cases))
            worst = max(case.ratio_to_stepped for case in cases)
            bench.figure(f"ratio_{name}{suffix}", worst, "x stepped", len(cases))
    bench.figure("unsafe_events", sum(sum(result.unsafe_events.values()) for result in runs), "", len(runs))
    periods = sum(result.timing.periods for result in runs)
    bench.figure("missed_periods", sum(result.timing.missed for result in runs), "", periods)
    for name in ("p50", "p99", "max"):
        for what in ("lateness_us", "cycle_us"):
            values = [getattr(getattr(result.timing, what), name) for result in runs]
            bench.figure(f"{what}_{name}", float(np.median(values)), "us", periods)
    bench.figure("wall_s", float(np.median([result.wall_s for result in runs])), "s", len(runs))
    bench.tables["runs"] = [json.loads(result.model_dump_json()) for result in runs]
    bench.finish()


def run(law: str, seed: int) -> DemoResult:
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "gateway.cli",
            "demo",
            "--quick",
            "--out",
            folder,
            "--law",
            law,
            "--seed",
            str(seed),
        ]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{law}, seed {seed}: the demonstration has failed\n{done.stdout}")
        print(f"{law}, seed {seed}: done", flush=True)
        return DemoResult.model_validate_json((Path(folder) / "result.json").read_bytes())


if __name__ == "__main__":
    main()

"""What a change must pass, and what has failed there by chance: `python -m tests.landing`, as `make landing`.

Every stage runs, also when one before it failed. What failed is tried again (`tests.landing.second_try`). The last
lines say what was intermittent, what failed, and how to have it again.
"""

import argparse
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from tests.landing import known
from tests.landing.ready import ready
from tests.landing.record import Recorded
from tests.landing.second_try import Crashes, tried_again
from tests.landing.stages import SAME_DRAWS, STAGES, WHOLE_LIMIT_S, Stage
from tests.landing.witness import Witness

OUT = Path("out/landing")
SLOWEST = 20
NEEDS_TRIES = 3
CALM_S, CALM_PATIENCE_S = 5.0, 60.0
TRY_LIMIT_S = 900.0
END_S = 30.0  #: for pytest to say what it has, once it is asked to end
ALL_PASSED, TESTS_FAILED, NONE_ASKED_FOR = 0, 1, 5  # pytest's exit codes


@dataclass
class Landing:
    """One run of the stages. `only`: paths; empty for all tests of a stage."""

    seed: int
    only: tuple[str, ...] = ()
    began_s: float = field(default_factory=time.monotonic)
    passed: int = 0
    skipped: int = 0
    failed: Crashes = field(default_factory=dict)
    broken: Crashes = field(default_factory=dict)  #: by stage, where it is no test that failed
    took_s: dict[str, float] = field(default_factory=dict)  #: by test
    minutes: dict[str, float] = field(default_factory=dict)  #: by stage

    def run(self, stage: Stage) -> None:
        began_s = time.monotonic()
        paths = tuple(path for path in self.only if path.startswith(stage.paths)) if self.only else stage.paths
        if not paths:
            return
        print(f"\n== {stage.name} ==", flush=True)
        if stage.needs and not _installed(stage.needs):
            self.broken[f"stage {stage.name}"] = f"{stage.needs} could not be installed"
            return
        limit_s = min(stage.limit_s, self.began_s + WHOLE_LIMIT_S - began_s)
        path = OUT / f"{stage.name.replace(' ', '-')}.jsonl"
        path.unlink(missing_ok=True)
        code = _pytest([*paths, *stage_arguments(stage, self.seed), "--record", str(path)], limit_s)
        self._take(stage, Recorded.read(path), code)
        self.minutes[stage.name] = (time.monotonic() - began_s) / 60.0

    def _take(self, stage: Stage, recorded: Recorded, code: int | None) -> None:
        self.passed += len(recorded.passed)
        self.skipped += len(recorded.skipped)
        self.took_s |= recorded.took_s
        self.failed |= recorded.failed
        if code is None:
            running = ", ".join(sorted(recorded.running)) or "none"
            self.broken[f"stage {stage.name}"] = f"took longer than it may; what was running: {running}"
        elif code not in (ALL_PASSED, NONE_ASKED_FOR) and not (code == TESTS_FAILED and recorded.failed):
            self.broken[f"stage {stage.name}"] = f"pytest ended with {code}"

    def verdict(self, witness: Witness) -> bool:
        """Whether the change passes, after what failed was tried again and all was told."""
        began_s = time.monotonic()
        if self.failed:
            print("\n== second tries ==", flush=True)
        intermittent, failed = tried_again(self.failed, lambda tests, number: self._passes(tests, number, witness))
        failed |= self.broken
        self.minutes["second tries"] = (time.monotonic() - began_s) / 60.0
        slowest = sorted(self.took_s.items(), key=lambda row: -row[1])[:SLOWEST]
        print("\nslowest:", *(f"  {took_s:6.1f} s {test}" for test, took_s in slowest), sep="\n")
        print(witness, "; seed ", self.seed, sep="")
        print("minutes:", ", ".join(f"{name} {took:.1f}" for name, took in self.minutes.items()))
        if intermittent:
            print(known.HEADING, *(f"  {test} ({crash})" for test, crash in intermittent.items()), sep="\n")
        for test, crash in failed.items():
            print(f"FAILED {test} ({crash})")
            if test.startswith("tests/"):
                print(f"  again: {sys.executable} -m pytest {' '.join(self._alone())} '{test}'")
        counted = f"{len(failed)} failed, " if failed else ""
        took_s = time.monotonic() - self.began_s
        print(
            f"{counted}{self.passed + len(intermittent)} passed, {self.skipped} skipped in {took_s:.0f} s", flush=True
        )
        return not failed

    def _passes(self, tests: list[str], number: int, witness: Witness) -> bool:
        """Each of them: what is skipped has not passed."""
        witness.calm_for(CALM_S, CALM_PATIENCE_S)
        print(f"try {number} of {' '.join(tests)}", flush=True)
        path = OUT / "again.jsonl"
        path.unlink(missing_ok=True)
        code = _pytest([*self._alone(), "--record", str(path), *tests], TRY_LIMIT_S)
        passed = Recorded.read(path).passed
        return code == ALL_PASSED and all(test in passed or "::" not in test for test in tests)

    def _alone(self) -> list[str]:
        return ["-p", "no:xdist", *SAME_DRAWS, "--randomly-seed", str(self.seed), "--randomly-dont-reorganize"]


def stage_arguments(stage: Stage, seed: int) -> list[str]:
    """Of pytest, for a stage, but for its paths."""
    workers = ["--numprocesses", str(stage.workers), "--dist", "worksteal"] if stage.workers else ["-p", "no:xdist"]
    marks = ["-m", stage.marks] if stage.marks else []
    return [*marks, *workers, *SAME_DRAWS, "--randomly-seed", str(seed)]


def _pytest(arguments: list[str], limit_s: float) -> int | None:
    """Its exit code; None where it was ended for taking too long. What it prints goes straight through."""
    with subprocess.Popen([sys.executable, "-m", "pytest", "-p", "tests.landing.record", *arguments]) as process:
        try:
            return process.wait(max(limit_s, 1.0))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)  # it ends the lines that it runs, too
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
            return None


def _installed(module: str) -> bool:
    """From the network, which may be gone for a moment."""
    for number in range(NEEDS_TRIES):
        time.sleep(10.0 * number)
        if subprocess.run([sys.executable, "-m", module], check=False).returncode == 0:
            return True
    return False


def _seed() -> int:
    """The same for the same tree: the order of the tests, and what they draw."""
    tree = subprocess.run(["git", "rev-parse", "HEAD^{tree}"], capture_output=True, text=True, check=True).stdout
    return int(tree[:7], 16)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.landing", description=__doc__.partition("\n\n")[0])
    commands = parser.add_subparsers(dest="command")
    keep = commands.add_parser("keep", help="take over what a run listed as intermittent")
    keep.add_argument("log", type=Path, help="what the run printed")
    keep.add_argument("--run", required=True, help="its commit")
    commands.add_parser("mended", help="fail while a test is intermittent again and again")
    repeat = commands.add_parser("ready", help="changed tests ten times, on a busy machine")
    repeat.add_argument("--since", default="HEAD", help="what they differ from; default: the last commit")
    parser.add_argument("--stage", action="append", choices=[stage.name for stage in STAGES], help="only this one")
    parser.add_argument("--only", action="append", default=[], metavar="PATH", help="only tests in this file or folder")
    options = parser.parse_args()
    if options.command == "keep":
        print(f"{known.keep(options.log.read_text(errors='replace'), options.run)} kept in {known.FILE.name}")
        return 0
    if options.command == "ready":
        return 0 if ready(options.since) else 1
    if options.command == "mended":
        tests = known.to_be_mended()
        for test in tests:
            print(f"intermittent in more than {known.MOST} of the last {known.RUNS} runs, to be mended first: {test}")
        return int(bool(tests))
    OUT.mkdir(parents=True, exist_ok=True)
    # Where this was begun in the background it is ignored, and would be in all that is begun from here.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    landing = Landing(_seed(), tuple(options.only))
    with Witness() as witness:
        for stage in STAGES:
            if not options.stage or stage.name in options.stage:
                landing.run(stage)
        return 0 if landing.verdict(witness) else 1


if __name__ == "__main__":
    sys.exit(main())

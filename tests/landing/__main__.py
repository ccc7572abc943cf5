"""What a change must pass, and what has failed there by chance: `python -m tests.landing`, as `make landing`.

Every stage runs, also when one before it failed. What failed is tried again (`tests.landing.second_try`). The last
lines say what was intermittent, what failed, and how to have it again.
"""

import argparse
import shlex
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from tests.landing import known
from tests.landing.ready import ready, since_when
from tests.landing.record import Recorded
from tests.landing.second_try import Crashes, tried_again
from tests.landing.stages import SAME_DRAWS, STAGES, WHOLE_LIMIT_S, Stage
from tests.landing.witness import Witness

OUT = Path("out/landing")
SLOWEST = 20
NEEDS_TRIES = 3
CALM_S, CALM_PATIENCE_S = 5.0, 60.0
TRY_LIMIT_S = 900.0
SECOND_TRIES_S = 400.0  #: of them all, where the stages have used up their time
LEAST_S = 30.0
NEEDS_LIMIT_S = 600.0
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
    whole: set[str] = field(default_factory=set)  #: of these, whose file is tried again
    broken: Crashes = field(default_factory=dict)  #: by stage, where it is no test that failed
    took_s: dict[str, float] = field(default_factory=dict)  #: by test
    minutes: dict[str, float] = field(default_factory=dict)  #: by stage

    def run(self, stage: Stage) -> None:
        """Of a stage of which nothing was asked for, nothing."""
        paths = stage.of(self.only) if self.only else stage.paths
        if not paths:
            return
        began_s = time.monotonic()
        print(f"\n== {stage.name} ==", flush=True)
        if stage.needs and not _installed(stage.needs):
            self.broken[f"stage {stage.name}"] = f"{stage.needs} could not be installed"
            return
        limit_s = min(stage.limit_s, self._left_s())
        if limit_s < LEAST_S:
            self.broken[f"stage {stage.name}"] = "was not run: no time was left"
            return
        path = OUT / f"{stage.name.replace(' ', '-')}.jsonl"
        path.unlink(missing_ok=True)
        arguments = [*paths, *stage_arguments(stage, self.seed)]
        code = _pytest([*arguments, "--record", str(path)], limit_s)
        recorded = Recorded.read(path)
        if why := self._why_broken(recorded, code):
            self.broken[f"stage {stage.name}"] = why
        if recorded.failed:
            print(f"in its order again: {sys.executable} -m pytest {shlex.join(arguments)}")
        self._take(recorded)
        self.minutes[stage.name] = (time.monotonic() - began_s) / 60.0

    def _why_broken(self, recorded: Recorded, code: int | None) -> str:
        """Why what was recorded is not all of the stage; empty where it is."""
        if code is None:
            return f"took longer than it may; what was running: {', '.join(sorted(recorded.running)) or 'none'}"
        if code == NONE_ASKED_FOR and self.only:
            return ""
        if code != ALL_PASSED and not (code == TESTS_FAILED and recorded.failed):
            return f"pytest ended with {code}"
        if not recorded.complete:
            return f"{len(recorded.ended)} of {recorded.collected or 'unknown'} tests came to their end"
        if not (recorded.passed or recorded.failed or self.only):
            return "no test passed"
        return ""

    def _take(self, recorded: Recorded) -> None:
        self.passed += len(recorded.passed)
        self.skipped += len(recorded.skipped)
        self.took_s |= recorded.took_s
        self.failed |= recorded.failed
        self.whole |= recorded.whole

    def _left_s(self) -> float:
        return self.began_s + WHOLE_LIMIT_S - time.monotonic()

    def verdict(self, witness: Witness) -> bool:
        """Whether the change passes, after what failed was tried again and all was told."""
        began_s = time.monotonic()
        if not self.minutes and not self.broken:
            self.broken["stages"] = "none has a test in what was asked for"
        if self.failed:
            print("\n== second tries ==", flush=True)

        def passes(asked: list[str], tests: list[str], number: int) -> bool:
            witness.calm_for(CALM_S, CALM_PATIENCE_S)
            return self._passes(asked, tests, number)

        intermittent, failed = tried_again(self.failed, self.whole, passes)
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

    def _passes(self, asked: list[str], tests: list[str], number: int) -> bool:
        """Each of `tests` (what is skipped has not), and all of what was asked for; of a file at least one."""
        limit_s = min(TRY_LIMIT_S, self._left_s() + SECOND_TRIES_S)
        if limit_s < LEAST_S:
            print(f"no time is left for {' '.join(asked)}")
            return False
        print(f"try {number} of {' '.join(asked)}", flush=True)
        path = OUT / "again.jsonl"
        path.unlink(missing_ok=True)
        code = _pytest([*self._alone(), "--record", str(path), *asked], limit_s)
        recorded = Recorded.read(path)
        named = {test for test in tests if "::" in test}
        return code == ALL_PASSED and recorded.complete and bool(recorded.passed) and named <= recorded.passed

    def _alone(self) -> list[str]:
        return ["-p", "no:xdist", *SAME_DRAWS, "--randomly-seed", str(self.seed), "--randomly-dont-reorganize"]


def stage_arguments(stage: Stage, seed: int) -> list[str]:
    """Of pytest, for a stage, but for its paths."""
    workers = ["--numprocesses", str(stage.workers), "--dist", "worksteal"] if stage.workers else ["-p", "no:xdist"]
    marks = ["-m", stage.marks] if stage.marks else []
    told = "--continue-on-collection-errors"  # the others are to be run all the same
    return [*marks, *workers, told, *SAME_DRAWS, "--randomly-seed", str(seed)]


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
        with suppress(subprocess.TimeoutExpired):
            if subprocess.run([sys.executable, "-m", module], check=False, timeout=NEEDS_LIMIT_S).returncode == 0:
                return True
    return False


def _seed() -> int:
    """The same for the same tree: the order of the tests, and what they draw."""
    tree = subprocess.run(["git", "rev-parse", "HEAD^{tree}"], capture_output=True, text=True, check=True).stdout
    return int(tree[:7], 16)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.landing", description=__doc__.partition("\n\n")[0])
    parser.add_argument("--stage", action="append", choices=[stage.name for stage in STAGES], help="only this one")
    parser.add_argument("--only", action="append", default=[], metavar="PATH", help="only tests in this file or folder")
    commands = parser.add_subparsers(dest="command")
    keep = commands.add_parser("keep", help="take over what a run listed as intermittent")
    keep.add_argument("log", type=Path, help="what the run printed")
    keep.add_argument("--run", required=True, help="its commit")
    mended = commands.add_parser("mended", help="what was intermittent is mended: it is counted anew")
    mended.add_argument("test")
    mended.add_argument("--run", required=True, help="the commit before")
    commands.add_parser("known", help="fail while a test is intermittent again and again")
    repeat = commands.add_parser("ready", help="changed tests ten times, on a busy machine")
    repeat.add_argument("--since", help="the commit that they differ from")
    options = parser.parse_args()
    match options.command:
        case "keep":
            print(f"{known.keep(options.log.read_text(errors='replace'), options.run)} kept in {known.FILE.name}")
        case "mended":
            known.mend(options.test, options.run)
        case "known":
            return _known()
        case "ready":
            return 0 if ready(options.since or since_when()) else 1
        case _:
            return _land(options.stage, tuple(options.only))
    return 0


def _known() -> int:
    tests = known.to_be_mended()
    for test in tests:
        print(f"intermittent in more than {known.MOST} of the last {known.RUNS} runs, to be mended first: {test}")
    if tests:
        print("then: python -m tests.landing mended TEST --run COMMIT")
    return int(bool(tests))


def _land(stages: list[str] | None, only: tuple[str, ...]) -> int:
    OUT.mkdir(parents=True, exist_ok=True)
    # Where this was begun in the background it is ignored, and would be in all that is begun from here.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    landing = Landing(_seed(), only)
    with Witness() as witness:
        for stage in STAGES:
            if not stages or stage.name in stages:
                landing.run(stage)
        return 0 if landing.verdict(witness) else 1


if __name__ == "__main__":
    sys.exit(main())

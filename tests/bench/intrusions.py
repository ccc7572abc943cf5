"""Intruders of the line's own user beside a line that runs: `python -m tests.bench.intrusions [--attempts 500]`.

Real processes on real sockets, loopback. Attempts are drawn from seeds (`intrusions_families`), carried out by
processes of their own (`intruder`), and judged by the recorder in the simulated line and by what people are told: the
line is unharmed, the status answers within a second, what controls the line is unchanged, no more proposals are taken
than an inbox allows, what pretends to be the loop is told as such, and a stop reaches the line whoever has its socket.
"""

import argparse
import asyncio
import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from gateway.cli.children import ChildFailed
from gateway.control.design import design_lqg, design_lqi, design_lqr, task_of
from gateway.core.messages import Stop
from gateway.core.status import GatewayStatus
from gateway.core.topics import GATEWAY_STATUS
from gateway.mailbox.paths import GATEWAY_SOCKET, LOOP_DATA
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox
from tests.bench import intrusions_families, intrusions_files, intrusions_forged
from tests.bench.figures import Bench
from tests.bench.intrusions_families import Attempt, Family, Site, draw
from tests.bench.intrusions_files import KEPT
from tests.bench.intrusions_restarts import Restarts, with_audit
from tests.bench.intrusions_torques import unexplained_torques
from tests.bench.kept_rows import KeptRows
from tests.closed_loop.gate_line import GateLine
from tests.closed_loop.wire import at_rest

FAMILIES = (*intrusions_families.FAMILIES, *intrusions_forged.FAMILIES, *intrusions_files.FAMILIES)
ALIVE_S = 1.0
OF_FALSE_LOOP = ("false-loop", "loop-frame")  #: how codes begin that tell one
LOOK_S = 0.1
TOLD_S = 5.0  #: for what pretends to be the loop to be told
INTRUDER_S = 60.0
HELD = "held"
FOUND = Path("out/bench/intrusions.jsonl")
#: What the first of these seeds gave on the code before there was a lock, a proof or an inbox.
BEFORE = Path(__file__).with_name("intrusions_before.json")
TRIES = 3  #: to have two configurations kept, each on another line
BUSY_S = 300.0  #: for a verdict on a busy machine, and a probation


@dataclass
class Seen:
    """What a person at the status saw during an attempt."""

    worst_s: float = 0.0
    unanswered: int = 0
    looks: int = 0
    states: set[str] = field(default_factory=set[str])
    codes: set[str] = field(default_factory=set[str])


class Watcher(threading.Thread):
    """Asks for the status all the time, over a connection of its own."""

    def __init__(self, run_folder: Path) -> None:
        super().__init__(daemon=True)
        self.seen = Seen()
        self._path = run_folder / GATEWAY_SOCKET
        self._ended = threading.Event()

    def run(self) -> None:
        asyncio.run(self._watch())

    def end(self) -> None:
        self._ended.set()
        self.join()

    def anew(self) -> Seen:
        """What was seen until now; from here on another is filled."""
        seen, self.seen = self.seen, Seen()
        return seen

    async def _watch(self) -> None:
        mailbox = UnixMailbox()
        mailbox.connect({GATEWAY_STATUS}, self._path)
        while not self._ended.is_set():
            began_s, seen = time.monotonic(), self.seen
            seen.looks += 1
            try:
                answer = await mailbox.request(GATEWAY_STATUS, b"", 5.0)
                status = GatewayStatus.model_validate_json(answer)
                seen.states.add(status.loop.state)
                seen.codes |= {one.code for one in getattr(status.loop, "false_loop", ())}
                seen.codes |= {one.code for one in getattr(status, "unexplained", ())}
            except Unreachable:
                seen.unanswered += 1
            seen.worst_s = max(seen.worst_s, time.monotonic() - began_s)
            await asyncio.sleep(LOOK_S)
        await mailbox.close()


class Judge:
    """Of one line: carries attempts out, and says what was wrong with each; nothing, where all is well."""

    def __init__(self, line: GateLine, watcher: Watcher, older: Path) -> None:
        self._line = line
        self._watcher = watcher
        self._restarts = Restarts(line, older)

    def try_out(self, attempt: Attempt) -> tuple[list[str], Seen, int]:
        """What was wrong, what was seen, and how many proposals were taken."""
        if attempt.spoils or attempt.rewrites:
            return self._try_beside(attempt)
        before, had = self._line.in_service(), self._proposals()
        self._watcher.anew()
        children = [self._begun(attempt) for _ in range(attempt.processes)]
        wrong = self._stopped(children[0]) if attempt.steals_loop else []
        for child in children:
            try:
                child.communicate(timeout=INTRUDER_S)
            except subprocess.TimeoutExpired:
                child.kill()
                wrong.append("the intruder did not come to its end")
        if attempt.forges_loop or attempt.told:
            self._wait_for_codes(attempt.told or OF_FALSE_LOOP)
        taken, seen = self._proposals() - had, self._watcher.anew()
        wrong += _against(attempt, seen, taken)
        if self._line.in_service() != before:
            wrong.append("another configuration is in service")
        if attempt.steals_loop:
            self._line.arm_and_start()
        return wrong, seen, taken

    def _try_beside(self, attempt: Attempt) -> tuple[list[str], Seen, int]:
        """Those that are no process beside the loop."""
        self._watcher.anew()
        if attempt.rewrites:
            return with_audit(self._line, attempt), self._watcher.anew(), 0
        wrong, told = self._restarts.with_files(attempt)
        seen = self._watcher.anew()
        seen.codes |= told
        if seen.worst_s > ALIVE_S or seen.unanswered:
            wrong.append(f"the status took {seen.worst_s:.2f} s, {seen.unanswered} times none came")
        return wrong, seen, 0

    def _begun(self, attempt: Attempt) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.bench.intruder"]
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert child.stdin is not None
        child.stdin.write(json.dumps(attempt.steps))
        child.stdin.close()
        child.stdin = None
        return child

    def _stopped(self, thief: subprocess.Popen[str]) -> list[str]:
        """Stop the line while its loop's socket belongs to another process; the recorder says whether it rests."""
        assert thief.stdout is not None
        thief.stdout.readline()
        reply = self._line.order(Stop())
        wrong = [] if reply.ok else [f"the stop was not done: {reply.text}"]
        codes = {one.code for one in reply.findings}
        if not any(code.startswith("false-loop") for code in codes):
            wrong.append("the stop was told as any other")
        try:
            self._line.wait(at_rest)
            self._line.wait_at_rest()
        except AssertionError as error:
            wrong.append(f"the line did not come to rest: {error}"[:200])
        return wrong

    def _proposals(self) -> int:
        listed = self._line.listed()
        return 0 if listed is None else listed.since_change

    def _wait_for_codes(self, codes: tuple[str, ...]) -> None:
        """Until one that begins so is told, for as long as that may take."""
        until_s = time.monotonic() + TOLD_S
        while not any(one.startswith(codes) for one in self._watcher.seen.codes) and time.monotonic() < until_s:
            time.sleep(LOOK_S)


def _against(attempt: Attempt, seen: Seen, taken: int) -> list[str]:
    """What of it speaks against the gateway."""
    wrong: list[str] = []
    if taken > attempt.most_taken:
        wrong.append(f"{taken} proposals were taken; allowed: {attempt.most_taken}")
    if seen.worst_s > ALIVE_S or seen.unanswered:
        wrong.append(f"the status took {seen.worst_s:.2f} s, {seen.unanswered} times none came")
    if attempt.forges_loop and not any(code.startswith(OF_FALSE_LOOP) for code in seen.codes):
        wrong.append("what pretended to be the loop was not told")
    if attempt.told and not seen.codes & set(attempt.told):
        wrong.append(f"nobody was told {' or '.join(attempt.told)}")
    if not attempt.steals_loop and seen.states - {"RUN"}:
        wrong.append(f"the status said {', '.join(sorted(seen.states))} of a line in RUN")
    return wrong


class Ground:
    """The line that is attacked; context. Where an attempt has done something to it, another one takes its place.

    `folder` is empty and gets one folder a line.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lines = 0
        self._undo = ExitStack()
        self.older: Path  #: a copy of what was kept first
        self._looked_s = 0.0  #: up to which (world) torques have been held against the records
        self.line: GateLine
        self.watcher: Watcher
        self.site: Site

    def __enter__(self) -> Self:
        self.begin()
        return self

    def __exit__(self, *error: object) -> None:
        self._undo.close()

    def end(self) -> int:
        """Of the line's life: the unsafe events at its drives."""
        with suppress(Unreachable):
            self.line.order(Stop())
        self.line.recording()
        unsafe = sum(self.line.unsafe().values())
        self._undo.close()
        return unsafe

    def unexplained_ms(self) -> int:
        """Of torque since the last look that no record explains."""
        odd, self._looked_s = unexplained_torques(self.line, self._looked_s)
        return odd

    def has_kept(self) -> bool:
        return (self.older / KEPT).exists()

    def keep(self) -> None:
        """Two configurations are kept, one after the other; the first lies in `older`. It may be another line then."""
        for _ in range(TRIES):
            try:
                self._keep()
            except AssertionError as error:  # a busy machine has stopped the line, or ended a probation
                print(f"nothing could be kept, another line: {error}"[:300], flush=True)
                self.end()
                self.begin()
            else:
                return
        raise SystemExit("no configuration is kept on this machine")

    def _keep(self) -> None:
        line = self.line
        line.until(line.approved(design_lqr(task_of(line.line)), BUSY_S), "kept", BUSY_S)
        first = (line.data / LOOP_DATA / KEPT).read_bytes()
        # The one that stays brings tensions to their set-points.
        line.until(line.approved(design_lqg(task_of(line.line)), BUSY_S), "kept", BUSY_S)
        self.older.mkdir()
        (self.older / KEPT).write_bytes(first)

    def begin(self) -> None:
        self._lines += 1
        self._looked_s = 0.0
        self._undo = ExitStack()
        folder = self._folder / str(self._lines)
        folder.mkdir()
        self._undo.callback(shutil.rmtree, folder)
        self.line = line = self._undo.enter_context(GateLine(folder))
        line.run()
        self.older = folder / "older"
        # A proposal that would be taken is one that was.
        hash_ = line.propose(design_lqi(task_of(line.line)), reason="what intruders copy")
        document = json.loads(line.shown(hash_).proposal.model_dump_json())
        described = line.line
        self.site = Site(
            line.children.run_folder,
            described.site,
            described.line,
            described.n,
            document,
            line.data / LOOP_DATA / KEPT,
        )
        self.watcher = Watcher(line.children.run_folder)
        self.watcher.start()
        self._undo.callback(self.watcher.end)


def attack(seeds: Sequence[int], families: Sequence[Family], kept: KeptRows) -> None:
    """What each attempt of `seeds` gave, into `kept`: all that was seen of it."""
    with tempfile.TemporaryDirectory(prefix="r2r-") as folder, Ground(Path(folder)) as ground:
        for seed in seeds:
            family, attempt = draw(seed, ground.site, families)
            if attempt.of_kept and not ground.has_kept():
                ground.keep()
                family, attempt = draw(seed, ground.site, families)  # it may be on another line
            try:
                wrong, seen, taken = Judge(ground.line, ground.watcher, ground.older).try_out(attempt)
            except (AssertionError, Unreachable, ChildFailed, ValueError) as error:
                wrong, seen, taken = [f"the line is not as it was: {error}"[:300]], ground.watcher.anew(), 0
            odd = ground.unexplained_ms()
            if odd:
                wrong.append(f"{odd} ms of torque that no record explains")
            unsafe = ground.end() if wrong or seed == seeds[-1] else 0
            if unsafe:
                wrong.append(f"{unsafe} unsafe events at the drives of this line")
            row = {
                "seed": seed, "point": family.point, "family": family.name, "attempt": attempt.name,
                "outcome": "; ".join(wrong) or HELD, "told": sorted(seen.codes), "taken": taken, "unsafe": unsafe,
                "unexplained_ms": odd,
                "status_worst_s": round(seen.worst_s, 3),
            }  # fmt: skip
            kept.add(row)
            if wrong:
                print(f"seed {seed}, {attempt.name}: {'; '.join(wrong)}", flush=True)
                if seed != seeds[-1]:
                    ground.begin()


def _count(rows: Sequence[dict[str, Any]], family: Family) -> dict[str, int]:
    tried = [row for row in rows if row["family"] == family.name]
    return {"tried": len(tried), "wrong": sum(row["outcome"] != HELD for row in tried)}


def told(bench: Bench, rows: Sequence[dict[str, Any]]) -> None:
    """Figures and tables."""
    wrong = [row for row in rows if row["outcome"] != HELD]
    bench.figure("unsafe_events", sum(row["unsafe"] for row in rows), "", len(rows))
    bench.figure("unexplained_torques", sum(row.get("unexplained_ms", 0) for row in rows), "ms", len(rows))
    bench.figure("attempts_wrong", len(wrong), "", len(rows))
    bench.figure("status_worst_s", max(row["status_worst_s"] for row in rows), "s", len(rows))
    bench.figure("proposals_taken", sum(row["taken"] for row in rows), "", len(rows))
    before = json.loads(BEFORE.read_text(encoding="utf-8"))["attempts"]
    bench.tables["families"] = [
        {"family": one.name, "point": one.point} | _count(rows, one) | {
            f"{key} before": value for key, value in _count(before, one).items()
        }
        for one in FAMILIES if any(row["family"] == one.name for row in rows)
    ]  # fmt: skip
    bench.tables["wrong"] = wrong
    bench.tables["attempts"] = list(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--attempts", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1, help="of the first attempt; each has the next one")
    parser.add_argument("--families", default=",".join(one.name for one in FAMILIES), help="separated by commas")
    parser.add_argument("--go-on", action="store_true", help="with what an earlier run has left")
    options = parser.parse_args()
    names, seeds = set(options.families.split(",")), range(options.seed, options.seed + options.attempts)
    kept = KeptRows(FOUND, options.go_on)
    done = {row["seed"] for row in kept}
    if open_ := [seed for seed in seeds if seed not in done]:
        attack(open_, [one for one in FAMILIES if one.name in names], kept)
    bench = Bench("intrusions", seeds=[options.seed])
    bench.tables["attempts by program"] = kept.made_by()
    told(bench, [row for row in kept if row["seed"] in seeds])
    bench.finish()


if __name__ == "__main__":
    main()

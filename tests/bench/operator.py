"""`make bench-operator`: `r2rgate operator` flooded beside a line that runs; the loop's own frames say how late it was.

Quiet, a case, quiet, and so on, in one run: clients that read at full speed, connections opened and left, messages that
are none, clients killed in mid-subscription, clients that ask for what waits again and again, the flood of all but the
last, and the same load on the processors with nothing on the network. In all of it an honest client reads ten times a
second, calls a method every second, and connects anew every three; each of its deeds counts for the case in which it
began. `lateness_p99_ratio_CASE` is the 99th percentile of how late the loop woke in the case, through that in quiet.
Quiet begins once the sessions of clients that were killed are over; a frame of the loop that is not in the history
would be missing from a percentile, so these are counted.

The attackers are no nicer than anybody else and run on the processors of the line. What they themselves take of these
is in the table `cases` (in processors, so 1.5 of 2 means that little is left); `busy` takes as much, as the operator's
process did in the flood beyond quiet and the attackers together, and asks nothing of anybody. A ratio like that of
`busy` is that of a busy computer; what is beyond it comes from what was asked.

Before that, with nothing wrong, the operator's process: its share of a processor without anybody, and with two clients
that have fifty variables told every 100 ms and a page open; and the page in Chromium (tests/bench/operator_page.py).

Writes out/bench/operator.json; with other than the usual ARGS out/bench/operator-part.json.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from gateway.cli.children import ChildFailed
from gateway.control.design import design_lqg, task_of
from gateway.core.signals import FloatArray
from gateway.supervisor.historian import FILE_NAME
from gateway.supervisor.history import History
from tests.bench.figures import Bench
from tests.bench.operator_page import page_figures
from tests.bench.operator_windows import Beside, Found, Turn, memory_watched
from tests.bench.slices import cpu_s, memory_mb
from tests.operator.names import PASSWORD
from tests.operator.real_line import OperatorLine

ROUNDS, SECONDS = 3, 10.0
COST_S = 20.0  #: of each look at the process's own cost, with other SECONDS as much longer or shorter
BURNERS = 4
CLIENTS, ATTACKS = "tests.bench.operator_clients", "tests.bench.operator_attacks"
READERS, CONNECTIONS, MALFORMED, KILLER = ("reader",) * 4, ("connections",), ("malformed",), ("killer",)
CASES: dict[str, Sequence[str]] = {
    "readers": READERS,
    "connections": CONNECTIONS,
    "malformed": MALFORMED,
    "killed": KILLER,
    "refreshers": ("refresher",) * 4,
    "flood": (*READERS, *CONNECTIONS, *MALFORMED, *KILLER),
}
BUSY, QUIET = "busy", "quiet"
AFTER_S = 11.0  #: from a case to quiet: sessions of clients that were killed last up to 10 s


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench-operator", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each case, and of quiet after it")
    given = parser.parse_args()
    bench = bench_of((given.rounds, given.seconds) == (ROUNDS, SECONDS), sys.argv[1:])
    with tempfile.TemporaryDirectory() as folder, OperatorLine(Path(folder)) as line:
        line.run()
        line.operate()
        line.until(line.propose(design_lqg(task_of(line.line)), "for those who ask what waits"), "waiting", 150.0)
        cost(bench, line, COST_S * given.seconds / SECONDS)
        page(bench, line, COST_S * given.seconds / SECONDS)
        found = flooded(line, given.rounds, given.seconds)
        ended = _ended(line)
        for name in ("operator", "loop", "gateway"):
            line.children.end(name)
        line.recording()
        report(bench, line, found)
        bench.figure("processes_that_ended", ended, "", 1)
        bench.figure("line_stopped", found.state != "RUN", "", 1)
        bench.figure("unsafe_events", sum(line.unsafe().values()), "", 1)
    bench.finish()


def bench_of(whole: bool, words: list[str]) -> Bench:
    """A run with other arguments is held against the same goals, and does not pass for the whole."""
    arguments = [f'ARGS="{" ".join(words)}"'] if words else []
    return Bench(
        "operator" if whole else "operator-part", [1], goals_of="operator", libraries=("numpy", "asyncua"),
        command=" ".join(["make bench-operator", *arguments]),
    )  # fmt: skip


def cost(bench: Bench, line: OperatorLine, seconds: float) -> None:
    """Of the operator's process, when nothing is wrong."""
    pid, beside = line.children.pid("operator"), Beside()
    bench.figure("cpu_share_alone", _share(pid, seconds), "", 1)
    try:
        for _ in range(2):
            beside.begin(CLIENTS, "subscriber", line.endpoint, str(line.pki))
        beside.begin(CLIENTS, "page", line.page, str(line.pki))
        bench.figure("cpu_share_two_clients_and_a_page", _share(pid, seconds), "", 1)
        bench.figure("memory_two_clients_and_a_page_mb", memory_mb(pid, "VmRSS"), "MB", 1)
    finally:
        bench.tables["told in that time"] = beside.end()


def page(bench: Bench, line: OperatorLine, seconds: float) -> None:
    """In a real browser, when nothing is wrong."""
    found = page_figures(line.page, "vera", PASSWORD, line.folder / "browser.log", seconds)
    bench.figure("telemetry_to_page_p95_s", found.age_p95_s, "s", found.looks)
    bench.figure("telemetry_to_page_s", found.age_max_s, "s", found.looks)
    bench.figure("first_paint_s", found.first_paint_s, "s", found.paints)
    bench.figure("line_seen_after_login_s", found.line_seen_s, "s", found.paints)
    bench.figure("page_weight_kb", found.bytes / 1e3, "kB", 1)


def flooded(line: OperatorLine, rounds: int, seconds: float) -> Found:
    found, honest, told = Found(), Beside(), line.folder / "honest.jsonl"
    honest.begin(CLIENTS, "honest", line.endpoint, str(line.pki), told=told)
    try:
        with memory_watched(line.children.pid("operator"), found.memory):
            found.turns.append(_turn(line, QUIET, Beside(), seconds))
            for _ in range(rounds):
                for case, kinds in CASES.items():
                    found.turns += _pair(line, case, [_words(line, kind) for kind in kinds], seconds)
                share = _beyond_quiet(found) / BURNERS
                burners = [[ATTACKS, "busy", f"{min(1.0, share):.3f}"]] * BURNERS
                found.turns += _pair(line, BUSY, burners, seconds)
    finally:
        honest.end()
    found.deeds = [json.loads(text) for text in told.read_text(encoding="utf-8").splitlines() if text[0] == "{"]
    status = line.status()
    found.state = "" if status is None else status.loop.state
    found.why = [] if status is None else [f"{event.kind}: {event.text}" for event in status.events]
    return found


def _words(line: OperatorLine, kind: str) -> list[str]:
    if kind in ("reader", "refresher", "killer"):
        return [CLIENTS, kind, line.endpoint, str(line.pki)]
    return [ATTACKS, kind, line.endpoint.removeprefix("opc.tcp://")]


def _pair(line: OperatorLine, case: str, words: Sequence[Sequence[str]], seconds: float) -> list[Turn]:
    """The case, and quiet after it."""
    beside = Beside()
    try:
        for one in words:
            beside.begin(*one)
        of_case = _turn(line, case, beside, seconds)
    finally:
        of_those = beside.end()
    of_case.told = of_those
    time.sleep(AFTER_S)
    return [of_case, _turn(line, QUIET, beside, seconds)]


def _turn(line: OperatorLine, case: str, beside: Beside, seconds: float) -> Turn:
    pid = line.children.pid("operator")
    begin_s, operator_s, others_s = time.monotonic(), cpu_s(pid), beside.used_s()
    time.sleep(seconds)
    end_s, operator_end_s, others_end_s = time.monotonic(), cpu_s(pid), beside.used_s()
    for_s = end_s - begin_s
    return Turn(case, begin_s, end_s, (others_end_s - others_s) / for_s, (operator_end_s - operator_s) / for_s, [])


def _beyond_quiet(found: Found) -> float:
    """Processors that the last flood took, with what the operator's process did for it."""
    flood, quiet = found.of("flood")[-1], found.of(QUIET)[-1]
    return max(0.0, flood.others_share + flood.operator_share - quiet.operator_share)


def report(bench: Bench, line: OperatorLine, found: Found) -> None:
    lateness_us = _lateness_us(line, found)
    quiet_us = float(np.percentile(lateness_us[QUIET], 99))
    bench.figure("lateness_p99_quiet_us", quiet_us, "us", len(lateness_us[QUIET]))
    for case in (*CASES, BUSY):
        ratio = float(np.percentile(lateness_us[case], 99)) / quiet_us
        bench.figure(f"lateness_p99_ratio_{case}", ratio, "", len(lateness_us[case]))
    due = sum(turn.end_s - turn.begin_s for turn in found.turns) / line.line.control.period_s
    seen = sum(map(len, lateness_us.values()))
    bench.figure("frames_missing_pct", max(0.0, 100.0 * (1.0 - seen / due)), "%", seen)
    for kind in ("read", "call"):
        took_s = [one for case in CASES for one in found.took_s(case, kind)]
        bench.figure(
            f"{kind}_during_attacks_p99_s", float(np.percentile(took_s, 99, method="higher")), "s", len(took_s)
        )
        bench.figure(f"{kind}_during_attacks_s", max(took_s), "s", len(took_s))
    anew = [one for one in found.deeds if one["kind"] == "connect"]  # also while cases begin and end
    bench.figure("connections_of_the_honest_that_failed", sum(bool(one["why"]) for one in anew), "", len(anew))
    begin_mb, peak_mb = found.memory[0][1], max(mb for _, mb in found.memory)
    first, last = found.of(QUIET)[len(CASES) + 1], found.of(QUIET)[-1]
    bench.figure("memory_begin_mb", begin_mb, "MB", 1)
    bench.figure("memory_peak_mb", peak_mb, "MB", len(found.memory))
    bench.figure("memory_end_mb", found.memory[-1][1], "MB", 1)
    growth_mb = _memory_at(found, last.end_s) - _memory_at(found, first.end_s)
    bench.figure("memory_growth_after_the_first_round_mb", growth_mb, "MB", len(found.of(BUSY)) - 1)
    bench.tables["cases"] = {case: _row(found, case, lateness_us[case], quiet_us) for case in (QUIET, *CASES, BUSY)}
    bench.tables["failed"] = [
        f"{one['at_s'] - found.turns[0].begin_s:.1f} s, {one['kind']}: {one['why']}"
        for one in found.deeds
        if one["why"]
    ][:20]
    bench.tables["cases began, s"] = [
        [turn.case, round(turn.begin_s - found.turns[0].begin_s, 1)] for turn in found.turns
    ]
    bench.tables["last events of the line"] = found.why
    bench.tables["attackers"] = {case: found.of(case)[-1].told for case in CASES}


def _row(found: Found, case: str, lateness_us: FloatArray, quiet_us: float) -> dict[str, Any]:
    turns = found.of(case)
    row: dict[str, Any] = {
        "lateness p99, us": round(float(np.percentile(lateness_us, 99)), 1),
        "lateness max, us": round(float(lateness_us.max()), 1),
        "ratio": round(float(np.percentile(lateness_us, 99)) / quiet_us, 3),
        "attackers, processors": round(float(np.mean([turn.others_share for turn in turns])), 2),
        "operator's process, processors": round(float(np.mean([turn.operator_share for turn in turns])), 2),
    }
    for kind in ("read", "call", "connect"):
        took_ms = 1e3 * np.array(found.took_s(case, kind))
        good_ms = took_ms[np.isfinite(took_ms)]
        spread = [round(float(np.percentile(good_ms, q)), 1) for q in (50, 99, 100)] if len(good_ms) else []
        row[f"{kind}: p50, p99, max in ms"] = spread
        row[f"{kind}: done, failed"] = [len(good_ms), len(took_ms) - len(good_ms)]
    return row


def _lateness_us(line: OperatorLine, found: Found) -> dict[str, FloatArray]:
    by_case: dict[str, list[FloatArray]] = {}
    with closing(History(line.gateway_data / FILE_NAME)) as history:
        for turn in found.turns:
            lateness = history.read(turn.begin_s, turn.end_s, ["lateness_s"])["lateness_s"].astype(float)
            by_case.setdefault(turn.case, []).append(1e6 * lateness)
    return {case: np.concatenate(parts) for case, parts in by_case.items()}


def _memory_at(found: Found, at_s: float) -> float:
    return next((mb for then_s, mb in found.memory if then_s >= at_s), found.memory[-1][1])


def _share(pid: int, seconds: float) -> float:
    begin_s, before_s = time.monotonic(), cpu_s(pid)
    time.sleep(seconds)
    return (cpu_s(pid) - before_s) / (time.monotonic() - begin_s)


def _ended(line: OperatorLine) -> int:
    try:
        line.children.check()
    except ChildFailed as failed:
        print(failed, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    main()

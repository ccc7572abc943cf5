"""`make bench-agents-live`: agents of every kind beside a line that runs; the loop's own frames say how late it was.

A case, then quiet, and so on: processes are started before the time counts, and end after it; who is killed or stopped
is so while it counts. In each case a phase asks, as `r2rgate commission` does, and goes on by what it gets. Then the
audit is asked for the records that the case must leave. They come a minute apart at most, so the next case begins once
nothing of this one can be outstanding. A pair of case and quiet takes 20 s each, and up to a minute for that.

Writes out/bench/agents-live.json; with other than the usual ARGS out/bench/agents-live-part.json.
"""

import argparse
import asyncio
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from gateway.cli.asked_agents import AskedAgents
from gateway.cli.lifetime import end, start
from gateway.commissioning.decisions import Decided
from gateway.core.line import Agents
from gateway.core.questions import usual_choice, wrong_with
from gateway.core.signals import FloatArray
from gateway.mailbox.bus import connect
from gateway.supervisor.historian import FILE_NAME
from gateway.supervisor.history import History
from tests.bench.agents_live_records import missing, records_in, settled_s
from tests.bench.figures import Bench
from tests.closed_loop.gate_line import GateLine
from tests.support.ports import free_port
from tests.unit.language_model_support import QUESTION

AGENT = QUESTION.agent
ANSWER_MAX_S = 3.0  #: that a language model has here
WITHIN_S = 6.0  #: for an agent to answer; then the rules decide
ASK_EVERY_S = 2.0


class Beside:
    """What runs beside the line in a case. A context: all of it is ended at its end."""

    def __init__(self, line: GateLine) -> None:
        self.line = line
        self._children: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for child in reversed(self._children):
            with suppress(ProcessLookupError):
                os.kill(child.pid, signal.SIGCONT)
            end(child, 5.0)
            if child.stdout is not None:
                child.stdout.close()

    def agents(self, url: str | None = None) -> subprocess.Popen[str]:
        """`r2rgate agents`, once it answers; `url`: of its language model."""
        file = self.line.folder / "line.toml"
        if url is not None:
            text = file.read_text(encoding="utf-8").replace('llm = "off" ', 'llm = "ollama" ', 1)
            text = text.replace(f'# url = "{Agents().url}"', f'url = "{url}"', 1)
            text = text.replace(f"# answer_max_s = {Agents().answer_max_s}", f"answer_max_s = {ANSWER_MAX_S}", 1)
            file = self.line.folder / "agents.toml"
            file.write_text(text, encoding="utf-8")
        child = start(["agents", str(file), *map(str, self.line.folders)], self.line.folder / "logs" / "agents.log")
        self._children.append(child)
        self.line.wait(lambda status: AGENT in status.agents_bus.agents)
        return child

    def stand_in(self, persona: str) -> str:
        """Its URL."""
        return self._said("tests.stand_in", "--persona", persona)

    def bad(self, how: str) -> None:
        self._said("tests.bench.agents_bad", how, str(self.line.children.run_folder))

    def _said(self, module: str, *words: str) -> str:
        """The first line of a module's process."""
        child = subprocess.Popen([sys.executable, "-m", module, *words], stdout=subprocess.PIPE, text=True)
        self._children.append(child)
        assert child.stdout is not None
        return child.stdout.readline().strip()


Amid = Callable[[], None]  #: what is done in the middle of the case, once the phase has begun to ask


def healthy(beside: Beside) -> None:
    beside.agents()


def killed(beside: Beside) -> Amid:
    return beside.agents().kill


def stopped(beside: Beside) -> Amid:
    pid = beside.agents().pid
    return lambda: os.kill(pid, signal.SIGSTOP)


def flooding(beside: Beside) -> None:
    beside.agents()
    beside.bad("flood")


def garbage(beside: Beside) -> None:
    beside.bad("garbage")


def model_absent(beside: Beside) -> None:
    beside.agents(f"http://127.0.0.1:{free_port()}")


def model_slow(beside: Beside) -> None:
    beside.agents(beside.stand_in("slow"))


def model_nonsense(beside: Beside) -> None:
    beside.agents(beside.stand_in("non_json"))


def model_lying(beside: Beside) -> None:
    beside.agents(beside.stand_in("adversarial"))


@dataclass(frozen=True)
class Case:
    begin: Callable[[Beside], Amid | None]
    records: frozenset[str]  #: cases that the audit must have of it
    by: str = "rules"  #: who answers; a model that lies within what is offered is judged by what comes of it
    answered: bool = False  #: by an agent, whatever it goes by: a phase on its own is wrong

    @property
    def name(self) -> str:
        return self.begin.__name__


CASES = (
    Case(healthy, frozenset(), answered=True),
    Case(killed, frozenset({"gone", "unanswered"})),
    Case(stopped, frozenset({"gone", "unanswered"})),
    Case(flooding, frozenset({"turned-away"})),
    Case(garbage, frozenset({"refused", "unanswered"})),
    Case(model_absent, frozenset({"rules-instead"})),
    Case(model_slow, frozenset({"rules-instead"})),
    Case(model_nonsense, frozenset({"rules-instead"})),
    Case(model_lying, frozenset(), AGENT),
)


@dataclass
class Turn:
    """Monotonic times; `case` None: quiet."""

    case: Case | None
    begin_s: float
    end_s: float
    answers: list[tuple[float, Decided]] = field(default_factory=list[tuple[float, Decided]])  #: with seconds
    missing: frozenset[str] = frozenset()  #: records that the audit should have of the case, and does not


ROUNDS, SECONDS = 3, 20.0
NAMES = [one.name for one in CASES]


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench-agents-live", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each case, and of quiet after it")
    parser.add_argument("--cases", default=",".join(NAMES), help="separated by commas")
    given = parser.parse_args()
    named = given.cases.split(",")
    if strange := sorted(set(named) - set(NAMES)):
        parser.error(f"--cases has {', '.join(strange)}; allowed: {', '.join(NAMES)}")
    cases = [one for one in CASES if one.name in named]
    whole = (given.rounds, given.seconds, cases) == (ROUNDS, SECONDS, list(CASES))
    bench = bench_of(whole, given.rounds, sys.argv[1:])
    with tempfile.TemporaryDirectory() as folder, GateLine(Path(folder), 1, spans=6) as line:
        line.run()
        turns = [turn for _ in range(given.rounds) for case in cases for turn in _pair(line, case, given.seconds)]
        state = line.wait(lambda status: True).loop.state
        line.children.end("loop")
        line.children.end("gateway")
        line.recording()
        report(bench, line, turns, state)


def bench_of(whole: bool, rounds: int, words: list[str]) -> Bench:
    """A run with other arguments is held against the same goals, and does not pass for the whole."""
    arguments = [f'ARGS="{" ".join(words)}"'] if words else []
    return Bench(
        "agents-live" if whole else "agents-live-part", list(range(1, rounds + 1)), goals_of="agents-live",
        command=" ".join(["make bench-agents-live", *arguments]),
    )  # fmt: skip


def _pair(line: GateLine, case: Case, seconds: float) -> list[Turn]:
    """The case, and quiet after it; nothing of it is outstanding then."""
    began_s = time.time()
    with Beside(line) as beside:
        amid = case.begin(beside)
        of_case = asyncio.run(_asking(line, case, seconds, amid))
    ended_s = time.time()
    begin_s = time.monotonic()
    time.sleep(seconds)
    quiet = Turn(None, begin_s, time.monotonic())
    while time.time() < settled_s(case.records, found := records_in(line.gateway_data), began_s, ended_s):
        time.sleep(1.0)
    of_case.missing = missing(case.records, found, began_s, time.time())
    return [of_case, quiet]


async def _asking(line: GateLine, case: Case, seconds: float, amid: Amid | None) -> Turn:
    """A phase that asks again and again, each time as if it were the first."""
    question = QUESTION.model_copy(update={"site": line.line.site, "line": line.line.line})
    turn = Turn(case, time.monotonic(), 0.0)
    if amid is not None:
        asyncio.get_running_loop().call_later(seconds / 4.0, amid)
    bus = await connect(line.children.run_folder, line.line.site, line.line.line)
    try:
        while time.monotonic() < turn.begin_s + seconds:
            decider = AskedAgents(line.line, bus, asyncio.get_running_loop(), WITHIN_S)
            asked_s = time.monotonic()
            decided = await asyncio.to_thread(decider.decide, question)
            turn.answers.append((time.monotonic() - asked_s, decided))
            await asyncio.sleep(ASK_EVERY_S)
    finally:
        turn.end_s = time.monotonic()
        await bus.close()
    return turn


def report(bench: Bench, line: GateLine, turns: list[Turn], state: str) -> None:
    absent = {f"{turn.case.name}, pair {k // 2 + 1}": sorted(turn.missing)
              for k, turn in enumerate(turns) if turn.case and turn.missing}  # fmt: skip
    of_case: dict[str, list[FloatArray]] = {}
    with closing(History(line.gateway_data / FILE_NAME)) as history:
        for turn in turns:
            lateness = history.read(turn.begin_s, turn.end_s, ["lateness_s"])["lateness_s"].astype(float)
            of_case.setdefault(turn.case.name if turn.case else "quiet", []).append(lateness)
        told = [one for one in history.events(0.0, time.time()) if one.kind in ("state", "trip")]
    quiet_s = _p99(of_case["quiet"])
    bench.figure("lateness_p99_quiet_us", 1e6 * quiet_s, "us", sum(map(len, of_case["quiet"])))
    for name, found in of_case.items():
        if name != "quiet":
            bench.figure(f"lateness_p99_{name}_us", 1e6 * _p99(found), "us", sum(map(len, found)))
            bench.figure(f"lateness_p99_ratio_{name}", _p99(found) / quiet_s, "", sum(map(len, found)))
    answers = [(turn.case, took_s, one) for turn in turns if turn.case for took_s, one in turn.answers]
    wrong = [f"{case.name}: {why}" for case, _, one in answers if (why := _wrong(case, one))]
    bench.figure("answer_s", max(took_s for _, took_s, _ in answers), "s", len(answers))
    bench.figure("answers_that_are_not_as_expected", len(wrong), "", len(answers))
    bench.figure("cases_without_a_record_in_the_audit", len(absent), "", len(turns) // 2)
    bench.figure("line_stopped", state != "RUN", "", 1)
    bench.figure("unsafe_events", sum(line.unsafe().values()), "", 1)
    why = {case.name: one.instead for case, _, one in answers}
    begin_s = turns[0].begin_s
    states = [f"{one.time_s - begin_s:.1f} s: {one.text}" for one in told if one.time_s > begin_s]
    bench.tables = {
        "states of the line since the first case": states,
        "why the rules": why,
        "not as expected": wrong[:20],
        "without a record": absent,
    }
    bench.finish()


def _wrong(case: Case, one: Decided) -> str:
    """Why a phase cannot go on by what it got, or somebody else has answered than should have; empty: all is well."""
    if one.by != case.by:
        return f"decided by {one.by}: {one.instead}"
    if case.answered and one.instead:
        return f"no agent answered: {one.instead}"
    if one.by == "rules" and one.choice != usual_choice(QUESTION):
        return f"the rules chose {one.choice.option}"
    return "; ".join(wrong_with(one.choice, QUESTION))


def _p99(found: list[FloatArray]) -> float:
    return float(np.percentile(np.concatenate(found), 99))


if __name__ == "__main__":
    main()

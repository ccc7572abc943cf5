"""`python -m tests.bench.compute`: what the loop itself computes in a control period, without wires and devices.

The whole cycle over the in-memory link, engaged in production. The simulated line moves between the periods, outside
the timing. Three ways:

    hot     period after period: what the code costs
    evicted each after 96 MB of other memory has been touched: what it costs with little of it in the caches
    paced   each at its tick of the loop's own timer, after idling: what it costs in real time

`read` is the in-memory link, in place of a driver. `total` is a bit more than its parts: the timing of the parts, the
runner, and the watch over what only blocks proposals.
"""

import argparse
import asyncio
import tempfile
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from time import monotonic, perf_counter_ns
from typing import Any

import numpy as np

from drivers.memory import MemoryLink
from gateway.control.design import design_lqi, design_pid, task_of
from gateway.core.line import Line, Recipe
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.signals import BoolArray, FloatArray
from gateway.core.states import Phase
from gateway.core.topics import LOOP_BUSES, LOOP_EVENT, LOOP_TELEMETRY
from gateway.loop.cycle import Cycle
from gateway.loop.machine import Machine
from gateway.loop.pacer import Tick, TimerPacer
from gateway.loop.realtime import become_punctual, freeze_collector, stay_awake
from gateway.loop.runner import Runner
from gateway.loop.voice import Voice
from gateway.loop.watch import Watch
from gateway.mailbox.unix import UnixMailbox
from sim_plant.plant import load_plant
from sim_plant.stepped import Sample, SteppedLine

SECTIONS = {"_read": "read", "_check": "check", "_step_machine": "machine", "_torque": "torque", "_write": "write"}
ROWS = (*SECTIONS.values(), "frame", "publish", "total")
TOUCHED = np.zeros(96 << 20, np.uint8)
SETTLING = 1000  #: periods before anything is counted: set-points reached, counts learnt, allocators warm


class Between:
    """The simulated line, moved between two periods only."""

    def __init__(self, truth: SteppedLine) -> None:
        self._truth = truth
        self._sample: Sample | None = None
        self._command: tuple[FloatArray, BoolArray, float, bool] | None = None
        self._now_s = 0.0  #: of the simulated line, which knows nothing of the loop's clock

    def move(self, now_s: float) -> None:
        """Take the last command and read the sample for `now_s`."""
        if self._command is not None:
            self._truth.apply(*self._command, self._now_s)
        self._sample, self._now_s = self._truth.sample(now_s), now_s

    def sample(self, now_s: float) -> Sample:
        assert self._sample is not None, now_s
        return self._sample

    def apply(
        self, torque_nm: FloatArray, enable: BoolArray, speed_request_m_per_s: float, run: bool, now_s: float
    ) -> None:
        self._command = torque_nm, enable, speed_request_m_per_s, run

    def warn(self, on: bool, now_s: float) -> None:
        """Nobody is near."""


class Subject:
    """A loop in the middle of production, of which every section is timed."""

    def __init__(self, line: Line, law: str, mailbox: UnixMailbox) -> None:
        config = (design_pid if law == "pid" else design_lqi)(task_of(line))
        plant = load_plant("sim_plant/plants/s_real.toml").model_copy(update={"spans": line.n})
        truth = SteppedLine(plant, 1, line.control.latency_s)
        self.between = Between(truth)
        link = MemoryLink(line, self.between)
        voice = Voice(mailbox, [link], line.control.period_s)
        self.spent_us = {row: list[float]() for row in ROWS}
        record = self._timed(voice.record, "publish")
        watch = Watch(line, np.zeros(line.n))
        self.cycle = Cycle(line, config, [link], watch, monotonic, record, voice.announce)
        self.runner = Runner(self.cycle)
        self.period_s = line.control.period_s
        self._periods = 0
        self._link = link
        self._begin(line.recipes[0], truth.start_at_equilibrium(np.array(line.recipes[0].tension_n), 0.05))
        for method, section in SECTIONS.items():
            timed = self._timed_read if method == "_read" else self._timed
            setattr(self.cycle, method, timed(getattr(self.cycle, method), section))
        setattr(self.cycle, "_frame", self._timed(getattr(self.cycle, "_frame"), "frame"))  # noqa: B009, B010

    def _begin(self, recipe: Recipe, torque_nm: FloatArray) -> None:
        self.cycle.machine = Machine(Phase.RUNNING)
        self.cycle.outputs.torque_nm = torque_nm.copy()
        self.cycle.setpoints.aim_at(recipe.model_copy(update={"speed_m_per_s": 0.05}))
        self.cycle.setpoints.begin_at_speed(0.05)

    async def prepare(self) -> None:
        await self._link.open()
        await self._link.prepare()

    def move(self) -> None:
        """The simulated line, one period on."""
        self._periods += 1
        self.between.move(self._periods * self.period_s)

    async def period(self, tick: Tick) -> None:
        begin_ns = perf_counter_ns()
        await self.runner.period(tick)
        self.spent_us["total"].append((perf_counter_ns() - begin_ns) * 1e-3)
        assert self.cycle.machine.phase is Phase.RUNNING, self.cycle.machine

    def _timed(self, function: Callable[..., Any], section: str) -> Callable[..., Any]:
        spent = self.spent_us[section]

        @wraps(function)
        def timed(*given: Any) -> Any:
            begin_ns = perf_counter_ns()
            result = function(*given)
            spent.append((perf_counter_ns() - begin_ns) * 1e-3)
            return result

        return timed

    def _timed_read(self, function: Callable[..., Any], section: str) -> Callable[..., Any]:
        spent = self.spent_us[section]

        @wraps(function)
        async def timed(*given: Any) -> Any:
            begin_ns = perf_counter_ns()
            result = await function(*given)
            spent.append((perf_counter_ns() - begin_ns) * 1e-3)
            return result

        return timed


async def back_to_back(subject: Subject, periods: int, evict: bool) -> None:
    for _ in range(periods):
        subject.move()
        await asyncio.sleep(0)  # the reader of the telemetry has its turn
        if evict:
            TOUCHED[::64] += 1
        now_s = monotonic()
        await subject.period(Tick(now_s, now_s, 0))


async def paced(subject: Subject, periods: int) -> None:
    pacer = TimerPacer(subject.period_s)
    try:
        for _ in range(periods):
            subject.move()
            tick = await pacer.wait()
            await subject.period(Tick(tick.due_s, tick.now_s, 0))
    finally:
        pacer.close()


async def measure(line: Line, law: str, periods: int, folder: Path) -> dict[str, dict[str, FloatArray]]:
    """Microseconds of every section in every period: {way: {row: ...}}."""
    gateway, loop = UnixMailbox(), UnixMailbox()
    await gateway.listen(folder / "gateway.sock")
    gateway.subscribe(LOOP_TELEMETRY, lambda _: None)
    loop.connect({LOOP_TELEMETRY, LOOP_EVENT, LOOP_BUSES}, folder / "gateway.sock")
    subject = Subject(line, law, loop)
    await subject.prepare()
    await back_to_back(subject, SETTLING, evict=False)
    freeze_collector()
    measured: dict[str, dict[str, FloatArray]] = {}
    ways = {
        "hot": lambda: back_to_back(subject, periods, evict=False),
        "evicted": lambda: back_to_back(subject, periods, evict=True),
        "paced": lambda: paced(subject, periods),
    }
    for way, run in ways.items():
        for spent in subject.spent_us.values():
            spent.clear()
        await run()
        spent_us = {row: np.array(spent) for row, spent in subject.spent_us.items()}
        spent_us["frame"] = spent_us["frame"] - spent_us["publish"]
        measured[way] = spent_us
    await loop.close()
    await gateway.close()
    return measured


def table(measured: dict[str, dict[str, FloatArray]]) -> str:
    ways = list(measured)
    lines = ["section   " + "".join(f"{way + ' p50':>14}{'p99':>8}" for way in ways) + "   (us)"]
    for row in ROWS:
        cells = (np.percentile(measured[way][row], (50, 99)) for way in ways)
        lines.append(f"{row:<10}" + "".join(f"{p50:14.1f}{p99:8.1f}" for p50, p99 in cells))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.compute", description=__doc__)
    parser.add_argument("--spans", type=int, default=6)
    parser.add_argument("--law", choices=("lqi", "pid"), default="lqi")
    parser.add_argument("--periods", type=int, default=1000)
    parser.add_argument("--cpu", type=int, default=None, help="run there as the loop does, in real time; as root")
    given = parser.parse_args()
    if given.cpu is not None:
        print("; ".join([*sum(become_punctual(given.cpu, 60), []), stay_awake() or "processors stay awake"]))
    with tempfile.TemporaryDirectory() as folder:
        line = load_line(line_template(given.spans, "line.toml"), "line.toml")
        measured = asyncio.run(measure(line, given.law, given.periods, Path(folder)))
    print(f"{given.spans} spans, {given.law}, {given.periods} periods each\n{table(measured)}")


if __name__ == "__main__":
    main()

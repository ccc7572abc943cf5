"""`make bench-engage`: a predictive controller deployed on a loop that runs in real time, at 6 to 60 spans.

The whole cycle over the in-memory link, paced by the loop's own timer, with what is real-time about it as far as it is
granted. The deployment goes the way that the gateway's does: built, warmed and measured in the thread aside, then taken
over between two periods. Counted are the periods that were skipped from when the command comes to two seconds after the
controller took over, and before it in as long a time; and what the longest period took, in which it took over, and with
it in service.
"""

import argparse
import asyncio
from time import monotonic, perf_counter

import numpy as np

from drivers.memory import MemoryLink
from gateway.control.design import design_lqi, design_mpc, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.messages import Deploy, Reply
from gateway.core.states import Phase
from gateway.loop.cycle import Cycle
from gateway.loop.machine import Machine
from gateway.loop.pacer import Tick, TimerPacer
from gateway.loop.realtime import become_punctual, freeze_collector, stay_awake
from gateway.loop.runner import Runner
from gateway.loop.watch import Watch
from sim_plant.plant import load_plant
from sim_plant.stepped import SteppedLine
from tests.bench.compute import Between
from tests.bench.figures import Bench

SPANS = (6, 20, 40, 60)
AFTER_S = 2.0


class Line:
    """A loop in the middle of production under a linear law, and the periods that it has run."""

    def __init__(self, spans: int) -> None:
        self.line = load_line(line_template(spans, "line.toml"), "line.toml")
        task = task_of(self.line)
        predictive = design_mpc(task)
        # As the gateway has made it: its hash takes as long as some periods, and is none of the loop's work.
        self.deployment = Deployment(
            controller=predictive, hash=config_hash(predictive), epoch=1, lease_s=60.0
        )  # fmt: skip
        plant = load_plant("sim_plant/plants/s_real.toml").model_copy(update={"spans": spans})
        truth = SteppedLine(plant, 1, self.line.control.latency_s)
        self._between = Between(truth)
        link = MemoryLink(self.line, self._between)
        watch = Watch(self.line, np.zeros(spans))
        self.cycle = Cycle(
            self.line, design_lqi(task), [link], watch, monotonic, lambda _: None, lambda *_: None, simulated=True
        )
        self.runner = Runner(self.cycle)
        self._link = link
        self.took_s: list[float] = []
        self.skipped: list[int] = []
        self.epochs: list[int] = []
        tension_n = np.array(self.line.recipes[0].tension_n)
        torque_nm = truth.start_at_equilibrium(tension_n, 0.05)
        self.cycle.machine = Machine(Phase.RUNNING)
        self.cycle.outputs.torque_nm = torque_nm.copy()
        self.cycle.guard.begin(torque_nm)
        recipe = self.line.recipes[0].model_copy(update={"speed_m_per_s": 0.05})
        self.cycle.setpoints.aim_at(recipe)
        self.cycle.setpoints.begin_at_speed(0.05)

    async def run(self, pacer: TimerPacer, ended: asyncio.Event) -> None:
        """Periods until `ended`; the simulated line moves on between them, in the time that a wire would take."""
        await self._link.open()
        await self._link.prepare()
        periods = 0
        while not ended.is_set():
            periods += 1
            self._between.move(periods * self.line.control.period_s)
            tick = await pacer.wait()
            begun_s = perf_counter()
            await self.runner.period(Tick(tick.due_s, tick.now_s, 0))
            self.took_s.append(perf_counter() - begun_s)
            self.skipped.append(tick.skipped)
            self.epochs.append(self.cycle.configurations.epoch)


async def deployed(line: Line) -> tuple[Reply, int]:
    """Deploy in the middle of a run; the answer, and the number of the period with which the command came."""
    ended = asyncio.Event()
    pacer = TimerPacer(line.line.control.period_s)
    running = asyncio.create_task(line.run(pacer, ended))
    await asyncio.sleep(AFTER_S)
    came = len(line.took_s)
    reply = await line.runner.submit(Deploy(deployment=line.deployment))
    await asyncio.sleep(AFTER_S)
    ended.set()
    await running
    pacer.close()
    line.runner.close()
    return reply, came


def measure(bench: Bench, spans: int) -> None:
    line = Line(spans)
    freeze_collector()
    reply, came = asyncio.run(deployed(line))
    first = max(0, came - round(AFTER_S / line.line.control.period_s))
    before, after = slice(first, came), slice(came, None)
    took_ms = 1e3 * np.array(line.took_s)
    bench.figure(f"{spans}_skipped_before", sum(line.skipped[before]), "periods", len(line.skipped[before]))
    bench.figure(f"{spans}_skipped", sum(line.skipped[after]), "periods", len(line.skipped[after]))
    bench.figure(f"{spans}_period_before_p50_ms", float(np.median(took_ms[before])), "ms", len(took_ms[before]))
    if not reply.ok:
        bench.tables[f"{spans} spans"] = {"refused": "; ".join(reply.reasons)}
        return
    over = line.epochs.index(1)
    bench.figure(f"{spans}_takes_over_ms", float(took_ms[over]), "ms", 1)
    bench.figure(f"{spans}_preparing_longest_ms", float(took_ms[came:over].max(initial=0.0)), "ms", over - came)
    bench.figure(f"{spans}_period_after_p50_ms", float(np.median(took_ms[over:])), "ms", len(took_ms[over:]))
    bench.figure(f"{spans}_period_after_p99_ms", float(np.percentile(took_ms[over:], 99)), "ms", len(took_ms[over:]))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.engage", description=__doc__)
    parser.add_argument("--spans", default=",".join(map(str, SPANS)), help="e.g. 6,40")
    given = parser.parse_args()
    bench = Bench("engage")
    granted, refused = become_punctual(None, 60)
    bench.tables["real-time help"] = {"granted": granted, "refused": [*refused, *filter(None, [stay_awake()])]}
    for spans in map(int, given.spans.split(",")):
        print(f"{spans} spans", flush=True)
        measure(bench, spans)
    bench.finish()


if __name__ == "__main__":
    main()

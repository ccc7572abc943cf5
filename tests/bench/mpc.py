"""`make bench-mpc`: the solver of predictive control, on problems of the product's own closed loop.

Steps and takeovers at 6, 20 and 60 spans with DAQP and, beside it, OSQP; how far either is from the exact solution;
lines of 3 to 20 spans that were drawn; and what a verdict on it takes beside one on LQI. Steps run without a limit of
time, takeovers with that of the line. Times are those of the processor, and of the quickest of three courses, which are
the same to the bit: other work on the computer changes them little. Writes out/bench/mpc.json.
"""

import argparse
import time
from dataclasses import dataclass, field, replace

import numpy as np

from gateway.cli.rehearse_designs import truth_of
from gateway.control.design import DesignRefused, DesignTask, design_lqi, design_mpc
from gateway.control.deviation import Measured
from gateway.control.law import Decision
from gateway.control.laws import untimed
from gateway.control.mpc import Mpc, MpcState
from gateway.control.reference import Reference
from gateway.control.rollout import Course, Setup, run_law
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.proposal import GainsChange
from gateway.core.signals import FloatArray
from gateway.loop.realtime import freeze_collector
from safety.judge import judge
from tests.bench.control_growth import Subject, subject
from tests.bench.control_plants import random_plant
from tests.bench.control_rollouts import course_of
from tests.bench.figures import LIBRARIES, Bench
from tests.bench.gate import prepared
from tests.bench.gate_contexts import payload_of
from tests.bench.gate_proposals import designed
from tests.independent.programme import exact

SPANS = (6, 20, 60)
REPEATED = 3  #: courses, of which each step's quickest counts
DRAWN = range(3, 21)  #: spans of the lines that are drawn, one of each
DRAWN_SEED = 71_000
VERDICTS = 10  #: of each kind
ENGAGED_EVERY = 3  #: of the samples that the loop has met
HEADS = ("spans", "solver", "p50, ms", "p99, ms", "worst, ms", "worst takeover, ms", "most active", "unsolved")
ACTIVE = 1e-6  #: Nm and N: a row this near its limit is active


@dataclass
class Timed:
    """A predictive law that keeps what it is asked and what asking takes."""

    law: Mpc
    processor_s: list[float] = field(default_factory=list[float])
    asked: list[tuple[Measured, Reference, FloatArray]] = field(default_factory=list)
    solved: list[tuple[FloatArray, ...]] = field(default_factory=list)  #: q, lower, upper and the solution
    unsolved: int = 0

    @property
    def n(self) -> int:
        return self.law.n

    def engage(self, measured: Measured, reference: Reference, applied_nm: FloatArray) -> MpcState:
        return self.law.engage(measured, reference, applied_nm)

    def ask(self, state: MpcState, measured: Measured, reference: Reference) -> Decision:
        kept = Measured(measured.tension_n.copy(), measured.speed_m_per_s.copy(), measured.unwind_speed_m_per_s)
        self.asked.append((kept, reference, state.applied_nm))
        processor_s = time.thread_time()
        decision = self.law.ask(state, measured, reference)
        self.processor_s.append(time.thread_time() - processor_s)
        self.unsolved += bool(decision.fallback)
        if not decision.fallback and decision.found is not None:
            vectors = self.law.problem.vectors(decision.found, reference.tension_n, state.applied_nm)
            self.solved.append((*vectors, decision.solution))
        return decision

    def commit(self, state: MpcState, decision: Decision, applied_nm: FloatArray) -> MpcState:
        return self.law.commit(state, decision, applied_nm)


def course(config: MpcConfig, one: Subject) -> Timed:
    """The law in its loop on the model of the task, with the noise and the limits of that."""
    task, law = one.task, Timed(Mpc(untimed_of(config)))
    setup = Setup(
        task.period_s, task.latency_s, 1, task.limits.torque_nm, task.limits.torque_rate_nm_per_s,
        task.noise.tension_n, task.noise.speed_m_per_s, seed=1,
    )  # fmt: skip
    whole: Course = course_of(one.case, task.period_s, one.case.duration_s)
    run_law(law, task.model, whole, setup, *setup.draw(whole.periods, task.n))
    return law


def untimed_of(config: MpcConfig) -> MpcConfig:
    found = untimed(config)
    assert isinstance(found, MpcConfig)
    return found


def repeated(config: MpcConfig, one: Subject) -> Timed:
    """The first of several courses, with each step's quickest time of all."""
    courses = [course(config, one) for _ in range(REPEATED)]
    first = courses[0]
    if any(
        a[3].tobytes() != b[3].tobytes() for law in courses[1:] for a, b in zip(first.solved, law.solved, strict=True)
    ):
        raise RuntimeError("the same course was solved otherwise")
    first.processor_s = np.min([law.processor_s for law in courses], axis=0).tolist()
    return first


def engagements(config: MpcConfig, asked: list[tuple[Measured, Reference, FloatArray]]) -> FloatArray:
    """Processor seconds (k,) of taking over, within the limit of time, at each of the samples that were met."""
    law, took_s = Mpc(config), np.full((REPEATED, len(asked)), np.inf)
    for k, (measured, reference, applied_nm) in enumerate(asked):
        for i in range(REPEATED):
            began_s = time.thread_time()
            state = law.engage(measured, reference, applied_nm)
            took_s[i, k] = time.thread_time() - began_s
            state.first = None
            law.commit(state, law.ask(state, measured, reference), applied_nm)
    return took_s.min(axis=0)


def apart_nm(law: Timed) -> tuple[float, int]:
    """The greatest difference of any torque of a plan to the exact solution; and the most rows that were active."""
    problem, apart, active = law.law.problem, 0.0, 0
    for q, lower, upper, solution in law.solved:
        z = exact(problem.P, q, problem.A, lower, upper, solution)
        apart = max(apart, float(np.abs(z - solution)[: problem.torque_variables].max()))
        rows = problem.A @ z
        active = max(active, int(np.count_nonzero((rows - lower < ACTIVE) | (upper - rows < ACTIVE))))
    return apart, active


def steps(bench: Bench, spans: tuple[int, ...]) -> None:
    rows: list[tuple[object, ...]] = []
    for n in spans:
        for solver in ("daqp", "osqp"):
            rows.append(_steps(bench, n, solver))
            print("  ", dict(zip(HEADS, rows[-1], strict=True)), flush=True)
    bench.tables["steps"] = {"heads": HEADS, "rows": rows}


def _steps(bench: Bench, n: int, solver: str) -> tuple[object, ...]:
    """Figures of one solver at one size, and its row."""
    one, suffix, most_active = subject(n), "" if solver == "daqp" else f"_{solver}", ""
    config = design_mpc(one.task).model_copy(update={"solver": solver})
    law = repeated(config, one)
    took, engaged = 1e3 * np.array(law.processor_s), 1e3 * engagements(config, law.asked[::ENGAGED_EVERY])
    for name, times in (("step", took), ("engage", engaged)):
        for q in (50, 99):
            bench.figure(f"{name}_{n}{suffix}_p{q}_ms", float(np.percentile(times, q)), "ms", len(times))
    if solver == "daqp":
        off_nm, most_active = apart_nm(law)
        bench.figure(f"off_{n}_nm", off_nm, "Nm", len(law.solved))
    worst = [f"{float(value):.3f}" for value in (*np.percentile(took, (50, 99)), took.max(), engaged.max())]
    return n, solver, *worst, most_active, law.unsolved


def drawn_lines(bench: Bench) -> None:
    """The worst step of any line, and of which."""
    rows, worst_ms = [], 0.0
    for n in DRAWN:
        one, plant = subject(n), random_plant(DRAWN_SEED + n, n)
        task: DesignTask = replace(one.task, model=truth_of(plant))
        try:
            law = course(design_mpc(task), replace(one, task=task))
        except DesignRefused as refused:
            rows.append((n, str(refused)[:80], ""))
            continue
        took = 1e3 * np.array(law.processor_s)
        worst_ms = max(worst_ms, float(took.max()))
        rows.append((n, f"{np.percentile(took, 99):.3f}", f"{took.max():.3f}"))
    bench.figure("lines_worst_step_ms", worst_ms, "ms", len(rows))
    bench.tables["lines"] = {"heads": ("spans", "p99, ms", "worst, ms"), "rows": rows}


def verdicts(bench: Bench) -> None:
    """On designs a little off the adapted one, for S_real with all that no model knows of."""
    line = prepared(0)
    if isinstance(line, str):
        raise SystemExit(f"there is no line to judge for: {line}")
    given, context, generator = line.given, line.contexts["plain"], np.random.default_rng(0)
    made: dict[str, list[Controller]] = {
        "mpc": [designed(given.task, "mpc", generator, 1.3) for _ in range(VERDICTS)],
        "lqi": [design_lqi(given.task)] * VERDICTS,
    }
    for kind, configs in made.items():
        took_s: list[float] = []
        for seed, config in enumerate([configs[0], *configs]):
            payload = payload_of(GainsChange(controller=config), context, given.line)
            began_s = time.process_time()
            judge(payload, context, given.line, line.recordings("plain"), seed)
            took_s.append(time.process_time() - began_s)
        for q in (50, 99):  # the first is for caches and compiled code
            bench.figure(f"verdict_{kind}_p{q}_s", float(np.percentile(took_s[1:], q)), "s", len(configs))


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench-mpc", description=__doc__)
    parser.add_argument("--spans", default=",".join(map(str, SPANS)), help="of the lines whose steps are told")
    spans = tuple(int(n) for n in parser.parse_args().spans.split(","))
    whole = spans == SPANS
    bench = Bench(
        "mpc" if whole else "mpc-part", [0, 1, DRAWN_SEED], goals_of="mpc", libraries=(*LIBRARIES, "daqp", "osqp")
    )
    freeze_collector()
    told = 0
    for measure in (lambda b: steps(b, spans), drawn_lines, verdicts):
        measure(bench)
        told = bench.so_far(told)
    bench.finish()


if __name__ == "__main__":
    main()

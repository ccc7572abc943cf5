"""Drives that are not what they say: in another mode of operation, or with a watchdog that takes no torque away."""

import numpy as np

from gateway.core.messages import Drill, Reply
from gateway.core.states import Phase
from sim_plant.faults.parse import parse_fault
from tests.bench.faults_lines import virtual_line
from tests.bench.harm_runs import AT_MOST_S, NEVER_S, NotStarted, Outcome
from tests.bench.lines import WIRINGS
from tests.closed_loop.virtual_line import VirtualLine

OTHER_MODES = (-1, 0, 1, 2, 3, 6, 7, 8, 9)  #: of CiA 402: those that give no torque that they are told
READY_S = 1.0  #: in which a drive that tells its mode is found out
SAYS = ("ignores", "follows")
#: What is told of a drive, and of the line PLC, by fault.
DEAD_WATCHDOGS = {
    "watchdog-dead": ("watchdog-ignored", "watchdog-ignored"),
    "watchdog-warns": ("watchdog-only-warns", "watchdog-keeps-transport"),
}


def wrong_mode(row: str, seed: int) -> Outcome:
    """A drive is in another mode of operation for good, on real wires: from READY on, or from somewhere in the start.

    Where no device tells its mode, READY says nothing of it: the line is started, and the time counts from there. In
    stepped time no drive tells it: there it is a drive that gives no torque, the row mode-lost.
    """
    dice = np.random.default_rng([seed, 37])
    mode, says, begins = int(dice.choice(OTHER_MODES)), str(dice.choice(SAYS)), bool(dice.integers(2))
    with virtual_line(str(dice.choice(list(WIRINGS))), seed) as line:
        line.step(5)
        for reply in (line.arm(), *([line.start()] if begins else [])):
            _require(reply)
        if begins:
            if not line.step_until(Phase.TENSIONING, AT_MOST_S):
                raise NotStarted(line.cycle.machine.reason)
            line.step(int(dice.integers(1, 200)))
        roller, known = int(dice.integers(1, line.line.n + 1)), len(line.findings)
        before = dict(line.truth.recorder.unsafe_events)
        _inject(line, f"drive {roller} mode-lost mode={mode} says={says}")
        at_s, found_s, rest_s, machine = line.now_s, NEVER_S, NEVER_S, line.cycle.machine
        while line.now_s - at_s < AT_MOST_S and rest_s == NEVER_S:
            line.step()
            machine = line.cycle.machine
            if found_s == NEVER_S and (len(line.findings) > known or machine.phase is Phase.OFF):
                found_s = line.now_s - at_s
            if machine.phase is Phase.OFF and not line.truth.world.torque_nm.any():
                rest_s = line.now_s - at_s
            if machine.phase is Phase.READY and line.now_s - at_s >= READY_S:
                _require(line.start())
                at_s = line.now_s
        now = line.truth.recorder.unsafe_events
        unsafe = {kind: now[kind] - before[kind] for kind in now if kind != "torque-rate" and now[kind] > before[kind]}
        code = line.findings[known].rule if len(line.findings) > known else machine.reason.partition(":")[0]
        return Outcome(row, seed, unsafe, code, found_s, rest_s, 0.0, machine.reason[:300])


def drill_of_dead_watchdog(row: str, seed: int) -> Outcome:
    """A device that takes its deadline and ignores it, or only warns, on real wires, drilled.

    It must be named, and nothing else.
    """
    dice = np.random.default_rng([seed, 38])
    wiring, watchdog_s = str(dice.choice(list(WIRINGS))), float(dice.uniform(0.03, 0.2))
    with virtual_line(wiring, seed, watchdog_s=watchdog_s) as line:
        roller = int(dice.integers(0, line.line.n + 1))  # 0: the line PLC
        names = {drive.roller: drive.name for drive in line.line.drives} | {0: line.line.plc.name}
        fault = str(dice.choice(list(DEAD_WATCHDOGS)))
        _inject(line, f"{f'drive {roller}' if roller else 'plc'} {fault}")
        line.step(5)
        begun_s = line.now_s
        reply = line.command(Drill())
        found_s = line.now_s - begun_s
        line.step(3)
        unsafe = {kind: count for kind, count in line.truth.recorder.unsafe_events.items() if count}
    told = [(each.code, each.parameters.get("device")) for each in reply.findings]
    wanted = DEAD_WATCHDOGS[fault][roller == 0]
    named = not reply.ok and told == [(wanted, names[roller])]
    code = wanted if named else f"not named: {told}"
    note = f"{wiring}, {names[roller]}, {fault}, {1e3 * watchdog_s:.0f} ms: {reply.text}"
    return Outcome(row, seed, unsafe, code, found_s if named else NEVER_S, NEVER_S, 0.0, note[:300])


def _require(reply: Reply) -> None:
    """Raises NotStarted."""
    if not reply.ok:
        raise NotStarted("; ".join([reply.text, *reply.reasons]))


def _inject(line: VirtualLine, fault: str) -> None:
    line.truth.faults.injector.add(parse_fault(fault), line.truth.faults.now_s())

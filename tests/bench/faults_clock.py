"""The wall clock is set while the line runs: nobody in the loop may look at it."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

import numpy as np

import drivers
import gateway.loop
import safety
from gateway.core.states import Phase
from tests.bench.faults_seen import Injection
from tests.closed_loop.virtual_line import VirtualLine

OURS = tuple(str(Path(package.__path__[0])) for package in (drivers, gateway.loop, safety))
BEFORE, AFTER = 20, 60  #: periods


def wall_clock(number: int) -> Injection:
    """The same line twice, once with a clock that jumps: the same commands, to the bit."""
    dice = Random(f"wall-clock/{number}")
    jump_s = dice.choice((-1, 1)) * 10 ** dice.uniform(-1.0, 8.0)
    plain, readers, safe = _commands(number, 0.0)
    jumped, jumped_readers, still_safe = _commands(number, jump_s)
    same = np.array_equal(plain, jumped) and len(plain) > 0 and safe == still_safe
    readers |= jumped_readers
    reaction = "nothing" if same and not readers else "changed"
    unsafe = {"any": still_safe} if still_safe else {}
    return Injection("wall-clock", "set", reaction, None, None, None, unsafe, f"by {jump_s:.3g} s, read by {readers}")


def _commands(seed: int, jump_s: float) -> tuple[np.ndarray, set[str], int]:
    """All torques that the drives were told, who of us read the wall clock, and the unsafe events."""
    with VirtualLine(seed=1 + seed) as line, _wall_clock() as (readers, jump):
        line.begin_in_production()
        line.step(BEFORE)
        jump(jump_s)
        line.step(AFTER)
        assert line.cycle.machine.phase is Phase.RUNNING
        told = [event["target_torque_nm"] for event in line.recording().of_kind("command")]
        return np.array(told), readers, line.truth.recorder.unsafe_total


@contextmanager
def _wall_clock() -> Iterator[tuple[set[str], Callable[[float], None]]]:
    """Who in the loop, its drivers or its rules reads the wall clock; and a way to set it."""
    readers: set[str] = set()
    ahead_s = 0.0
    real, real_ns = time.time, time.time_ns

    def jump(by_s: float) -> None:
        nonlocal ahead_s
        ahead_s += by_s

    def note() -> None:
        caller = sys._getframe(2).f_code.co_filename  # noqa: SLF001
        if caller.startswith(OURS):
            readers.add(Path(caller).name)

    def wall_s() -> float:
        note()
        return real() + ahead_s

    def wall_ns() -> int:
        note()
        return real_ns() + round(ahead_s * 1e9)

    time.time, time.time_ns = wall_s, wall_ns
    try:
        yield readers, jump
    finally:
        time.time, time.time_ns = real, real_ns

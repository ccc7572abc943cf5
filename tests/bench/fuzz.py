"""`make bench-fuzz`: frames that no device sends, through every decoder.

Each target gets the same number of frames: a fifth are sound, the others are mutants of sound ones, or noise; seeded.
It may refuse a frame in the way that its docstring says, and nothing else; what it accepts must be what an oracle of
its own reads from the same bytes. A frame that breaks either is kept in the result.

ARGS="--frames 100000" sends fewer.
"""

import argparse
import asyncio
import inspect
import os
import signal
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from random import Random
from typing import Any

from rich.progress import Progress

from tests.bench import fuzz_canopen, fuzz_messages, fuzz_modbus, fuzz_opcua, fuzz_sim
from tests.bench.figures import Bench
from tests.bench.fuzz_bytes import mutate
from tests.bench.fuzz_canopen import AtOnceLoop

FRAMES = 1_000_000
CHUNK = 50_000  #: frames of one task
SEED = 1
KEPT = 10  #: frames of each target that broke something
PATIENCE_S = 0.5  #: of processor time, for one frame; a decoder that takes longer hangs
MOST_HANGS = 50  #: of one task; the rest of its frames is not sent
#: Every target gets all the frames.
TARGETS: tuple[Callable[[], Any], ...] = (
    fuzz_canopen.DriveTpdo,
    fuzz_canopen.CellTpdo,
    fuzz_canopen.PlcTpdo,
    fuzz_canopen.Heartbeat,
    fuzz_canopen.Emergency,
    fuzz_canopen.SdoAnswer,
    fuzz_modbus.ClientAnswer,
    fuzz_modbus.CellRegisters,
    fuzz_modbus.DriveRegisters,
    fuzz_modbus.PlcRegisters,
    fuzz_opcua.EngineAnswer,
    fuzz_opcua.CellReadings,
    fuzz_messages.OpcUaAnswer,
    fuzz_messages.OpcUaQuestion,
    fuzz_messages.Telemetry,
    fuzz_messages.Mail,
    fuzz_sim.SimModbus,
    fuzz_sim.SimCanopen,
)


class Hangs(BaseException):
    """A frame keeps a decoder busy. No Exception: what catches those must not catch this."""


@dataclass
class Found:
    """What came of the frames of a target."""

    name: str
    frames: int = 0
    accepted: int = 0
    refused: int = 0
    uncaught: int = 0
    hung: int = 0
    wrong: int = 0  #: accepted and not what the oracle reads, or sound and refused
    busy_s: float = 0.0
    broken: list[str] = field(default_factory=list[str])

    def add(self, other: "Found") -> None:
        for name in ("frames", "accepted", "refused", "uncaught", "hung", "wrong", "busy_s"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.broken = (self.broken + other.broken)[:KEPT]


def task(number: int, seed: int, frames: int) -> Found:
    """So many frames for a target, in a worker process."""
    warnings.simplefilter("error")
    signal.signal(signal.SIGVTALRM, _ring)
    with asyncio.Runner(loop_factory=AtOnceLoop) as runner:
        target = TARGETS[number]()
        return runner.run(_feed(target, Random(seed), frames))


async def _feed(target: Any, dice: Random, frames: int) -> Found:
    found = Found(target.name)
    waits = inspect.iscoroutinefunction(target.check)
    began_s = time.perf_counter()
    while found.frames < frames and found.hung < MOST_HANGS:
        data = mutate(target.valid(dice), dice)
        found.frames += 1
        signal.setitimer(signal.ITIMER_VIRTUAL, PATIENCE_S)
        try:
            verdict = await target.check(data) if waits else target.check(data)
        except Hangs:
            found.hung += 1
            found.broken.append(f"{data.hex()}: hangs")
            target = type(target)()  # nobody knows what state it was left in
        except AssertionError as wrong:
            found.wrong += 1
            found.broken.append(f"{data.hex()}: {wrong}")
        except Exception as error:  # anything but the refusal that the target knows
            found.uncaught += 1
            found.broken.append(f"{data.hex()}: {type(error).__name__}: {error}")
        else:
            found.accepted += verdict == fuzz_canopen.ACCEPTED
            found.refused += verdict == fuzz_canopen.REFUSED
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
    found.busy_s = time.perf_counter() - began_s
    found.broken = found.broken[:KEPT]
    return found


def _ring(number: int, frame: object) -> None:
    raise Hangs


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench-fuzz", description="Frames that no device sends.")
    parser.add_argument("--frames", type=int, default=FRAMES, help="for each target; the slow ones get fewer")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    arguments = parser.parse_args()
    found = _run(arguments.frames, arguments.workers)
    bench = Bench("fuzz", [SEED])
    frames = sum(of.frames for of in found)
    bench.figure("uncaught_exceptions", sum(of.uncaught for of in found), "", frames)
    bench.figure("hangs", sum(of.hung for of in found), "", frames)
    bench.figure("wrong_verdicts", sum(of.wrong for of in found), "", frames)
    bench.figure("frames", frames, "", frames)
    bench.tables["targets"] = [
        {"target": of.name, "frames": of.frames, "accepted": of.accepted, "refused": of.refused,
         "uncaught": of.uncaught, "hung": of.hung, "wrong": of.wrong, "frames_per_s": round(of.frames / of.busy_s)}
        for of in found
    ]  # fmt: skip
    bench.tables["broken"] = {of.name: of.broken for of in found if of.broken}
    print(
        f"{'target':<28}{'frames':>9}{'accepted':>10}{'refused':>10}{'uncaught':>9}{'hung':>6}{'wrong':>7}{'frames/s':>10}"
    )
    for row in bench.tables["targets"]:
        name, frames, *counts, rate = row.values()
        accepted, refused, uncaught, hung, wrong = counts
        print(f"{name:<28}{frames:>9}{accepted:>10}{refused:>10}{uncaught:>9}{hung:>6}{wrong:>7}{rate:>10}")
    for name, broken in bench.tables["broken"].items():
        print(f"{name}:\n    " + "\n    ".join(broken[:3]))
    bench.finish()


def _run(frames: int, workers: int) -> list[Found]:
    found = {number: Found("") for number in range(len(TARGETS))}
    with Progress() as progress, ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        work = {
            pool.submit(task, number, SEED + 1000 * number + k, size): (number, size)
            for number in range(len(TARGETS))
            for k, size in enumerate(_sizes(frames))
        }
        bar = progress.add_task("frames", total=sum(size for _, size in work.values()))
        for done in as_completed(work):
            number, size = work[done]
            found[number].name = done.result().name
            found[number].add(done.result())
            progress.advance(bar, size)
    return list(found.values())


def _sizes(frames: int) -> list[int]:
    whole, rest = divmod(frames, CHUNK)
    return [CHUNK] * whole + ([rest] if rest else [])


if __name__ == "__main__":
    main()

"""How late the loop's timer would be on this computer: measured as the loop would run, in a process of its own.

    python -m gateway.cli.doctor_jitter PERIOD_S SECONDS CPU PRIORITY

takes the loop's own pacer and real-time settings, measures, and prints one JSON document. CPU is "-" for the default.
"""

import asyncio
import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

from gateway.cli.doctor_check import Check
from gateway.core.line import Line

GOOD_SHARE, POOR_SHARE = 0.05, 0.20  #: of the period, of the 99th percentile: OK below the one, FAIL from the other
LEAST_TICKS = 20
PATIENCE_S = 20.0  #: beyond the measurement
RULE = f"p99 below {GOOD_SHARE:.0%} of the period (warning below {POOR_SHARE:.0%}), no period skipped"
_GROUP = "real time"


@dataclass(frozen=True, slots=True)
class Punctuality:
    """What the process was granted, and how late its ticks were."""

    fifo_priority: int  #: 0: none was granted
    processors: list[int]
    locked_kb: int
    refused: list[str]
    sleepy: str  #: why processors may sleep between periods, or nothing
    ticks: int
    skipped: int  #: periods that went by unused
    p50_s: float
    p99_s: float
    max_s: float


class MeasurementFailed(Exception):
    """The measuring process did not give an answer; the text says why."""


async def measure(line: Line, seconds: float) -> Punctuality:
    """Run the measurement in a process of its own. Raises MeasurementFailed."""
    control = line.control
    cpu = "-" if control.cpu is None else str(control.cpu)
    measured_s = max(seconds, LEAST_TICKS * control.period_s)
    child = await asyncio.create_subprocess_exec(
        sys.executable,
        *("-m", "gateway.cli.doctor_jitter", str(control.period_s), str(measured_s), cpu, str(control.priority)),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        async with asyncio.timeout(measured_s + PATIENCE_S):
            told, complaints = await child.communicate()
    except TimeoutError as error:
        raise MeasurementFailed(f"no answer within {measured_s + PATIENCE_S:g} s") from error
    finally:
        if child.returncode is None:
            child.kill()
            await child.wait()
    try:
        return Punctuality(**json.loads(told))
    except (ValueError, TypeError) as error:
        last = complaints.decode(errors="replace").strip().rpartition("\n")[2]
        raise MeasurementFailed(last or f"it ended with code {child.returncode}") from error


def judged(line: Line, found: Punctuality) -> Iterator[Check]:
    """What was granted, and the lateness."""
    yield from _granted(line, found)
    yield lateness_check(
        _GROUP, line.control.period_s, (found.p50_s, found.p99_s, found.max_s), found.skipped, found.ticks
    )


def lateness_check(
    group: str, period_s: float, p50_p99_max_s: tuple[float, float, float], skipped: int, ticks: int
) -> Check:
    """The verdict on lateness, by RULE."""
    p50_s, p99_s, max_s = p50_p99_max_s
    share = p99_s / period_s
    measured = (
        f"p50 {1e3 * p50_s:.3f}, p99 {1e3 * p99_s:.3f}, max {1e3 * max_s:.3f} ms of {1e3 * period_s:g} ms "
        f"({share:.1%} at p99), {skipped} of {ticks} periods skipped"
    )
    todo = "real-time priority, a processor of its own (isolcpus), governor performance, fewer other programs"
    if skipped or share >= POOR_SHARE:
        return Check(group, "lateness", "", "FAIL", measured, RULE, todo)
    if share >= GOOD_SHARE:
        return Check(group, "lateness", "", "warning", measured, RULE, todo)
    return Check(group, "lateness", "", "OK", measured, RULE)


def _granted(line: Line, found: Punctuality) -> Iterator[Check]:
    control, refused = line.control, "; ".join(found.refused)
    wanted = f"SCHED_FIFO {control.priority}"
    if found.fifo_priority == control.priority:
        yield Check(_GROUP, "priority", "", "OK", f"SCHED_FIFO {found.fifo_priority} granted", wanted)
    else:
        todo = "run as the service does (LimitRTPRIO=), or raise rtprio in /etc/security/limits.d"
        yield Check(_GROUP, "priority", "", "warning", refused or "not granted", wanted, todo)
    place = "the last one" if control.cpu is None else f"processor {control.cpu}"
    pinned = len(found.processors) == 1
    if pinned:
        yield Check(_GROUP, "processor", "", "OK", f"pinned to processor {found.processors[0]}", place)
    else:
        todo = "it is pinned once real-time priority is granted" if not found.fifo_priority else refused
        yield Check(_GROUP, "processor", "", "warning", f"not pinned, may run on {found.processors}", place, todo)
    if found.locked_kb:
        yield Check(_GROUP, "memory", "", "OK", f"{found.locked_kb / 1e3:.0f} MB locked", "locked")
    else:
        todo = "run as the service does (LimitMEMLOCK=), or raise memlock in /etc/security/limits.d"
        yield Check(_GROUP, "memory", "", "warning", f"not locked{_memory_limit()}", "locked", todo)

    if not found.sleepy:
        yield Check(_GROUP, "sleep states", "", "OK", "processors stay awake", "awake")
    else:
        todo = "let the service's user write there (a udev rule, or a group), or forbid deep states in the BIOS"
        yield Check(_GROUP, "sleep states", "", "warning", found.sleepy, "awake", todo)


def _memory_limit() -> str:
    import resource

    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return "" if limit == resource.RLIM_INFINITY else f" (limit {limit / 1e6:.1f} MB)"


# the measuring process


async def _measure_here(period_s: float, seconds: float, cpu: int | None, priority: int) -> Punctuality:
    from gateway.loop.pacer import TimerPacer
    from gateway.loop.realtime import become_punctual, freeze_collector, stay_awake

    late_s: list[float] = []
    skipped = 0
    freeze_collector()
    _, refused = become_punctual(cpu, priority)
    sleepy = stay_awake()
    fifo = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    given = os.sched_getparam(0).sched_priority if fifo else 0
    processors = sorted(os.sched_getaffinity(0))
    locked_kb = _locked_kb()
    pacer = TimerPacer(period_s)
    try:
        await pacer.wait()  # what the start has cost is not the timer's
        for _ in range(max(LEAST_TICKS, round(seconds / period_s))):
            tick = await pacer.wait()
            late_s.append(tick.now_s - tick.due_s)
            skipped += tick.skipped
    finally:
        pacer.close()
        if fifo:  # what follows is no loop's work
            os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    p50_s, p99_s = percentiles(late_s, (0.5, 0.99))
    return Punctuality(given, processors, locked_kb, refused, sleepy, len(late_s), skipped, p50_s, p99_s, max(late_s))


def percentiles(values: Sequence[float], shares: tuple[float, float]) -> tuple[float, float]:
    """The values below which such shares of all lie."""
    ordered = sorted(values)
    first, second = (ordered[min(len(ordered) - 1, int(share * len(ordered)))] for share in shares)
    return first, second


def _locked_kb() -> int:
    with open("/proc/self/status", encoding="ascii") as status:
        return next((int(row.split()[1]) for row in status if row.startswith("VmLck:")), 0)


def main(arguments: Sequence[str]) -> None:
    period_s, seconds, cpu, priority = arguments
    try:
        found = asyncio.run(
            _measure_here(float(period_s), float(seconds), None if cpu == "-" else int(cpu), int(priority))
        )
    except KeyboardInterrupt:  # whoever started it has been interrupted, too
        sys.exit(1)
    print(json.dumps(asdict(found)))


if __name__ == "__main__":
    main(sys.argv[1:])

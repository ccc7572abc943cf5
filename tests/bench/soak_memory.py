"""Memory of a line's processes while it runs: by process, per hour, per fault, and with nothing going wrong.

What is looked at is RssAnon of /proc/PID/status: pages that are resident and the process's own. Files that are mapped
(libraries, SQLite's shared memory) come and go with the page cache and are nobody's growth.

Slopes are those of Theil and Sen (the median of the slopes of all pairs of samples, which one restart of a device or
one step of the allocator does not move), with their 95 % interval. What a process grows by while it warms up is in a
table of its own, and in no slope: SQLite fills its page cache for some seven minutes, the loop's windows fill within
one, and CPython fills its stocks of empty tuples, 2,000 of each size, over the first 60 faults.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import nan
from pathlib import Path

from scipy.stats import theilslopes

from tests.bench.figures import Bench

HOUR_S = 3600.0
KB_PER_MB = 1024.0
#: Children that count for themselves: the OPC UA worker with its spawner, and whoever judges proposals.
BELOW = {"loop": "worker", "gateway": "judges"}


@dataclass(frozen=True, slots=True)
class Sample:
    """A look at the processes."""

    time_s: float  #: monotonic
    faults: int  #: so far
    anon_kb: dict[str, int]
    descriptors: dict[str, int]
    threads: dict[str, int]


def take_sample(pids: Mapping[str, int], time_s: float, faults: int) -> Sample:
    """`pids`: of the processes that were started, by name; those that they have started are found."""
    families: dict[str, list[int]] = {}
    for name, pid in pids.items():
        first, *others = _family(pid)
        below = BELOW.get(name, name)
        families.setdefault(name, []).append(first)
        if others:
            families.setdefault(below, []).extend(others)
    return Sample(
        time_s,
        faults,
        {name: sum(_status(pid, "RssAnon") for pid in family) for name, family in families.items()},
        {name: sum(_descriptors(pid) for pid in family) for name, family in families.items()},
        {name: sum(_status(pid, "Threads") for pid in family) for name, family in families.items()},
    )


def memory_figures(bench: Bench, rest: Sequence[Sample], broken: Sequence[Sample]) -> None:
    """Slopes of each process: `rest` with nothing going wrong, `broken` with faults. Both without their warm-up."""
    for name in rest[0].anon_kb:
        quiet, per_hour, per_fault = _per_hour(rest, name), _per_hour(broken, name), _per_fault(broken, name)
        bench.figure(f"{name}_rest_mb_per_h", quiet[0], "MB/h", len(rest))
        bench.figure(f"{name}_mb_per_h", per_hour[0], "MB/h", len(broken))
        bench.figure(f"{name}_kb_per_fault", per_fault[0], "kB", broken[-1].faults - broken[0].faults)
        bench.tables[f"{name} memory"] = {
            "rest_95_mb_per_h": list(quiet[1:]), "slope_95_mb_per_h": list(per_hour[1:]),
            "fault_95_kb": list(per_fault[1:]), "rss_anon_mb": broken[-1].anon_kb[name] / KB_PER_MB,
            "descriptors": broken[-1].descriptors[name], "threads": broken[-1].threads[name],
        }  # fmt: skip


def grown_kb(samples: Sequence[Sample]) -> dict[str, int]:
    """By process, from the first sample to the last."""
    return {name: samples[-1].anon_kb[name] - first_kb for name, first_kb in samples[0].anon_kb.items()}


def most_descriptors(samples: Iterable[Sample]) -> int:
    """Of all processes together."""
    return max(sum(sample.descriptors.values()) for sample in samples)


def _per_hour(samples: Sequence[Sample], name: str) -> tuple[float, float, float]:
    return slope(
        [sample.time_s / HOUR_S for sample in samples], [sample.anon_kb[name] / KB_PER_MB for sample in samples]
    )


def _per_fault(samples: Sequence[Sample], name: str) -> tuple[float, float, float]:
    return slope([float(sample.faults) for sample in samples], [float(sample.anon_kb[name]) for sample in samples])


def slope(x: Sequence[float], y: Sequence[float]) -> tuple[float, float, float]:
    """Of `y` over `x`, and the ends of the 95 % interval. NaN when all `x` are the same: nothing was measured."""
    if len(set(x)) < 2:
        return nan, nan, nan
    found, _, low, high = theilslopes(y, x, 0.95)
    return float(found), float(low), float(high)


def _family(pid: int) -> list[int]:
    """A process and all below it."""
    family = [pid]
    for member in family:
        for task in Path(f"/proc/{member}/task").glob("*/children"):
            with suppress(OSError):
                family += [int(child) for child in task.read_text().split()]
    return family


def _status(pid: int, key: str) -> int:
    """A number of /proc/PID/status; 0 of a process that has just gone."""
    with suppress(OSError):
        for row in Path(f"/proc/{pid}/status").read_text().splitlines():
            if row.startswith(key + ":"):
                return int(row.split()[1])
    return 0


def _descriptors(pid: int) -> int:
    with suppress(OSError):
        return len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return 0

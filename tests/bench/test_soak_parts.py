"""What the soak makes of memory: slopes that a step does not move, and whose memory it is."""

import os
import subprocess
import sys
from math import isnan

import pytest

from tests.bench.figures import Bench
from tests.bench.soak_memory import Sample, grown_kb, memory_figures, slope, take_sample

#: Starts a child, says so, and ends it at the end of its input.
PARENT = """
import subprocess, sys
child = subprocess.Popen(["sleep", "60"])
print("up", flush=True)
sys.stdin.read()
child.kill()
child.wait()
"""


def sample(time_s: float, faults: int, anon_kb: int) -> Sample:
    return Sample(time_s, faults, {"loop": anon_kb}, {"loop": 9}, {"loop": 2})


def test_one_step_does_not_move_a_slope() -> None:
    hours = [k / 10 for k in range(11)]
    assert slope(hours, [2.0 * hour for hour in hours])[0] == pytest.approx(2.0)
    assert slope(hours, [100.0 * (hour > 0.85) for hour in hours])[0] == 0.0


def test_without_a_fault_there_is_no_slope_per_fault() -> None:
    assert all(map(isnan, slope([0.0, 0.0], [1.0, 2.0])))


def test_growth_is_told_per_hour_per_fault_and_at_rest() -> None:
    rest = [sample(60.0 * k, 0, 50_000) for k in range(10)]
    broken = [sample(60.0 * k, 3 * k, 50_000 + 6 * k) for k in range(10)]
    bench = Bench("soak-part")
    memory_figures(bench, rest, broken)
    found = {figure.name: figure.value for figure in bench.figures}
    assert found["loop_rest_mb_per_h"] == 0.0
    assert found["loop_mb_per_h"] == pytest.approx(60 * 6 / 1024)
    assert found["loop_kb_per_fault"] == pytest.approx(2.0)
    assert grown_kb(broken) == {"loop": 54}


def test_children_of_the_loop_count_for_themselves() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "up\n"
        found = take_sample({"loop": parent.pid, "sim": os.getpid()}, 1.0, 2)
        assert set(found.anon_kb) == {"loop", "worker", "sim"}
        assert found.anon_kb["loop"] > found.anon_kb["worker"] > 0
        assert (found.threads["loop"], found.threads["worker"], found.faults) == (1, 1, 2)
        parent.communicate("")
